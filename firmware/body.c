// SPDX-License-Identifier: Apache-2.0
// The same bits on every x86-64: no function of libm but sqrt, and no contraction (firmware/building.py).
#include "body.h"
#include <math.h>
#include <string.h>

#define EDGEWISE 49.0  // m^2/s^2, at which translational lift is half of its most
static const double SIDE_X[4] = {-1, 1, -1, 1}, SIDE_Y[4] = {-1, -1, 1, 1}, YAW[4] = {1, -1, -1, 1};

// x ** n of an x in 0.3 to 3: exp(n * log(x)) by series.
static double power(double x, double n)
{
    double t = (x - 1) / (x + 1), square = t * t, term = t, log = 0;
    for (int k = 1; k < 60; k += 2, term *= square) log += 2 * term / k;
    double y = n * log / 8, sum = 1, part = 1;  // an eighth: the series is short
    for (int k = 1; k < 14; k++) sum += part *= y / k;
    sum *= sum; sum *= sum;
    return sum * sum;
}

static void axes_of(const double *q, double R[3][3])
{
    double w = q[0], x = q[1], y = q[2], z = q[3];
    R[0][0] = 1 - 2 * (y * y + z * z); R[0][1] = 2 * (x * y - w * z); R[0][2] = 2 * (x * z + w * y);
    R[1][0] = 2 * (x * y + w * z); R[1][1] = 1 - 2 * (x * x + z * z); R[1][2] = 2 * (y * z - w * x);
    R[2][0] = 2 * (x * z - w * y); R[2][1] = 2 * (y * z + w * x); R[2][2] = 1 - 2 * (x * x + y * y);
}

static double steady_speed(const Body *b, float pwm, double volt_factor)
{
    double c = (pwm - 1000.0) / 1000.0;
    c = c < 0 ? 0 : c > 1 ? 1 : c;
    return sqrt((b->linear * c + (1 - b->linear) * c * c) * volt_factor);
}

static void load_battery(const Body *b, BodyState *s)
{
    double current = 0;
    for (int k = 0; k < 4; k++) current += b->full_current / 4 * s->speed[k] * s->speed[k] * s->speed[k];
    s->loaded_v = s->open_v - b->resistance * current;
}

static double volt_factor(const Body *b, const BodyState *s)
{
    double share = s->loaded_v / b->full_v;
    return power(share < 0.3 ? 0.3 : share > 3 ? 3 : share, b->volt_exponent);
}

// Turn the motors for a step; return thrust, N, and torque, N m.
static double turn_motors(const Body *b, BodyState *s, const float *pwm, double torque[3])
{
    double thrust = 0, factor = volt_factor(b, s);
    torque[0] = torque[1] = torque[2] = 0;
    for (int k = 0; k < 4; k++) {
        double to = steady_speed(b, pwm[k], factor);
        double change = (to - s->speed[k]) * (to > s->speed[k] ? b->blend_up : b->blend_down);
        s->speed[k] += change;
        double one = b->health[k] * b->max_thrust * s->speed[k] * s->speed[k];
        thrust += one;
        torque[0] += (SIDE_Y[k] * b->arm_y - b->center[1]) * one;   // left rotors: positive roll
        torque[1] -= (SIDE_X[k] * b->arm_x - b->center[0]) * one;   // rear rotors: positive pitch, nose down
        torque[2] += b->spin * YAW[k] * (b->torque * one + b->rotor_inertia * change / STEP_S);
    }
    load_battery(b, s);
    return thrust;
}

static void turn_body(const Body *b, BodyState *s, const double torque[3])
{
    double *w = s->w, dw[3], mid[3], q[4];
    const double *J = b->inertia;
    dw[0] = (torque[0] - (J[2] - J[1]) * w[1] * w[2]) / J[0];
    dw[1] = (torque[1] - (J[0] - J[2]) * w[2] * w[0]) / J[1];
    dw[2] = (torque[2] - (J[1] - J[0]) * w[0] * w[1]) / J[2];
    for (int k = 0; k < 3; k++) { mid[k] = w[k] + 0.5 * dw[k] * STEP_S; w[k] += dw[k] * STEP_S; }
    // The exponential map of a small angle h = |mid| dt / 2: cos(h) and sin(h) / h by series.
    double h2 = 0.25 * STEP_S * STEP_S * (mid[0] * mid[0] + mid[1] * mid[1] + mid[2] * mid[2]);
    double c = 1 - h2 / 2 * (1 - h2 / 12 * (1 - h2 / 30));
    double si = 0.5 * STEP_S * (1 - h2 / 6 * (1 - h2 / 20 * (1 - h2 / 42)));
    double x = si * mid[0], y = si * mid[1], z = si * mid[2];
    memcpy(q, s->q, sizeof q);
    s->q[0] = q[0] * c - q[1] * x - q[2] * y - q[3] * z;
    s->q[1] = q[0] * x + q[1] * c + q[2] * z - q[3] * y;
    s->q[2] = q[0] * y - q[1] * z + q[2] * c + q[3] * x;
    s->q[3] = q[0] * z + q[1] * y - q[2] * x + q[3] * c;
    double norm = sqrt(s->q[0] * s->q[0] + s->q[1] * s->q[1] + s->q[2] * s->q[2] + s->q[3] * s->q[3]);
    for (int k = 0; k < 4; k++) s->q[k] /= norm;
}

// One step. is_held: the body stays where it is and as fast, level as its accelerometer goes; motors turn.
void body_step(const Body *b, BodyState *s, const float *pwm, int is_held)
{
    double torque[3], R[3][3], air[3], a;
    double thrust = turn_motors(b, s, pwm, torque);
    if (is_held) {
        s->f[0] = s->f[1] = 0;
        s->f[2] = b->gravity;
        return;
    }
    s->open_v -= b->drain * STEP_S;
    axes_of(s->q, R);
    for (int k = 0; k < 3; k++) air[k] = R[0][k] * s->v[0] + R[1][k] * s->v[1] + R[2][k] * s->v[2];
    double edgewise = air[0] * air[0] + air[1] * air[1];
    double up = thrust / b->mass * (1 + b->lift * edgewise / (edgewise + EDGEWISE));
    s->f[0] = up * (b->tilt[0] - b->rotor_drag * air[0]);
    s->f[1] = up * (b->tilt[1] - b->rotor_drag * air[1]);
    s->f[2] = up;
    for (int k = 0; k < 3; k++)
        s->f[k] -= (b->linear_drag[k] + b->quadratic_drag[k] * fabs(air[k])) * air[k] / b->mass;
    for (int k = 0; k < 3; k++) {
        a = R[k][0] * s->f[0] + R[k][1] * s->f[1] + R[k][2] * s->f[2] - (k == 2 ? b->gravity : 0);
        s->p[k] += (s->v[k] + 0.5 * a * STEP_S) * STEP_S;
        s->v[k] += a * STEP_S;
    }
    turn_body(b, s, torque);
}

double body_noise(BodyState *s)
{
    double sum = -6;  // of twelve numbers within [0, 1): close to normal, and exact
    for (int round = 0; round < 3; round++) {
        s->noise ^= s->noise >> 12; s->noise ^= s->noise << 25; s->noise ^= s->noise >> 27;  // xorshift64*
        uint64_t bits = s->noise * 2685821657736338717ULL;
        for (int part = 0; part < 4; part++) sum += (double)((bits >> 16 * part) & 0xffff) / 65536.0;
    }
    return sum;
}
