/* SPDX-License-Identifier: Apache-2.0 */
/* A plan: a lifter's constants in the kernel's layout, and the memory that it computes with.

   CompiledBackend in lifting/compiled_backend.py fills it. Symbols as in the paper: p keypoints, W (p, 2)
   normalised keypoints, S shape, M (3, 2) camera, R (3, 3) rotation from object to camera axes, Psi (3 k, 2)
   block code, psi (k) code.

   Shapes are stored with the keypoints last, S (3, p), so that every layer is one `product`. Rows of S are
   `stride` apart, p filled up to a multiple of FLOATS. Files carry the names of the Python modules that compute
   the same: lift.c that of numpy_backend.py.
*/
#ifndef PLAN_H
#define PLAN_H

#include <stddef.h>

#include "algebra.h"
#include "geometry.h"

/* An object that is lifted. */
typedef struct {
    const float *image_points, *confidence; /* (p, 2), (p): the arguments of `lift` */
    float *input, *input_mask;              /* (p, 2), (p): what the network reads, refilled round by round */
    float *visible;                         /* (p), 1 or 0: whether the network reads the keypoint */
    double *weight, *certainty;             /* (p) in the correction, and relative confidence; 0 = missing */
    char *wrong;                            /* (p), an output of `lift`: 1 = contradicts the other keypoints */
    float *W, *S;                           /* (p, 2), (3, stride) in camera axes */
    double gain;                            /* p / number of keypoints in the input */
    double unit, origin[2];                 /* image = unit W + origin */
    double visible_count, residual;
    camera M;
    rotation R;
    /* Of a context; see `recall`. */
    double *state;          /* what is remembered of it; NULL: nothing */
    const double *bones;    /* (bones, 2) length and deviation: its own, or the model's */
    double *own_bones, *own_growth; /* (bones, 2); (bones) logarithms of their lengths relative to the model's */
    const double *view;     /* (3, 3) from the camera to the view that is lifted; NULL: they are the same */
    double time, seconds;   /* of this frame; since the last one */
    int last;               /* whether the next fit is the last one, which updates the state */
    int first;              /* whether it is the first one, which looks for wrong keypoints */
    int goes_on, updates;   /* whether the state is smoothed on, and changed at all */
    int upright;            /* whether gravity is known */
    double up[3];           /* against gravity, in the view */
} Object;

/* What is known of n objects beside their keypoints: Context of lifting/history.py. */
typedef struct {
    double *states;                 /* (capacity, state_size) */
    ptrdiff_t capacity;
    const int *rows;                /* (n); < 0: nothing is remembered */
    double time;                    /* seconds */
    const double *up, *to_view;     /* (3), (n, 3, 3); NULL: unknown, the same */
} Context;

/* Constants of lifting/history.py, own_bones.py and gravity.py, in the order of the plan's doubles. */
typedef struct {
    double shape_time, hidden_time, rotation_time, bones_time, max_gap, max_back, outlier, max_step, max_seconds,
        memory, max_variance_reduction, misfit_time, misfit_ratio, change_evidence, doubted_evidence, lean_deviation, free_lean,
        cosine_of_turn, max_agreement;
} HistoryConstants;
#define HISTORY_NUMBERS ((int)(sizeof(HistoryConstants) / sizeof(double)))

