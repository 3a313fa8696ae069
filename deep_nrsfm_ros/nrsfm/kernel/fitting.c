/* The sums of `fitting.Fit` for one object at a time, in C.

   A lift is some four hundred small NumPy calls, and calling them costs ten times what they compute.
   This file does the same in one: each function carries the name of the Python function that says what
   it does and why, and the tests hold both to the same results. Symbols as in the package's legend.
   Shapes are stored with the points last, S (3, p), so that every layer is one `product`.
*/
#include "fitting.h"

#include <math.h>
#include <string.h>

#include "algebra.h"

#define TINY 1e-12
#define NEAREST 0.1f          /* fitting._NEAREST */
#define RESIDUAL_SPREAD 0.02  /* fitting._RESIDUAL_SPREAD */
#define UNKNOWN 1e4           /* correction._UNKNOWN */
#define LEAST_RESIDUAL 0.02   /* confidence._LEAST_RESIDUAL */

typedef double camera[3][2];
typedef double rotation[3][3];

void choose_instructions(void) { choose(); }

/* ---- geometry.py ------------------------------------------------------------------------------ */

/* Replace the columns of A (3, 2) by those of its orthonormal factor. */
static void polar(camera A) {
    double G[2][2] = {{0}}, cross = 0;
    for (int i = 0; i < 2; i++)
        for (int j = 0; j < 2; j++)
            for (int r = 0; r < 3; r++) G[i][j] += A[r][i] * A[r][j];
    double trace = G[0][0] + G[1][1];
    for (int r = 0; r < 3; r++) {
        double c = A[(r + 1) % 3][0] * A[(r + 2) % 3][1] - A[(r + 2) % 3][0] * A[(r + 1) % 3][1];
        cross += c * c;
    }
    double s = sqrt(cross + TINY * trace * trace + 1e-36), size = s * sqrt(trace + 2 * s);
    for (int r = 0; r < 3; r++) {
        double a = A[r][0], b = A[r][1];
        A[r][0] = ((trace + s) * a - G[0][0] * a - G[0][1] * b) / size;
        A[r][1] = ((trace + s) * b - G[1][0] * a - G[1][1] * b) / size;
    }
}

static void rotation_from_camera(camera M, rotation R) {
    for (int r = 0; r < 3; r++) {
        R[0][r] = M[r][0], R[1][r] = M[r][1];
        R[2][r] = M[(r + 1) % 3][0] * M[(r + 2) % 3][1] - M[(r + 2) % 3][0] * M[(r + 1) % 3][1];
    }
}

typedef struct {
    double mean[4], WW, PP, WP, WxWx, WyWy, WxWy;
} Moments;

/* Of W (p, 2) and of P, whose coordinates are P[0 ... p - 1] and P[apart ... apart + p - 1]. */
static Moments moments(int p, const float *W, const float *P, int apart, const float *visible) {
    Moments m = {{0}};
    double n = 0;
    for (int i = 0; i < p; i++) {
        n += visible[i];
        m.mean[0] += visible[i] * W[2 * i], m.mean[1] += visible[i] * W[2 * i + 1];
        m.mean[2] += visible[i] * P[i], m.mean[3] += visible[i] * P[apart + i];
    }
    for (int c = 0; c < 4; c++) m.mean[c] /= fmax(n, 1);
    for (int i = 0; i < p; i++) {
        double a = W[2 * i] - m.mean[0], b = W[2 * i + 1] - m.mean[1], v = visible[i];
        double c = P[i] - m.mean[2], d = P[apart + i] - m.mean[3];
        m.WxWx += v * a * a, m.WyWy += v * b * b, m.WxWy += v * a * b;
        m.PP += v * (c * c + d * d), m.WP += v * (a * c + b * d);
    }
    m.WW = m.WxWx + m.WyWy;
    return m;
}

static double fitted_scale(Moments m) { return m.WP / fmax(m.PP, TINY); }

static double reprojection_error(Moments m) {
    return sqrt(fmax(1 - fitted_scale(m) * m.WP / fmax(m.WW, TINY), 0));
}

