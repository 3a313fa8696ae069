/* SPDX-License-Identifier: Apache-2.0 */
/* The bones of one object: Bones of nrsfm/bones.py. */
#include <math.h>

#include "plan.h"

double measure_bones(Plan *k, const Object *o) {
    int p = DOUBLES_OF(k->p);
    double size = 0, weights = 0;
    for (int b = 0; b < k->bones; b++) {
        const int *ends = k->bone_ends + 2 * b;
        const double *bone = o->bones + 2 * b;
        double *edge = k->bone_directions + 4 * b, square = 0, weight = bone[0] / bone[1] * (bone[0] / bone[1]);
        for (int r = 0; r < 3; r++) {
            const float *S = o->S + r * k->stride;
            const double *E = k->E + r * p;
            edge[r] = S[ends[0]] + E[ends[0]] - (S[ends[1]] + E[ends[1]]);
            square += edge[r] * edge[r];
        }
        edge[3] = sqrt(square);
        for (int r = 0; r < 3; r++) edge[r] /= fmax(edge[3], 1e-9);
        size += weight * edge[3] / bone[0], weights += weight;
    }
    return size / weights;
}
