/* SPDX-License-Identifier: Apache-2.0 */
/* The normalisation of one object: nrsfm/normalisation.py. */
#include <math.h>

#include "plan.h"

/* Set W, gain, unit and origin from points (p, 2) where mask (p) is 1. */
static void normalise_points(Plan *k, Object *o, const float *points, const float *mask) {
    int p = k->p;
    double n = 0, square = 0;
    o->origin[0] = o->origin[1] = 0;
    for (int i = 0; i < p; i++) {
        n += mask[i];
        for (int c = 0; c < 2; c++) o->origin[c] += mask[i] * points[2 * i + c];
    }
    n = fmax(n, 1);
    for (int c = 0; c < 2; c++) o->origin[c] /= n;
    for (int i = 0; i < 2 * p; i++) {
        double w = (points[i] - o->origin[i % 2]) * mask[i / 2];
        o->W[i] = (float)w;
        square += w * w;
    }
    o->unit = k->scale_by_rms ? 2 * (sqrt(square / n) + 1e-9) : 1;
    for (int i = 0; i < 2 * p; i++) o->W[i] = (float)(o->W[i] / o->unit);
    o->gain = p / n;
}

void normalise(Plan *k, Object *o) {
    int all_present = 1;
    for (int i = 0; i < k->p; i++) all_present &= o->input_mask[i] > 0;
    if (all_present || !k->whitened) {
        normalise_points(k, o, o->input, o->input_mask);
        return;
    }
    float *filled = k->V, *all_visible = k->V + 2 * k->p;
    complete_points(k, o, filled);
    for (int i = 0; i < k->p; i++) all_visible[i] = 1;
    normalise_points(k, o, filled, all_visible);
}