static int on_one_line(Moments m) {
    return m.WxWx * m.WyWy - m.WxWy * m.WxWy <= 1e-6 * m.WW * m.WW;
}

/* ---- normaliser.py ---------------------------------------------------------------------------- */

/* Fill the missing of points (p, 2), where mask (p) is 0, and set mask to 1; `network.complete`. */
static void complete(Plan *k, float *points, float *mask) {
    int p = k->p, missing = 0;
    double *b = k->r;
    for (int i = 0; i < p; i++) {
        if (mask[i]) continue;
        const double *row = k->filling + (size_t)i * p;
        b[2 * missing] = b[2 * missing + 1] = 0;
        for (int j = 0; j < p; j++)
            for (int c = 0; c < 2 && mask[j]; c++) b[2 * missing + c] -= row[j] * points[2 * j + c];
        missing++;
    }
    double *A = k->A;
    for (int i = 0; i < p; i++)
        for (int j = 0; j < p && !mask[i]; j++)
            if (!mask[j]) *A++ = k->filling[(size_t)i * p + j];
    solve(missing, k->A, 2, b);
    for (int i = 0; i < p; i++) {
        if (mask[i]) continue;
        points[2 * i] = (float)*b++, points[2 * i + 1] = (float)*b++;
        mask[i] = 1;
    }
}

/* Set W (p, 2) from points and mask; `Normaliser.encode`. */
static void encode_points(Plan *k, const float *points, const float *mask, double *gain,
                          double *unit, double origin[2]) {
    int p = k->p;
    double n = 0, square = 0;
    origin[0] = origin[1] = 0;
    for (int i = 0; i < p; i++) {
        n += mask[i];
        for (int c = 0; c < 2; c++) origin[c] += mask[i] * points[2 * i + c];
    }
    n = fmax(n, 1);
    for (int c = 0; c < 2; c++) origin[c] /= n;
    for (int i = 0; i < 2 * p; i++) {
        double w = (points[i] - origin[i % 2]) * mask[i / 2];
        k->W[i] = (float)w;
        square += w * w;
    }
    *unit = k->rms ? 2 * (sqrt(square / n) + 1e-9) : 1;
    for (int i = 0; i < 2 * p; i++) k->W[i] = (float)(k->W[i] / *unit);
    *gain = p / n;
}

/* ---- network.py ------------------------------------------------------------------------------- */

/* out (rows, n) = relu(V - b), for V and b with n entries a row. */
static void relu(int rows, int n, const float *V, int stride, const float *b, float *out, int wide) {
    for (int r = 0; r < rows; r++)
        for (int j = 0; j < n; j++) {
            float v = V[(size_t)r * stride + j] - b[j];
            out[(size_t)r * wide + j] = v > 0 ? v : 0;
        }
}

/* Set `shapes` (t, 3, PADDED(p)) and the cameras M (t) of input x (p, 2) by `turns` turns of it.

   x is turned after the first dictionary: that is linear, so one product serves all turns. */
