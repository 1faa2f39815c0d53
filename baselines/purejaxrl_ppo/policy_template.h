/* $about
 *
 * C99, float32, without heap, global state or any library but the C library's tanhf (link with -lm).
 * A NaN in the state makes the whole action NaN: check the action before it is flown.
$meanings
 */
#ifndef FLYTRACK_POLICY_H
#define FLYTRACK_POLICY_H

#include <math.h>

#define FLYTRACK_STATE $state_size
#define FLYTRACK_GATES $num_gates
#define FLYTRACK_PAST $num_past
#define FLYTRACK_OF_DRONE $num_of_drone
#define FLYTRACK_OBSERVATION $num_observation
#define FLYTRACK_ACTION $num_actions

/* A gate's centre, world, m, and its axes forward (the direction of flight), left and up in the world. */
static const float flytrack_centre[FLYTRACK_GATES * 3] = {
$centres
};
static const float flytrack_frame[FLYTRACK_GATES * 9] = {
$frames
};
/* How far from the centre, along left and up, the drone's centre may pass, m. */
static const float flytrack_free[FLYTRACK_GATES] = {
$free
};
/* The observation of the gate after each gate. */
static const float flytrack_next_rows[FLYTRACK_GATES * 6] = {
$next_rows
};
/* A row of the observation is (quantity - offset) * factor, within +-limit. */
static const float flytrack_offset[FLYTRACK_OF_DRONE] = {
$offsets
};
static const float flytrack_factor[FLYTRACK_OF_DRONE] = {
$factors
};
static const float flytrack_limit[FLYTRACK_OF_DRONE] = {
$limits
};
/* How much of the way to the command the applied action goes in a step, by the model's lags alone. */
static const float flytrack_blend[FLYTRACK_ACTION] = {
$blend
};
/* The network: a row of weights for each output, tanh between the layers. */
$layers

/* NaN stays. */
static inline float flytrack_clip(float value, float limit) {
    return value > limit ? limit : value < -limit ? -limit : value;
}

static inline float flytrack_dot(const float a[3], const float b[3]) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static inline void flytrack_to_gate(int gate, const float position[3], float in_frame[3]) {
    float relative[3];
    for (int i = 0; i < 3; i++) {
        relative[i] = position[i] - flytrack_centre[gate * 3 + i];
    }
    for (int i = 0; i < 3; i++) {
        in_frame[i] = flytrack_dot(&flytrack_frame[gate * 9 + i * 3], relative);
    }
}

static inline void flytrack_layer(const float *kernel, const float *bias, int inputs, int outputs,
                                  const float *in, float *out) {
    for (int row = 0; row < outputs; row++) {
        float sum = bias[row];
        for (int i = 0; i < inputs; i++) {
            sum += kernel[row * inputs + i] * in[i];
        }
        out[row] = sum;
    }
}

static inline void flytrack_tanh(int size, float *values) {
    for (int i = 0; i < size; i++) {
        values[i] = tanhf(values[i]);
    }
}

/* Write what the network sees: the observation of FlyTrack$past_in_words. */
static inline void flytrack_observe(const float state[FLYTRACK_STATE], int gate,$past_parameter
                                    float observation[FLYTRACK_OBSERVATION]) {
    const float *frame = &flytrack_frame[gate * 9];
    const float w = state[9], x = state[10], y = state[11], z = state[12];
    const float axes[3][3] = {
        {1.0f - 2.0f * (y * y + z * z), 2.0f * (x * y + w * z), 2.0f * (x * z - w * y)},
        {2.0f * (x * y - w * z), 1.0f - 2.0f * (x * x + z * z), 2.0f * (y * z + w * x)},
        {2.0f * (x * z + w * y), 2.0f * (y * z - w * x), 1.0f - 2.0f * (x * x + y * y)},
    };
    flytrack_to_gate(gate, state, observation);
    for (int row = 0; row < 3; row++) {
        observation[3 + row] = flytrack_dot(&frame[row * 3], &state[3]);
        for (int column = 0; column < 3; column++) {
            observation[6 + row * 3 + column] = flytrack_dot(&frame[row * 3], axes[column]);
        }
    }
    for (int i = 13; i < FLYTRACK_STATE; i++) {
        observation[2 + i] = state[i];
    }
    for (int i = 0; i < FLYTRACK_OF_DRONE; i++) {
        const float scaled = (observation[i] - flytrack_offset[i]) * flytrack_factor[i];
        observation[i] = flytrack_clip(scaled, flytrack_limit[i]);
    }
    for (int i = 0; i < 6; i++) {
        observation[FLYTRACK_OF_DRONE + i] = flytrack_next_rows[gate * 6 + i];
    }$past_rows
}

/* Write the action for a state before a gate. */
static inline void flytrack_policy(const float state[FLYTRACK_STATE], int gate,$past_parameter
                                   float action[FLYTRACK_ACTION]) {
    float layer_0[FLYTRACK_OBSERVATION];
    flytrack_observe(state, gate,$past_argument layer_0);
$network
    for (int i = 0; i < FLYTRACK_ACTION; i++) {
        action[i] = flytrack_clip($last[i], 1.0f);
    }
}

/* Return the gate to fly after a step between two positions, world, m: the one after, if this was passed. */
static inline int flytrack_next_gate(int gate, const float before[3], const float after[3]) {
    float start[3], end[3];
    flytrack_to_gate(gate, before, start);
    flytrack_to_gate(gate, after, end);
    if (!(start[0] < 0.0f && end[0] >= 0.0f)) {
        return gate;
    }
    const float fraction = -start[0] / (end[0] - start[0]);
    for (int i = 1; i < 3; i++) {
        if (!(fabsf(start[i] + fraction * (end[i] - start[i])) <= flytrack_free[gate])) {
            return gate;
        }
    }
    return (gate + 1) % FLYTRACK_GATES;
}

/* Move the applied action, state[16:20], by the lag of a step; for drones that do not measure it. */
static inline void flytrack_lag(const float action[FLYTRACK_ACTION], float applied[FLYTRACK_ACTION]) {
    for (int i = 0; i < FLYTRACK_ACTION; i++) {
        applied[i] += flytrack_blend[i] * (action[i] - applied[i]);
    }
}

#endif
