/* gradient.py: the network there and back, for some frames at a time and a part of the batch a thread. */
#include <math.h>
#include <pthread.h>
#include <string.h>

#include "gradient.h"

/* A part of the weights, as they are given: (rows, columns), neighbours so many numbers apart. */
typedef struct {
    const float *from;
    ptrdiff_t row, column;
} Part;

/* Put a part in the panels of A, from its row `top` and column `left` on, a multiple of FLOATS. */
static void pack(Matrix A, int top, int left, int rows, int columns, Part part) {
    for (int j = 0; j < columns; j += FLOATS) {
        float *to = (float *)A.panels + (size_t)(left + j) * A.k + (size_t)top * FLOATS;
        const float *from = part.from + j * part.column;
        int some = columns - j < FLOATS ? columns - j : FLOATS;
        for (int i = 0; i < rows; i++, to += FLOATS, from += part.row)
            for (int c = 0; c < some; c++) to[c] = from[c * part.column];
    }
}

/* Lay out the weights, in the order of `Network.learned`. */
static void take_weights(Worker *w, const float *at) {
    const Kind *kind = w->kind;
    const int p = kind->p, *k = kind->widths, *filled = kind->filled, n = kind->layers, last = k[n - 1];
    for (int r = 0; r < 3; r++) {
        Part D = {at + r * k[0], 3 * k[0], 1}, D_T = {D.from, 1, 3 * k[0]};
        pack(w->encoder[0], 0, r * filled[0], p, k[0], D);
        pack(w->decoder[0], 0, r * kind->wide, k[0], p, D_T);
        pack(w->first, r * kind->wide, 0, p, k[0], D);
    }
    at += (size_t)3 * p * k[0];
    for (int i = 1; i < n; at += (size_t)k[i - 1] * k[i], i++) {
        pack(w->encoder[i], 0, 0, k[i - 1], k[i], (Part){at, k[i], 1});
        pack(w->decoder[i], 0, 0, k[i], k[i - 1], (Part){at, 1, k[i]});
    }
    for (int i = 0; i < n; at += k[i], i++)
        for (int r = 0; r < (i ? 1 : 3); r++) memcpy(w->b[i] + r * filled[i], at, k[i] * sizeof(float));
    for (int i = 0; i < p; i++)
        for (int r = 0; r < 3; r++) w->b_[0][r * kind->wide + i] = *at++;
    for (int i = 1; i < n; at += k[i - 1], i++) memcpy(w->b_[i], at, k[i - 1] * sizeof(float));
    for (int block = 0; block < 6; block++, at += (size_t)last * last) {
        pack(w->code_head, block * filled[n - 1], 0, last, last, (Part){at, last, 1});
        pack(w->code_back, 0, block * filled[n - 1], last, last, (Part){at, 1, last});
    }
    memcpy(w->camera_head, at, last * sizeof(float));
}

/* Write (rows, columns) of the workers' gradient, whose rows are `apart`; return where the next goes. */
static float *give(const Worker *workers, int n, const float *bar, int rows, int columns, int apart, float *to) {
    size_t offset = bar - workers->bars;
    for (int i = 0; i < rows; i++, offset += apart, to += columns)
        for (int j = 0; j < columns; j++) {
            float sum = 0;
            for (int worker = 0; worker < n; worker++) sum += workers[worker].bars[offset + j];
            to[j] = sum;
        }
    return to;
}

