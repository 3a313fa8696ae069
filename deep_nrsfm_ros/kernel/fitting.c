/* fitting.py, for a block of objects at a time.

   A lift is some four hundred small NumPy calls, and calling them costs ten times what they compute.
   This folder does the same in one: its files carry the names of the Python modules, its functions
   those of the Python functions that say what they do and why, and the tests hold both to the same
   results. Nothing that is computed of an object depends on the others of its block.
*/
#include <math.h>
#include <string.h>

#include "plan.h"

/* Put one of the shapes of the network, seen after turn t, in camera axes, and its camera M in place. */
static void place(Plan *k, int t, int across, float *S, camera M) {
    int p = k->p, wide = k->wide;
    const double *T = k->turn + 4 * t;
    rotation A, R;
    camera framed = {{0}};
    for (int i = 0; i < 9; i++) A[i % 3][i / 3] = k->frame[i]; /* transposed: S A is A^T S here */
    rotate(p, wide, A, S);
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 2; c++) {
            for (int q = 0; q < 3; q++) framed[r][c] += A[r][q] * M[q][c];
            if (across) framed[r][c] *= (r == 1 ? -1 : 1) * (c == 0 ? -1 : 1);
        }
    for (int r = 0; r < 3 && across; r++) {
        for (int i = 0; i < p; i++) k->V[i] = (r == 1 ? -1 : 1) * S[r * wide + k->partners[i]];
        memcpy(S + r * wide, k->V, p * sizeof(float));
    }
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 2; c++) M[r][c] = framed[r][0] * T[c] + framed[r][1] * T[2 + c];
    rotation_from_camera(M, R);
    rotate(p, wide, R, S);
}

/* What shape S leaves of W. */
static double left_over(Plan *k, const Object *o, int perspective, const float *S) {
    int p = k->p, wide = k->wide;
    float *P = k->V;
    if (!perspective) return reprojection_error(moments(p, o->W, S, wide, o->visible));
    for (int i = 0; i < p; i++) {
        float depth = (float)fmax((float)(1 + o->unit * S[2 * wide + i]), k->nearest);
        P[i] = S[i] / depth, P[wide + i] = S[wide + i] / depth;
    }
    return reprojection_error(moments(p, o->W, P, wide, o->visible));
}

/* Set S, M and residual of n objects: means over turns and mirror images. */
static void average(Plan *k, int n, Object *const *objects, int perspective) {
    int wide = k->wide, size = 3 * wide, t = k->turns, all = t * (1 + k->mirrored);
    for (int across = 0; across <= k->mirrored; across++)
        forward(k, n, objects, across, k->shapes + (size_t)across * n * t * size,
                (camera *)k->M + across * n * t);
    for (int i = 0; i < n; i++) {
        Object *o = objects[i];
        double least = INFINITY, sum = 0;
        for (int turn = 0; turn < all; turn++) {
            int at = (turn / t * n + i) * t + turn % t;
            float *S = k->shapes + (size_t)at * size;
            place(k, turn % t, turn >= t, S, ((camera *)k->M)[at]);
            k->residual[turn] = left_over(k, o, perspective, S);
            least = fmin(least, k->residual[turn]);
        }
        memset(o->S, 0, size * sizeof(float));
        memset(o->M, 0, sizeof(camera));
        o->residual = 0;
        for (int turn = 0; turn < all; turn++)
            sum += exp((least * least - k->residual[turn] * k->residual[turn]) / k->residual_spread);
        for (int turn = 0; turn < all; turn++) {
            int at = (turn / t * n + i) * t + turn % t;
            const float *S = k->shapes + (size_t)at * size;
            double r = k->residual[turn];
            double trust = exp((least * least - r * r) / k->residual_spread) / sum;
            o->residual += trust * r;
            for (int j = 0; j < size; j++) o->S[j] += (float)trust * S[j];
            for (int j = 0; j < 6; j++) o->M[j / 2][j % 2] += trust * k->M[6 * at + j];
        }
        polar(o->M);
    }
}

/* Set S, in camera axes, and R of n objects; the network sees `points` of `mask`. */
static void fit(Plan *k, int n, Object *const *objects, int perspective) {
    int p = k->p, apart = DOUBLES_OF(p);
    for (int i = 0; i < n; i++) observe(k, objects[i]);
    average(k, n, objects, perspective);
    for (int j = 0; j < n; j++) {
        Object *o = objects[j];
        double square = 0;
        rotation back;
        rotation_from_camera(o->M, o->R);
        if (!k->corrected) continue;
        for (int i = 0; i < p; i++) {
            for (int c = 0; c < 2; c++) {
                double along = perspective ? o->points[2 * i + c] : 0, w = o->W[2 * i + c];
                for (int r = 0; r < 3; r++)
                    k->cameras[(2 * r + c) * apart + i] = o->M[r][c] - o->R[2][r] * along;
                square += o->visible[i] * w * w;
            }
        }
        transpose(o->R, back);
        rotate(p, k->wide, back, o->S);
        correct(k, o, k->noise * sqrt(square / fmax(2 * o->seen, 1)));
        rotate(p, k->wide, o->R, o->S);
    }
}

