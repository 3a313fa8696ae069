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
#endif

void product(int rows, const float *X, int stride, Matrix A, const float *b, int relu, float *out) {
    CHOSEN(product)(rows, X, stride, A, b, relu, out);
}

void solve(int n, int done, int stride, double *A) { CHOSEN(solve)(n, done, stride, A); }
