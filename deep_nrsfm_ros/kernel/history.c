/* SPDX-License-Identifier: Apache-2.0 */
/* What is remembered of one object from frame to frame: lifting/history_update.py, network_smoothing.py, own_bones.py and
   gravity.py. */
#include <math.h>
#include <string.h>

#include "plan.h"

#define REWEIGHTINGS 2 /* own_bones.REWEIGHTINGS */

/* Parts of a state; see StateLayout of lifting/history.py. */
#define STATE_TIME 0
#define STATE_MISFIT 1
#define STATE_AGREEMENT 3
#define STATE_ROTATION 4
#define STATE_SHAPE 13

ptrdiff_t state_size(const Plan *k) { return STATE_SHAPE + 3 * (ptrdiff_t)k->p + 2 * (ptrdiff_t)k->bones; }

static double *growth_of(const Plan *k, const Object *o) { return o->state + STATE_SHAPE + 3 * k->p; }
static double *evidence_of(const Plan *k, const Object *o) { return growth_of(k, o) + k->bones; }

static double gain(double seconds, double time) { return time > 0 ? 1 - exp(-seconds / time) : 1; }

/* Return the share of what is learned that counts. */
static double share(const Plan *k, double evidence) {
    return k->history.bones_time > 0 ? evidence / (evidence + k->history.bones_time) : 0;
}

/* Set the bones of an object, and their growth, which is without the common scale: own_bones. */
static void set_own_bones(Plan *k, Object *o) {
    const double *growth = growth_of(k, o), *evidence = evidence_of(k, o);
    double whole = 0, sum = 0;
    for (int b = 0; b < k->bones; b++) {
        double T = k->precision[b] * k->precision[b], part = share(k, evidence[b]);
        o->own_growth[b] = part * growth[b];
        o->own_bones[2 * b + 1] = k->bone_lengths[2 * b + 1] * sqrt(1 - k->history.max_variance_reduction * part);
        whole += T * o->own_growth[b], sum += T;
    }
    whole /= sum;
    for (int b = 0; b < k->bones; b++) {
        o->own_growth[b] -= whole;
        o->own_bones[2 * b] = k->bone_lengths[2 * b] * exp(o->own_growth[b]);
    }
    o->bones = o->own_bones;
}

void recall(Plan *k, Object *o, const Context *context, ptrdiff_t i, int lifted) {
    o->state = NULL, o->bones = k->bone_lengths, o->view = NULL, o->upright = 0;
    o->goes_on = o->updates = 0;
    if (!context || !k->corrected) return;
    if (context->to_view) o->view = context->to_view + 9 * i;
    if (context->up && k->has_axis) {
        o->upright = 1;
        for (int r = 0; r < 3; r++) {
            o->up[r] = o->view ? 0 : context->up[r];
            for (int c = 0; c < 3 && o->view; c++) o->up[r] += o->view[3 * r + c] * context->up[c];
        }
    }
    ptrdiff_t row = context->rows[i];
    if (row < 0 || row >= context->capacity || !lifted) return;
    o->state = context->states + row * state_size(k);
    double elapsed = context->time - o->state[STATE_TIME];
    int begins = isnan(elapsed);
    if (begins) {
        o->state[STATE_MISFIT] = o->state[STATE_MISFIT + 1] = 0;
        memset(growth_of(k, o), 0, 2 * k->bones * sizeof(double));
    }
    int restarts = begins || elapsed < -k->history.max_back || elapsed > k->history.max_gap;
    o->time = context->time;
    o->seconds = begins || elapsed < 0 ? 0 : elapsed;
    o->goes_on = !restarts && elapsed > 0;
    o->updates = restarts || o->goes_on;
    if (!k->bones || !(k->history.bones_time > 0)) return;
    set_own_bones(k, o);
}

/* Set out = V R, or V^T R; V NULL: R. */
static void turn(const double *V, int transposed, rotation R, rotation out) {
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++) {
            out[r][c] = V ? 0 : R[r][c];
            for (int q = 0; q < 3 && V; q++) out[r][c] += V[transposed ? 3 * q + r : 3 * r + q] * R[q][c];
        }
}

/* Return what becomes of the remembered rotation if the new one is `step` away from it: 0, it is smoothed on; 1, it
   stays; -1, the new one takes its place. Update the agreement: weigh_turns of network_smoothing.py. */
