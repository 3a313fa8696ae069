/* SPDX-License-Identifier: Apache-2.0 */
/* Entry points of training in the module `_kernel`: Python's arrays to training_pass.c and back.

   As in module.c, no argument is trusted. */
#include "training_module.h"

#include <stdint.h>

#include "arguments.h"
#include "training_pass.h"

static const char POOL[] = "deep_nrsfm_ros.kernel._kernel.worker_pool";

static void worker_pool_free(WorkerPool *pool) {
    PyMem_Free(pool->memory), PyMem_Free(pool->weights), PyMem_Free(pool->workers), PyMem_Free(pool);
}

static void worker_pool_stop(PyObject *capsule) {
    WorkerPool *pool = PyCapsule_GetPointer(capsule, POOL);
    if (pool) worker_pool_free(pool);
}

/* Return a pool of workers for a network, or NULL without memory. Header as in `training_worker_pool`, valid. */
static WorkerPool *worker_pool_start(const int *header, const float *L, const float *L_inverse) {
    WorkerPool *pool = PyMem_Calloc(1, sizeof(WorkerPool));
    if (!pool) return NULL;
    NetworkSizes *sizes = &pool->sizes;
    sizes->p = header[0], sizes->layers = header[1], sizes->whitened = header[2] != 0, sizes->block = header[3];
    pool->threads = header[4];
    network_sizes_set(sizes, header + 5);
    pool->workers = PyMem_Calloc(pool->threads, sizeof(Worker));
    pool->weights = PyMem_Calloc(sizes->weights, sizeof(float));
    size_t each, total;
    int fits = pool->workers && pool->weights;
    /* The bytes of a worker are a multiple of a cache line. */
    fits = fits && !__builtin_add_overflow(worker_lay_out(pool->workers, sizes, NULL), 0, &each) &&
           !__builtin_mul_overflow(each, pool->threads, &total) && !__builtin_add_overflow(total, CACHE_LINE, &total);
    pool->memory = fits ? PyMem_Calloc(total, 1) : NULL;
    if (!pool->memory) {
        worker_pool_free(pool);
        return NULL;
    }
    char *at = (char *)TO_CACHE_LINE((uintptr_t)pool->memory);
    for (int i = 0; i < pool->threads; i++, at += each) {
        worker_lay_out(pool->workers + i, sizes, at);
        worker_set_whitening(pool->workers + i, L, L_inverse);
    }
    return pool;
}

/* Return whether n ints are the header of a pool. */
static int header_valid(const int *header, Py_ssize_t n) {
    if (n < 6 || header[1] < 1 || header[1] > MAX_LAYERS || n != 5 + header[1]) return 0;
    if (header[0] < 1 || header[0] > MAX_KEYPOINTS || header[3] < 1 || header[3] > MAX_BLOCK) return 0;
    if (header[4] < 1 || header[4] > MAX_THREADS) return 0;
    for (int i = 5; i < n; i++)
        if (header[i] < 1 || header[i] > MAX_WIDTH) return 0;
    return 1;
}

/* worker_pool(header int32, L, L_inverse float32) -> capsule; header: p, layers, whitened, frames of a block,
   threads, widths. */
PyObject *training_worker_pool(PyObject *Py_UNUSED(module), PyObject *args) {
    static const ArrayArgument expected[3] = {{"header", INT32, 0}, {"L", FLOAT32, 0}, {"L_inverse", FLOAT32, 0}};
    PyObject *objects[3];
    Py_buffer arrays[3];
    if (!parse_arguments(args, "OOO:worker_pool", &objects[0], &objects[1], &objects[2])) return NULL;
    if (!get_arrays(3, expected, objects, arrays)) return NULL;
    const int *header = arrays[0].buf;
    int valid = header_valid(header, count_items(arrays));
    for (int i = 1; valid && i < 3; i++) valid = count_items(arrays + i) == (Py_ssize_t)header[0] * header[0];
    WorkerPool *pool = valid ? worker_pool_start(header, arrays[1].buf, arrays[2].buf) : NULL;
    release_arrays(3, arrays);
    if (!valid) {
        PyErr_SetString(PyExc_ValueError, "the arrays are not those of a network");
        return NULL;
    }
    if (!pool) {
        PyErr_SetString(PyExc_ValueError, "there is no memory for the workers");
        return NULL;
    }
    PyObject *capsule = PyCapsule_New(pool, POOL, worker_pool_stop);
    if (!capsule) worker_pool_free(pool);
    return capsule;
}

/* activations_per_frame(pool) -> floats that the forward pass keeps of a frame. */
PyObject *training_activations(PyObject *Py_UNUSED(module), PyObject *capsule) {
    WorkerPool *pool = PyCapsule_GetPointer(capsule, POOL);
    return pool ? PyLong_FromSize_t(pool->sizes.activations) : NULL;
}