static void forward(Plan *k, const float *x, int across, float *shapes, camera *M) {
    int p = k->p, t = k->turns, n = k->layers, first = k->widths[0], wide = PADDED(p);
    for (int i = 0; i < p; i++) {
        int from = across ? k->partners[i] : i;
        k->x[i] = x[2 * from], k->x[wide + i] = x[2 * from + 1];
    }
    const float *rows = k->x;
    if (k->whitened) {
        product(2, p, wide, k->x, wide, k->L, k->shapes);
        rows = k->shapes;
    }
    int columns = PADDED(3 * first);
    product(2, p, columns, rows, wide, k->encoder[0], k->V);
    float *Psi = k->Psi[0], *next = k->Psi[1], *turned = k->V + 2 * columns;
    int width = first;
    for (int turn = 0; turn < t; turn++) {
        const double *T = k->turn + 4 * turn;
        for (int a = 0; a < 2; a++) {
            /* Row a of the turned x^T; mirrored, x changes its sign. */
            float sign = across && !a ? -1 : 1, c = sign * (float)T[2 * a],
                  s = sign * (float)T[2 * a + 1];
            for (int j = 0; j < 3 * first; j++) turned[j] = c * k->V[j] + s * k->V[columns + j];
            for (int r = 0; r < 3; r++)
                relu(1, first, turned + r * first, 0, k->b[0],
                     Psi + (size_t)(turn * 6 + a * 3 + r) * PADDED(first), 0);
        }
    }
    for (int i = 1; i < n; i++) {
        int to = k->widths[i];
        product(6 * t, width, PADDED(to), Psi, PADDED(width), k->encoder[i], k->V);
        relu(6 * t, to, k->V, PADDED(to), k->b[i], next, PADDED(to));
        float *swap = Psi;
        Psi = next, next = swap, width = to;
    }
    int atoms = PADDED(width);
    for (int row = 0; row < 6 * t; row++) {
        double sum = 0;
        for (int j = 0; j < width; j++) sum += Psi[(size_t)row * atoms + j] * k->camera_head[j];
        M[row / 6][row % 3][row / 3 % 2] = sum;
        memmove(Psi + (size_t)row * width, Psi + (size_t)row * atoms, width * sizeof(float));
    }
    for (int turn = 0; turn < t; turn++) polar(M[turn]);
    float *psi = k->psi[0], *wider = k->psi[1];
    product(t, 6 * width, atoms, Psi, 6 * width, k->code_head, psi);
    for (int i = n - 1; i > 0; i--) {
        int to = k->widths[i - 1];
        product(t, width, PADDED(to), psi, PADDED(width), k->decoder[i], k->V);
        relu(t, to, k->V, PADDED(to), k->b_[i], wider, PADDED(to));
        float *swap = psi;
        psi = wider, wider = swap, width = to;
    }
    columns = PADDED(3 * p);
    product(t, width, columns, psi, PADDED(width), k->decoder[0], k->V);
    for (int turn = 0; turn < t; turn++) {
        float *s = k->V + turn * columns, *S = shapes + turn * 3 * wide;
        for (int i = 0; i < 3 * p; i++) s[i] -= k->b_[0][i];
        if (k->whitened)
            product(3, p, wide, s, p, k->L_inverse, S);
        else
            for (int r = 0; r < 3; r++) memcpy(S + r * wide, s + r * p, p * sizeof(float));
    }
}

/* ---- fitting.py ------------------------------------------------------------------------------- */

/* S (3, p) = A S for A (3, 3); rows are PADDED(p) apart. */
static void rotate(int p, rotation A, float *S) {
    int wide = PADDED(p);
    for (int i = 0; i < p; i++) {
        double x = S[i], y = S[wide + i], z = S[2 * wide + i];
        for (int r = 0; r < 3; r++)
            S[r * wide + i] = (float)(A[r][0] * x + A[r][1] * y + A[r][2] * z);
    }
}

static void transpose(rotation R, rotation out) {
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) out[i][j] = R[j][i];
}

