/* SPDX-License-Identifier: Apache-2.0 */
#include "algebra.h"

#include <math.h>

#define BYTES 16
#define FOR(name) name##_anywhere
#define TARGET
#include "vectors.h"

#ifdef __x86_64__
#define BYTES 32
#define FOR(name) name##_avx2
#define TARGET AVX2
#include "vectors.h"
#define BYTES 64
#define FOR(name) name##_avx512
#define TARGET AVX512
#define FOUR(name) name##_avx2
#include "vectors.h"
#endif

int vector_bytes = 16;

int choose_vectors(int bytes) {
    int most = 16;
#ifdef __x86_64__
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) most = 32;
    if (most == 32 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
        __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl"))
        most = 64;
#endif
    int asked = bytes >= 64 ? 64 : bytes >= 32 ? 32 : 16;
    return vector_bytes = asked < most ? asked : most;
}

void product(int rows, const float *X, int stride, Matrix A, const float *b, int relu, float *out) {
    CHOSEN(product)(rows, X, stride, A, b, relu, out);
}

void accumulate(int n, int k, const float *X, int stride, int wide, const float *Y, float *out, int apart) {
    CHOSEN(accumulate)(n, k, X, stride, wide, Y, out, apart);
}

void solve(int n, int factored, int stride, double *A) { CHOSEN(solve)(n, factored, stride, A); }
