// SPDX-License-Identifier: Apache-2.0
// A quadcopter's rigid body, motors and battery. Body frame x forward, y left, z up; world z up. Motors in
// Betaflight's order: rear right, front right, rear left, front left. SI units. All fields are doubles, in the
// order in which firmware/body.py packs them.
#pragma once
#include <stdint.h>

#define STEP_S 125e-6  // of integration, and between two samples of the gyro

typedef struct {
    double mass, gravity, inertia[3];
    double arm_x, arm_y;             // of the motors, from the middle of the frame
    double center[2];                // of mass, x and y, from there
    double tilt[2];                  // of all motors' thrust towards x and y, rad
    double max_thrust;               // N, of one motor at full command and full_v
    double health[4];                // factor on each motor's thrust
    double linear;                   // share of thrust that is linear in the command; the rest is quadratic
    double blend_up, blend_down;     // of the motors' lag, per step
    double torque;                   // N m of yaw per N of thrust
    double rotor_inertia;            // N m s of yaw per change of the normalised speed
    double spin;                     // 1, or -1 where the firmware has yaw_motors_reversed
    double linear_drag[3], quadratic_drag[3];  // N s/m, N s^2/m^2, body axes
    double rotor_drag, lift;         // s/m; gain of thrust in fast edgewise flight
    double full_v, volt_exponent;    // thrust grows with (V / full_v) ** volt_exponent
    double drain;                    // V/s
    double resistance, full_current; // ohm; A of all motors at full speed
    double gyro_noise, acc_noise;    // rad/s, m/s^2, of every sample
} Body;

typedef struct {
    double p[3], v[3], a[3], q[4], w[3];  // a: mean acceleration since the last report
    double speed[4];                 // of the motors; thrust is speed^2 * max_thrust
    double open_v, loaded_v;         // of the battery
    double f[3];                     // specific force, body
    uint64_t noise;                  // state of the noise
} BodyState;

void body_step(const Body *body, BodyState *state, const float *pwm, int is_held);
double body_noise(BodyState *state);  // of mean 0 and variance 1