/* The sum of the workers' gradients, in the order of `Network.learned`. */
static void give_gradient(const Worker *w, int workers, float *to) {
    const Kind *kind = w->kind;
    const int p = kind->p, *k = kind->widths, *filled = kind->filled, n = kind->layers, last = k[n - 1];
    to = give(w, workers, w->D_bar[0], 3 * p, k[0], filled[0], to);
    for (int i = 1; i < n; i++) to = give(w, workers, w->D_bar[i], k[i - 1], k[i], filled[i], to);
    for (int i = 0; i < n; i++) to = give(w, workers, w->b_bar[i], 1, k[i], 0, to);
    for (int i = 0; i < p; i++)
        for (int r = 0; r < 3; r++) to = give(w, workers, w->b__bar[0] + r * kind->wide + i, 1, 1, 0, to);
    for (int i = 1; i < n; i++) to = give(w, workers, w->b__bar[i], 1, k[i - 1], 0, to);
    for (int block = 0; block < 6; block++)
        to = give(w, workers, w->code_bar + (size_t)block * filled[n - 1] * filled[n - 1], last, last,
                  filled[n - 1], to);
    give(w, workers, w->camera_bar, 1, last, 0, to);
}

/* sums (n) -= the rows of X (rows, n). */
INLINE void subtract_rows_inline(ptrdiff_t rows, ptrdiff_t n, const float *restrict X, float *restrict sums) {
    for (ptrdiff_t i = 0; i < rows; i++)
        for (ptrdiff_t j = 0; j < n; j++) sums[j] -= X[i * n + j];
}
FAST(subtract_rows, (ptrdiff_t rows, ptrdiff_t n, const float *X, float *sums), (rows, n, X, sums))

/* Put 0 in `bar` (rows, n) where the result of a ReLU is none, and subtract its rows from `sums`. */
INLINE void relu_gradient_inline(ptrdiff_t rows, ptrdiff_t n, const float *restrict result,
                                 float *restrict bar, float *restrict sums) {
    for (ptrdiff_t i = 0; i < rows; i++)
        for (ptrdiff_t j = 0; j < n; j++) {
            float kept = result[i * n + j] <= 0 ? 0 : bar[i * n + j];
            bar[i * n + j] = kept;
            sums[j] -= kept;
        }
}
FAST(relu_gradient, (ptrdiff_t rows, ptrdiff_t n, const float *result, float *bar, float *sums),
     (rows, n, result, bar, sums))

/* sums (n) += the rows of X (rows, n), each by its number of `by`; and the other way round. */
INLINE void combine_inline(ptrdiff_t rows, ptrdiff_t n, const float *restrict by, const float *restrict X,
                           float *restrict sums) {
    for (ptrdiff_t i = 0; i < rows; i++)
        for (ptrdiff_t j = 0; j < n; j++) sums[j] += by[i] * X[i * n + j];
}
FAST(combine, (ptrdiff_t rows, ptrdiff_t n, const float *by, const float *X, float *sums), (rows, n, by, X, sums))

INLINE void spread_inline(ptrdiff_t rows, ptrdiff_t n, const float *restrict by, const float *restrict x,
                          float *restrict X) {
    for (ptrdiff_t i = 0; i < rows; i++)
        for (ptrdiff_t j = 0; j < n; j++) X[i * n + j] += by[i] * x[j];
}
FAST(spread, (ptrdiff_t rows, ptrdiff_t n, const float *by, const float *x, float *X), (rows, n, by, x, X))

INLINE void dots_inline(ptrdiff_t rows, ptrdiff_t n, const float *restrict X, const float *restrict x,
                        float *restrict by) {
    for (ptrdiff_t i = 0; i < rows; i++) {
        float sums[FLOATS] = {0}, sum = 0;
        for (ptrdiff_t j = 0; j < n; j += FLOATS)
            for (ptrdiff_t h = 0; h < FLOATS; h++) sums[h] += X[i * n + j + h] * x[j + h];
        for (ptrdiff_t h = 0; h < FLOATS; h++) sum += sums[h];
        by[i] = sum;
    }
}
FAST(dots, (ptrdiff_t rows, ptrdiff_t n, const float *X, const float *x, float *by), (rows, n, X, x, by))

