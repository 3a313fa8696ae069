/* SPDX-License-Identifier: Apache-2.0 */
/* The network forward and backward, a block of frames at a time and a part of the batch on each thread. */
#include "training_pass.h"

#include <math.h>
#include <pthread.h>
#include <string.h>

#include "geometry.h"

/* A part of the weight vector as a matrix: entry (i, j) is at i * row + j * column. */
typedef struct {
    const float *from;
    ptrdiff_t row, column;
} Part;

/* Put a part into the panels of A, from its row `top` and column `left` on; `left` is a multiple of FLOATS. */
static void pack(Matrix A, int top, int left, int rows, int columns, Part part) {
    for (int j = 0; j < columns; j += FLOATS) {
        float *to = (float *)A.panels + (size_t)(left + j) * A.k + (size_t)top * FLOATS;
        const float *from = part.from + j * part.column;
        int some = columns - j < FLOATS ? columns - j : FLOATS;
        for (int i = 0; i < rows; i++, to += FLOATS, from += part.row)
            for (int c = 0; c < some; c++) to[c] = from[c * part.column];
    }
}

/* Lay out the weights for the products; they are in the order of `Network.trainable_weights`. */
static void lay_out_weights(Worker *w, const float *at) {
    const NetworkSizes *sizes = w->sizes;
    const int p = sizes->p, *k = sizes->widths, *filled = sizes->filled, n = sizes->layers, last = k[n - 1];
    for (int r = 0; r < 3; r++) {
        Part D = {at + r * k[0], 3 * k[0], 1}, D_T = {D.from, 1, 3 * k[0]};
        pack(w->encoder[0], 0, r * filled[0], p, k[0], D);
        pack(w->decoder[0], 0, r * sizes->wide, k[0], p, D_T);
        pack(w->first, r * sizes->wide, 0, p, k[0], D);
    }
    at += (size_t)3 * p * k[0];
    for (int i = 1; i < n; at += (size_t)k[i - 1] * k[i], i++) {
        pack(w->encoder[i], 0, 0, k[i - 1], k[i], (Part){at, k[i], 1});
        pack(w->decoder[i], 0, 0, k[i], k[i - 1], (Part){at, 1, k[i]});
    }
    for (int i = 0; i < n; at += k[i], i++)
        for (int r = 0; r < (i ? 1 : 3); r++) memcpy(w->b[i] + r * filled[i], at, k[i] * sizeof(float));
    for (int i = 0; i < p; i++)
        for (int r = 0; r < 3; r++) w->b_[0][r * sizes->wide + i] = *at++;
    for (int i = 1; i < n; at += k[i - 1], i++) memcpy(w->b_[i], at, k[i - 1] * sizeof(float));
    for (int block = 0; block < 6; block++, at += (size_t)last * last) {
        pack(w->code_head, block * filled[n - 1], 0, last, last, (Part){at, last, 1});
        pack(w->code_back, 0, block * filled[n - 1], last, last, (Part){at, 1, last});
    }
    memcpy(w->camera_head, at, last * sizeof(float));
}

/* Write the sum over the workers of a gradient (rows, columns) whose rows are `stride` apart; return where the next
   gradient goes. */
static float *sum_gradient(const WorkerPool *pool, const float *bar, int rows, int columns, int stride, float *to) {
    size_t offset = bar - pool->workers->gradient;
    for (int i = 0; i < rows; i++, offset += stride, to += columns) {
        memcpy(to, pool->workers->gradient + offset, columns * sizeof(float));
        for (int worker = 1; worker < pool->threads; worker++) {
            const float *from = pool->workers[worker].gradient + offset;
            for (int j = 0; j < columns; j++) to[j] += from[j];
        }
    }
    return to;
}

/* Write the sum of the workers' gradients, in the order of `Network.trainable_weights`. */
static void sum_gradients(const WorkerPool *pool, float *to) {
    const Worker *w = pool->workers;
    const NetworkSizes *sizes = w->sizes;
    const int p = sizes->p, *k = sizes->widths, *filled = sizes->filled, n = sizes->layers, last = k[n - 1];
    to = sum_gradient(pool, w->D_bar[0], 3 * p, k[0], filled[0], to);
    for (int i = 1; i < n; i++) to = sum_gradient(pool, w->D_bar[i], k[i - 1], k[i], filled[i], to);
    for (int i = 0; i < n; i++) to = sum_gradient(pool, w->b_bar[i], 1, k[i], 0, to);
    for (int i = 0; i < p; i++) to = sum_gradient(pool, w->b__bar[0] + i, 3, 1, sizes->wide, to);
    for (int i = 1; i < n; i++) to = sum_gradient(pool, w->b__bar[i], 1, k[i - 1], 0, to);
    for (int block = 0; block < 6; block++)
        to = sum_gradient(pool, w->code_bar + (size_t)block * filled[n - 1] * filled[n - 1], last, last, filled[n - 1],
                          to);
    sum_gradient(pool, w->camera_bar, 1, last, 0, to);
}

