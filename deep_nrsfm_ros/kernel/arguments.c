/* SPDX-License-Identifier: Apache-2.0 */
#include "arguments.h"

#include <stdarg.h>
#include <stdint.h>

static const struct {
    const char *name, *formats; /* characters of `struct` for items of this type */
    Py_ssize_t size;
} ITEM_TYPES[] = {
    [INT32] = {"int32", "il", 4},  [FLOAT32] = {"float32", "f", 4}, [FLOAT64] = {"float64", "d", 8},
    [BOOL] = {"bool", "?", 1},     [BYTES] = {"bytes", "Bbc", 1},
};

static int matches(const Py_buffer *view, ItemType type) {
    const char *format = view->format ? view->format : "B", *known = ITEM_TYPES[type].formats;
    if (*format == '@') format++;
    while (*known && *known != *format) known++;
    return *known && !format[1] && view->itemsize == ITEM_TYPES[type].size &&
           (uintptr_t)view->buf % view->itemsize == 0;
}

int get_arrays(int n, const ArrayArgument *arguments, PyObject *const *objects, Py_buffer *views) {
    for (int i = 0; i < n; i++) {
        const ArrayArgument *argument = arguments + i;
        int flags = PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | (argument->output ? PyBUF_WRITABLE : 0);
        int failed = PyObject_GetBuffer(objects[i], views + i, flags) < 0;
        if (!failed && matches(views + i, argument->type)) continue;
        if (!failed) PyBuffer_Release(views + i);
        release_arrays(i, views);
        if (failed && !PyErr_ExceptionMatches(PyExc_TypeError) && !PyErr_ExceptionMatches(PyExc_ValueError) &&
            !PyErr_ExceptionMatches(PyExc_BufferError))
            return 0;
        PyErr_Format(PyExc_TypeError, "%s must be a C-contiguous%s array of %s", argument->name,
                     argument->output ? ", writable" : "", ITEM_TYPES[argument->type].name);
        return 0;
    }
    return 1;
}

void release_arrays(int n, Py_buffer *views) {
    for (int i = 0; i < n; i++) PyBuffer_Release(views + i);
}

Py_ssize_t count_items(const Py_buffer *view) { return view->len / view->itemsize; }

int parse_arguments(PyObject *args, const char *format, ...) {
    va_list targets;
    va_start(targets, format);
    int parsed = PyArg_VaParse(args, format, targets);
    va_end(targets);
    if (!parsed) overflow_to_value_error();
    return parsed;
}

PyObject *overflow_to_value_error(void) {
    if (PyErr_ExceptionMatches(PyExc_OverflowError)) {
        PyErr_Clear();
        PyErr_SetString(PyExc_ValueError, "a number is out of range");
    }
    return NULL;
}
