/* SPDX-License-Identifier: Apache-2.0 */
/* Arrays as arguments of the module's entry points. */
#ifndef ARGUMENTS_H
#define ARGUMENTS_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

/* Borders of cache lines, in bytes: the memory of plans and workers begins there. */
#define CACHE_LINE 64
#define TO_CACHE_LINE(address) ((address) + (CACHE_LINE - (uintptr_t)(address) % CACHE_LINE) % CACHE_LINE)

typedef enum { INT32, FLOAT32, FLOAT64, BOOL, BYTES } ItemType;

/* What an entry point expects of an array; `output`: it is written to. */
typedef struct {
    const char *name;
    ItemType type;
    int output;
} ArrayArgument;

/* Get the buffers of n objects into `views`.

   Each must be a C-contiguous buffer of aligned items of its type, writable if it is an output. Their lengths
   are left to the caller. Outputs must not overlap other arrays: what is computed is unspecified if they do, but
   no memory beyond the arrays is touched, since sizes and indices are never read from an output.

   Returns 1, or 0 with an exception set (TypeError, MemoryError, or what the object's own buffer
   method raised) and no buffer held. */
int get_arrays(int n, const ArrayArgument *arguments, PyObject *const *objects, Py_buffer *views);

void release_arrays(int n, Py_buffer *views);

/* Return the number of items of an array. */
Py_ssize_t count_items(const Py_buffer *view);

/* PyArg_ParseTuple, except that a number out of the range of its C type raises ValueError. */
int parse_arguments(PyObject *args, const char *format, ...);

/* Replace an OverflowError that is set by a ValueError with its message; return NULL. */
PyObject *overflow_to_value_error(void);

#endif