/* sums (n) -= the rows of X (rows, n). */
INLINE void subtract_rows_inline(ptrdiff_t rows, ptrdiff_t n, const float *restrict X, float *restrict sums) {
    for (ptrdiff_t i = 0; i < rows; i++)
        for (ptrdiff_t j = 0; j < n; j++) sums[j] -= X[i * n + j];
}
FAST(subtract_rows, (ptrdiff_t rows, ptrdiff_t n, const float *X, float *sums), (rows, n, X, sums))

/* Put 0 in `bar` (rows, n) where the result of a ReLU is 0, and subtract its rows from `sums`. */
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

/* sums (n) += the rows of X (rows, n), each times its entry of `by` (rows). */
INLINE void combine_inline(ptrdiff_t rows, ptrdiff_t n, const float *restrict by, const float *restrict X,
                           float *restrict sums) {
    for (ptrdiff_t i = 0; i < rows; i++)
        for (ptrdiff_t j = 0; j < n; j++) sums[j] += by[i] * X[i * n + j];
}
FAST(combine, (ptrdiff_t rows, ptrdiff_t n, const float *by, const float *X, float *sums), (rows, n, by, X, sums))

/* X (rows, n) += by (rows) times x (n). */
INLINE void spread_inline(ptrdiff_t rows, ptrdiff_t n, const float *restrict by, const float *restrict x,
                          float *restrict X) {
    for (ptrdiff_t i = 0; i < rows; i++)
        for (ptrdiff_t j = 0; j < n; j++) X[i * n + j] += by[i] * x[j];
}
FAST(spread, (ptrdiff_t rows, ptrdiff_t n, const float *by, const float *x, float *X), (rows, n, by, x, X))

/* by (rows) = X (rows, n) times x (n). */
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

/* Return where the activations of a block of n frames are, in memory of n * sizes.activations floats. */
static Activations activations_at(const NetworkSizes *sizes, ptrdiff_t n, float *at) {
    Activations kept;
    kept.x = at, at += 2 * n * sizes->wide;
    for (int i = 0; i < sizes->layers; i++) {
        kept.Psi[i] = at, at += 6 * n * sizes->filled[i];
        kept.psi[i] = at, at += n * sizes->filled[i];
    }
    kept.camera_rows = at;
    return kept;
}

/* Set A and its orthonormal factor M, both by columns, from a row pair (2, 3). */
static void cameras_of(const float *rows, camera A, camera M) {
    for (int i = 0; i < 6; i++) A[i % 3][i / 3] = rows[i];
    memcpy(M, A, sizeof(camera));
    polar(M);
}

/* One block of n frames. network.c has another forward pass: it encodes rotations of one input, and keeps no codes. */
static void forward_block(Worker *w, int n, const float *x, float *memory, float *S, float *M_T) {
    const NetworkSizes *sizes = w->sizes;
    const Activations kept = activations_at(sizes, n, memory);
    const int p = sizes->p, wide = sizes->wide, layers = sizes->layers, *filled = sizes->filled;
    float *rows = sizes->whitened ? w->spare[0] : kept.x;
    for (int row = 0; row < 2 * n; row++)
        memcpy(rows + row * wide, x + row * p, p * sizeof(float));
    if (sizes->whitened) product(2 * n, rows, wide, w->L, NULL, 0, kept.x);
    product(2 * n, kept.x, wide, w->encoder[0], w->b[0], 1, kept.Psi[0]);
    for (int i = 1; i < layers; i++)
        product(6 * n, kept.Psi[i - 1], filled[i - 1], w->encoder[i], w->b[i], 1, kept.Psi[i]);
    const float *Psi = kept.Psi[layers - 1];
    dots(6 * n, filled[layers - 1], Psi, w->camera_head, kept.camera_rows);
    for (int o = 0; o < n; o++) {
        camera A, M;
        cameras_of(kept.camera_rows + 6 * o, A, M);
        for (int i = 0; i < 6; i++) M_T[6 * o + i] = (float)M[i % 3][i / 3];
    }
    product(n, Psi, 6 * filled[layers - 1], w->code_head, NULL, 0, kept.psi[layers - 1]);
    for (int i = layers - 1; i > 0; i--)
        product(n, kept.psi[i], filled[i], w->decoder[i], w->b_[i], 1, kept.psi[i - 1]);
    float *from = w->S;
    product(n, kept.psi[0], filled[0], w->decoder[0], w->b_[0], 0, from);
    if (sizes->whitened) product(3 * n, w->S, wide, w->L_inverse, NULL, 0, from = w->spare[0]);
    for (int row = 0; row < 3 * n; row++) memcpy(S + row * p, from + row * wide, p * sizeof(float));
}

