/* SPDX-License-Identifier: Apache-2.0 */
/* Keypoints that contradict all others, which a lift takes as missing: lifting/wrong_keypoints.py. */
#include <math.h>
#include <string.h>

#include "plan.h"

/* Set the distance of each keypoint in the image from its projection, in RMS radii of the visible ones. */
static void set_distances(Plan *k, const Object *o, int perspective) {
    double square = 0;
    for (int i = 0; i < k->p; i++)
        for (int c = 0; c < 2; c++) square += o->visible[i] * o->W[2 * i + c] * o->W[2 * i + c];
    double radius = fmax(sqrt(square / fmax(o->visible_count, 1)), 1e-9);
    for (int i = 0; i < k->p; i++) {
        double depth = 1, apart[2];
        if (perspective) depth = fmax(1 + o->unit * o->S[2 * k->stride + i], k->min_relative_depth);
        for (int c = 0; c < 2; c++)
            apart[c] = (o->image_points[2 * i + c] - o->origin[c]) / o->unit - o->S[c * k->stride + i] / depth;
        k->apart[i] = hypot(apart[0], apart[1]) / radius;
    }
}

/* Set which keypoints are visible, to `shown`, and fit the network to them. */
static void fit_to(Plan *k, Object *o, const float *shown, int perspective) {
    o->visible_count = 0;
    for (int i = 0; i < k->p; i++) o->visible_count += o->visible[i] = o->input_mask[i] = shown[i];
    normalise(k, o);
    average_rotations(k, 1, &o, perspective);
    set_distances(k, o, perspective);
}

/* Set `shown` to the visible keypoints without one, and without those that follow from it. */
static void show_without(const Plan *k, const float *visible, int keypoint, float *shown) {
    memcpy(shown, visible, k->p * sizeof(float));
    shown[keypoint] = 0;
    for (int i = 0; i < k->derivations; i++)
        if (k->derivation_pairs[2 * i + 1] == keypoint) shown[k->derivation_pairs[2 * i]] = 0;
}

/* Set `candidates` to the visible keypoints of the largest distances; return their number. */
static int find_candidates(const Plan *k, const float *visible, int candidates[MAX_CANDIDATES]) {
    int n = 0;
    for (int i = 0; i < k->p; i++) {
        if (!visible[i]) continue;
        int at = n < k->candidates ? n++ : n;
        for (; at > 0 && k->apart[candidates[at - 1]] < k->apart[i]; at--)
            if (at < k->candidates) candidates[at] = candidates[at - 1];
        if (at < k->candidates) candidates[at] = i;
    }
    return n;
}

void leave_out_wrong(Plan *k, Object *o, int perspective) {
    float *visible = k->shown, *shown = visible + k->p;
    int candidates[MAX_CANDIDATES], fewest = k->min_visible > k->fewest_left ? k->min_visible : k->fewest_left;
    if (!(o->residual > k->min_residual)) return;
    memcpy(visible, o->visible, k->p * sizeof(float));
    set_distances(k, o, perspective);
    for (int round = 0; round < k->most_wrong && o->residual > k->min_residual; round++) {
        double limit = k->residual_ratio * o->residual;
        int wrong = -1, n = find_candidates(k, visible, candidates);
        for (int i = 0; i < n; i++) {
            show_without(k, visible, candidates[i], shown);
            fit_to(k, o, shown, perspective);
            if (!is_lifted(k, o, fewest) || !(o->residual < limit)) continue;
            if (k->apart[candidates[i]] > k->min_distance) wrong = candidates[i], limit = o->residual;
        }
        if (wrong < 0) {
            fit_to(k, o, visible, perspective);
            break;
        }
        show_without(k, visible, wrong, shown);
        for (int i = 0; i < k->p; i++)
            if (visible[i] > shown[i]) o->weight[i] = o->certainty[i] = 0, o->wrong[i] = 1;
        memcpy(visible, shown, k->p * sizeof(float));
        fit_to(k, o, visible, perspective);
        o->last = !k->refill_rounds;
    }
}