/* Return whether the arrays are those of n frames, n >= 1; floats: of each array for a frame, 0 for a weight vector. */
static int arrays_fit(const NetworkSizes *sizes, Py_ssize_t n, const Py_buffer *arrays, const size_t floats[5]) {
    for (int i = 0; i < 5; i++) {
        size_t expected = sizes->weights;
        if (floats[i] && __builtin_mul_overflow(floats[i], n, &expected)) return 0;
        if ((size_t)count_items(arrays + i) != expected) return 0;
    }
    return n > 0;
}

/* A call of one of the passes, with its pool taken and its arrays held. */
typedef struct {
    WorkerPool *pool;
    Py_buffer arrays[5];
} PassCall;

/* Take the pool and the arrays; return 0 with an exception set if there is none or another call has it. */
static int pass_begin(PassCall *call, PyObject *capsule, const ArrayArgument *expected, PyObject *const *objects) {
    call->pool = PyCapsule_GetPointer(capsule, POOL);
    if (!call->pool) return 0;
    if (__atomic_exchange_n(&call->pool->busy, 1, __ATOMIC_ACQUIRE)) {
        PyErr_SetString(PyExc_RuntimeError, "the workers are in use by another call");
        return 0;
    }
    if (get_arrays(5, expected, objects, call->arrays)) return 1;
    __atomic_store_n(&call->pool->busy, 0, __ATOMIC_RELEASE);
    return 0;
}

/* Give the arrays and the pool back; return None, or NULL with ValueError if the arrays did not fit. */
static PyObject *pass_end(PassCall *call, int fit) {
    release_arrays(5, call->arrays);
    __atomic_store_n(&call->pool->busy, 0, __ATOMIC_RELEASE);
    if (fit) Py_RETURN_NONE;
    PyErr_SetString(PyExc_ValueError, "the arrays do not fit the network and each other");
    return NULL;
}

/* network_forward(pool, weights, x, activations, S, M_T): fill the last three; arrays as in training_pass.h. */
PyObject *training_forward(PyObject *Py_UNUSED(module), PyObject *args) {
    static const ArrayArgument expected[5] = {{"weights", FLOAT32, 0},
                                              {"x", FLOAT32, 0},
                                              {"activations", FLOAT32, 1},
                                              {"S", FLOAT32, 1},
                                              {"M_T", FLOAT32, 1}};
    PyObject *capsule, *o[5];
    PassCall call;
    if (!parse_arguments(args, "OOOOOO:network_forward", &capsule, &o[0], &o[1], &o[2], &o[3], &o[4])) return NULL;
    if (!pass_begin(&call, capsule, expected, o)) return NULL;
    const Py_buffer *a = call.arrays;
    size_t p = call.pool->sizes.p;
    const size_t floats[5] = {0, 2 * p, call.pool->sizes.activations, 3 * p, 6};
    Py_ssize_t n = count_items(a + 4) / 6;
    int fit = arrays_fit(&call.pool->sizes, n, a, floats);
    if (fit) {
        Py_BEGIN_ALLOW_THREADS
        network_forward(call.pool, a[0].buf, n, a[1].buf, a[2].buf, a[3].buf, a[4].buf);
        Py_END_ALLOW_THREADS
    }
    return pass_end(&call, fit);
}

/* network_backward(pool, weights, activations, S_bar, M_T_bar, gradient): fill the last; arrays as in
   training_pass.h. */
PyObject *training_backward(PyObject *Py_UNUSED(module), PyObject *args) {
    static const ArrayArgument expected[5] = {{"weights", FLOAT32, 0},
                                              {"activations", FLOAT32, 0},
                                              {"S_bar", FLOAT32, 0},
                                              {"M_T_bar", FLOAT32, 0},
                                              {"gradient", FLOAT32, 1}};
    PyObject *capsule, *o[5];
    PassCall call;
    if (!parse_arguments(args, "OOOOOO:network_backward", &capsule, &o[0], &o[1], &o[2], &o[3], &o[4])) return NULL;
    if (!pass_begin(&call, capsule, expected, o)) return NULL;
    const Py_buffer *a = call.arrays;
    size_t p = call.pool->sizes.p;
    const size_t floats[5] = {0, call.pool->sizes.activations, 3 * p, 6, 0};
    Py_ssize_t n = count_items(a + 3) / 6;
    int fit = arrays_fit(&call.pool->sizes, n, a, floats);
    if (fit) {
        Py_BEGIN_ALLOW_THREADS
        network_backward(call.pool, a[0].buf, n, a[1].buf, a[2].buf, a[3].buf, a[4].buf);
        Py_END_ALLOW_THREADS
    }
    return pass_end(&call, fit);
}