/* Set S (3, p) in camera axes and M (3, 2), means over turns and mirror images; return the residual. */
static double average(Plan *k, double gain, double unit, int perspective, const float *visible,
                      camera mean) {
    int p = k->p, wide = PADDED(p), t = k->turns, all = t * (1 + k->mirrored);
    camera *M = (camera *)k->M;
    float *shapes = k->shapes + 6 * wide, *x = k->points;
    for (int i = 0; i < 2 * p; i++) x[i] = (float)(gain * k->W[i]);
    for (int across = 0; across <= k->mirrored; across++)
        forward(k, x, across, shapes + across * t * 3 * wide, M + across * t);
    double least = INFINITY, sum = 0, residual = 0;
    rotation A, R;
    for (int i = 0; i < 9; i++) A[i % 3][i / 3] = k->frame[i]; /* transposed: S A is A^T S here */
    for (int turn = 0; turn < all; turn++) {
        float *S = shapes + turn * 3 * wide;
        const double *T = k->turn + 4 * (turn % t);
        int across = turn >= t;
        rotate(p, A, S);
        camera framed = {{0}};
        for (int r = 0; r < 3; r++)
            for (int c = 0; c < 2; c++) {
                for (int q = 0; q < 3; q++) framed[r][c] += A[r][q] * M[turn][q][c];
                if (across) framed[r][c] *= (r == 1 ? -1 : 1) * (c == 0 ? -1 : 1);
            }
        if (across) {
            float *swap = k->V;
            for (int r = 0; r < 3; r++) {
                for (int i = 0; i < p; i++)
                    swap[i] = (r == 1 ? -1 : 1) * S[r * wide + k->partners[i]];
                memcpy(S + r * wide, swap, p * sizeof(float));
            }
        }
        for (int r = 0; r < 3; r++)
            for (int c = 0; c < 2; c++)
                M[turn][r][c] = framed[r][0] * T[c] + framed[r][1] * T[2 + c];
        rotation_from_camera(M[turn], R);
        rotate(p, R, S);
        const float *P = S;
        if (perspective) {
            for (int i = 0; i < p; i++) {
                float depth = fmaxf((float)(1 + unit * S[2 * wide + i]), NEAREST);
                k->V[i] = S[i] / depth, k->V[wide + i] = S[wide + i] / depth;
            }
            P = k->V;
        }
        k->residual[turn] = reprojection_error(moments(p, k->W, P, wide, visible));
        least = fmin(least, k->residual[turn]);
    }
    memset(k->S, 0, 3 * wide * sizeof(float));
    memset(mean, 0, sizeof(camera));
    for (int turn = 0; turn < all; turn++)
        sum += exp((least * least - k->residual[turn] * k->residual[turn]) / RESIDUAL_SPREAD);
    for (int turn = 0; turn < all; turn++) {
        double r = k->residual[turn], trust = exp((least * least - r * r) / RESIDUAL_SPREAD) / sum;
        const float *S = shapes + turn * 3 * wide;
        residual += trust * r;
        for (int i = 0; i < 3 * wide; i++) k->S[i] += (float)trust * S[i];
        for (int i = 0; i < 6; i++) mean[i / 2][i % 2] += trust * M[turn][i / 2][i % 2];
    }
    polar(mean);
    return residual;
}

/* Move S (3, p), in the axes of the object, towards the visible of W; `correction.correct`. */
static void correct(Plan *k, float *S, const camera *cameras, const float *visible, double noise) {
    int p = k->p, wide = PADDED(p), n = 2 * p;
    for (int row = 0; row < 3 * p; row++)
        for (int j = 0; j < p; j++) {
            const double *C = k->covariance + (size_t)row * 3 * p + 3 * j;
            for (int c = 0; c < 2; c++)
                k->CH[(size_t)row * n + 2 * j + c] = C[0] * cameras[j][0][c] +
                                                     C[1] * cameras[j][1][c] + C[2] * cameras[j][2][c];
        }
    for (int i = 0; i < p; i++)
        for (int a = 0; a < 2; a++) {
            double *row = k->A + (size_t)(2 * i + a) * n, *CH = k->CH + (size_t)3 * i * n;
            double m[3] = {cameras[i][0][a], cameras[i][1][a], cameras[i][2][a]};
            for (int j = 2 * i; j < n; j++)
                row[j] = m[0] * CH[j] + m[1] * CH[n + j] + m[2] * CH[2 * n + j];
            for (int j = 2 * i + a; j < n; j += 2) row[j] += k->unknown;
            row[2 * i + a] += visible[i] ? noise * noise + 1e-12 * k->unknown : k->unknown;
            double left = k->W[2 * i + a];
            for (int r = 0; r < 3; r++) left -= S[r * wide + i] * m[r];
            k->r[2 * i + a] = visible[i] ? left : 0;
        }
    solve(n, k->A, 1, k->r);
    for (int row = 0; row < 3 * p; row++) {
        double E = 0;
        for (int j = 0; j < n; j++) E += k->CH[(size_t)row * n + j] * k->r[j];
        S[row % 3 * wide + row / 3] += (float)E;
    }
}

