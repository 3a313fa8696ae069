/* Entry points of training, for the method table of the module `_kernel`. */
#ifndef TRAINING_MODULE_H
#define TRAINING_MODULE_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

PyObject *workers(PyObject *module, PyObject *args);
PyObject *gradient(PyObject *module, PyObject *args);

#define TRAINING_METHODS \
    {"workers", workers, METH_VARARGS, NULL}, {"gradient", gradient, METH_VARARGS, NULL}

#endif
