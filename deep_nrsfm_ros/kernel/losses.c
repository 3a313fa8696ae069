/* losses.py, Objective, for some frames at a time. */
#include <math.h>
#include <string.h>

#include "gradient.h"

/* L X of the rows of X. */
static const float *weigh(Worker *w, int rows, const float *X, float *out) {
    if (!w->kind->whitened) return X;
    product(rows, X, w->kind->wide, w->L, NULL, 0, out);
    return out;
}

INLINE void square_inline(ptrdiff_t n, const float *restrict X, float *restrict sums) {
    for (ptrdiff_t j = 0; j < n; j += FLOATS)
        for (ptrdiff_t i = 0; i < FLOATS; i++) sums[i] += X[j + i] * X[j + i];
}
FAST(square, (ptrdiff_t n, const float *X, float *sums), (n, X, sums))

static double frobenius(ptrdiff_t n, const float *X) {
    float sums[FLOATS] = {0};
    double sum = 1e-12;
    square(n, X, sums);
    for (int i = 0; i < FLOATS; i++) sum += sums[i];
    return sqrt(sum);
}

/* Put in place of n differences `left` (n, size) the gradient by them of the sum over n of `weight` ||L left|| /
   ||L target||; return that sum without its weight. */
static double relative(Worker *w, int n, int rows, double weight) {
    int p = w->kind->p, wide = w->kind->wide, size = rows * wide;
    const float *target = weigh(w, n * rows, w->target, w->spare[0]);
    float *E = (float *)weigh(w, n * rows, w->left, w->weighed);
    double sum = 0;
    for (int o = 0; o < n; o++) {
        double error = frobenius(size, E + (size_t)o * size), extent = frobenius(size, target + (size_t)o * size);
        float scale = (float)(weight / (error * extent));
        /* Not what fills them up: NaN would stay there. */
        for (int row = o * rows; row < (o + 1) * rows; row++)
            for (int i = 0; i < p; i++) E[row * wide + i] *= scale;
        sum += error / extent;
    }
    weigh(w, n * rows, E, w->left);
    return sum;
}

/* Take the mean over the visible from a row of `points`, and put 0 where nothing is; mask: 1 or 0. */
static void centre_visible(int p, const float *mask, float *row) {
    float sum = 0, visible = 0;
    for (int i = 0; i < p; i++) sum += mask[i] * row[i], visible += mask[i];
    float mean = sum / fmaxf(visible, 1);
    for (int i = 0; i < p; i++) row[i] = (row[i] - mean) * mask[i];
}

static void centre(int p, float *row) {
    float mean = 0;
    for (int i = 0; i < p; i++) mean += row[i];
    mean /= p;
    for (int i = 0; i < p; i++) row[i] -= mean;
}

void frames_loss(Worker *w, const Task *task, ptrdiff_t first, int n, float *shapes) {
    int p = w->kind->p, wide = w->kind->wide;
    for (int o = 0; o < n; o++) {
        const float *W = task->W + 2 * p * (first + o), *mask = task->mask + p * (first + o), *S = w->S + 3 * wide * o;
        for (int c = 0; c < 2; c++) {
            float *left = w->left + (2 * o + c) * wide, *target = w->target + (2 * o + c) * wide;
            float m[3] = {(float)w->M[o][0][c], (float)w->M[o][1][c], (float)w->M[o][2][c]};
            for (int i = 0; i < p; i++) left[i] = m[0] * S[i] + m[1] * S[wide + i] + m[2] * S[2 * wide + i];
            centre_visible(p, mask, left);
            for (int i = 0; i < p; i++) {
                target[i] = W[2 * i + c];
                left[i] = target[i] - left[i];
            }
        }
        for (int r = 0; r < 3; r++) {
            float m[2] = {(float)w->M[o][r][0], (float)w->M[o][r][1]}, *to = w->spare[0];
            const float *left = w->left + 2 * o * wide;
            for (int i = 0; i < p; i++) to[i] = S[r * wide + i] + m[0] * left[i] + m[1] * left[wide + i];
            centre(p, to);
            for (int i = 0; i < p; i++) shapes[3 * (p * (first + o) + i) + r] = to[i];
        }
    }
    w->reprojection += relative(w, n, 2, 1.0 / task->b);
    for (int o = 0; o < n; o++) {
        const float *mask = task->mask + p * (first + o), *S = w->S + 3 * wide * o;
        float *bar = w->left + 2 * o * wide;
        for (int c = 0; c < 2; c++) {
            centre_visible(p, mask, bar + c * wide);
            for (int r = 0; r < 3; r++) {
                float sum = 0;
                for (int i = 0; i < p; i++) sum -= S[r * wide + i] * bar[c * wide + i];
                w->M_bar[o][r][c] = sum;
            }
        }
        for (int r = 0; r < 3; r++) {
            float m[2] = {(float)w->M[o][r][0], (float)w->M[o][r][1]}, *to = w->S_bar + (3 * o + r) * wide;
            for (int i = 0; i < p; i++) to[i] = -m[0] * bar[i] - m[1] * bar[wide + i];
        }
    }
}

void known_loss(Worker *w, const Task *task, ptrdiff_t first, int n) {
    int p = w->kind->p, wide = w->kind->wide;
    for (int o = 0; o < n; o++)
        for (int r = 0; r < 3; r++) {
            float *left = w->left + (3 * o + r) * wide, *target = w->target + (3 * o + r) * wide;
            memcpy(left, w->S + (3 * o + r) * wide, p * sizeof(float));
            centre(p, left);
            for (int i = 0; i < p; i++) {
                target[i] = task->T[3 * (p * (first + o) + i) + r];
                left[i] -= target[i];
            }
        }
    w->cycle += relative(w, n, 3, task->cycle / task->c);
    for (int row = 0; row < 3 * n; row++) {
        centre(p, w->left + row * wide);
        memcpy(w->S_bar + row * wide, w->left + row * wide, p * sizeof(float));
    }
    memset(w->M_bar, 0, n * sizeof(camera));
}