/* network.py, x (n, p, 2): not as in network.c, whose shapes of turned objects need no codes but the last. */
static void forward(Worker *w, int n, const float *x) {
    const Kind *kind = w->kind;
    const int p = kind->p, wide = kind->wide, layers = kind->layers, *filled = kind->filled;
    float *rows = kind->whitened ? w->spare[0] : w->x;
    for (int row = 0; row < 2 * n; row++)
        for (int i = 0; i < p; i++) rows[row * wide + i] = x[2 * (row / 2 * p + i) + row % 2];
    if (kind->whitened) product(2 * n, rows, wide, w->L, NULL, 0, w->x);
    product(2 * n, w->x, wide, w->encoder[0], w->b[0], 1, w->Psi[0]);
    for (int i = 1; i < layers; i++)
        product(6 * n, w->Psi[i - 1], filled[i - 1], w->encoder[i], w->b[i], 1, w->Psi[i]);
    const float *Psi = w->Psi[layers - 1];
    dots(6 * n, filled[layers - 1], Psi, w->camera_head, w->rows);
    for (int o = 0; o < n; o++) {
        for (int row = 0; row < 6; row++) w->A[o][row % 3][row / 3] = w->rows[6 * o + row];
        memcpy(w->M[o], w->A[o], sizeof(camera));
        polar(w->M[o]);
    }
    product(n, Psi, 6 * filled[layers - 1], w->code_head, NULL, 0, w->psi[layers - 1]);
    for (int i = layers - 1; i > 0; i--)
        product(n, w->psi[i], filled[i], w->decoder[i], w->b_[i], 1, w->psi[i - 1]);
    float *S = kind->whitened ? w->spare[0] : w->S;
    product(n, w->psi[0], filled[0], w->decoder[0], w->b_[0], 0, S);
    if (kind->whitened) product(3 * n, S, wide, w->L_inverse, NULL, 0, w->S);
}

/* Return psi_bar (n, k_n). */
static float *through_decoder(Worker *w, int n) {
    const Kind *kind = w->kind;
    const int p = kind->p, wide = kind->wide, *filled = kind->filled;
    float *s_bar = w->S_bar, *bar = w->spare[0], *next = w->spare[1];
    if (kind->whitened) product(3 * n, w->S_bar, wide, w->L_inverse, NULL, 0, s_bar = w->spare[1]);
    subtract_rows(n, 3 * wide, s_bar, w->b__bar[0]);
    for (int r = 0; r < 3; r++)
        accumulate(n, p, s_bar + r * wide, 3 * wide, filled[0], w->psi[0], w->D_bar[0] + r * filled[0],
                   3 * filled[0]);
    product(n, s_bar, 3 * wide, w->first, NULL, 0, bar);
    for (int i = 1; i < kind->layers; i++) {
        relu_gradient(n, filled[i - 1], w->psi[i - 1], bar, w->b__bar[i]);
        accumulate(n, kind->widths[i - 1], bar, filled[i - 1], filled[i], w->psi[i], w->D_bar[i], filled[i]);
        product(n, bar, filled[i - 1], w->encoder[i], NULL, 0, next);
        float *swap = bar;
        bar = next, next = swap;
    }
    return bar;
}

/* The gradient by A of one by its orthonormal factor R; all by columns, as the camera M. */
static void polar_gradient(camera A, camera R, camera R_bar, float by[6]) {
    double P[2][2] = {{0}}, X[2][2] = {{0}};
    for (int a = 0; a < 2; a++)
        for (int b = 0; b < 2; b++)
            for (int r = 0; r < 3; r++) P[a][b] += A[r][a] * R[r][b], X[a][b] += R_bar[r][a] * R[r][b];
    double trace = P[0][0] + P[1][1], determinant = P[0][0] * P[1][1] - P[0][1] * P[1][0];
    determinant = fmax(determinant, 1e-6 * trace * trace + 1e-30);
    double turn = (X[0][1] - X[1][0]) / fmax(trace, 1e-15);
    for (int r = 0; r < 3; r++) {
        double out[2];
        for (int a = 0; a < 2; a++) out[a] = R_bar[r][a] - X[a][0] * R[r][0] - X[a][1] * R[r][1];
        for (int a = 0; a < 2; a++)
            by[3 * a + r] = (float)((a ? -turn : turn) * R[r][1 - a] +
                                    (trace * out[a] - P[a][0] * out[0] - P[a][1] * out[1]) / determinant);
    }
}

