/* SPDX-License-Identifier: Apache-2.0 */
/* The correction of one object: `correct` of lifting/correction.py.

   The errors of a shape are normal, with the covariance Sigma of the model. Their mean given the keypoints, and
   then the bone lengths, solves A x = b with A the covariance of these observations. In this file p is filled up
   to a multiple of DOUBLES. */
#include <math.h>
#include <string.h>

#include "plan.h"

/* Set the rows of A = H Sigma H^T, (2, p) x (2, p), of keypoint i; only the upper half is read.

   Sigma: (3, 3, p), its three rows of the keypoint. m: (3, 2, p), the point cameras. */
INLINE void project_inline(ptrdiff_t p, ptrdiff_t i, const float *restrict Sigma, const double *restrict m,
                           double *restrict A, int stride) {
    double *restrict along = A + (size_t)i * stride, *restrict across = A + (size_t)(p + i) * stride + p;
    for (ptrdiff_t j = 0; j < p; j++) {
        double x[3], y[3];
        for (int c = 0; c < 3; c++) {
            const float *C = Sigma + c * p + j;
            x[c] = m[i] * C[0] + m[2 * p + i] * C[3 * p] + m[4 * p + i] * C[6 * p];
            y[c] = m[p + i] * C[0] + m[3 * p + i] * C[3 * p] + m[5 * p + i] * C[6 * p];
        }
        along[j] = x[0] * m[j] + x[1] * m[2 * p + j] + x[2] * m[4 * p + j];
        along[p + j] = x[0] * m[p + j] + x[1] * m[3 * p + j] + x[2] * m[5 * p + j];
        across[j] = y[0] * m[p + j] + y[1] * m[3 * p + j] + y[2] * m[5 * p + j];
    }
}
FAST(project, (ptrdiff_t p, ptrdiff_t i, const float *Sigma, const double *m, double *A, int stride),
     (p, i, Sigma, m, A, stride))

/* E (n) += v^T Sigma, for v (n) and Sigma (n, n); n is a multiple of DOUBLES. */
INLINE void combine_inline(ptrdiff_t n, const double *restrict v, const float *restrict Sigma,
                           double *restrict E) {
    for (ptrdiff_t i = 0; i < n; i += DOUBLES, Sigma += DOUBLES * n)
        for (ptrdiff_t j = 0; j < n; j++)
            E[j] += v[i] * Sigma[j] + v[i + 1] * Sigma[n + j] + v[i + 2] * Sigma[2 * n + j] +
                    v[i + 3] * Sigma[3 * n + j];
}
FAST(combine, (ptrdiff_t n, const double *v, const float *Sigma, double *E), (n, v, Sigma, E))

/* Set E (3, p) = Sigma H^T x from the solution x (2 p + n + upright) of the keypoints, n bones and gravity; x is a
   column of A. */
static void expected_error(Plan *k, const double *x, int stride, int n, int upright) {
    int p = DOUBLES_OF(k->p);
    double *m = k->point_cameras, *v = k->spread;
    for (int j = 0; j < 3 * p; j++) k->E[j] = 0;
    for (int i = 0; i < p; i++) {
        double along = x[(size_t)i * stride], across = x[(size_t)(p + i) * stride];
        for (int r = 0; r < 3; r++)
            v[3 * i + r] = i < k->p ? m[2 * r * p + i] * along + m[(2 * r + 1) * p + i] * across : 0;
    }
    for (int b = 0; b < n; b++)
        for (int end = 0; end < 2; end++)
            for (int r = 0; r < 3; r++)
                v[3 * k->bone_ends[2 * b + end] + r] +=
                    (end ? -1 : 1) * k->bone_directions[4 * b + r] * x[(size_t)(2 * p + b) * stride];
    for (int row = n; row < n + upright; row++)
        for (int i = 0; i < k->p; i++)
            for (int r = 0; r < 3; r++)
                v[3 * i + r] += k->axis[i] * k->bone_directions[4 * row + r] * x[(size_t)(2 * p + row) * stride];
    combine(3 * p, v, k->covariance, k->E);
}

