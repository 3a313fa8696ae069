/* SPDX-License-Identifier: Apache-2.0 */
/* The forward and the backward pass of a network in training: network.py, and its gradient as torch's
   autograd finds it. Symbols as in the legend of deep_nrsfm_ros.nrsfm; X_bar is the gradient of the loss by X.

   Codes of n frames are rows of a matrix, Psi_i (6 n, k_i) and psi_i (n, k_i). Shapes have the points last,
   S (n, 3, p), and so has the input, (n, 2, p). All k_i and p are padded to a multiple of FLOATS, p to `wide`.
   The padding of matrices, biases and gradients is 0: memory starts as zeros and nothing writes there.
*/
#ifndef TRAINING_PASS_H
#define TRAINING_PASS_H

#include <stddef.h>

#include "algebra.h"

/* Limits under which, with those of a network, no number below overflows an int or 64 bits. */
#define MAX_BLOCK 256 /* frames of a block */
#define MAX_THREADS 256

/* Sizes of a network; all workers share them. */
typedef struct {
    int p, wide, layers, whitened, widths[MAX_LAYERS], filled[MAX_LAYERS];
    int block;           /* frames that are computed at a time, so that their codes stay in the cache */
    size_t weights;      /* learned numbers: the length of the weight vector */
    size_t activations;  /* floats that the forward pass keeps of each frame */
} NetworkSizes;

/* What the forward pass keeps of n frames, and the backward pass reads. */
typedef struct {
    float *x;                                     /* (2 n, wide), whitened */
    float *Psi[MAX_LAYERS], *psi[MAX_LAYERS];   /* (6 n, filled_i), (n, filled_i) */
    float *camera_rows;                           /* (n, 2, 3): M^T before it is made orthonormal */
} Activations;

/* The memory of one thread.

   encoder[i] is D_i+1 and decoder[i] its transpose: the gradient goes back through the one by a product with the
   other. For the first dictionary, p x 3k and k x 3p, the entries have another order: the gradient goes back through
   decoder[0] by `first`, 3p x k. It goes back through code_head by code_back.
*/
typedef struct {
    const NetworkSizes *sizes;
    Matrix L, L_inverse, first, encoder[MAX_LAYERS], decoder[MAX_LAYERS], code_head, code_back;
    float *b[MAX_LAYERS], *b_[MAX_LAYERS], *camera_head;
    float *gradient; /* all gradients by the weights, padded, one after the other */
    size_t gradient_floats;
    float *D_bar[MAX_LAYERS], *b_bar[MAX_LAYERS], *b__bar[MAX_LAYERS], *code_bar, *camera_bar;
    float *S, *S_bar, *camera_bars, *spare[2]; /* scratch of one block of frames */
} Worker;

/* Workers, one for each thread, and the weights that they have laid out. */
typedef struct {
    NetworkSizes sizes;
    int threads;
    int busy;      /* a call is using the workers */
    int laid_out;  /* `weights` are those that the workers have laid out */
    float *weights;
    Worker *workers;
    char *memory;
} WorkerPool;

/* Set what follows from p, the number of layers and their widths. */
void network_sizes_set(NetworkSizes *sizes, const int *widths);

/* Point a worker at its memory, which begins at `at`; return how many bytes it takes. */
unsigned long long worker_lay_out(Worker *w, const NetworkSizes *sizes, char *at);

/* Set L and its inverse (p, p). */
void worker_set_whitening(Worker *w, const float *L, const float *L_inverse);

/* Forward pass of input x (n, 2, p): set S (n, 3, p), M^T (n, 2, 3) and the activations, n * sizes.activations floats.
   The weights are in the order of `Network.trainable_weights`. */
void network_forward(WorkerPool *pool, const float *weights, ptrdiff_t n, const float *x, float *activations, float *S,
                     float *M_T);

/* Backward pass: set the gradient by the weights from S_bar (n, 3, p) and M_T_bar (n, 2, 3). The weights and the
   activations are those of the forward pass. */
void network_backward(WorkerPool *pool, const float *weights, ptrdiff_t n, const float *activations, const float *S_bar,
                      const float *M_T_bar, float *gradient);

#endif
