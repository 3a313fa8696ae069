/* observation.py, for keypoints as they lie in serialised messages. */
#ifndef OBSERVATION_H
#define OBSERVATION_H

#include <stddef.h>

/* Where n objects of q keypoints are: bytes from the beginning to x, y and confidence (below 0: none) of the
   first, from a keypoint to the next, and from an object to the next. All are little-endian floats. */
typedef struct {
    ptrdiff_t n, q, offsets[3], point_step, object_step;
} Places;

/* Write points (n, q, 2) and confidence (n, q), 0 where a keypoint is missing, `farthest` away or more, or has less
   confidence than `least`. */
void observe_keypoints(const char *data, const Places *at, float farthest, float least, float *points,
                       float *confidence);

#endif
