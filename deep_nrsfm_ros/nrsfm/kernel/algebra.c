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
    vector_bytes = 16;
#ifdef __x86_64__
    if (bytes >= 32 && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) vector_bytes = 32;
    if (bytes >= 64 && vector_bytes == 32 && __builtin_cpu_supports("avx512f") &&
        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw") &&
        __builtin_cpu_supports("avx512vl"))
        vector_bytes = 64;
#endif
    return vector_bytes;
}

void product(int rows, const float *X, int stride, Matrix A, const float *b, int relu, float *out) {
    CHOSEN(product)(rows, X, stride, A, b, relu, out);
}

void accumulate(int n, int k, const float *X, int stride, int wide, const float *Y, float *out, int apart) {
    CHOSEN(accumulate)(n, k, X, stride, wide, Y, out, apart);
}

void solve(int n, int done, int stride, double *A) { CHOSEN(solve)(n, done, stride, A); }