/* Return Psi_bar (6 n, k_n). */
static float *through_recovery(Worker *w, int n, float *psi_bar) {
    const int last = w->kind->layers - 1, filled = w->kind->filled[last];
    const float *Psi = w->Psi[last];
    float *bar = psi_bar == w->spare[0] ? w->spare[1] : w->spare[0], *by = w->rows;
    for (int o = 0; o < n; o++) polar_gradient(w->A[o], w->M[o], w->M_bar[o], by + 6 * o);
    accumulate(n, 6 * filled, Psi, 6 * filled, filled, psi_bar, w->code_bar, filled);
    combine(6 * n, filled, by, Psi, w->camera_bar);
    product(n, psi_bar, filled, w->code_back, NULL, 0, bar);
    spread(6 * n, filled, by, w->camera_head, bar);
    return bar;
}

static void through_encoder(Worker *w, int n, float *bar) {
    const Kind *kind = w->kind;
    const int p = kind->p, *filled = kind->filled;
    float *next = bar == w->spare[0] ? w->spare[1] : w->spare[0];
    for (int i = kind->layers - 1; i >= 0; i--) {
        relu_gradient(6 * n, filled[i], w->Psi[i], bar, w->b_bar[i]);
        if (!i) break;
        accumulate(6 * n, kind->widths[i - 1], w->Psi[i - 1], filled[i - 1], filled[i], bar, w->D_bar[i],
                   filled[i]);
        product(6 * n, bar, filled[i], w->decoder[i], NULL, 0, next);
        float *swap = bar;
        bar = next, next = swap;
    }
    accumulate(2 * n, p, w->x, kind->wide, 3 * filled[0], bar, w->D_bar[0], 3 * filled[0]);
}

/* A worker, and its share of the batch: frames and known shapes from the first to before the last. */
typedef struct {
    Worker *worker;
    const float *weights;
    const Task *task;
    float *shapes;
    ptrdiff_t frames[2], known[2];
} Share;

static void *work(void *given) {
    Share *share = given;
    Worker *w = share->worker;
    const Task *task = share->task;
    take_weights(w, share->weights);
    memset(w->bars, 0, w->sums * sizeof(float));
    w->reprojection = w->cycle = 0;
    for (int known = 0; known < 2; known++) {
        const ptrdiff_t *range = known ? share->known : share->frames;
        for (ptrdiff_t i = range[0], n; i < range[1]; i += n) {
            n = range[1] - i < w->kind->block ? range[1] - i : w->kind->block;
            forward(w, (int)n, task->x + 2 * w->kind->p * (known ? task->b + i : i));
            if (known)
                known_loss(w, task, i, (int)n);
            else
                frames_loss(w, task, i, (int)n, share->shapes);
            through_encoder(w, (int)n, through_recovery(w, (int)n, through_decoder(w, (int)n)));
        }
    }
    return NULL;
}

void gradient_of(Worker *workers, int n, const float *weights, const Task *task, double losses[2], float *shapes,
                 float *gradient) {
    Share shares[n];
    pthread_t threads[n];
    int started[n];
    for (int i = 0; i < n; i++) {
        Share *s = shares + i;
        *s = (Share){workers + i, weights, task, shapes, {task->b * i / n, task->b * (i + 1) / n},
                     {task->c * i / n, task->c * (i + 1) / n}};
        started[i] = i + 1 < n && !pthread_create(threads + i, NULL, work, s);
    }
    for (int i = n - 1; i >= 0; i--)
        if (!started[i]) work(shares + i);
    losses[0] = losses[1] = 0;
    for (int i = 0; i < n; i++) {
        if (started[i]) pthread_join(threads[i], NULL);
        losses[0] += workers[i].reprojection / task->b;
        losses[1] += task->c ? workers[i].cycle / task->c : 0;
    }
    give_gradient(workers, n, gradient);
}

