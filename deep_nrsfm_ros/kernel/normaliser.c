/* normaliser.py, for one object. */
#include <math.h>

#include "plan.h"

static void encode(Plan *k, Object *o, const float *points, const float *mask) {
    int p = k->p;
    double n = 0, square = 0;
    o->origin[0] = o->origin[1] = 0;
    for (int i = 0; i < p; i++) {
        n += mask[i];
        for (int c = 0; c < 2; c++) o->origin[c] += mask[i] * points[2 * i + c];
    }
    n = fmax(n, 1);
    for (int c = 0; c < 2; c++) o->origin[c] /= n;
    for (int i = 0; i < 2 * p; i++) {
        double w = (points[i] - o->origin[i % 2]) * mask[i / 2];
        o->W[i] = (float)w;
        square += w * w;
    }
    o->unit = k->rms ? 2 * (sqrt(square / n) + 1e-9) : 1;
    for (int i = 0; i < 2 * p; i++) o->W[i] = (float)(o->W[i] / o->unit);
    o->gain = p / n;
}

void observe(Plan *k, Object *o) {
    int whole = 1;
    for (int i = 0; i < k->p; i++) whole &= o->mask[i] > 0;
    if (whole || !k->whitened) {
        encode(k, o, o->points, o->mask);
        return;
    }
    float *filled = k->V, *everything = k->V + 2 * k->p;
    complete(k, o, filled);
    for (int i = 0; i < k->p; i++) everything[i] = 1;
    encode(k, o, filled, everything);
}
