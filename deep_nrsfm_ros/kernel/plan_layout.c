/* SPDX-License-Identifier: Apache-2.0 */
/* Where each part of a plan lies in its arrays, and how much memory it computes with. */
#include "plan.h"

#include <math.h>
#include <string.h>

/* Rows of a product, at most: the codes of more do not stay in the cache. */
#define MAX_ROWS 144

/* Of two lengths; rounding may take the 1 of a length with itself a little above it. */
#define MAX_CORRELATION 1.001

#define HEADER_LENGTH 17
#define SCALARS 13 /* doubles at the end of a plan */

static int in_range(int value, int first, int last) { return first <= value && value <= last; }

/* Check n indices of keypoints. */
static int all_keypoints(const int *indices, ptrdiff_t n, int p) {
    int sound = 1;
    for (ptrdiff_t i = 0; i < n; i++) sound &= in_range(indices[i], 0, p - 1);
    return sound;
}

const char *check_header(const int *h, ptrdiff_t length) {
    if (length < HEADER_LENGTH) return "the header is too short";
    int p = h[0], layers = h[1], bones = h[15], derivations = h[16];
    if (!in_range(p, 1, MAX_KEYPOINTS)) return "the number of keypoints is out of range";
    if (!in_range(layers, 1, MAX_LAYERS)) return "the number of dictionaries is out of range";
    if (!in_range(h[2], 1, MAX_ROTATIONS)) return "the number of rotations is out of range";
    for (int i = 3; i < 7; i++)
        if (!in_range(h[i], 0, 1)) return "a flag is neither 0 nor 1";
    if (!in_range(h[7], 0, MAX_REFILL)) return "the number of refill rounds is out of range";
    if (!(h[8] == -1 && h[9] == -1) && !all_keypoints(h + 8, 2, p)) return "the reference is no pair of keypoints";
    if (h[10] < 0) return "min_visible is negative";
    if (!in_range(h[11], 0, 1)) return "a flag is neither 0 nor 1";
    if (!in_range(h[12], 0, MAX_KEYPOINTS)) return "the fewest keypoints are out of range";
    if (!in_range(h[13], 0, MAX_CANDIDATES)) return "the number of candidates is out of range";
    if (!in_range(h[14], 0, MAX_KEYPOINTS)) return "the number of wrong keypoints is out of range";
    if (!in_range(bones, 0, MAX_BONES)) return "the number of bones is out of range";
    if (!in_range(derivations, 0, MAX_DERIVATIONS)) return "the number of derivations is out of range";
    /* All five are bounded: the sum cannot overflow. */
    if (length != HEADER_LENGTH + (ptrdiff_t)layers + p + 3 * bones + 2 * derivations) return "the header has another length";
    h += HEADER_LENGTH;
    for (int i = 0; i < layers; i++, h++)
        if (!in_range(*h, 1, MAX_WIDTH)) return "the width of a dictionary is out of range";
    if (!all_keypoints(h, p, p)) return "a partner is no keypoint";
    if (!all_keypoints(h + p, 2 * (ptrdiff_t)bones, p)) return "the end of a bone is no keypoint";
    if (!all_keypoints(h + p + 2 * bones, 2 * (ptrdiff_t)derivations, p)) return "a derivation is of no keypoints";
    h += p + 2 * bones + 2 * derivations;
    for (int b = 0; b < bones; b++)
        if (!in_range(h[b], 0, bones - 1)) return "the partner of a bone is no bone";
    return NULL;
}

/* Items of an array that are not taken; `exceeded`: more were requested than there are. */
typedef struct {
    size_t left;
    int exceeded;
} Items;

/* Take rows x columns items; return how many, 0 if there are fewer. */
static size_t take(Items *items, size_t rows, size_t columns) {
    size_t count;
    if (__builtin_mul_overflow(rows, columns, &count) || count > items->left) {
        items->exceeded = 1;
        return 0;
    }
    items->left -= count;
    return count;
}

static const float *matrix(Matrix *A, int k, int n, const float *at, Items *items) {
    A->k = k, A->n = FLOATS_OF(n), A->panels = at;
    return at + take(items, k, A->n);
}