/* Set S (3, p) in camera axes and R, return the residual; the network sees points (p, 2) of mask. */
static double fit(Plan *k, float *points, float *mask, const float *visible, int perspective,
                  rotation R, double *unit, double origin[2]) {
    int p = k->p, whole = 1;
    double gain, square = 0, seen = 0;
    camera M;
    rotation back;
    for (int i = 0; i < p; i++) whole &= mask[i] > 0;
    /* Rays of the correction are those of what was given, not of what is filled in for the network. */
    if (perspective && k->corrected)
        for (int i = 0; i < 2 * p; i++) k->cameras[6 * (i / 2) + i % 2] = points[i];
    if (!whole && k->whitened) complete(k, points, mask);
    encode_points(k, points, mask, &gain, unit, origin);
    double residual = average(k, gain, *unit, perspective, visible, M);
    rotation_from_camera(M, R);
    if (!k->corrected) return residual;
    for (int i = 0; i < p; i++) {
        double *own = k->cameras + 6 * i, u = own[0], v = own[1];
        for (int r = 0; r < 3; r++) {
            own[2 * r] = M[r][0] - (perspective ? R[2][r] * u : 0);
            own[2 * r + 1] = M[r][1] - (perspective ? R[2][r] * v : 0);
        }
        seen += visible[i];
        square += visible[i] * ((double)k->W[2 * i] * k->W[2 * i] +
                                (double)k->W[2 * i + 1] * k->W[2 * i + 1]);
    }
    transpose(R, back);
    rotate(p, back, k->S);
    correct(k, k->S, (const camera *)k->cameras, visible,
            k->noise * sqrt(square / fmax(2 * seen, 1)));
    rotate(p, R, k->S);
    return residual;
}

int lift(Plan *k, const float *given, const float *confidence, int perspective, float *shape,
         float *rotated, float *scale, float *translation, float *left, float *sure) {
    int p = k->p, wide = PADDED(p);
    float *points = k->mask + 2 * p, *mask = k->mask, *visible = k->mask + p;
    double unit, origin[2], seen = 0;
    rotation R;
    for (int i = 0; i < p; i++) seen += mask[i] = visible[i] = confidence[i] > 0;
    memcpy(points, given, 2 * p * sizeof(float));
    double residual = fit(k, points, mask, visible, perspective, R, &unit, origin);
    for (int round = 0; round < k->refill && seen < p; round++) {
        for (int i = 0; i < p; i++) {
            mask[i] = 1;
            for (int c = 0; c < 2; c++) {
                double at = unit * k->S[c * wide + i] + origin[c];
                if (perspective) at /= fmax(1 + unit * k->S[2 * wide + i], NEAREST);
                points[2 * i + c] = visible[i] ? given[2 * i + c] : (float)at;
            }
        }
        residual = fit(k, points, mask, visible, perspective, R, &unit, origin);
    }
    double radius = 0, size = 0, mean;
    for (int r = 0; r < 3; r++) {
        float *S = k->S + r * wide;
        mean = 0;
        for (int i = 0; i < p; i++) mean += S[i];
        for (int i = 0; i < p; i++) {
            S[i] -= (float)(mean / p);
            radius += (double)S[i] * S[i] / p;
        }
        double apart = k->reference[0] < 0 ? 0 : S[k->reference[0]] - S[k->reference[1]];
        size += apart * apart;
    }
    radius = sqrt(radius), size = k->reference[0] < 0 ? radius : sqrt(size);
    const double *by = k->calibration; /* confidence.near */
    double common = by[0] + by[2] * log(residual + LEAST_RESIDUAL) + by[3] * log(fmax(seen, 1) / p);
    for (int i = 0; i < p; i++) {
        double odds = exp(-common - by[1] * log(k->spread[i] / fmax(radius, 1e-9)));
        double certain = fmin(confidence[i], 1);
        sure[i] = (float)(certain / (1 + odds) + (1 - certain) / (1 + odds * exp(-by[4])));
    }
    float factor = (float)(k->length / fmax(size, 1e-9));
    for (int i = 0; i < 3 * wide; i++) k->S[i] *= factor;
    for (int i = 0; i < 3 * p; i++) shape[i] = k->S[i % 3 * wide + i / 3];
    Moments m = moments(p, given, k->S, wide, visible);
    double pixels = fitted_scale(m);
    *scale = (float)pixels, *left = (float)residual;
    for (int c = 0; c < 2; c++) translation[c] = (float)(m.mean[c] - pixels * m.mean[2 + c]);
    for (int i = 0; i < 9; i++) rotated[i] = (float)R[i / 3][i % 3];
    return on_one_line(m) || seen < k->min_visible;
}

