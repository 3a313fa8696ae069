/* compiled.py: what a plan is made of. */
#include "plan.h"

/* Rows of a product, at most: more of them, and the codes of a block leave the cache. */
#define ROWS 144

static const float *matrix(Matrix *A, int k, int n, const float *at) {
    A->k = k, A->n = FLOATS_OF(n), A->panels = at;
    return at + (size_t)k * A->n;
}

int lay_out(Plan *k, const int *header, const float *floats, const double *doubles,
            const ptrdiff_t lengths[3]) {
    const int *h = header;
    const float *f = floats;
    const double *d = doubles;
    k->p = *h++, k->layers = *h++, k->turns = *h++, k->mirrored = *h++, k->whitened = *h++;
    k->rms = *h++, k->corrected = *h++, k->refill = *h++, k->reference[0] = *h++;
    k->reference[1] = *h++, k->min_visible = *h++, k->bones = *h++;
    int p = k->p, wide = k->wide = FLOATS_OF(p), last;
    k->widths = h, h += k->layers;
    k->partners = h, h += p;
    k->ends = h, h += 2 * k->bones;
    f = matrix(&k->L, p, p, f);
    f = matrix(&k->L_inverse, p, p, f);
    for (int i = 0; i < k->layers; i++) {
        int to = k->widths[i], from = i ? k->widths[i - 1] : 0;
        f = matrix(&k->encoder[i], i ? from : p, i ? to : 3 * FLOATS_OF(to), f);
        k->b[i] = f, f += FLOATS_OF(to);
        f = matrix(&k->decoder[i], to, i ? from : 3 * wide, f);
        k->b_[i] = f, f += k->decoder[i].n;
    }
    last = k->widths[k->layers - 1];
    f = matrix(&k->code_head, 6 * FLOATS_OF(last), last, f);
    k->camera_head = f, f += last;
    k->spread = f, f += p;
    k->covariance = f, f += (size_t)9 * DOUBLES_OF(p) * DOUBLES_OF(p);
    k->filling = d, d += (size_t)p * p;
    k->turn = d, d += 4 * k->turns;
    k->frame = d, d += 9;
    k->calibration = d, d += 5;
    k->lengths = d, d += 2 * k->bones;
    k->noise = *d++, k->length = *d++, k->unknown = *d++, k->nearest = *d++;
    k->residual_spread = *d++, k->least_residual = *d++;
    return h - header == lengths[0] && f - floats == lengths[1] && d - doubles == lengths[2];
}

size_t scratch(Plan *k, char *at) {
    int n = k->block = 6 * k->turns < ROWS ? ROWS / (6 * k->turns) : 1;
    int p = k->p, wide = k->wide, all = k->turns * (1 + k->mirrored);
    size_t even = DOUBLES_OF(p), bones = DOUBLES_OF(k->bones);
    size_t widest = 3 * wide, turned = (size_t)n * k->turns, used = 0;
    for (int i = 0; i < k->layers; i++)
        if ((size_t)FLOATS_OF(k->widths[i]) > widest) widest = FLOATS_OF(k->widths[i]);
#define ROOM(member, type, count)                    \
    member = (type *)(at ? at + used : NULL);         \
    used += ((count) * sizeof(type) + 63) / 64 * 64;
    ROOM(k->x, float, 4 * (size_t)n * wide)
    ROOM(k->V, float, 6 * n * widest)
    ROOM(k->Psi[0], float, 6 * turned * widest)
    ROOM(k->Psi[1], float, 6 * turned * widest)
    ROOM(k->psi[0], float, turned * widest)
    ROOM(k->psi[1], float, turned * widest)
    ROOM(k->shapes, float, 3 * (size_t)n * all * wide)
    ROOM(k->M, double, 6 * (size_t)n * all)
    ROOM(k->residual, double, all)
    ROOM(k->cameras, double, 6 * even)
    ROOM(k->seen, double, 2 * DOUBLES * even)
    ROOM(k->E, double, 3 * even)
    ROOM(k->A, double, (2 * even + bones) * (2 * even + bones + DOUBLES))
    ROOM(k->left, double, 2 * even)
    ROOM(k->edges, double, 4 * bones)
    ROOM(k->along, double, 3 * even * bones)
    ROOM(k->missing, int, p)
    ROOM(k->some, Object *, n)
    ROOM(k->objects, Object, n)
    Object nobody, *o = at ? k->objects : &nobody;
    for (int i = 0; i < n; i++, o += at != 0) {
        ROOM(o->points, float, 2 * p)
        ROOM(o->mask, float, p)
        ROOM(o->visible, float, p)
        ROOM(o->W, float, 2 * p)
        ROOM(o->S, float, 3 * wide)
    }
#undef ROOM
    return used;
}
