/* A step of training: the loss of a batch and its gradient. Symbols as in the package's legend; X_bar is
   the gradient of the loss by X.

   Codes of n frames are rows of a matrix, Psi_i (6 n, k_i) and psi_i (n, k_i); shapes are stored with
   the points last, S (n, 3, p), input and residuals (n, 2, p). All k_i, and p, are filled up to FLOATS,
   p to `wide`. What fills them is 0 and stays so: the memory begins as zeros, so do the panels' columns.
*/
#ifndef GRADIENT_H
#define GRADIENT_H

#include <stddef.h>

#include "algebra.h"
#include "geometry.h"

/* What all threads know. */
typedef struct {
    int p, wide, layers, whitened, block, widths[MOST_LAYERS], filled[MOST_LAYERS];
    size_t learned; /* numbers */
} Kind;

/* losses.py, Task. */
typedef struct {
    ptrdiff_t b, c;
    const float *x, *W, *mask, *T; /* (b + c, p, 2), (b, p, 2), (b, p), (c, p, 3) */
    double cycle;                  /* its weight */
} Task;

/* What one thread computes with, for `block` frames at a time.

   encoder[i] is D_i+1, decoder[i] its transpose: the way back through the one is a product with the other. But
   those of the first dictionary, p x 3k and k x 3p, hold its numbers in other orders: the way back through
   decoder[0] is `first`, 3p x k. The way back through code_head is code_back.
*/
typedef struct {
    const Kind *kind;
    Matrix L, L_inverse, first, encoder[MOST_LAYERS], decoder[MOST_LAYERS], code_head, code_back;
    float *b[MOST_LAYERS], *b_[MOST_LAYERS], *camera_head;
    float *bars; /* all gradients, one after the other */
    size_t sums;
    float *D_bar[MOST_LAYERS], *b_bar[MOST_LAYERS], *b__bar[MOST_LAYERS], *code_bar, *camera_bar;
    float *x, *Psi[MOST_LAYERS], *psi[MOST_LAYERS], *S, *S_bar, *left, *weighed, *target, *rows, *spare[2];
    camera *A, *M, *M_bar; /* rows: (n, 2, 3) entries of A, or their gradient */
    double reprojection, cycle; /* sums over its frames */
} Worker;

/* gradient.py: set the losses (reprojection, cycle), the shapes (b, p, 3) and the gradient (learned). */
void gradient_of(Worker *workers, int n, const float *weights, const Task *task, double losses[2], float *shapes,
                 float *gradient);

/* Set what follows from p, the number of layers and their widths. */
void describe(Kind *kind, const int *widths);

/* Set L and its inverse (p, p). */
void whiten_by(Worker *w, const float *L, const float *L_inverse);

/* Lay a worker out at `at`; return how many bytes it takes. */
size_t employ(Worker *w, const Kind *kind, char *at);

/* losses.py, for n frames from the `first`, or n known shapes from the `first`: add their loss, set S_bar and
   M_bar, and of frames the shapes. */
void frames_loss(Worker *w, const Task *task, ptrdiff_t first, int n, float *shapes);
void known_loss(Worker *w, const Task *task, ptrdiff_t first, int n);

#endif