static int weigh_turn(const Plan *k, Object *o, rotation step) {
    double *agreement = o->state + STATE_AGREEMENT, trace = step[0][0] + step[1][1] + step[2][2];
    int turned = trace < 1 + 2 * k->history.cosine_of_turn;
    if (turned) *agreement -= o->seconds;
    else *agreement = fmin(*agreement + o->seconds, k->history.max_agreement);
    return !turned ? 0 : *agreement > 0 ? 1 : -1;
}

void smooth_network(Plan *k, Object *o) {
    int p = k->p, stride = k->stride, held = 0;
    double *Z = o->state + STATE_SHAPE, mean[3], size = 0, old_size = 0;
    rotation R, old = {{0}}, step = {{0}};
    for (int r = 0; r < 3; r++) {
        mean[r] = 0;
        for (int i = 0; i < p; i++) mean[r] += o->S[r * stride + i];
        mean[r] /= p;
        for (int i = 0; i < p; i++) {
            double y = o->S[r * stride + i] - mean[r];
            size += y * y, old_size += Z[3 * i + r] * Z[3 * i + r];
        }
    }
    if (!(size < INFINITY)) {
        o->updates = 0;
        return;
    }
    int goes_on = o->goes_on && old_size < INFINITY;
    turn(o->view, 1, o->R, R);
    if (goes_on) {
        rotation back;
        memcpy(old, o->state + STATE_ROTATION, sizeof(old));
        transpose(old, back);
        turn(&R[0][0], 0, back, step);
        int weighed = k->history.rotation_time > 0 ? weigh_turn(k, o, step) : 0;
        held = weighed > 0, goes_on = weighed >= 0;
    }
    if (!goes_on) o->state[STATE_AGREEMENT] = 0;
    double seen = held ? 0 : goes_on ? gain(o->seconds, k->history.shape_time) : 1;
    double hidden = held ? 0 : goes_on ? gain(o->seconds, k->history.hidden_time) : 1;
    double ratio = goes_on ? sqrt(size) / fmax(sqrt(old_size), 1e-9) : 0;
    for (int i = 0; i < p; i++) {
        double part = o->visible[i] ? seen : hidden;
        for (int r = 0; r < 3; r++) {
            double y = o->S[r * stride + i] - mean[r], predicted = goes_on ? ratio * Z[3 * i + r] : y;
            Z[3 * i + r] = predicted + part * (y - predicted);
            o->S[r * stride + i] = (float)(Z[3 * i + r] + mean[r]);
        }
    }
    if (held) memcpy(R, old, sizeof(R));
    else if (goes_on) {
        rotation_part(step, gain(o->seconds, k->history.rotation_time), step);
        turn(&step[0][0], 0, old, R);
    }
    memcpy(o->state + STATE_ROTATION, R, sizeof(R));
    turn(o->view, 0, R, o->R);
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 2; c++) o->M[r][c] = o->R[c][r];
    o->state[STATE_TIME] = o->time;
}

/* Return the weighted mean of the bones' growth less `expected`, with the weights of `sight`. limit > 0: bones that
   deviate by more from the mean `about`, in spreads of the model, count less. */
static double mean_growth(const Plan *k, const double *expected, double limit, double about) {
    const double *growth = k->sight, *weight = k->sight + k->bones;
    double mean = 0, sum = 0;
    for (int b = 0; b < k->bones; b++) {
        double w = weight[b] * k->precision[b] * k->precision[b], x = growth[b] - expected[b];
        double deviation = fabs(x - about) * k->precision[b];
        if (limit > 0 && deviation > limit) w *= limit / deviation;
        mean += w * x, sum += w;
    }
    return mean / fmax(sum, 1e-12);
}

/* Return the mean squared deviation of the bones from lengths of growth `expected`, in spreads: _misfit. */
static double misfit(const Plan *k, const double *expected) {
    const double *growth = k->sight, *weight = k->sight + k->bones, limit = k->history.outlier;
    double mean = mean_growth(k, expected, 0, 0), square = 0, sum = 0;
    for (int b = 0; b < k->bones; b++) {
        double x = (growth[b] - expected[b] - mean) * k->precision[b];
        square += weight[b] * fmin(x * x, limit * limit), sum += weight[b];
    }
    return square / fmax(sum, 1e-12);
}

