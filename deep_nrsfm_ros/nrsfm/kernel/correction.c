/* correction.py, for one object. */
#include "plan.h"

/* Set the rows of A = H Sigma H^T (2, p) x (2, p) for point i; p in DOUBLES.

   Sigma: (3, 3, p), its three rows for that point. `cameras` (3, 2, p). HC: (3, p) of room. */
INLINE void project_inline(int p, int i, const double *restrict Sigma, const double *restrict cameras,
                         double *restrict HC, double *restrict A, int wide) {
    const double *C = Sigma, *m = cameras;
    for (int a = 0; a < 2; a++) {
        double x = m[a * p + i], y = m[(2 + a) * p + i], z = m[(4 + a) * p + i];
        for (int j = 0; j < 3 * p; j++) HC[j] = x * C[j] + y * C[3 * p + j] + z * C[6 * p + j];
        /* Only the upper half of A is read. */
        for (int c = a; c < 2; c++)
            for (int j = a == c ? i / DOUBLES * DOUBLES : 0; j < p; j++)
                A[(size_t)(a * p + i) * wide + c * p + j] = HC[j] * m[c * p + j] +
                                                            HC[p + j] * m[(2 + c) * p + j] +
                                                            HC[2 * p + j] * m[(4 + c) * p + j];
    }
}
FAST(static, project,
            (int p, int i, const double *Sigma, const double *cameras, double *HC, double *A, int wide),
            (p, i, Sigma, cameras, HC, A, wide))

/* E (3) = Sigma v: of three rows (3, 3, p) and v (3, p). */
INLINE void multiply_inline(int p, const double *Sigma, const double *v, double *E) {
    double4 sums[3][3] = {{{0}}};
    for (int j = 0; j < p; j += DOUBLES)
        for (int r = 0; r < 3; r++)
            for (int q = 0; q < 3; q++)
                sums[r][q] += *(const double4 *)(Sigma + (3 * r + q) * p + j) *
                              *(const double4 *)(v + q * p + j);
    for (int r = 0; r < 3; r++) {
        double4 sum = sums[r][0] + sums[r][1] + sums[r][2];
        E[r] = sum[0] + sum[1] + sum[2] + sum[3];
    }
}
FAST(static, multiply, (int p, const double *Sigma, const double *v, double *E), (p, Sigma, v, E))

void correct(Plan *k, Object *o, double noise) {
    int p = DOUBLES_OF(k->p), n = 2 * p, wide = n + DOUBLES;
    double *A = k->A, *m = k->cameras, *v = k->HC, E[3];
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
            for (int j = i; j < k->p; j++) row[j] += k->unknown;
            row[i] += o->visible[i] ? noise * noise + 1e-12 * k->unknown : k->unknown;
            double left = o->W[2 * i + a];
            for (int r = 0; r < 3; r++) left -= o->S[r * k->wide + i] * m[(2 * r + a) * p + i];
            b[0] = o->visible[i] ? left : 0;
        }
    }
    solve(n, A);
    for (int i = 0; i < p; i++)
        for (int r = 0; r < 3; r++)
            v[r * p + i] = m[2 * r * p + i] * A[(size_t)i * wide + n] +
                           m[(2 * r + 1) * p + i] * A[(size_t)(p + i) * wide + n];
    for (int i = 0; i < k->p; i++) {
        multiply(p, k->covariance + (size_t)9 * p * i, v, E);
        for (int r = 0; r < 3; r++) o->S[r * k->wide + i] += (float)E[r];
    }
}