/* Return psi_bar (n, k_n) from S_bar (n, 3, p). */
static float *through_decoder(Worker *w, int n, const Activations *kept, const float *S_bar) {
    const NetworkSizes *sizes = w->sizes;
    const int p = sizes->p, wide = sizes->wide, *filled = sizes->filled;
    float *s_bar = w->S_bar, *bar = w->spare[0], *next = w->spare[1];
    for (int row = 0; row < 3 * n; row++) memcpy(s_bar + row * wide, S_bar + row * p, p * sizeof(float));
    if (sizes->whitened) product(3 * n, w->S_bar, wide, w->L_inverse, NULL, 0, s_bar = w->spare[1]);
    subtract_rows(n, 3 * wide, s_bar, w->b__bar[0]);
    for (int r = 0; r < 3; r++)
        accumulate(n, p, s_bar + r * wide, 3 * wide, filled[0], kept->psi[0], w->D_bar[0] + r * filled[0],
                   3 * filled[0]);
    product(n, s_bar, 3 * wide, w->first, NULL, 0, bar);
    for (int i = 1; i < sizes->layers; i++) {
        relu_gradient(n, filled[i - 1], kept->psi[i - 1], bar, w->b__bar[i]);
        accumulate(n, sizes->widths[i - 1], bar, filled[i - 1], filled[i], kept->psi[i], w->D_bar[i], filled[i]);
        product(n, bar, filled[i - 1], w->encoder[i], NULL, 0, next);
        float *swap = bar;
        bar = next, next = swap;
    }
    return bar;
}

/* Set the gradient by A (2, 3) from that by its orthonormal factor R; A and R by columns, as the camera M.

   With A = P R, P symmetric, a change of A turns the rows of R within their plane by (dA R^T - R dA^T) / tr P and
   moves them out of it by P^-1 dA (I - R^T R); this is the adjoint. */
static void polar_gradient(camera A, camera R, const float R_bar[6], float A_bar[6]) {
    double P[2][2] = {{0}}, X[2][2] = {{0}};
    for (int a = 0; a < 2; a++)
        for (int b = 0; b < 2; b++)
            for (int r = 0; r < 3; r++) P[a][b] += A[r][a] * R[r][b], X[a][b] += R_bar[3 * a + r] * R[r][b];
    double trace = P[0][0] + P[1][1], determinant = P[0][0] * P[1][1] - P[0][1] * P[1][0];
    /* Where A has no camera in it, any finite gradient will do; see `polar`. */
    determinant = fmax(determinant, 1e-6 * trace * trace + 1e-30);
    double rotation = (X[0][1] - X[1][0]) / fmax(trace, 1e-15);
    for (int r = 0; r < 3; r++) {
        double out[2];
        for (int a = 0; a < 2; a++) out[a] = R_bar[3 * a + r] - X[a][0] * R[r][0] - X[a][1] * R[r][1];
        for (int a = 0; a < 2; a++)
            A_bar[3 * a + r] = (float)((a ? -rotation : rotation) * R[r][1 - a] +
                                       (trace * out[a] - P[a][0] * out[0] - P[a][1] * out[1]) / determinant);
    }
}