/* Set along (3, p), the covariance of the errors with the growth of a bone, and spread (2, p), its projection into
   the image. from, to: (3, 3, p), the rows of Sigma of the bone's ends. g: its unit vector. m: as above. */
INLINE void bone_spread_inline(ptrdiff_t p, const float *restrict from, const float *restrict to,
                        const double *restrict g, const double *restrict m, double *restrict along,
                        double *restrict spread) {
    for (ptrdiff_t j = 0; j < 3 * p; j++)
        along[j] = g[0] * (from[j] - to[j]) + g[1] * (from[3 * p + j] - to[3 * p + j]) +
                   g[2] * (from[6 * p + j] - to[6 * p + j]);
    for (ptrdiff_t i = 0; i < p; i++) {
        double x = along[i], y = along[p + i], z = along[2 * p + i];
        spread[i] = m[i] * x + m[2 * p + i] * y + m[4 * p + i] * z;
        spread[p + i] = m[p + i] * x + m[3 * p + i] * y + m[5 * p + i] * z;
    }
}
FAST(bone_spread,
     (ptrdiff_t p, const float *from, const float *to, const double *g, const double *m,
      double *along, double *spread),
     (p, from, to, g, m, along, spread))

/* Set the same of the axis from bottom to top, in direction g. */
static void axis_spread(const Plan *k, const double *g, double *along, double *spread) {
    int p = DOUBLES_OF(k->p);
    const double *m = k->point_cameras;
    for (int j = 0; j < 3 * p; j++) along[j] = 0;
    for (int i = 0; i < k->p; i++)
        for (int r = 0; r < 3 && k->axis[i] != 0; r++) {
            const float *Sigma = k->covariance + (size_t)9 * p * i + 3 * p * r;
            for (int j = 0; j < 3 * p; j++) along[j] += k->axis[i] * g[r] * Sigma[j];
        }
    for (int i = 0; i < p; i++)
        for (int a = 0; a < 2; a++) {
            spread[a * p + i] = 0;
            for (int r = 0; r < 3; r++) spread[a * p + i] += m[(2 * r + a) * p + i] * along[r * p + i];
        }
}

/* Set the columns of the bones and of gravity, n together, and the right side b (2, p) in the rows (2, p) of the
   keypoints. */
static void add_columns(Plan *k, const double *b, double *A, int stride, int n) {
    int p = DOUBLES_OF(k->p), wide = DOUBLES_OF(n);
    double *spread = k->spread;
    for (int first = 0; first < wide; first += DOUBLES) {
        memset(spread, 0, DOUBLES * 2 * p * sizeof(double));
        for (int bone = first; bone < first + DOUBLES && bone < n; bone++) {
            double *along = k->bone_covariance + (size_t)3 * p * bone, *to_image = spread + (bone - first) * 2 * p;
            const double *g = k->bone_directions + 4 * bone;
            if (bone >= k->bones) {
                axis_spread(k, g, along, to_image);
                continue;
            }
            const float *from = k->covariance + (size_t)9 * p * k->bone_ends[2 * bone];
            const float *to = k->covariance + (size_t)9 * p * k->bone_ends[2 * bone + 1];
            bone_spread(p, from, to, g, k->point_cameras, along, to_image);
        }
        for (int i = 0; i < 2 * p; i++)
            for (int j = 0; j < DOUBLES; j++)
                A[(size_t)i * stride + 2 * p + first + j] = spread[2 * j * p + i];
    }
    for (int i = 0; i < 2 * p; i++)
        for (int j = 0; j < DOUBLES; j++) A[(size_t)i * stride + 2 * p + wide + j] = j ? 0 : b[i];
}

/* Return the component of e (3, p) along row c of gravity. */
static double along_axis(const Plan *k, int c, const double *e) {
    int p = DOUBLES_OF(k->p);
    double sum = 0;
    for (int r = 0; r < 3; r++)
        for (int i = 0; i < k->p; i++) sum += k->bone_directions[4 * c + r] * k->axis[i] * e[r * p + i];
    return sum;
}

/* Set the rows of the bones from their covariances, and those of gravity, n together.

   size: that of the object, see measure_bones. upright: see set_upright. */
