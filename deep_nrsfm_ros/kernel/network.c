/* SPDX-License-Identifier: Apache-2.0 */
/* The forward pass of nrsfm/network.py for the default variant of an architecture and a block of objects.

   Each layer is one matrix product for all objects of the block, so that its weights are read once. */
#include <string.h>

#include "plan.h"

/* Fill in the m missing keypoints: solve P_mm x = -P_mv w, with P (p, p) the completion matrix and v the keypoints of
   the input. */
void complete_points(Plan *k, const Object *o, float *filled) {
    int p = k->p, m = 0, *missing = k->missing;
    for (int i = 0; i < p; i++)
        if (!o->input_mask[i]) missing[m++] = i;
    int n = DOUBLES_OF(m), system_stride = n + DOUBLES;
    memset(k->system, 0, (size_t)n * system_stride * sizeof(double));
    for (int a = 0; a < n; a++) {
        double *row = k->system + (size_t)a * system_stride;
        if (a >= m) {
            row[a] = 1;
            continue;
        }
        const double *P = k->completion + (size_t)missing[a] * p;
        for (int b = a; b < m; b++) row[b] = P[missing[b]];
        for (int i = 0; i < p; i++)
            for (int c = 0; c < 2 && o->input_mask[i]; c++) row[n + c] -= P[i] * o->input[2 * i + c];
    }
    solve(n, 0, system_stride, k->system);
    memcpy(filled, o->input, 2 * p * sizeof(float));
    for (int a = 0; a < m; a++)
        for (int c = 0; c < 2; c++)
            filled[2 * missing[a] + c] = (float)k->system[(size_t)a * system_stride + n + c];
}

/* Psi (3, n) = relu(c V[0] + s V[1] - b) for V (2, 3, n), b (n). */
INLINE void rotate_code_inline(ptrdiff_t n, float c, float s, const float *restrict V, const float *restrict b,
                        float *restrict Psi) {
    for (int r = 0; r < 3; r++)
        for (ptrdiff_t j = 0; j < n; j++) {
            float v = c * V[r * n + j] + s * V[(3 + r) * n + j] - b[j];
            Psi[r * n + j] = v <= 0 ? 0 : v;
        }
}
FAST(rotate_code, (ptrdiff_t n, float c, float s, const float *V, const float *b, float *Psi),
     (n, c, s, V, b, Psi))

/* Set the first block codes of n objects, (n, rotations, 2, 3, k_1).

   The first dictionary is linear: one product serves all rotations of the input. */
static void encode_first(Plan *k, int n, Object *const *objects, int mirrored, float *Psi) {
    int p = k->p, stride = k->stride, first = k->encoder[0].n / 3;
    float *rows = k->x, *whitened = k->x + (size_t)2 * k->block * stride;
    for (int o = 0; o < n; o++)
        for (int i = 0; i < p; i++) {
            const float *w = objects[o]->W + 2 * (mirrored ? k->partners[i] : i);
            for (int a = 0; a < 2; a++)
                rows[(2 * o + a) * stride + i] = (float)(objects[o]->gain * w[a]);
        }
    if (k->whitened) {
        product(2 * n, rows, stride, k->L, NULL, 0, whitened);
        rows = whitened;
    }
    product(2 * n, rows, stride, k->encoder[0], NULL, 0, k->V);
    for (int o = 0; o < n; o++)
        for (int t = 0; t < k->rotations; t++)
            for (int a = 0; a < 2; a++, Psi += 3 * first) {
                /* Row a of the rotated x^T; the mirror image changes the sign of x. */
                const double *T = k->image_rotations + 4 * t + 2 * a;
                float sign = mirrored && !a ? -1 : 1;
                rotate_code(first, sign * (float)T[0], sign * (float)T[1],
                     k->V + (size_t)6 * o * first, k->b[0], Psi);
            }
}

/* Set the cameras (n) of n block codes Psi (n, 6, k) and their codes psi (n, k) of the last layer. */
static void recover(Plan *k, int n, const float *Psi, float *psi, camera *M) {
    int atoms = k->code_head.n, width = k->widths[k->layers - 1];
    for (int row = 0; row < 6 * n; row++) {
        double sum = 0;
        for (int j = 0; j < width; j++) sum += Psi[(size_t)row * atoms + j] * k->camera_head[j];
        M[row / 6][row % 3][row / 3 % 2] = sum;
    }
    for (int i = 0; i < n; i++) polar(M[i]);
    product(n, Psi, 6 * atoms, k->code_head, NULL, 0, psi);
}

/* Set the shapes (n, 3, stride) of codes psi (n, k); `spare` is as large as psi. */
static void decode(Plan *k, int n, float *psi, float *spare, float *shapes) {
    for (int i = k->layers - 1; i > 0; i--) {
        product(n, psi, FLOATS_OF(k->decoder[i].k), k->decoder[i], k->b_[i], 1, spare);
        float *swap = psi;
        psi = spare, spare = swap;
    }
    float *S = k->whitened ? spare : shapes;
    product(n, psi, FLOATS_OF(k->decoder[0].k), k->decoder[0], k->b_[0], 0, S);
    if (k->whitened) product(3 * n, S, k->stride, k->L_inverse, NULL, 0, shapes);
}

void forward(Plan *k, int n, Object *const *objects, int mirrored, float *shapes, camera *M) {
    int rotated = n * k->rotations;
    float *Psi = k->Psi[0], *spare = k->Psi[1];
    encode_first(k, n, objects, mirrored, Psi);
    for (int i = 1; i < k->layers; i++) {
        product(6 * rotated, Psi, FLOATS_OF(k->encoder[i].k), k->encoder[i], k->b[i], 1, spare);
        float *swap = Psi;
        Psi = spare, spare = swap;
    }
    recover(k, rotated, Psi, k->psi[0], M);
    decode(k, rotated, k->psi[0], k->psi[1], shapes);
}
