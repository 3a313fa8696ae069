/* Products and solutions for the lifter: plain C, and the same with AVX2 where the processor has it. */
#ifndef ALGEBRA_H
#define ALGEBRA_H

#include <math.h>
#include <stddef.h>

#define LANES 16
/* Rows of matrices that are multiplied are filled up with zeros to a multiple of LANES. */
#define PADDED(n) (((n) + LANES - 1) / LANES * LANES)

#define INLINE static inline __attribute__((always_inline))
typedef float vector __attribute__((vector_size(4 * LANES / 2), aligned(4), may_alias));

/* The first LANES columns of out (rows, n) = X A, as `product`; for a constant number of rows. */
INLINE void tile(const int rows, int k, int n, const float *X, int stride, const float *A,
                 float *out) {
    vector sums[6][2] = {{{0}}};
    for (int i = 0; i < k; i++) {
        const vector *a = (const vector *)(A + (size_t)i * n);
        vector left = a[0], right = a[1];
        for (int r = 0; r < rows; r++) {
            float x = X[r * stride + i];
            sums[r][0] += x * left;
            sums[r][1] += x * right;
        }
    }
    for (int r = 0; r < rows; r++)
        for (int h = 0; h < 2; h++) ((vector *)(out + (size_t)r * n))[h] = sums[r][h];
}

/* out (rows, n) = X A for X (rows, k), whose rows are `stride` apart, and A (k, n); n is PADDED.

   Column by column, so that what is read of A stays in the cache for all rows. */
INLINE void product_inline(int rows, int k, int n, const float *X, int stride, const float *A,
                           float *out) {
    for (int j = 0; j < n; j += LANES) {
        int r = 0;
        for (; r + 6 <= rows; r += 6) tile(6, k, n, X + r * stride, stride, A + j, out + r * n + j);
        for (; r + 3 <= rows; r += 3) tile(3, k, n, X + r * stride, stride, A + j, out + r * n + j);
        for (; r < rows; r++) tile(1, k, n, X + r * stride, stride, A + j, out + r * n + j);
    }
}

/* Solve A x = b for a symmetric positive definite A (n, n), of which the upper half is read and spoilt. */
INLINE void solve_inline(int n, double *A, int columns, double *b) {
    for (int k = 0; k < n; k++) {
        double *row = A + (size_t)k * n;
        double scale = 1 / sqrt(fmax(row[k], 1e-300));
        for (int j = k; j < n; j++) row[j] *= scale;
        for (int c = 0; c < columns; c++) b[k * columns + c] *= scale;
        for (int i = k + 1; i < n; i++) {
            double *below = A + (size_t)i * n, factor = row[i];
            for (int j = i; j < n; j++) below[j] -= factor * row[j];
            for (int c = 0; c < columns; c++) b[i * columns + c] -= factor * b[k * columns + c];
        }
    }
    for (int k = n - 1; k >= 0; k--)
        for (int c = 0; c < columns; c++) {
            double sum = b[k * columns + c];
            for (int j = k + 1; j < n; j++) sum -= A[(size_t)k * n + j] * b[j * columns + c];
            b[k * columns + c] = sum / A[(size_t)k * n + k];
        }
}

static void product_anywhere(int rows, int k, int n, const float *X, int stride, const float *A,
                             float *out) {
    product_inline(rows, k, n, X, stride, A, out);
}
static void solve_anywhere(int n, double *A, int columns, double *b) {
    solve_inline(n, A, columns, b);
}

static void (*product)(int, int, int, const float *, int, const float *, float *) = product_anywhere;
static void (*solve)(int, double *, int, double *) = solve_anywhere;

#ifdef __x86_64__
#define AVX2 __attribute__((target("avx2,fma")))
AVX2 static void product_avx2(int rows, int k, int n, const float *X, int stride, const float *A,
                              float *out) {
    product_inline(rows, k, n, X, stride, A, out);
}
AVX2 static void solve_avx2(int n, double *A, int columns, double *b) {
    solve_inline(n, A, columns, b);
}
static void choose(void) {
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"))
        product = product_avx2, solve = solve_avx2;
}
#else
static void choose(void) {}
#endif

#endif