static void add_rows(Plan *k, const Object *o, double size, const double *upright, double *A, int stride, int n) {
    int p = DOUBLES_OF(k->p), wide = DOUBLES_OF(n);
    for (int b = 0; b < wide; b++) {
        double *row = A + (size_t)(2 * p + b) * stride + 2 * p;
        for (int j = b; j < wide + DOUBLES; j++) row[j] = j == b;
        if (b >= n) continue; /* Beyond the last one: x = 0. */
        const double *along = k->bone_covariance + (size_t)3 * p * b;
        for (int c = b > k->bones ? b : k->bones; c < n; c++) row[c] = along_axis(k, c, along);
        if (b >= k->bones) {
            row[b] += upright[2] * upright[2] + 1e-12 * k->unknown_variance;
            row[wide] = upright[b - k->bones];
            continue;
        }
        const int *ends = k->bone_ends + 2 * b;
        const double *bone = o->bones + 2 * b, *g = k->bone_directions + 4 * b;
        const double *correlation = k->bone_correlation + (size_t)k->bones * b;
        double shortfall = size * bone[0] - g[3];
        for (int r = 0; r < 3; r++) shortfall += g[r] * (k->E[r * p + ends[0]] - k->E[r * p + ends[1]]);
        for (int c = b; c < k->bones; c++) {
            const int *other_ends = k->bone_ends + 2 * c;
            const double *h = k->bone_directions + 4 * c;
            const double *other = o->bones + 2 * c;
            row[c] = size * size * (bone[0] * other[0] + correlation[c] * bone[1] * other[1]);
            for (int r = 0; r < 3; r++) row[c] += h[r] * (along[r * p + other_ends[0]] - along[r * p + other_ends[1]]);
        }
        row[b] += 1e-12 * k->unknown_variance;
        row[wide] = shortfall;
    }
}

void correct(Plan *k, Object *o, double noise) {
    int p = DOUBLES_OF(k->p), n = 2 * p, more = k->bones + 2 * o->upright, stride = n + DOUBLES_OF(more) + DOUBLES;
    double *A = k->system, *m = k->point_cameras, unknown = k->unknown_variance;
    for (int i = 0; i < p; i++) {
        const float *Sigma = k->covariance + (size_t)9 * p * i;
        if (i < k->p) project(p, i, Sigma, m, A, stride);
        for (int a = 0; a < 2; a++) {
            double *row = A + (size_t)(a * p + i) * stride + a * p, *b = A + (size_t)(a * p + i) * stride + n;
            for (int j = 0; j < DOUBLES; j++) b[j] = 0;
            if (i >= k->p) { /* Beyond the last keypoint: x = 0. */
                for (double *entry = row + i; entry < b; entry++) *entry = 0;
                row[i] = 1;
                k->difference[a * p + i] = 0;
                continue;
            }
            for (int j = i; j < k->p; j++) row[j] += unknown;
            double weight = o->weight[i];
            row[i] += weight > 0 ? fmin(noise * noise / weight + 1e-12 * unknown, unknown) : unknown;
            double difference = o->W[2 * i + a];
            for (int r = 0; r < 3; r++) difference -= o->S[r * k->stride + i] * m[(2 * r + a) * p + i];
            k->difference[a * p + i] = b[0] = weight > 0 ? difference : 0;
        }
    }
    solve(n, 0, stride, A);
    expected_error(k, A + n, stride, 0, 0);
    if (o->last && o->updates) learn_bones(k, o);
    if (more) {
        double size = k->bones ? measure_bones(k, o) : 0, upright[3];
        if (o->upright) set_upright(k, o, k->bone_directions + 4 * k->bones, upright);
        add_columns(k, k->difference, A, stride, more);
        add_rows(k, o, size, upright, A, stride, more);
        solve(n + DOUBLES_OF(more), n, stride, A);
        expected_error(k, A + n + DOUBLES_OF(more), stride, k->bones, 2 * o->upright);
    }
    for (int r = 0; r < 3; r++)
        for (int i = 0; i < k->p; i++) o->S[r * k->stride + i] += (float)k->E[r * p + i];
}
