/* Entry points of training in the module `_kernel`. */
#include "training_module.h"

#include <stdint.h>

#include "gradient.h"

#define LINE 64 /* bytes of the cache, at whose borders all parts begin */

/* The workers of a training, one a thread. */
typedef struct {
    Kind kind;
    int threads;
    char *memory;
    Worker *workers;
} Staff;

static const char STAFF[] = "deep_nrsfm_ros.kernel._kernel.workers";

static void dismiss(PyObject *capsule) {
    Staff *staff = PyCapsule_GetPointer(capsule, STAFF);
    if (staff) PyMem_Free(staff->memory), PyMem_Free(staff->workers), PyMem_Free(staff);
}

/* workers(header int32, L, L_inverse float32) -> capsule; header: p, layers, whitened, frames at a time,
   threads, widths. */
PyObject *workers(PyObject *Py_UNUSED(module), PyObject *args) {
    Py_buffer parts[3];
    if (!PyArg_ParseTuple(args, "y*y*y*", &parts[0], &parts[1], &parts[2])) return NULL;
    const int *h = parts[0].buf;
    Py_ssize_t n = parts[0].len / 4;
    int sound = n > 5 && h[0] > 0 && h[1] > 0 && h[1] <= MOST_LAYERS && n == 5 + h[1] && h[3] > 0 && h[4] > 0;
    for (int i = 0; sound && i < h[1]; i++) sound = h[5 + i] > 0;
    for (int i = 1; i < 3; i++) sound = sound && parts[i].len == (Py_ssize_t)4 * h[0] * h[0];
    Staff *staff = sound ? PyMem_Calloc(1, sizeof(Staff)) : NULL;
    if (staff) {
        Kind *kind = &staff->kind;
        kind->p = h[0], kind->layers = h[1], kind->whitened = h[2], kind->block = h[3], staff->threads = h[4];
        describe(kind, h + 5);
        staff->workers = PyMem_Calloc(staff->threads, sizeof(Worker));
        size_t each = staff->workers ? (employ(staff->workers, kind, NULL) + LINE - 1) / LINE * LINE : 0;
        staff->memory = each ? PyMem_Calloc(staff->threads * each + LINE, 1) : NULL;
        char *at = staff->memory ? staff->memory + (LINE - (uintptr_t)staff->memory % LINE) : NULL;
        for (int i = 0; at && i < staff->threads; i++, at += each) {
            employ(staff->workers + i, kind, at);
            whiten_by(staff->workers + i, parts[1].buf, parts[2].buf);
        }
    }
    for (int i = 0; i < 3; i++) PyBuffer_Release(&parts[i]);
    if (staff && !staff->memory) {
        PyMem_Free(staff->workers), PyMem_Free(staff);
        return PyErr_NoMemory();
    }
    if (!staff) {
        PyErr_SetString(PyExc_ValueError, "the arrays are not those of a network");
        return NULL;
    }
    return PyCapsule_New(staff, STAFF, dismiss);
}

/* gradient(workers, cycle, weights, x, W, mask, T, losses float64, shapes, gradient): fill the last three,
   arrays as in `gradient.h`; T may be empty. For one thread of Python at a time. */
PyObject *gradient(PyObject *Py_UNUSED(module), PyObject *args) {
    PyObject *capsule;
    Py_buffer b[8];
    double cycle;
    if (!PyArg_ParseTuple(args, "Ody*y*y*y*y*w*w*w*", &capsule, &cycle, &b[0], &b[1], &b[2], &b[3], &b[4],
                          &b[5], &b[6], &b[7]))
        return NULL;
    Staff *staff = PyCapsule_GetPointer(capsule, STAFF);
    int sound = staff != NULL;
    if (staff) {
        Py_ssize_t p = staff->kind.p, weights = 4 * staff->kind.learned, frames = b[3].len / (4 * p);
        Py_ssize_t known = b[4].len / (12 * p);
        const Py_ssize_t lengths[8] = {weights,       8 * p * (frames + known), 8 * p * frames, 4 * p * frames,
                                       12 * p * known, 16,                       12 * p * frames, weights};
        for (int i = 0; i < 8; i++) sound = sound && b[i].len == lengths[i];
        Task task = {frames, known, b[1].buf, b[2].buf, b[3].buf, b[4].buf, cycle};
        if (sound && frames) {
            Py_BEGIN_ALLOW_THREADS
            gradient_of(staff->workers, staff->threads, b[0].buf, &task, b[5].buf, b[6].buf, b[7].buf);
            Py_END_ALLOW_THREADS
        } else {
            sound = 0;
            PyErr_SetString(PyExc_ValueError, "the arrays do not fit the network and each other");
        }
    }
    for (int i = 0; i < 8; i++) PyBuffer_Release(&b[i]);
    if (!sound) return NULL;
    Py_RETURN_NONE;
}