typedef struct {
    int p, stride, layers, rotations, refill_rounds, reference[2], min_visible, bones, derivations;
    int leave_out_wrong, fewest_left, candidates, most_wrong; /* lifting/wrong_keypoints.py */
    int mirrored, whitened, scale_by_rms, corrected, has_axis;           /* flags */
    const int *widths, *partners, *bone_ends;                            /* (layers), (p), (bones, 2) */
    const int *derivation_pairs; /* (derivations, 2): a keypoint, and one that it follows from */
    const int *bone_partners;    /* (bones): of each bone that of the other side, or itself */
    Matrix L, L_inverse, encoder[MAX_LAYERS], decoder[MAX_LAYERS], code_head;
    const float *b[MAX_LAYERS], *b_[MAX_LAYERS], *camera_head;
    const float *log_error_std, *covariance;                             /* (p), (p, 3, 3, p) in DOUBLES */
    const double *completion, *image_rotations, *object_frame;           /* (p, p), (rotations, 2, 2), (3, 3) */
    const double *calibration, *point_precision;                         /* (2, COEFFICIENTS), (p, p) */
    const double *bone_lengths;                                          /* (bones, 2) length and deviation */
    const double *bone_correlation;                                      /* (bones, bones), symmetric */
    const double *axis;                                                  /* (p) from bottom to top */
    HistoryConstants history;
    double noise, reference_length, unknown_variance, min_relative_depth, residual_scale, min_residual,
        residual_ratio, min_distance, residual_offset, trusted_weight, full_ratio, extent_offset, min_known;
    void *constants, *scratch; /* the memory of all above, and of all below */
    int busy;                  /* whether a lift computes in the scratch memory */
    /* Scratch memory, for `block` objects at a time. Rows of doubles are filled up to multiples of DOUBLES. */
    int block, *missing;          /* (p) keypoints that are not in the input */
    Object *objects, **incomplete; /* (block): all, and those with missing keypoints */
    float *x, *V;                 /* input of the network, and its product with the first dictionary */
    float *Psi[2], *psi[2];       /* codes of two neighbouring layers */
    float *shapes;                /* (mirrored + 1, n, rotations, 3, stride) of n objects */
    double *cameras, *residuals;  /* (mirrored + 1, n, rotations, 3, 2), (mirrored + 1, rotations) */
    double *point_cameras, *E;    /* (3, 2, p) projection of each keypoint, (3, p) errors of the shape */
    double *system, *difference;  /* A x = b of the correction, W less the projection of S (2, p) */
    double *bone_directions;      /* (bones + 2, 4) unit vectors and lengths; last those of gravity */
    double *bone_covariance;      /* (bones + 2, 3, p) of the growth of a bone and the errors */
    double *sight;                /* (2, bones) growth and weight of the bones in this frame */
    double *precision, *no_growth; /* (bones) length / deviation of the model; 0 */
    double *spread;               /* (DOUBLES, 2, p) of bones and keypoints in the image */
    double *gap;                  /* (p) deviation of a missing keypoint given the visible ones */
    double *apart;                /* (p) distances of the keypoints from their projections */
    float *shown;                 /* (2, p) which keypoints are visible, with and without the wrong ones */
} Plan;

#define COEFFICIENTS 7 /* of the log odds of a keypoint: Coefficients of lifting/confidence.py */

/* Limits of a plan, as those of a network in algebra.h. */
#define MAX_ROTATIONS 1024
#define MAX_BONES 65536
#define MAX_DERIVATIONS 65536
#define MAX_CANDIDATES 8 /* for a wrong keypoint */
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

/* Set `filled` (p, 2) to the input, with the missing keypoints that fit the network's prior. */
void complete_points(Plan *k, const Object *o, float *filled);

/* Set W, gain, unit and origin from the input. */
void normalise(Plan *k, Object *o);

/* Set shapes (n, rotations, 3, stride) and cameras (n, rotations) of n objects from the rotations of W, or of its
   mirror image. */
void forward(Plan *k, int n, Object *const *objects, int mirrored, float *shapes, camera *cameras);

/* Set S in camera axes, M and residual of n objects: means over rotations and mirror images, weighted by their
   residuals. */
void average_rotations(Plan *k, int n, Object *const *objects, int perspective);

/* Return whether an object is lifted: enough keypoints are detected, and not all lie on one line. `fewest`: that many
   are enough. */
int is_lifted(const Plan *k, const Object *o, int fewest);

/* Take keypoints that contradict the others as missing, after `average_rotations` of an object, and set its S, M and
   residual anew. */
void leave_out_wrong(Plan *k, Object *o, int perspective);

/* Return the doubles of a state. */
ptrdiff_t state_size(const Plan *k);

/* Set what object i has of a context, NULL if there is none. `lifted`: an object that is not lifted changes no
   state. */
void recall(Plan *k, Object *o, const Context *context, ptrdiff_t i, int lifted);

/* Smooth S, in object axes, R and M of an object with a state, and update its shape, rotation and time. */
void smooth_network(Plan *k, Object *o);

/* Learn the bone lengths of S + E, in object axes, of an object with a state. */
void learn_bones(Plan *k, Object *o);

/* Set two directions (2, 4) across gravity, in object axes, and values: how much is missing along each for S to be
   upright, and the standard deviation of both, by the lean of S + E. Returns their number. */
int set_upright(Plan *k, Object *o, double *directions, double values[3]);

/* Set the directions and lengths of the bones of S + E; return the size of the object, relative to the bone
   lengths of the plan. */
double measure_bones(Plan *k, const Object *o);

/* Move S, in object axes, by its expected error given W, the point cameras and the bone lengths. `noise`: standard
   deviation of W. */
void correct(Plan *k, Object *o, double noise);

/* Lift n objects.

   points (n, p, 2), confidence (n, p). Outputs, as in `lifting.Lifted`: shapes (n, p, 3), rotations (n, 3, 3),
   scale (n), translation (n, 2), residual (n), confidence (n, p) and, apart, wrong (n, p), a detected keypoint that
   contradicts the others; not_lifted (n) is 1 where too few keypoints are detected or all lie on one line. An object's
   result does not depend on the others. context: NULL if there is none; its states are updated. */
void lift(Plan *k, ptrdiff_t n, const float *points, const float *confidence, int perspective,
          const Context *context, float *const outputs[6], char *wrong, char *not_lifted);

#endif
