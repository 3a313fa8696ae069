/* SPDX-License-Identifier: Apache-2.0 */
/* Detections and tracks of one topic: lifting/track_matching.py. */
#ifndef TRACKING_H
#define TRACKING_H

#include <stddef.h>

/* In the order of track_matching.py, times in seconds and lengths in sizes of the object. */
typedef struct {
    float max_motion, motion_growth, decay, velocity_gain, size_decay, uncertainty, shrinkage, nearness, reach;
} TrackingConstants;

enum { TRACKING_CONSTANTS = sizeof(TrackingConstants) / sizeof(float) };

/* n detections: points (n, q, 2) in pixels; confidence (n, q), above 0 where visible. */
typedef struct {
    ptrdiff_t n, q;
    const float *points, *confidence;
} Detections;

/* m tracks: points (m, q, 2), age (m, q), velocity (m, 2), size (m), and the seconds that have passed (m). */
typedef struct {
    ptrdiff_t m;
    float *points, *age, *velocity, *size;
    const float *passed;
} TrackArrays;

/* Fill score (n, m), shift (n, m, 2) and best (n), the track of the highest score above 0; -1: none. sigma: (q)
   tolerances of the keypoints. */
void match_tracks(const TrackingConstants *c, const float *sigma, const Detections *detections, const TrackArrays *tracks,
                  float *score, float *shift, int *best);

/* Update the tracks by the detections that `assigned` (n) names for them; below 0: none. */
void update_tracks(const TrackingConstants *c, const Detections *detections, const int *assigned, const float *shift,
                   const TrackArrays *tracks);

#endif
