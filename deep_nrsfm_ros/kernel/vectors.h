/* SPDX-License-Identifier: Apache-2.0 */
/* `product`, `accumulate` and `solve` for processors with vectors of BYTES; `algebra.c` includes it once for each.

   FOR(name) is the name of that version of `name`; TARGET tells the compiler its processor. Functions on rows
   of four doubles use vectors of at most 32 bytes; FOUR(name) selects that version.
*/
#define HERE TARGET static inline __attribute__((always_inline))
#define A_PANEL (4 * FLOATS / BYTES) /* vectors of a panel's row */
#define LANES (BYTES / 8)            /* doubles of a vector */
#define ABREAST (BYTES == 64 ? 2 : 1) /* panels for which there are registers beside six rows */

typedef float FOR(singles) __attribute__((vector_size(BYTES), aligned(4), may_alias));
typedef int FOR(bits) __attribute__((vector_size(BYTES)));
typedef double FOR(doubles) __attribute__((vector_size(BYTES), aligned(8), may_alias));

/* The part of out = X A - b that is `rows` by `panels`; both are constants where it is called. */
HERE void FOR(tile)(const int rows, const int panels, const float *X, int stride, Matrix A,
                    int column, const float *b, int relu, float *out) {
    typedef FOR(singles) vector;
    vector sums[6][2 * A_PANEL];
    for (int h = 0; h < A_PANEL * panels; h++) {
        vector from = {0};
        if (b) from -= ((const vector *)(b + column))[h];
        for (int r = 0; r < rows; r++) sums[r][h] = from;
    }
    const float *panel = A.panels + (size_t)column * A.k, *row_of[6];
    /* Addresses are computed here, because in the loop they would cost as much as the products. */
    for (int r = 0; r < rows; r++) row_of[r] = X + (ptrdiff_t)r * stride;
    for (ptrdiff_t i = 0; i < A.k; i++) {
        vector a[2 * A_PANEL];
        for (int h = 0; h < A_PANEL * panels; h++) {
            const float *row = panel + ((size_t)(h / A_PANEL) * A.k + i) * FLOATS;
            a[h] = ((const vector *)row)[h % A_PANEL];
        }
        for (int r = 0; r < rows; r++)
            for (int h = 0; h < A_PANEL * panels; h++) sums[r][h] += row_of[r][i] * a[h];
    }
    for (int r = 0; r < rows; r++)
        for (int h = 0; h < A_PANEL * panels; h++) {
            vector sum = sums[r][h];
            if (relu) sum = (vector)((FOR(bits))sum & ~(sum <= 0)); /* NaN stays what it is */
            ((vector *)(out + (size_t)r * A.n + column))[h] = sum;
        }
}

/* The products stand panel by panel, so that one stays in the cache for all rows. Few rows take two
   panels at a time: a sum waits for the one before, and the processor has eight in hand. */
TARGET static void FOR(product)(int rows, const float *X, int stride, Matrix A, const float *b,
                                int relu, float *out) {
    int sixes = rows / 6 * 6;
    for (int j = 0, columns; j < A.n; j += columns) {
        columns = j + ABREAST * FLOATS <= A.n ? ABREAST * FLOATS : FLOATS;
        for (int r = 0; r < sixes; r += 6)
            if (columns == FLOATS)
                FOR(tile)(6, 1, X + r * stride, stride, A, j, b, relu, out + (size_t)r * A.n);
            else
                FOR(tile)(6, 2, X + r * stride, stride, A, j, b, relu, out + (size_t)r * A.n);
    }
    X += sixes * stride, out += (size_t)sixes * A.n, rows -= sixes;
    for (int done; rows > 0; rows -= done, X += done * stride, out += (size_t)done * A.n) {
        int j = 0;
        done = rows < 3 ? rows : rows == 4 ? 2 : 3;
        for (; j + 2 * FLOATS <= A.n; j += 2 * FLOATS)
            if (done == 3)
                FOR(tile)(3, 2, X, stride, A, j, b, relu, out);
            else if (done == 2)
                FOR(tile)(2, 2, X, stride, A, j, b, relu, out);
            else
                FOR(tile)(1, 2, X, stride, A, j, b, relu, out);
        for (int r = 0; r < done && j < A.n; r++)
            FOR(tile)(1, 1, X + r * stride, stride, A, j, b, relu, out + (size_t)r * A.n);
    }
}

/* The part of out += X^T Y that is `rows`, columns of X, by `panels`, of Y; both constants where it is called. */
HERE void FOR(outer)(const int rows, const int panels, int n, const float *X, int stride, const float *Y,
                     int wide, float *out, int apart) {
    typedef FOR(singles) vector;
    vector sums[6][2 * A_PANEL];
    for (int r = 0; r < rows; r++)
        for (int h = 0; h < A_PANEL * panels; h++) sums[r][h] = ((vector *)(out + (size_t)r * apart))[h];
    for (int i = 0; i < n; i++, X += stride, Y += wide) {
        /* Row by row of the sums: the other order takes more registers than there are. */
        vector y[2 * A_PANEL];
        for (int h = 0; h < A_PANEL * panels; h++) y[h] = ((const vector *)Y)[h];
        for (int r = 0; r < rows; r++)
            for (int h = 0; h < A_PANEL * panels; h++) sums[r][h] += X[r] * y[h];
    }
    for (int r = 0; r < rows; r++)
        for (int h = 0; h < A_PANEL * panels; h++) ((vector *)(out + (size_t)r * apart))[h] = sums[r][h];
}