void describe(Kind *kind, const int *widths) {
    kind->wide = FLOATS_OF(kind->p);
    kind->learned = 0;
    for (int i = 0; i < kind->layers; i++) {
        size_t k = kind->widths[i] = widths[i], before = i ? (size_t)widths[i - 1] : (size_t)3 * kind->p;
        kind->filled[i] = FLOATS_OF(widths[i]);
        kind->learned += before * k + k + before;
        if (i + 1 == kind->layers) kind->learned += 6 * k * k + k;
    }
}

void whiten_by(Worker *w, const float *L, const float *L_inverse) {
    int p = w->kind->p;
    pack(w->L, 0, 0, p, p, (Part){L, p, 1});
    pack(w->L_inverse, 0, 0, p, p, (Part){L_inverse, p, 1});
}

size_t employ(Worker *w, const Kind *kind, char *at) {
    const int wide = kind->wide, layers = kind->layers, *filled = kind->filled;
    size_t n = kind->block, used = 0, widest = 3 * wide;
    for (int i = 0; i < layers; i++)
        if ((size_t)6 * filled[i] > widest) widest = 6 * filled[i];
#define ROOM(member, type, count)                   \
    member = (type *)(at ? at + used : NULL);        \
    used += ((count) * sizeof(type) + 63) / 64 * 64;
#define MATRIX(A, rows, columns)         \
    (A).k = (rows), (A).n = (columns);   \
    ROOM((A).panels, float, (size_t)(A).k *(A).n)
    w->kind = kind;
    MATRIX(w->L, kind->p, wide)
    MATRIX(w->L_inverse, kind->p, wide)
    MATRIX(w->first, 3 * wide, filled[0])
    for (int i = 0; i < layers; i++) {
        MATRIX(w->encoder[i], i ? kind->widths[i - 1] : kind->p, i ? filled[i] : 3 * filled[0])
        MATRIX(w->decoder[i], kind->widths[i], i ? filled[i - 1] : 3 * wide)
        ROOM(w->b[i], float, i ? filled[i] : 3 * filled[0])
        ROOM(w->b_[i], float, i ? filled[i - 1] : 3 * wide)
        ROOM(w->Psi[i], float, 6 * n * filled[i])
        ROOM(w->psi[i], float, n * filled[i])
    }
    int last = filled[layers - 1];
    MATRIX(w->code_head, 6 * last, last)
    MATRIX(w->code_back, kind->widths[layers - 1], 6 * last)
    ROOM(w->camera_head, float, last)
    size_t before = used;
    for (int i = 0; i < layers; i++) {
        ROOM(w->D_bar[i], float, (size_t)(i ? kind->widths[i - 1] : 3 * kind->p) * filled[i])
        ROOM(w->b_bar[i], float, filled[i])
        ROOM(w->b__bar[i], float, i ? filled[i - 1] : 3 * wide)
    }
    ROOM(w->code_bar, float, (size_t)6 * last * last)
    ROOM(w->camera_bar, float, last)
    w->bars = w->D_bar[0], w->sums = (used - before) / sizeof(float);
    ROOM(w->x, float, 2 * n * wide)
    ROOM(w->S, float, 3 * n * wide)
    ROOM(w->S_bar, float, 3 * n * wide)
    ROOM(w->left, float, 3 * n * wide)
    ROOM(w->weighed, float, 3 * n * wide)
    ROOM(w->target, float, 3 * n * wide)
    ROOM(w->rows, float, 6 * n)
    ROOM(w->spare[0], float, n * widest)
    ROOM(w->spare[1], float, n * widest)
    ROOM(w->A, camera, n)
    ROOM(w->M, camera, n)
    ROOM(w->M_bar, camera, n)
#undef MATRIX
#undef ROOM
    return used;
}
