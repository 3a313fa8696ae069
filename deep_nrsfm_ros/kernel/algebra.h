/* SPDX-License-Identifier: Apache-2.0 */
/* Products and solutions: what NumPy is to the Python. */
#ifndef ALGEBRA_H
#define ALGEBRA_H

#include <stddef.h>

/* Limits of a network: products of these numbers that are computed as `int` cannot overflow. */
#define MAX_LAYERS 64
#define MAX_KEYPOINTS 4096
#define MAX_WIDTH 65536 /* atoms of a dictionary */

/* Columns of matrices are filled up with zeros to a multiple of these. */
#define FLOATS 16
#define DOUBLES 4
#define FLOATS_OF(n) (((n) + FLOATS - 1) / FLOATS * FLOATS)
#define DOUBLES_OF(n) (((n) + DOUBLES - 1) / DOUBLES * DOUBLES)

/* Take vectors of 64, 32 or 16 bytes, or of the next fewer that this processor has; return of how many. */
int choose_vectors(int bytes);
extern int vector_bytes;

/* Of the function `name`, the one for these vectors. */
#ifdef __x86_64__
#define AVX2 __attribute__((target("avx2,fma")))
#define AVX512 __attribute__((target("avx512f,avx512dq,avx512bw,avx512vl,avx2,fma")))
#define CHOSEN(name) \
    (vector_bytes == 64 ? name##_avx512 : vector_bytes == 32 ? name##_avx2 : name##_anywhere)
#else
#define CHOSEN(name) name##_anywhere
#endif

/* Define `name`, whose plain loops are `name_inline`, for vectors of any length. */
#define FAST(name, parameters, arguments)                               \
    static void name##_anywhere parameters { name##_inline arguments; } \
    FAST_ON_X86(name, parameters, arguments)                            \
    static void name parameters { CHOSEN(name) arguments; }
#ifdef __x86_64__
#define FAST_ON_X86(name, parameters, arguments)                         \
    AVX2 static void name##_avx2 parameters { name##_inline arguments; } \
    AVX512 static void name##_avx512 parameters { name##_inline arguments; }
#else
#define FAST_ON_X86(name, parameters, arguments)
#endif
#define INLINE static inline __attribute__((always_inline))

/* A (k, n) with n a multiple of FLOATS, in panels of FLOATS columns: (n / FLOATS, k, FLOATS). */
typedef struct {
    int k, n;
    const float *panels;
} Matrix;

/* out (rows, n) = X A - b for X (rows, k), whose rows are `stride` apart; b (n) or NULL.
   `relu`: what is negative becomes 0. A row of out does not depend on how many there are. */
void product(int rows, const float *X, int stride, Matrix A, const float *b, int relu, float *out);

/* out (k, wide) += X^T Y for X (n, k) and Y (n, wide), wide a multiple of FLOATS; rows of X are `stride` apart,
   those of out `apart`. */
void accumulate(int n, int k, const float *X, int stride, int wide, const float *Y, float *out, int apart);

/* Solve A x = b for a symmetric positive definite A (n, n), of which the upper half is read and spoilt.

   n is a multiple of DOUBLES. b (n, DOUBLES) stands beside A, as columns n, n + 1 ... of its rows, which
   are `stride` apart, and x takes its place; Cholesky's U takes that of A. The first `factored` rows and columns may hold
   U from an earlier call; then only the rest is factorised. */
void solve(int n, int factored, int stride, double *A);

#endif
