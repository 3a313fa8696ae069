/* What a lifter knows before it sees any keypoints, and where it computes; `compiled.py` fills it.

   Shapes are stored with the points last, S (3, p), so that every layer is one `product`. Rows of S
   are `wide` apart, p filled up to FLOATS. Symbols as in the package's legend.
*/
#ifndef PLAN_H
#define PLAN_H

#include <stddef.h>

#include "algebra.h"
#include "geometry.h"

/* An object that is being lifted. */
typedef struct {
    const float *given, *confidence; /* (p, 2), (p) */
    float *points, *mask;            /* what the network sees, (p, 2) of (p) */
    float *visible;                  /* (p), 1 or 0 */
    float *W, *S;                    /* (p, 2), (3, wide) in camera axes */
    double gain, unit, origin[2], seen, residual;
    camera M;
    rotation R;
} Object;

typedef struct {
    int p, wide, layers, turns, mirrored, whitened, rms, corrected, refill, reference[2], min_visible, bones;
    const int *widths, *partners, *ends;
    Matrix L, L_inverse, encoder[MOST_LAYERS], decoder[MOST_LAYERS], code_head;
    const float *b[MOST_LAYERS], *b_[MOST_LAYERS], *camera_head, *spread, *covariance;
    const double *filling, *turn, *frame, *calibration, *lengths;
    double noise, length, unknown, nearest, residual_spread, least_residual;
    void *constants, *scratch; /* the memory of all above, and of all below */
    int busy;                  /* whether a lift computes in the scratch memory */
    /* Scratch, for `block` objects at a time. */
    int block, *missing;
    Object *objects, **some;
    float *x, *V, *Psi[2], *psi[2], *shapes;
    double *M, *cameras, *seen, *E, *A, *left, *edges, *along, *residual;
} Plan;

/* Limits of a plan, as those of a network in algebra.h. */
#define MAX_ROTATIONS 1024
#define MAX_BONES 65536
#define MAX_REFILL 1000 /* rounds; so that no plan makes a lift endless */

/* Check the numbers of a plan's header (length): counts, flags, widths and indices of keypoints. Returns what is
   wrong, NULL if nothing. */
const char *check_header(const int *header, ptrdiff_t length);

/* Point `k` at its parts of three arrays, of which the header is checked. Returns what is wrong with the lengths
   of the others or with numbers that the lift divides by, NULL if nothing. */
const char *lay_out(Plan *k, const int *header, const float *floats, const double *doubles, size_t n_floats,
                    size_t n_doubles);

/* Point `k` at its scratch memory, NULL to compute only its size in bytes. Returns 0 if that overflows. */
int lay_out_scratch(Plan *k, char *memory, size_t *size);

/* network.py: set `filled` to the points, the missing filled in. */
void complete(Plan *k, const Object *o, float *filled);

/* normaliser.py: set W and what leads back to the image. */
void observe(Plan *k, Object *o);

/* network.py: set `shapes` (n, turns, 3, wide) and the cameras M (n, turns) of n objects by turns of
   their input; `across`: of its mirror image. */
void forward(Plan *k, int n, Object *const *objects, int across, float *shapes, camera *M);

/* bones.py: set the edges (bones, 4) of S + E, unit vectors and lengths; return the size of the object. */
double observe_bones(Plan *k, const Object *o);

/* correction.py: move S, in the axes of the object, towards the visible of W. `cameras` (3, 2, p), p in
   DOUBLES: those of each point. */
void correct(Plan *k, Object *o, double noise);

/* fitting.py, Fit.__call__: lift n objects into the arrays of `lifting.Lifted`; set `lost` (n) where there
   is nothing to lift. */
void lift(Plan *k, ptrdiff_t n, const float *points, const float *confidence, int perspective,
          float *const lifted[6], char *lost);

#endif
