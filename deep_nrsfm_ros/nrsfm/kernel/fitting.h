/* A plan: what a lifter knows before it sees any keypoints; `compiled.py` fills it. */
#ifndef FITTING_H
#define FITTING_H

#include <stddef.h>

#define MOST_LAYERS 64

typedef struct {
    int p, layers, turns, mirrored, whitened, rms, corrected, refill, reference[2], min_visible;
    const int *widths, *partners;
    const float *L, *L_inverse, *encoder[MOST_LAYERS], *b[MOST_LAYERS], *decoder[MOST_LAYERS],
        *b_[MOST_LAYERS], *code_head, *camera_head, *spread;
    const double *filling, *turn, *frame, *covariance, *calibration;
    double noise, length, unknown;
    void *memory;
    /* Scratch. */
    float *x, *V, *Psi[2], *psi[2], *shapes, *S, *W, *points, *mask;
    double *M, *cameras, *CH, *A, *r, *residual;
} Plan;

/* To be called once, before any lift. */
void choose_instructions(void);

/* Point `k` at its parts of three arrays; return whether these have the `lengths` of a plan. */
int lay_out(Plan *k, const int *header, const float *floats, const double *doubles,
            const ptrdiff_t lengths[3]);

/* Point `k` at its scratch memory, which begins at `at`; return how many bytes it takes. */
size_t scratch(Plan *k, char *at);

/* Lift one object; `fitting.Fit.__call__`. Return whether there is nothing to lift. */
int lift(Plan *k, const float *given, const float *confidence, int perspective, float *shape,
         float *rotated, float *scale, float *translation, float *left, float *sure);

#endif