/* ---- compiled.py ------------------------------------------------------------------------------ */

int lay_out(Plan *k, const int *header, const float *floats, const double *doubles,
            const ptrdiff_t lengths[3]) {
    const int *h = header;
    const float *f = floats;
    const double *d = doubles;
    k->p = *h++, k->layers = *h++, k->turns = *h++, k->mirrored = *h++, k->whitened = *h++;
    k->rms = *h++, k->corrected = *h++, k->refill = *h++, k->reference[0] = *h++;
    k->reference[1] = *h++, k->min_visible = *h++;
    int p = k->p, wide = PADDED(p);
    k->widths = h, h += k->layers;
    k->partners = h, h += p;
    k->L = f, f += (size_t)p * wide;
    k->L_inverse = f, f += (size_t)p * wide;
    for (int i = 0; i < k->layers; i++) {
        int to = k->widths[i], from = i ? k->widths[i - 1] : 0;
        k->encoder[i] = f, f += i ? (size_t)from * PADDED(to) : (size_t)p * PADDED(3 * to);
        k->b[i] = f, f += to;
        k->decoder[i] = f, f += (size_t)to * (i ? PADDED(from) : PADDED(3 * p));
        k->b_[i] = f, f += i ? from : 3 * p;
    }
    int last = k->widths[k->layers - 1];
    k->code_head = f, f += (size_t)6 * last * PADDED(last);
    k->camera_head = f, f += last;
    k->spread = f, f += p;
    k->filling = d, d += (size_t)p * p;
    k->turn = d, d += 4 * k->turns;
    k->frame = d, d += 9;
    k->covariance = d, d += (size_t)9 * p * p;
    k->calibration = d, d += 5;
    k->noise = *d++, k->length = *d++, k->unknown = UNKNOWN * *d++;
    return h - header == lengths[0] && f - floats == lengths[1] && d - doubles == lengths[2];
}

size_t scratch(Plan *k, char *at) {
    int p = k->p, wide = PADDED(p), rows = 6 * k->turns, widest = 0, all = k->turns * (1 + k->mirrored);
    for (int i = 0; i < k->layers; i++)
        if (k->widths[i] > widest) widest = k->widths[i];
    size_t room = (size_t)rows * PADDED(3 * widest) + (size_t)(rows + 3) * PADDED(3 * p), used = 0;
#define ROOM(member, type, count)                     \
    k->member = (type *)(at + used);                  \
    used += ((count) * sizeof(type) + 63) / 64 * 64;
    ROOM(x, float, 2 * wide)
    ROOM(V, float, room)
    ROOM(Psi[0], float, room)
    ROOM(Psi[1], float, room)
    ROOM(psi[0], float, room)
    ROOM(psi[1], float, room)
    ROOM(shapes, float, (size_t)(3 * all + 6) * wide)
    ROOM(S, float, 3 * wide)
    ROOM(W, float, 2 * p)
    ROOM(points, float, 2 * p)
    ROOM(mask, float, 4 * p)
    ROOM(M, double, (size_t)6 * all)
    ROOM(cameras, double, 6 * p)
    ROOM(CH, double, (size_t)6 * p * p)
    ROOM(A, double, (size_t)4 * p * p)
    ROOM(r, double, 2 * p)
    ROOM(residual, double, all)
#undef ROOM
    return used;
}