const char *lay_out(Plan *k, const int *header, const float *floats, const double *doubles, size_t n_floats,
                    size_t n_doubles) {
    const int *h = header;
    const float *f = floats;
    const double *d = doubles;
    Items f_items = {n_floats, 0}, d_items = {n_doubles, 0};
    k->p = *h++, k->layers = *h++, k->rotations = *h++, k->mirrored = *h++, k->whitened = *h++;
    k->scale_by_rms = *h++, k->corrected = *h++, k->refill_rounds = *h++, k->reference[0] = *h++;
    k->reference[1] = *h++, k->min_visible = *h++, k->leave_out_wrong = *h++;
    k->fewest_left = *h++, k->candidates = *h++, k->most_wrong = *h++, k->bones = *h++, k->derivations = *h++;
    int p = k->p, stride = k->stride = FLOATS_OF(p), last;
    k->widths = h, h += k->layers;
    k->partners = h, h += p;
    k->bone_ends = h, h += 2 * k->bones;
    k->derivation_pairs = h, h += 2 * k->derivations;
    k->bone_partners = h;
    f = matrix(&k->L, p, p, f, &f_items);
    f = matrix(&k->L_inverse, p, p, f, &f_items);
    for (int i = 0; i < k->layers; i++) {
        int to = k->widths[i], from = i ? k->widths[i - 1] : 0;
        f = matrix(&k->encoder[i], i ? from : p, i ? to : 3 * FLOATS_OF(to), f, &f_items);
        k->b[i] = f, f += take(&f_items, FLOATS_OF(to), 1);
        f = matrix(&k->decoder[i], to, i ? from : 3 * stride, f, &f_items);
        k->b_[i] = f, f += take(&f_items, k->decoder[i].n, 1);
    }
    last = k->widths[k->layers - 1];
    f = matrix(&k->code_head, 6 * FLOATS_OF(last), last, f, &f_items);
    k->camera_head = f, f += take(&f_items, last, 1);
    k->log_error_std = f, f += take(&f_items, p, 1);
    k->covariance = f, take(&f_items, 9 * DOUBLES_OF(p), DOUBLES_OF(p));
    k->completion = d, d += take(&d_items, p, p);
    k->image_rotations = d, d += take(&d_items, k->rotations, 4);
    k->object_frame = d, d += take(&d_items, 9, 1);
    k->calibration = d, d += take(&d_items, 2, COEFFICIENTS);
    k->point_precision = d, d += take(&d_items, p, p);
    k->bone_lengths = d, d += take(&d_items, k->bones, 2);
    k->bone_correlation = d, d += take(&d_items, k->bones, k->bones);
    k->axis = d, d += take(&d_items, p, 1);
    const double *history = d;
    d += take(&d_items, HISTORY_NUMBERS, 1);
    take(&d_items, SCALARS, 1);
    if (f_items.exceeded || f_items.left) return "the array of float32 has another length";
    if (d_items.exceeded || d_items.left) return "the array of float64 has another length";
    k->noise = *d++, k->reference_length = *d++, k->unknown_variance = *d++, k->min_relative_depth = *d++;
    k->residual_scale = *d++, k->min_residual = *d++, k->residual_ratio = *d++, k->min_distance = *d++;
    k->residual_offset = *d++, k->trusted_weight = *d++, k->full_ratio = *d++;
    k->extent_offset = *d++, k->min_known = *d++;
    const double *scalars = &d[-SCALARS];
    for (int i = 0; i < SCALARS; i++)
        if (!(scalars[i] >= 0 && scalars[i] < INFINITY)) return "a variance or length is negative or not finite";
    if (!k->min_relative_depth || !k->residual_scale || !k->residual_offset || !k->trusted_weight || !k->extent_offset ||
        !k->min_known) return "a divisor is zero";
    for (int i = 0; i < HISTORY_NUMBERS; i++)
        if (!(history[i] >= 0 && history[i] < INFINITY)) return "a constant of the history is negative or not finite";
    memcpy(&k->history, history, sizeof(HistoryConstants));
    for (int i = 0; i < p; i++) {
        if (!isfinite(k->axis[i])) return "the axis is not finite";
        k->has_axis |= k->axis[i] != 0;
    }
    for (int i = 0; i < 2 * k->bones; i++)
        if (!(k->bone_lengths[i] > 0 && k->bone_lengths[i] < INFINITY)) return "the length of a bone is not positive and finite";
    for (size_t i = 0; i < (size_t)k->bones * k->bones; i++)
        if (!(fabs(k->bone_correlation[i]) <= MAX_CORRELATION)) return "a correlation of bones is above 1";
    return NULL;
}

