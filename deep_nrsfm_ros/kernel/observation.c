#include "observation.h"

#include <math.h>
#include <string.h>

void observe_keypoints(const char *data, const Places *at, float farthest, float least, float *points,
                       float *confidence) {
    for (ptrdiff_t k = 0; k < at->n * at->q; k++) {
        const char *here = data + k / at->q * at->object_step + k % at->q * at->point_step;
        float value[3] = {0, 0, 1};
        for (int i = 0; i < 3; i++)
            if (at->offsets[i] >= 0) memcpy(value + i, here + at->offsets[i], sizeof(float));
        /* NaN compares false. */
        int seen = fabsf(value[0]) < farthest && fabsf(value[1]) < farthest && (value[0] != 0 || value[1] != 0);
        if (at->offsets[2] >= 0) seen = seen && value[2] >= least && value[2] < farthest;
        for (int i = 0; i < 2; i++) points[2 * k + i] = seen ? value[i] : 0;
        confidence[k] = seen ? fminf(value[2], 1) : 0;
    }
}
