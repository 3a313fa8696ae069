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

void correct(Plan *k, Object *o, double noise) {
    int p = DOUBLES_OF(k->p), n = 2 * p, wide = n + DOUBLES;
    double *A = k->A, *m = k->cameras, *E = k->HC, unknown = k->unknown;
    for (int i = 0; i < p; i++) {
        const double *Sigma = k->covariance + (size_t)9 * p * i;
        if (i < k->p) project(p, i, Sigma, m, k->HC, A, wide);
        for (int a = 0; a < 2; a++) {
            double *row = A + (size_t)(a * p + i) * wide + a * p, *b = A + (size_t)(a * p + i) * wide + n;
            for (int j = 0; j < DOUBLES; j++) b[j] = 0;
            if (i >= k->p) { /* No point: x = 0. */
                for (double *entry = row + i; entry < b; entry++) *entry = 0;
                row[i] = 1;
                continue;
            }
            for (int j = i; j < k->p; j++) row[j] += unknown;
            row[i] += o->visible[i] ? noise * noise + 1e-12 * unknown : unknown;
            double left = o->W[2 * i + a];
            for (int r = 0; r < 3; r++) left -= o->S[r * k->wide + i] * m[(2 * r + a) * p + i];
            b[0] = o->visible[i] ? left : 0;
        }
    }
    solve(n, A);
    for (int j = 0; j < 3 * p; j++) E[j] = 0;
    for (int i = 0; i < k->p; i++) {
        double x = A[(size_t)i * wide + n], y = A[(size_t)(p + i) * wide + n], v[3];
        for (int r = 0; r < 3; r++) v[r] = m[2 * r * p + i] * x + m[(2 * r + 1) * p + i] * y;
        combine(p, k->covariance + (size_t)9 * p * i, v[0], v[1], v[2], E);
    }
    for (int r = 0; r < 3; r++)
        for (int i = 0; i < k->p; i++) o->S[r * k->wide + i] += (float)E[r * p + i];
}