/* Return Psi_bar (6 n, k_n) from psi_bar (n, k_n) and M_T_bar (n, 2, 3). */
static float *through_recovery(Worker *w, int n, const Activations *kept, float *psi_bar, const float *M_T_bar) {
    const int last = w->sizes->layers - 1, filled = w->sizes->filled[last];
    const float *Psi = kept->Psi[last];
    float *bar = psi_bar == w->spare[0] ? w->spare[1] : w->spare[0], *by = w->camera_bars;
    for (int o = 0; o < n; o++) {
        camera A, M;
        cameras_of(kept->camera_rows + 6 * o, A, M);
        polar_gradient(A, M, M_T_bar + 6 * o, by + 6 * o);
    }
    accumulate(n, 6 * filled, Psi, 6 * filled, filled, psi_bar, w->code_bar, filled);
    combine(6 * n, filled, by, Psi, w->camera_bar);
    product(n, psi_bar, filled, w->code_back, NULL, 0, bar);
    spread(6 * n, filled, by, w->camera_head, bar);
    return bar;
}

/* Add the gradients by the encoder, from Psi_bar (6 n, k_n). */
static void through_encoder(Worker *w, int n, const Activations *kept, float *bar) {
    const NetworkSizes *sizes = w->sizes;
    const int p = sizes->p, *filled = sizes->filled;
    float *next = bar == w->spare[0] ? w->spare[1] : w->spare[0];
    for (int i = sizes->layers - 1; i >= 0; i--) {
        relu_gradient(6 * n, filled[i], kept->Psi[i], bar, w->b_bar[i]);
        if (!i) break;
        accumulate(6 * n, sizes->widths[i - 1], kept->Psi[i - 1], filled[i - 1], filled[i], bar, w->D_bar[i],
                   filled[i]);
        product(6 * n, bar, filled[i], w->decoder[i], NULL, 0, next);
        float *swap = bar;
        bar = next, next = swap;
    }
    accumulate(2 * n, p, kept->x, sizes->wide, 3 * filled[0], bar, w->D_bar[0], 3 * filled[0]);
}

/* The arrays of a call, as in the header; x is NULL in a backward pass. */
typedef struct {
    WorkerPool *pool;
    const float *weights, *x;
    ptrdiff_t n;
    float *activations, *S, *M_T;
    const float *S_bar, *M_T_bar;
    int lay_out; /* the weights are not laid out yet */
} Call;

/* What a thread starts with. */
typedef struct {
    const Call *call;
    int worker;
} Job;

static void *work(void *argument) {
    const Job *job = argument;
    const Call *call = job->call;
    const NetworkSizes *sizes = &call->pool->sizes;
    const ptrdiff_t p = sizes->p, threads = call->pool->threads;
    Worker *w = call->pool->workers + job->worker;
    if (call->lay_out) lay_out_weights(w, call->weights);
    if (!call->x) memset(w->gradient, 0, w->gradient_floats * sizeof(float));
    ptrdiff_t i = call->n * job->worker / threads, end = call->n * (job->worker + 1) / threads;
    for (int n; i < end; i += n) {
        n = (int)(end - i < sizes->block ? end - i : sizes->block);
        float *memory = call->activations + i * sizes->activations;
        if (call->x) {
            forward_block(w, n, call->x + 2 * p * i, memory, call->S + 3 * p * i, call->M_T + 6 * i);
        } else {
            const Activations kept = activations_at(sizes, n, memory);
            float *psi_bar = through_decoder(w, n, &kept, call->S_bar + 3 * p * i);
            through_encoder(w, n, &kept, through_recovery(w, n, &kept, psi_bar, call->M_T_bar + 6 * i));
        }
    }
    return NULL;
}

/* Run `work` on every worker, each but the last on a thread of its own where there is one to be had. */
static void run(Call *call) {
    WorkerPool *pool = call->pool;
    size_t bytes = pool->sizes.weights * sizeof(float);
    Job jobs[MAX_THREADS];
    pthread_t threads[MAX_THREADS];
    int started[MAX_THREADS];
    call->lay_out = !pool->laid_out || memcmp(pool->weights, call->weights, bytes);
    for (int i = 0; i < pool->threads; i++) {
        jobs[i] = (Job){call, i};
        started[i] = i + 1 < pool->threads && !pthread_create(threads + i, NULL, work, jobs + i);
    }
    if (call->lay_out) memcpy(pool->weights, call->weights, bytes), pool->laid_out = 1;
    for (int i = pool->threads - 1; i >= 0; i--)
        if (!started[i]) work(jobs + i);
    for (int i = 0; i < pool->threads; i++)
        if (started[i]) pthread_join(threads[i], NULL);
}