/* Memory that is laid out part by part. */
typedef struct {
    char *memory; /* NULL: only the size is computed */
    size_t size;
    int overflow;
} Arena;

/* Return the place of rows x columns items of `item` bytes, at the border of a cache line. */
static void *room(Arena *arena, size_t item, size_t rows, size_t columns) {
    void *place = arena->memory ? arena->memory + arena->size : NULL;
    size_t bytes;
    arena->overflow |= __builtin_mul_overflow(rows, columns, &bytes) ||
                       __builtin_mul_overflow(bytes, item, &bytes) || __builtin_add_overflow(bytes, 63, &bytes) ||
                       __builtin_add_overflow(arena->size, bytes / 64 * 64, &arena->size);
    return place;
}

int lay_out_scratch(Plan *k, char *memory, size_t *size) {
    int n = k->block = 6 * k->rotations < MAX_ROWS ? MAX_ROWS / (6 * k->rotations) : 1;
    size_t p = k->p, stride = k->stride, rotated = (size_t)n * k->rotations, all = k->rotations * (1 + k->mirrored);
    size_t even = DOUBLES_OF(k->p), bones = DOUBLES_OF(k->bones + 2), system = 2 * even + bones;
    size_t widest = 3 * stride;
    for (int i = 0; i < k->layers; i++)
        if ((size_t)FLOATS_OF(k->widths[i]) > widest) widest = FLOATS_OF(k->widths[i]);
    Arena arena = {memory, 0, 0}, *a = &arena;
    k->x = room(a, sizeof(float), 4 * n, stride);
    k->V = room(a, sizeof(float), 6 * n, widest);
    k->Psi[0] = room(a, sizeof(float), 6 * rotated, widest);
    k->Psi[1] = room(a, sizeof(float), 6 * rotated, widest);
    k->psi[0] = room(a, sizeof(float), rotated, widest);
    k->psi[1] = room(a, sizeof(float), rotated, widest);
    k->shapes = room(a, sizeof(float), 3 * n * all, stride);
    k->cameras = room(a, sizeof(double), n * all, 6);
    k->residuals = room(a, sizeof(double), all, 1);
    k->point_cameras = room(a, sizeof(double), 6, even);
    k->spread = room(a, sizeof(double), 2 * DOUBLES, even);
    k->E = room(a, sizeof(double), 3, even);
    k->system = room(a, sizeof(double), system, system + DOUBLES);
    k->difference = room(a, sizeof(double), 2, even);
    k->bone_directions = room(a, sizeof(double), bones, 4);
    k->bone_covariance = room(a, sizeof(double), 3 * even, bones);
    k->sight = room(a, sizeof(double), 2, k->bones);
    k->precision = room(a, sizeof(double), k->bones, 1);
    k->no_growth = room(a, sizeof(double), k->bones, 1);
    for (int b = 0; memory && b < k->bones; b++) k->precision[b] = k->bone_lengths[2 * b] / k->bone_lengths[2 * b + 1];
    k->gap = room(a, sizeof(double), p, 1);
    k->apart = room(a, sizeof(double), p, 1);
    k->shown = room(a, sizeof(float), p, 2);
    k->missing = room(a, sizeof(int), p, 1);
    k->incomplete = room(a, sizeof(Object *), n, 1);
    k->objects = room(a, sizeof(Object), n, 1);
    Object unused, *o = memory ? k->objects : &unused;
    for (int i = 0; i < n; i++, o += memory != NULL) {
        o->input = room(a, sizeof(float), p, 2);
        o->input_mask = room(a, sizeof(float), p, 1);
        o->visible = room(a, sizeof(float), p, 1);
        o->weight = room(a, sizeof(double), p, 1);
        o->certainty = room(a, sizeof(double), p, 1);
        o->W = room(a, sizeof(float), p, 2);
        o->S = room(a, sizeof(float), 3, stride);
        o->own_bones = room(a, sizeof(double), k->bones, 2);
        o->own_growth = room(a, sizeof(double), k->bones, 1);
    }
    *size = arena.size;
    return !arena.overflow;
}
