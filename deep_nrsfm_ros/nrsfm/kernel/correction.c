/* correction.py, for one object. */
#include "plan.h"

/* Set the rows of A = H Sigma H^T (2, p) x (2, p) for point i; p in DOUBLES. Only the upper half is read.

   Sigma: (3, 3, p), its three rows for that point. `cameras` (3, 2, p). HC: (2, 3, p) of room. */
INLINE void project_inline(int p, int i, const double *restrict Sigma,
                           const double *restrict cameras, double *restrict HC,
                           double *restrict A, int wide) {
    const double *C = Sigma, *m = cameras;
    for (int j = 0; j < 3 * p; j++)
        for (int a = 0; a < 2; a++)
            HC[3 * a * p + j] = m[a * p + i] * C[j] + m[(2 + a) * p + i] * C[3 * p + j] +
                                m[(4 + a) * p + i] * C[6 * p + j];
    for (int a = 0; a < 2; a++)
        for (int c = a; c < 2; c++) {
            const double *x = HC + 3 * a * p, *n = m + c * p;
            double *row = A + (size_t)(a * p + i) * wide + c * p;
            for (int j = a == c ? i / DOUBLES * DOUBLES : 0; j < p; j++)
                row[j] = x[j] * n[j] + x[p + j] * n[2 * p + j] + x[2 * p + j] * n[4 * p + j];
        }
}
FAST(project,
     (int p, int i, const double *Sigma, const double *cameras, double *HC, double *A, int wide),
     (p, i, Sigma, cameras, HC, A, wide))

/* E (3, p) += what v (3) of point i says by `Sigma` (3, 3, p), which is symmetric. */
INLINE void combine_inline(int p, const double *restrict Sigma, double x, double y, double z,
                           double *restrict E) {
    for (int j = 0; j < 3 * p; j++)
        E[j] += x * Sigma[j] + y * Sigma[3 * p + j] + z * Sigma[6 * p + j];
}
FAST(combine, (int p, const double *Sigma, double x, double y, double z, double *E),
     (p, Sigma, x, y, z, E))

/* E (3, p) of the answer x beside A: that of the keypoints, and of n bones. */
static void errors(Plan *k, const double *x, int stride, int n) {
    int p = DOUBLES_OF(k->p);
    double *m = k->cameras, *E = k->E;
    for (int j = 0; j < 3 * p; j++) E[j] = 0;
    for (int i = 0; i < k->p; i++) {
        double along = x[(size_t)i * stride], across = x[(size_t)(p + i) * stride], v[3];
        for (int r = 0; r < 3; r++) v[r] = m[2 * r * p + i] * along + m[(2 * r + 1) * p + i] * across;
        combine(p, k->covariance + (size_t)9 * p * i, v[0], v[1], v[2], E);
    }
    for (int b = 0; b < n; b++) {
        const double *from = k->along + (size_t)3 * p * b;
        for (int j = 0; j < 3 * p; j++) E[j] += x[(size_t)(2 * p + b) * stride] * from[j];
    }
}

/* Complete A (2, p) x (2, p) by the rows, columns and right side of the bones. */
static void add_bones(Plan *k, const Object *o, double *A, int stride) {
    int p = DOUBLES_OF(k->p), n = DOUBLES_OF(k->bones);
    double *m = k->cameras, size = observe_bones(k, o);
    for (int b = 0; b < n; b++) {
        double *row = A + (size_t)(2 * p + b) * stride + 2 * p;
        for (int j = b; j < n + DOUBLES; j++) row[j] = j == b;
        for (int i = 0; i < 2 * p; i++) A[(size_t)i * stride + 2 * p + b] = 0;
        if (b >= k->bones) continue; /* No bone: x = 0. */
        const int *ends = k->ends + 2 * b;
        const double *g = k->edges + 4 * b, *Sigma[2];
        double *along = k->along + (size_t)3 * p * b, growth = 0;
        for (int end = 0; end < 2; end++) Sigma[end] = k->covariance + (size_t)9 * p * ends[end];
        for (int j = 0; j < 3 * p; j++) {
            along[j] = 0;
            for (int r = 0; r < 3; r++)
                along[j] += g[r] * (Sigma[0][3 * r * p + j] - Sigma[1][3 * r * p + j]);
        }
        for (int a = 0; a < 2; a++)
            for (int i = 0; i < k->p; i++) {
                double sum = 0;
                for (int r = 0; r < 3; r++) sum += m[(2 * r + a) * p + i] * along[r * p + i];
                A[(size_t)(a * p + i) * stride + 2 * p + b] = sum;
            }
        for (int r = 0; r < 3; r++) growth += g[r] * (k->E[r * p + ends[0]] - k->E[r * p + ends[1]]);
        row[n] = size * k->lengths[2 * b] - g[3] + growth;
    }
    for (int b = 0; b < k->bones; b++) {
        double *row = A + (size_t)(2 * p + b) * stride + 2 * p, *along = k->along + (size_t)3 * p * b;
        for (int c = b; c < k->bones; c++) {
            const int *ends = k->ends + 2 * c;
            row[c] = size * size * k->lengths[2 * b] * k->lengths[2 * c];
            for (int r = 0; r < 3; r++)
                row[c] += k->edges[4 * c + r] * (along[r * p + ends[0]] - along[r * p + ends[1]]);
        }
        double spread = size * k->lengths[2 * b + 1];
        row[b] += spread * spread + 1e-12 * k->unknown;
    }
    for (int i = 0; i < 2 * p; i++)
        for (int j = 0; j < DOUBLES; j++)
            A[(size_t)i * stride + 2 * p + n + j] = j ? 0 : k->left[i];
}

void correct(Plan *k, Object *o, double noise) {
    int p = DOUBLES_OF(k->p), n = 2 * p, bones = DOUBLES_OF(k->bones), stride = n + bones + DOUBLES;
    double *A = k->A, *m = k->cameras, unknown = k->unknown;
    for (int i = 0; i < p; i++) {
        const double *Sigma = k->covariance + (size_t)9 * p * i;
        if (i < k->p) project(p, i, Sigma, m, k->HC, A, stride);
        for (int a = 0; a < 2; a++) {
            double *row = A + (size_t)(a * p + i) * stride + a * p, *b = A + (size_t)(a * p + i) * stride + n;
            for (int j = 0; j < DOUBLES; j++) b[j] = 0;
            if (i >= k->p) { /* No point: x = 0. */
                for (double *entry = row + i; entry < b; entry++) *entry = 0;
                row[i] = 1;
                k->left[a * p + i] = 0;
                continue;
            }
            for (int j = i; j < k->p; j++) row[j] += unknown;
            row[i] += o->visible[i] ? noise * noise + 1e-12 * unknown : unknown;
            double left = o->W[2 * i + a];
            for (int r = 0; r < 3; r++) left -= o->S[r * k->wide + i] * m[(2 * r + a) * p + i];
            k->left[a * p + i] = b[0] = o->visible[i] ? left : 0;
        }
    }
    solve(n, 0, stride, A);
    errors(k, A + n, stride, 0);
    if (bones) {
        add_bones(k, o, A, stride);
        solve(n + bones, n, stride, A);
        errors(k, A + n + bones, stride, k->bones);
    }
    for (int r = 0; r < 3; r++)
        for (int i = 0; i < k->p; i++) o->S[r * k->wide + i] += (float)k->E[r * p + i];
}
