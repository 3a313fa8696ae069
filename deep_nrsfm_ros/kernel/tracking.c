/* SPDX-License-Identifier: Apache-2.0 */
#include "tracking.h"

#include <math.h>

/* Centre and size of the visible keypoints of an object. */
typedef struct {
    float x, y, size;
} Extent;

static Extent extent(ptrdiff_t q, const float *points, const float *confidence) {
    float x = 0, y = 0, squares = 0;
    int visible = 0;
    for (ptrdiff_t k = 0; k < q; k++)
        if (confidence[k] > 0) x += points[2 * k], y += points[2 * k + 1], visible++;
    x /= visible, y /= visible;
    for (ptrdiff_t k = 0; k < q; k++)
        if (confidence[k] > 0) {
            float dx = points[2 * k] - x, dy = points[2 * k + 1] - y;
            squares += dx * dx + dy * dy;
        }
    return (Extent){x, y, fmaxf(sqrtf(squares / visible), 1e-9f)};
}

/* A track some seconds later: its keypoints are moved by (dx, dy). */
typedef struct {
    float dx, dy, decay, size, limit;
    Extent known; /* centre of the keypoints that were ever visible */
} Prediction;

static Prediction predict(const TrackingConstants *c, ptrdiff_t q, const TrackArrays *tracks, ptrdiff_t j) {
    float passed = tracks->passed[j], decay = expf(-passed / c->decay), x = 0, y = 0;
    float dx = tracks->velocity[2 * j] * c->decay * (1 - decay), dy = tracks->velocity[2 * j + 1] * c->decay * (1 - decay);
    int known = 0;
    for (ptrdiff_t k = j * q; k < (j + 1) * q; k++)
        if (tracks->age[k] < INFINITY) x += tracks->points[2 * k], y += tracks->points[2 * k + 1], known++;
    float size = tracks->size[j] * expf(-passed / c->size_decay);
    return (Prediction){dx, dy, decay, size, c->max_motion + c->motion_growth * passed,
                        {x / known + dx, y / known + dy, 0}};
}

/* Return the distance of the centres in sizes of the object. */
static float centre_distance(Extent object, const Prediction *predicted) {
    float distance = hypotf(object.x - predicted->known.x, object.y - predicted->known.y);
    return distance / fmaxf(object.size, predicted->size);
}

/* A detection and a track. */
typedef struct {
    const float *points, *confidence;
    Extent extent;
} Object;

typedef struct {
    const float *points, *age;
    float passed;
    Prediction predicted;
} Track;

/* Return the score of a pair that may match; set its shift. */
static float score_pair(const TrackingConstants *c, const float *sigma, ptrdiff_t q, const Object *object, const Track *track,
                        float shift[2]) {
    const Prediction *predicted = &track->predicted;
    float size = fmaxf(object->extent.size, predicted->size), common = 0, oks = 0, x = 0, y = 0;
    float weights = 0, weighted_x = 0, weighted_y = 0;
    for (ptrdiff_t k = 0; k < q; k++) {
        if (!(object->confidence[k] > 0) || !(track->age[k] < INFINITY)) continue;
        float dx = object->points[2 * k] - track->points[2 * k] - predicted->dx;
        float dy = object->points[2 * k + 1] - track->points[2 * k + 1] - predicted->dy;
        float growth = c->uncertainty * (track->age[k] + track->passed), variance = sigma[k] * sigma[k] + growth * growth;
        float similarity = expf(-0.5f * (dx * dx + dy * dy) / (size * size * variance)), weight = similarity + 1e-6f;
        /* Where a hidden keypoint may be anywhere, a detection nearby proves less. */
        common += 1, oks += similarity * sigma[k] / sqrtf(variance);
        x += dx, y += dy;
        weights += weight, weighted_x += weight * dx, weighted_y += weight * dy;
    }
    shift[0] = weighted_x / fmaxf(weights, 1e-9f), shift[1] = weighted_y / fmaxf(weights, 1e-9f);
    float motion = hypotf(x, y) / (fmaxf(common, 1) * size * predicted->limit);
    if (!(motion < 1)) return 0; /* NaN is no match */
    if (common > 0) return oks / (common + c->shrinkage) + c->nearness * (1 - motion);
    float distance = centre_distance(object->extent, predicted), centred = 1 - distance / (predicted->limit + c->reach);
    return c->nearness * centred * centred;
}

enum { BLOCK = 32 }; /* detections whose extents are kept */

void match_tracks(const TrackingConstants *c, const float *sigma, const Detections *detections, const TrackArrays *tracks,
                  float *score, float *shift, int *best) {
    ptrdiff_t n = detections->n, m = tracks->m, q = detections->q;
    for (ptrdiff_t first = 0; first < n; first += BLOCK) {
        ptrdiff_t last = first + BLOCK < n ? first + BLOCK : n;
        Object objects[BLOCK];
        for (ptrdiff_t i = first; i < last; i++) {
            const float *points = detections->points + 2 * i * q, *confidence = detections->confidence + i * q;
            best[i] = -1;
            objects[i - first] = (Object){points, confidence, extent(q, points, confidence)};
        }
        for (ptrdiff_t j = 0; j < m; j++) {
            Track track = {tracks->points + 2 * j * q, tracks->age + j * q, tracks->passed[j], predict(c, q, tracks, j)};
            for (ptrdiff_t i = first; i < last; i++) {
                const Object *object = objects + i - first;
                float *shifted = shift + 2 * (i * m + j), far = track.predicted.limit + c->reach;
                int near = centre_distance(object->extent, &track.predicted) < far || n * m == 1;
                shifted[0] = shifted[1] = 0;
                float scored = score[i * m + j] = near ? score_pair(c, sigma, q, object, &track, shifted) : 0;
                if (scored > (best[i] < 0 ? 0 : score[i * m + best[i]])) best[i] = j;
            }
        }
    }
}

void update_tracks(const TrackingConstants *c, const Detections *detections, const int *assigned, const float *shift,
                   const TrackArrays *tracks) {
    ptrdiff_t q = detections->q;
    for (ptrdiff_t i = 0; i < detections->n; i++) {
        ptrdiff_t j = assigned[i];
        if (j < 0) continue;
        const float *points = detections->points + 2 * i * q, *confidence = detections->confidence + i * q;
        const float *moved = shift + 2 * (i * tracks->m + j);
        Prediction predicted = predict(c, q, tracks, j);
        float *track = tracks->points + 2 * j * q, *age = tracks->age + j * q, passed = tracks->passed[j];
        for (ptrdiff_t k = 0; k < q; k++) {
            int visible = confidence[k] > 0;
            track[2 * k] = visible ? points[2 * k] : track[2 * k] + predicted.dx + moved[0];
            track[2 * k + 1] = visible ? points[2 * k + 1] : track[2 * k + 1] + predicted.dy + moved[1];
            age[k] = visible ? 0 : age[k] + passed;
        }
        for (int axis = 0; axis < 2; axis++)
            tracks->velocity[2 * j + axis] =
                tracks->velocity[2 * j + axis] * predicted.decay + moved[axis] * c->velocity_gain / fmaxf(passed, 1e-3f);
        tracks->size[j] = fmaxf(extent(q, points, confidence).size, predicted.size);
    }
}
