/* SPDX-License-Identifier: Apache-2.0 */
/* Depths that are steady over time: lifting/steady_depth.py. */
#ifndef STEADY_DEPTH_H
#define STEADY_DEPTH_H

#include <stddef.h>

/* In the order of steady_depth.py, times in seconds and cutoffs in Hz. */
typedef struct {
    double cutoff, beta, speed_cutoff, max_gap, max_back;
} DepthConstants;

enum { DEPTH_CONSTANTS = sizeof(DepthConstants) / sizeof(double) };

/* Change the shapes (n, p, 3) and rotations (n, 3, 3) of n objects, and their rows of the states; a row of 1 + 7 p numbers
   for each object, below 0: none. time: of the frame, in seconds. NaN objects are left as they are. */
void steady_depths(const DepthConstants *c, double time, ptrdiff_t n, ptrdiff_t p, double *states, const int *rows, float *shapes,
                   float *rotations);

#endif
