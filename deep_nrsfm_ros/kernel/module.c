/* The module `_kernel`: Python's arrays to C and back. */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <stdint.h>
#include <string.h>

#include "observation.h"
#include "plan.h"
#include "training_module.h"

#define LINE 64 /* bytes of the cache, at whose borders all parts begin */

static const char NAME[] = "deep_nrsfm_ros.kernel._kernel.plan";

static void forget(PyObject *capsule) {
    Plan *k = PyCapsule_GetPointer(capsule, NAME);
    if (k) PyMem_Free(k->memory), PyMem_Free(k);
}

/* plan(header int32, floats float32, doubles float64) -> capsule; `compiled.plan` says what is in them. */
static PyObject *plan(PyObject *Py_UNUSED(module), PyObject *args) {
    Py_buffer parts[3];
    if (!PyArg_ParseTuple(args, "y*y*y*", &parts[0], &parts[1], &parts[2])) return NULL;
    size_t aligned[4] = {0};
    for (int i = 0; i < 3; i++) aligned[i + 1] = aligned[i] + (parts[i].len + LINE - 1) / LINE * LINE;
    const int *header = parts[0].buf;
    Py_ssize_t lengths[3] = {parts[0].len / 4, parts[1].len / 4, parts[2].len / 8};
    int sound = lengths[0] > 13 && header[0] > 0 && header[1] > 0 && header[1] <= MOST_LAYERS;
    sound = sound && header[11] >= 0 && lengths[0] == 12 + header[0] + header[1] + 2 * header[11];
    Plan *k = sound ? PyMem_Calloc(1, sizeof(Plan)) : NULL;
    char *memory = NULL;
    if (k && lay_out(k, header, parts[1].buf, parts[2].buf, lengths)) {
        size_t needed = scratch(k, NULL);
        memory = k->memory = PyMem_Calloc(1, aligned[3] + needed + LINE);
        if (memory) memory += LINE - (uintptr_t)memory % LINE;
        for (int i = 0; memory && i < 3; i++) memcpy(memory + aligned[i], parts[i].buf, parts[i].len);
        if (memory) {
            lay_out(k, (int *)memory, (float *)(memory + aligned[1]), (double *)(memory + aligned[2]),
                    lengths);
            scratch(k, memory + aligned[3]);
        }
    }
    for (int i = 0; i < 3; i++) PyBuffer_Release(&parts[i]);
    if (!memory) {
        PyMem_Free(k);
        PyErr_SetString(PyExc_ValueError, "the arrays are not those of a plan, or too large");
        return NULL;
    }
    return PyCapsule_New(k, NAME, forget);
}

/* lift(plan, points, confidence, perspective, shapes, rotations, scale, translation, residual, sure, lost):
   fill the last seven, arrays as in `lifting.Lifted`, and lost (n,) of bytes. */
static PyObject *lift_objects(PyObject *Py_UNUSED(module), PyObject *args) {
    PyObject *capsule;
    Py_buffer b[9];
    int perspective;
    if (!PyArg_ParseTuple(args, "Oy*y*pw*w*w*w*w*w*w*", &capsule, &b[0], &b[1], &perspective, &b[2],
                          &b[3], &b[4], &b[5], &b[6], &b[7], &b[8]))
        return NULL;
    Plan *k = PyCapsule_GetPointer(capsule, NAME);
    int sound = k != NULL;
    if (k) {
        Py_ssize_t n = b[8].len, p = k->p;
        const Py_ssize_t each[8] = {2 * p, p, 3 * p, 9, 1, 2, 1, p};
        float *lifted[6];
        for (int i = 0; i < 8; i++) sound = sound && b[i].len == 4 * n * each[i];
        for (int i = 0; i < 6; i++) lifted[i] = b[2 + i].buf;
        if (sound)
            lift(k, n, b[0].buf, b[1].buf, perspective, lifted, b[8].buf);
        else
            PyErr_SetString(PyExc_ValueError, "the arrays do not fit the plan and each other");
    }
    for (int i = 0; i < 9; i++) PyBuffer_Release(&b[i]);
    if (!sound) return NULL;
    Py_RETURN_NONE;
}

/* observe(data, (messages, apart), (height, width), (row_step, point_step), (x, y, confidence), farthest, least,
   points, confidence): fill the last two; what begins at x, y and confidence in the first message does so `apart` bytes
   later in the next. */
static PyObject *observe_raw(PyObject *Py_UNUSED(module), PyObject *args) {
    Py_buffer data, points, confidence;
    Py_ssize_t messages, apart, height, width, row_step, point_step, offset[3], most = -1;
    float farthest, least;
    if (!PyArg_ParseTuple(args, "y*(nn)(nn)(nn)(nnn)ffw*w*", &data, &messages, &apart, &height, &width, &row_step,
                          &point_step, &offset[0], &offset[1], &offset[2], &farthest, &least, &points, &confidence))
        return NULL;
    for (int i = 0; i < 3; i++) most = offset[i] > most ? offset[i] : most;
    Py_ssize_t n = messages * height * width;
    int sound = apart >= 0 && row_step >= 0 && point_step >= 0 && offset[0] >= 0 && offset[1] >= 0;
    sound = sound && points.len == 8 * n && confidence.len == 4 * n;
    sound = sound && (n == 0 || (messages - 1) * apart + (height - 1) * row_step + (width - 1) * point_step + most + 4 <=
                                    data.len);
    for (Py_ssize_t m = 0; sound && m < messages; m++) {
        Places at = {height, width, {offset[0], offset[1], offset[2]}, point_step, row_step};
        observe_keypoints((const char *)data.buf + m * apart, &at, farthest, least,
                          (float *)points.buf + 2 * m * height * width,
                          (float *)confidence.buf + m * height * width);
    }
    PyBuffer_Release(&data), PyBuffer_Release(&points), PyBuffer_Release(&confidence);
    if (!sound) return PyErr_Format(PyExc_ValueError, "the arrays do not fit the data");
    Py_RETURN_NONE;
}

/* choose_vectors(bytes) -> bytes: for tests, which try them all. */
static PyObject *choose(PyObject *Py_UNUSED(module), PyObject *bytes) {
    long asked = PyLong_AsLong(bytes);
    if (asked == -1 && PyErr_Occurred()) return NULL;
    return PyLong_FromLong(choose_vectors(asked < 64 ? (int)asked : 64));
}

static PyMethodDef methods[] = {{"plan", plan, METH_VARARGS, NULL},
                                {"lift", lift_objects, METH_VARARGS, NULL},
                                TRAINING_METHODS,
                                {"observe", observe_raw, METH_VARARGS, NULL},
                                {"choose_vectors", choose, METH_O, NULL},
                                {NULL, NULL, 0, NULL}};
static PyModuleDef module = {PyModuleDef_HEAD_INIT, "_kernel", NULL, -1, methods, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__kernel(void) {
    PyObject *made = PyModule_Create(&module);
    choose_vectors(64);
    if (made && (PyModule_AddIntMacro(made, FLOATS) || PyModule_AddIntMacro(made, DOUBLES) ||
                 PyModule_AddIntMacro(made, MOST_LAYERS)))
        Py_CLEAR(made);
    return made;
}
