/* SPDX-License-Identifier: Apache-2.0 */
/* Keypoints in the data of serialised PointCloud2 messages. */
#ifndef POINT_CLOUD_H
#define POINT_CLOUD_H

#include <stddef.h>

/* Where the keypoints of n objects of q keypoints are, in bytes: offsets of x, y and confidence (below 0: none) of
   the first, and steps to the next keypoint and the next object. All are little-endian float32. */
typedef struct {
    ptrdiff_t n, q, offsets[3], point_step, object_step;
} CloudLayout;

/* Write points (n, q, 2) and confidence (n, q) in [0, 1]. Both are 0 where a keypoint is missing: at (0, 0), not
   finite, a coordinate of `max_coordinate` or more, or a confidence below `min_confidence`. */
void decode_keypoints(const char *data, const CloudLayout *at, float max_coordinate, float min_confidence, float *points,
                       float *confidence);

#endif
