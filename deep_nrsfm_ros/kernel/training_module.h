/* SPDX-License-Identifier: Apache-2.0 */
/* Entry points of training, for the method table of the module `_kernel`. */
#ifndef TRAINING_MODULE_H
#define TRAINING_MODULE_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

PyObject *training_worker_pool(PyObject *module, PyObject *args);
PyObject *training_activations(PyObject *module, PyObject *pool);
PyObject *training_forward(PyObject *module, PyObject *args);
PyObject *training_backward(PyObject *module, PyObject *args);

#define TRAINING_METHODS                                              \
    {"worker_pool", training_worker_pool, METH_VARARGS, NULL},        \
    {"activations_per_frame", training_activations, METH_O, NULL},    \
    {"network_forward", training_forward, METH_VARARGS, NULL},        \
    {"network_backward", training_backward, METH_VARARGS, NULL}

#endif
