#include "algebra.h"

#include <math.h>

/* The part of out = X A - b that is `rows` by `panels`; both are constants where it is called. */
INLINE void tile(const int rows, const int panels, const float *X, int stride, Matrix A, int column,
                 const float *b, int relu, float *out) {
    float8 sums[6][4];
    for (int h = 0; h < 2 * panels; h++) {
        float8 from = {0};
        if (b) from -= ((const float8 *)(b + column))[h];
        for (int r = 0; r < rows; r++) sums[r][h] = from;
    }
    const float *panel = A.panels + (size_t)column * A.k;
    for (int i = 0; i < A.k; i++) {
        float8 a[4];
        for (int h = 0; h < 2 * panels; h++)
            a[h] = ((const float8 *)(panel + ((size_t)(h / 2) * A.k + i) * FLOATS))[h % 2];
        for (int r = 0; r < rows; r++)
            for (int h = 0; h < 2 * panels; h++) sums[r][h] += X[r * stride + i] * a[h];
    }
    for (int r = 0; r < rows; r++)
        for (int h = 0; h < 2 * panels; h++) {
            float8 sum = sums[r][h];
            typedef __typeof__(sum > 0) bits;
            if (relu) sum = (float8)((bits)sum & (sum > 0));
            ((float8 *)(out + (size_t)r * A.n + column))[h] = sum;
        }
}

/* The products stand panel by panel, so that one stays in the cache for all rows. Few rows take two
   panels at a time: a sum waits for the one before, and the processor has eight in hand. */
INLINE void product_inline(int rows, const float *X, int stride, Matrix A, const float *b, int relu,
                           float *out) {
    int sixes = rows / 6 * 6;
    for (int j = 0; j < A.n; j += FLOATS)
        for (int r = 0; r < sixes; r += 6)
            tile(6, 1, X + r * stride, stride, A, j, b, relu, out + (size_t)r * A.n);
    X += sixes * stride, out += (size_t)sixes * A.n, rows -= sixes;
    for (int done; rows > 0; rows -= done, X += done * stride, out += (size_t)done * A.n) {
        int j = 0;
        done = rows < 3 ? rows : rows == 4 ? 2 : 3;
        for (; j + 2 * FLOATS <= A.n; j += 2 * FLOATS)
            if (done == 3)
                tile(3, 2, X, stride, A, j, b, relu, out);
            else if (done == 2)
                tile(2, 2, X, stride, A, j, b, relu, out);
            else
                tile(1, 2, X, stride, A, j, b, relu, out);
        for (int r = 0; r < done && j < A.n; r++)
            tile(1, 1, X + r * stride, stride, A, j, b, relu, out + (size_t)r * A.n);
    }
}
FAST(extern, product,
     (int rows, const float *X, int stride, Matrix A, const float *b, int relu, float *out),
     (rows, X, stride, A, b, relu, out))

/* Columns j ... of rows k ... k + 3, less what the rows above have in them. */
INLINE void subtract(const int vectors, int k, int wide, const double *A, int j,
                     double4 left[4][2]) {
    for (int r = 0; r < 4; r++)
        for (int v = 0; v < vectors; v++)
            left[r][v] = ((const double4 *)(A + (size_t)(k + r) * wide + j))[v];
    for (int i = 0; i < k; i++) {
        const double *above = A + (size_t)i * wide;
        for (int r = 0; r < 4; r++)
            for (int v = 0; v < vectors; v++)
                left[r][v] -= above[k + r] * ((const double4 *)(above + j))[v];
    }
}

/* Columns j ... of rows k ... k + 3 of U, whose columns k ... k + 3 are there. */
INLINE void eliminate(const int vectors, int k, int wide, double *A, int j, const double *scale) {
    double4 left[4][2];
    subtract(vectors, k, wide, A, j, left);
    for (int r = 0; r < 4; r++)
        for (int v = 0; v < vectors; v++) {
            for (int q = 0; q < r; q++) left[r][v] -= A[(size_t)(k + q) * wide + k + r] * left[q][v];
            left[r][v] *= scale[r];
            ((double4 *)(A + (size_t)(k + r) * wide + j))[v] = left[r][v];
        }
}

/* By Cholesky's U^T U = A, four rows at a time; y of U^T y = b comes out beside U. */
INLINE void solve_inline(int n, double *A) {
    int wide = n + DOUBLES;
    for (int k = 0; k < n; k += 4) {
        double4 corner[4][2];
        double U[4][4], scale[4];
        subtract(1, k, wide, A, k, corner);
        for (int r = 0; r < 4; r++)
            for (int c = 0; c < 4; c++) U[r][c] = corner[r][0][c];
        for (int r = 0; r < 4; r++) {
            scale[r] = 1 / sqrt(fmax(U[r][r], 1e-300));
            for (int c = r; c < 4; c++) A[(size_t)(k + r) * wide + k + c] = U[r][c] *= scale[r];
            for (int q = r + 1; q < 4; q++)
                for (int c = q; c < 4; c++) U[q][c] -= U[r][q] * U[r][c];
        }
        int j = k + 4;
        for (; j + 8 <= wide; j += 8) eliminate(2, k, wide, A, j, scale);
        for (; j < wide; j += 4) eliminate(1, k, wide, A, j, scale);
    }
    for (int k = n - 4; k >= 0; k -= 4) {
        double4 x[4];
        for (int r = 0; r < 4; r++) x[r] = *(const double4 *)(A + (size_t)(k + r) * wide + n);
        for (int j = k + 4; j < n; j++)
            for (int r = 0; r < 4; r++)
                x[r] -= A[(size_t)(k + r) * wide + j] * *(const double4 *)(A + (size_t)j * wide + n);
        for (int r = 3; r >= 0; r--) {
            double *row = A + (size_t)(k + r) * wide;
            for (int q = r + 1; q < 4; q++) x[r] -= row[k + q] * x[q];
            *(double4 *)(row + n) = x[r] /= row[k + r];
        }
    }
}
FAST(extern, solve, (int n, double *A), (n, A))