void network_forward(WorkerPool *pool, const float *weights, ptrdiff_t n, const float *x, float *activations, float *S,
                     float *M_T) {
    Call call = {.pool = pool, .weights = weights, .x = x, .n = n, .activations = activations, .S = S, .M_T = M_T};
    run(&call);
}

void network_backward(WorkerPool *pool, const float *weights, ptrdiff_t n, const float *activations, const float *S_bar,
                      const float *M_T_bar, float *gradient) {
    Call call = {.pool = pool, .weights = weights, .n = n, .activations = (float *)activations, .S_bar = S_bar,
                 .M_T_bar = M_T_bar};
    run(&call);
    sum_gradients(pool, gradient);
}

void network_sizes_set(NetworkSizes *sizes, const int *widths) {
    sizes->wide = FLOATS_OF(sizes->p);
    sizes->weights = 0;
    sizes->activations = 2 * (size_t)sizes->wide + 6;
    for (int i = 0; i < sizes->layers; i++) {
        size_t k = sizes->widths[i] = widths[i], before = i ? (size_t)widths[i - 1] : (size_t)3 * sizes->p;
        sizes->filled[i] = FLOATS_OF(widths[i]);
        sizes->weights += before * k + k + before;
        sizes->activations += 7 * (size_t)sizes->filled[i];
        if (i + 1 == sizes->layers) sizes->weights += 6 * k * k + k;
    }
    sizes->activations = FLOATS_OF(sizes->activations);
}

void worker_set_whitening(Worker *w, const float *L, const float *L_inverse) {
    int p = w->sizes->p;
    pack(w->L, 0, 0, p, p, (Part){L, p, 1});
    pack(w->L_inverse, 0, 0, p, p, (Part){L_inverse, p, 1});
}

unsigned long long worker_lay_out(Worker *w, const NetworkSizes *sizes, char *at) {
    const int wide = sizes->wide, layers = sizes->layers, *filled = sizes->filled;
    unsigned long long n = sizes->block, used = 0, widest = 3ULL * wide;
    for (int i = 0; i < layers; i++)
        if (6ULL * filled[i] > widest) widest = 6ULL * filled[i];
#define ROOM(member, count)                   \
    member = (float *)(at ? at + used : NULL); \
    used += ((count) * sizeof(float) + 63ULL) / 64 * 64;
#define MATRIX(A, rows, columns)       \
    (A).k = (rows), (A).n = (columns); \
    ROOM((A).panels, (unsigned long long)(A).k *(A).n)
    w->sizes = sizes;
    MATRIX(w->L, sizes->p, wide)
    MATRIX(w->L_inverse, sizes->p, wide)
    MATRIX(w->first, 3 * wide, filled[0])
    for (int i = 0; i < layers; i++) {
        MATRIX(w->encoder[i], i ? sizes->widths[i - 1] : sizes->p, i ? filled[i] : 3 * filled[0])
        MATRIX(w->decoder[i], sizes->widths[i], i ? filled[i - 1] : 3 * wide)
        ROOM(w->b[i], (i ? 1ULL : 3ULL) * filled[i])
        ROOM(w->b_[i], i ? (size_t)filled[i - 1] : (size_t)3 * wide)
    }
    int last = filled[layers - 1];
    MATRIX(w->code_head, 6 * last, last)
    MATRIX(w->code_back, sizes->widths[layers - 1], 6 * last)
    ROOM(w->camera_head, last)
    unsigned long long before = used;
    for (int i = 0; i < layers; i++) {
        ROOM(w->D_bar[i], (i ? (size_t)sizes->widths[i - 1] : (size_t)3 * sizes->p) * filled[i])
        ROOM(w->b_bar[i], filled[i])
        ROOM(w->b__bar[i], i ? (size_t)filled[i - 1] : (size_t)3 * wide)
    }
    ROOM(w->code_bar, 6ULL * last * last)
    ROOM(w->camera_bar, last)
    w->gradient = w->D_bar[0], w->gradient_floats = (size_t)(used - before) / sizeof(float);
    ROOM(w->S, 3 * n * wide)
    ROOM(w->S_bar, 3 * n * wide)
    ROOM(w->camera_bars, 6 * n)
    ROOM(w->spare[0], n * widest)
    ROOM(w->spare[1], n * widest)
#undef MATRIX
#undef ROOM
    return used;
}
