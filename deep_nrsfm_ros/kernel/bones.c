/* bones.py, for one object. */
#include <math.h>

#include "plan.h"

double observe_bones(Plan *k, const Object *o) {
    int p = DOUBLES_OF(k->p);
    double size = 0, all = 0;
    for (int b = 0; b < k->bones; b++) {
        const int *ends = k->ends + 2 * b;
        const double *known = k->lengths + 2 * b;
        double *edge = k->edges + 4 * b, square = 0, trust = known[0] / known[1] * (known[0] / known[1]);
        for (int r = 0; r < 3; r++) {
            const float *S = o->S + r * k->wide;
            const double *E = k->E + r * p;
            edge[r] = S[ends[0]] + E[ends[0]] - (S[ends[1]] + E[ends[1]]);
            square += edge[r] * edge[r];
        }
        edge[3] = sqrt(square);
        for (int r = 0; r < 3; r++) edge[r] /= fmax(edge[3], 1e-9);
        size += trust * edge[3] / known[0], all += trust;
    }
    return size / all;
}