/* The next round's points: the given, and where these are missing those of the shape in the image. */
static void refill(Plan *k, Object *o, int perspective) {
    int p = k->p, wide = k->wide;
    for (int i = 0; i < p; i++) {
        o->mask[i] = 1;
        for (int c = 0; c < 2; c++) {
            double at = o->unit * o->S[c * wide + i] + o->origin[c];
            if (perspective) at /= fmax(1 + o->unit * o->S[2 * wide + i], k->nearest);
            o->points[2 * i + c] = o->visible[i] ? o->given[2 * i + c] : (float)at;
        }
    }
}

/* confidence.py: the chance (p) that each point is near its true place, for the RMS radius of the shape. */
static void near(Plan *k, const Object *o, double radius, float *sure) {
    const double *by = k->calibration;
    double common = by[0] + by[2] * log(o->residual + k->least_residual) +
                    by[3] * log(fmax(o->seen, 1) / k->p);
    for (int i = 0; i < k->p; i++) {
        double odds = exp(-common - by[1] * log(k->spread[i] / fmax(radius, 1e-9)));
        double certain = fmin(o->confidence[i], 1);
        sure[i] = (float)(certain / (1 + odds) + (1 - certain) / (1 + odds * exp(-by[4])));
    }
}

/* Write a fitted object as the i-th of the arrays; return whether there is nothing to lift. */
static int write_lifted(Plan *k, Object *o, ptrdiff_t i, float *const lifted[6]) {
    int p = k->p, wide = k->wide;
    const int *pair = k->reference;
    double radius = 0, size = 0;
    for (int r = 0; r < 3; r++) {
        float *S = o->S + r * wide;
        double mean = 0;
        for (int j = 0; j < p; j++) mean += S[j];
        for (int j = 0; j < p; j++) {
            S[j] -= (float)(mean / p);
            radius += (double)S[j] * S[j] / p;
        }
        double apart = pair[0] < 0 ? 0 : S[pair[0]] - S[pair[1]];
        size += apart * apart;
    }
    radius = sqrt(radius), size = pair[0] < 0 ? radius : sqrt(size);
    near(k, o, radius, lifted[5] + i * p);
    float factor = (float)(k->length / fmax(size, 1e-9));
    for (int j = 0; j < 3 * wide; j++) o->S[j] *= factor;
    for (int j = 0; j < 3 * p; j++) lifted[0][3 * i * p + j] = o->S[j % 3 * wide + j / 3];
    for (int j = 0; j < 9; j++) lifted[1][9 * i + j] = (float)o->R[j / 3][j % 3];
    Moments m = moments(p, o->given, o->S, wide, o->visible);
    double scale = fitted_scale(m);
    lifted[2][i] = (float)scale;
    for (int c = 0; c < 2; c++) lifted[3][2 * i + c] = (float)(m.mean[c] - scale * m.mean[2 + c]);
    lifted[4][i] = (float)o->residual;
    return on_one_line(m) || o->seen < k->min_visible;
}

void lift(Plan *k, ptrdiff_t n, const float *points, const float *confidence, int perspective,
          float *const lifted[6], char *lost) {
    int p = k->p;
    for (ptrdiff_t start = 0; start < n; start += k->block) {
        int block = n - start < k->block ? (int)(n - start) : k->block, gaps = 0;
        for (int i = 0; i < block; i++) {
            Object *o = k->some[i] = k->objects + i;
            o->given = points + 2 * p * (start + i), o->confidence = confidence + p * (start + i);
            memcpy(o->points, o->given, 2 * p * sizeof(float));
            o->seen = 0;
            for (int j = 0; j < p; j++)
                o->seen += o->mask[j] = o->visible[j] = o->confidence[j] > 0;
        }
        fit(k, block, k->some, perspective);
        for (int i = 0; i < block; i++)
            if (k->objects[i].seen < p) k->some[gaps++] = k->objects + i;
        for (int round = 0; round < k->refill && gaps; round++) {
            for (int i = 0; i < gaps; i++) refill(k, k->some[i], perspective);
            fit(k, gaps, k->some, perspective);
        }
        for (int i = 0; i < block; i++)
            lost[start + i] = (char)write_lifted(k, k->objects + i, start + i, lifted);
    }
}