/* Its part of so many panels. */
HERE void FOR(stripe)(const int panels, int n, int k, const float *X, int stride, const float *Y, int wide,
                      float *out, int apart) {
    for (; k >= 6; k -= 6, X += 6, out += 6 * apart)
        FOR(outer)(6, panels, n, X, stride, Y, wide, out, apart);
    if (k >= 4) {
        FOR(outer)(4, panels, n, X, stride, Y, wide, out, apart);
        k -= 4, X += 4, out += 4 * apart;
    }
    for (; k > 0; k--, X++, out += apart) FOR(outer)(1, panels, n, X, stride, Y, wide, out, apart);
}

TARGET static void FOR(accumulate)(int n, int k, const float *X, int stride, int wide, const float *Y,
                                   float *out, int apart) {
    int j = 0;
    for (; j + ABREAST * FLOATS <= wide; j += ABREAST * FLOATS)
        FOR(stripe)(ABREAST, n, k, X, stride, Y + j, wide, out + j, apart);
    if (j < wide) FOR(stripe)(1, n, k, X, stride, Y + j, wide, out + j, apart);
}

/* Columns j ... of rows k ... k + 3, less what the rows above have in them. */
HERE void FOR(subtract)(const int vectors, int k, int stride, const double *A, int j,
                        FOR(doubles) left[4][3]) {
    typedef FOR(doubles) vector;
    for (int r = 0; r < 4; r++)
        for (int v = 0; v < vectors; v++)
            left[r][v] = ((const vector *)(A + (size_t)(k + r) * stride + j))[v];
    for (int i = 0; i < k; i++) {
        const double *above = A + (size_t)i * stride;
        for (int r = 0; r < 4; r++)
            for (int v = 0; v < vectors; v++)
                left[r][v] -= above[k + r] * ((const vector *)(above + j))[v];
    }
}

/* Columns j ... of rows k ... k + 3 of U, whose columns k ... k + 3 are there. */
HERE void FOR(eliminate)(const int vectors, int k, int stride, double *A, int j,
                         const double *scale) {
    typedef FOR(doubles) vector;
    vector left[4][3];
    FOR(subtract)(vectors, k, stride, A, j, left);
    for (int r = 0; r < 4; r++)
        for (int v = 0; v < vectors; v++) {
            for (int q = 0; q < r; q++)
                left[r][v] -= A[(size_t)(k + q) * stride + k + r] * left[q][v];
            left[r][v] *= scale[r];
            ((vector *)(A + (size_t)(k + r) * stride + j))[v] = left[r][v];
        }
}

#if BYTES < 64
#define FOUR FOR
/* The corner k ... k + 3 of U in place of A's, and one over its diagonal. */
HERE void FOR(factor)(int k, int stride, double *A, double scale[4]) {
    FOR(doubles) corner[4][3];
    double U[4][4];
    FOR(subtract)(4 / LANES, k, stride, A, k, corner);
    for (int r = 0; r < 4; r++)
        for (int c = 0; c < 4; c++) U[r][c] = corner[r][c / LANES][c % LANES];
    for (int r = 0; r < 4; r++) {
        scale[r] = 1 / sqrt(fmax(U[r][r], 1e-300));
        for (int c = r; c < 4; c++) A[(size_t)(k + r) * stride + k + c] = U[r][c] *= scale[r];
        for (int q = r + 1; q < 4; q++)
            for (int c = q; c < 4; c++) U[q][c] -= U[r][q] * U[r][c];
    }
}

/* x of U x = y in place of y. */
HERE void FOR(substitute)(int n, int stride, double *A) {
    typedef FOR(doubles) vector;
    for (int k = n - 4; k >= 0; k -= 4)
        for (int c = n; c < n + DOUBLES; c += LANES) {
            vector x[4];
            for (int r = 0; r < 4; r++) x[r] = *(const vector *)(A + (size_t)(k + r) * stride + c);
            for (int j = k + 4; j < n; j++)
                for (int r = 0; r < 4; r++)
                    x[r] -= A[(size_t)(k + r) * stride + j] *
                            *(const vector *)(A + (size_t)j * stride + c);
            for (int r = 3; r >= 0; r--) {
                double *row = A + (size_t)(k + r) * stride;
                for (int q = r + 1; q < 4; q++) x[r] -= row[k + q] * x[q];
                *(vector *)(row + c) = x[r] /= row[k + r];
            }
        }
}
#endif

/* By Cholesky's U^T U = A, four rows at a time; y of U^T y = b comes out beside U. */
TARGET static void FOR(solve)(int n, int factored, int stride, double *A) {
    int wide = n + DOUBLES;
    for (int k = 0; k < n; k += 4) {
        int j = k < factored ? factored : k + 4;
        double scale[4];
        if (k < factored)
            for (int r = 0; r < 4; r++) scale[r] = 1 / A[(size_t)(k + r) * stride + k + r];
        else
            FOUR(factor)(k, stride, A, scale);
        for (; j + 3 * LANES <= wide; j += 3 * LANES) FOR(eliminate)(3, k, stride, A, j, scale);
        for (; j + LANES <= wide; j += LANES) FOR(eliminate)(1, k, stride, A, j, scale);
        if (j < wide) FOUR(eliminate)(1, k, stride, A, j, scale);
    }
    FOUR(substitute)(n, stride, A);
}

#undef HERE
#undef A_PANEL
#undef LANES
#undef ABREAST
#undef BYTES
#undef FOUR
#undef FOR
#undef TARGET