void learn_bones(Plan *k, Object *o) {
    int p = DOUBLES_OF(k->p), n = k->bones;
    const HistoryConstants *constants = &k->history;
    double *sight_growth = k->sight, *weight = k->sight + n, *own = o->own_growth, sum = 0, most = 0;
    if (!n || !(constants->bones_time > 0)) return;
    for (int b = 0; b < n; b++) {
        const int *ends = k->bone_ends + 2 * b;
        double square = 0, along = 0;
        for (int r = 0; r < 3; r++) {
            const float *S = o->S + r * k->stride;
            const double *E = k->E + r * p;
            double edge = S[ends[0]] + E[ends[0]] - (S[ends[1]] + E[ends[1]]);
            square += edge * edge, along += o->R[2][r] * edge;
        }
        square = fmax(square, 1e-18);
        double across = fmin(fmax(1 - along * along / square, 0), 1);
        double seen[2];
        for (int end = 0; end < 2; end++) seen[end] = o->visible[ends[end]] ? o->weight[ends[end]] : 0;
        sight_growth[b] = log(square / (k->bone_lengths[2 * b] * k->bone_lengths[2 * b])) / 2;
        /* own_bones.FORESHORTENING_POWER */
        weight[b] = across * across * across * across * fmin(seen[0], seen[1]);
        sum += weight[b];
    }
    if (!(sum > 0)) return; /* Nothing is visible, or a number is NaN. */
    double *growth = growth_of(k, o), *evidence = evidence_of(k, o), *q = o->state + STATE_MISFIT;
    double part = gain(o->seconds, constants->misfit_time);
    q[0] += part * (misfit(k, own) - q[0]);
    q[1] += part * (misfit(k, k->no_growth) - q[1]);
    for (int b = 0; b < n; b++) most = fmax(most, evidence[b]);
    if (most > constants->change_evidence && q[0] > constants->misfit_ratio * q[1])
        for (int b = 0; b < n; b++) evidence[b] = fmin(evidence[b], constants->doubted_evidence);
    double whole = mean_growth(k, own, 0, 0), seconds = fmin(o->seconds, constants->max_seconds);
    for (int i = 0; i < REWEIGHTINGS; i++) whole = mean_growth(k, own, constants->outlier, whole);
    for (int b = 0; b < n; b++) {
        int other = k->bone_partners[b];
        double both = weight[b] + weight[other], gained = both / 2 * seconds;
        double sides = weight[b] * (sight_growth[b] - whole) + weight[other] * (sight_growth[other] - whole);
        double difference = sides / fmax(both, 1e-12) - growth[b];
        evidence[b] = fmin(evidence[b] + gained, constants->memory);
        growth[b] += fmin(gained / fmax(evidence[b], 1e-12), 1) *
                     fmin(fmax(difference, -constants->max_step), constants->max_step);
    }
}

int set_upright(Plan *k, Object *o, double *directions, double values[3]) {
    int p = DOUBLES_OF(k->p);
    double up[3], v[3], length = 0, along = 0, *a = directions, *b = directions + 4;
    for (int r = 0; r < 3; r++) {
        const float *S = o->S + r * k->stride;
        up[r] = o->R[0][r] * o->up[0] + o->R[1][r] * o->up[1] + o->R[2][r] * o->up[2];
        v[r] = 0;
        for (int i = 0; i < k->p; i++) v[r] += k->axis[i] * (S[i] + k->E[r * p + i]);
        length += v[r] * v[r], along += v[r] * up[r];
    }
    length = fmax(sqrt(length), 1e-9);
    double lean = acos(fmin(fmax(along / length, -1), 1)) / k->history.free_lean;
    values[2] = k->history.lean_deviation * length * sqrt(1 + lean * lean * lean * lean);
    int least = fabs(up[1]) < fabs(up[0]);
    if (fabs(up[2]) < fabs(up[least])) least = 2;
    /* a = up x e, with e the axis that is furthest from up; b = up x a. */
    int next = (least + 1) % 3, last = (least + 2) % 3;
    double size = fmax(sqrt(up[next] * up[next] + up[last] * up[last]), 1e-9);
    a[least] = 0, a[next] = up[last] / size, a[last] = -up[next] / size;
    for (int r = 0; r < 3; r++) b[r] = up[(r + 1) % 3] * a[(r + 2) % 3] - up[(r + 2) % 3] * a[(r + 1) % 3];
    for (int row = 0; row < 2; row++) {
        values[row] = 0;
        for (int r = 0; r < 3; r++)
            for (int i = 0; i < k->p; i++)
                values[row] -= directions[4 * row + r] * k->axis[i] * o->S[r * k->stride + i];
    }
    return 2;
}
