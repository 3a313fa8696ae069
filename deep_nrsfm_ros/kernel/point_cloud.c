/* SPDX-License-Identifier: Apache-2.0 */
#include "point_cloud.h"

#include <math.h>
#include <string.h>

void decode_keypoints(const char *data, const CloudLayout *layout, float max_coordinate, float min_confidence, float *points,
                       float *confidence) {
    for (ptrdiff_t k = 0; k < layout->n * layout->q; k++) {
        const char *here = data + k / layout->q * layout->object_step + k % layout->q * layout->point_step;
        float value[3] = {0, 0, 1};
        for (int i = 0; i < 3; i++)
            if (layout->offsets[i] >= 0) memcpy(value + i, here + layout->offsets[i], sizeof(float));
        /* NaN compares false. */
        int visible = fabsf(value[0]) < max_coordinate && fabsf(value[1]) < max_coordinate && (value[0] != 0 || value[1] != 0);
        if (layout->offsets[2] >= 0) visible = visible && value[2] >= min_confidence && value[2] < max_coordinate;
        for (int i = 0; i < 2; i++) points[2 * k + i] = visible ? value[i] : 0;
        confidence[k] = visible ? fminf(value[2], 1) : 0;
    }
}
