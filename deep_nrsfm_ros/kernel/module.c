/* SPDX-License-Identifier: Apache-2.0 */
/* The module `_kernel`: its entry points of lifting, decoding and tracking, which hand Python's arrays to C.

   No argument is trusted: types, lengths, sizes and indices are checked here and in plan_layout.c, and whatever
   is wrong raises TypeError, ValueError or RuntimeError. Functions of the other files assume what is checked. */
#include "arguments.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "joints.h"
#include "point_cloud.h"
#include "plan.h"
#include "steady_depth.h"
#include "tracking.h"
#include "training_module.h"

static const char PLAN[] = "deep_nrsfm_ros.kernel._kernel.plan";

static void plan_free(Plan *k) {
    if (k) PyMem_Free(k->constants), PyMem_Free(k->scratch);
    PyMem_Free(k);
}

static void plan_destructor(PyObject *capsule) { plan_free(PyCapsule_GetPointer(capsule, PLAN)); }

/* Copy the arrays of a plan into its own memory, and lay it out; return what is wrong with them, NULL if nothing. */
static const char *plan_fill(Plan *k, const Py_buffer *arrays) {
    size_t begin[4] = {0}, needed;
    for (int i = 0; i < 3; i++)
        if (__builtin_add_overflow(begin[i], TO_CACHE_LINE((size_t)arrays[i].len), &begin[i + 1]))
            return "the arrays are too large";
    k->constants = PyMem_Calloc(begin[3] + CACHE_LINE, 1);
    if (!k->constants) return "there is no memory for the plan";
    char *memory = (char *)TO_CACHE_LINE((uintptr_t)k->constants);
    for (int i = 0; i < 3; i++)
        if (arrays[i].len) memcpy(memory + begin[i], arrays[i].buf, arrays[i].len);
    const int *header = (const int *)memory;
    const char *problem = check_header(header, count_items(arrays));
    if (problem) return problem;
    problem = lay_out(k, header, (float *)(memory + begin[1]), (double *)(memory + begin[2]),
                      count_items(arrays + 1), count_items(arrays + 2));
    if (problem) return problem;
    if (!lay_out_scratch(k, NULL, &needed) || __builtin_add_overflow(needed, CACHE_LINE, &needed))
        return "the plan is too large";
    k->scratch = PyMem_Calloc(needed, 1);
    if (!k->scratch) return "there is no memory for the plan";
    lay_out_scratch(k, (char *)TO_CACHE_LINE((uintptr_t)k->scratch), &needed);
    return NULL;
}

/* plan(header int32, floats float32, doubles float64) -> capsule; CompiledBackend lays them out. */
static PyObject *plan(PyObject *Py_UNUSED(module), PyObject *args) {
    static const ArrayArgument expected[3] = {{"header", INT32, 0}, {"floats", FLOAT32, 0}, {"doubles", FLOAT64, 0}};
    PyObject *objects[3];
    Py_buffer arrays[3];
    if (!parse_arguments(args, "OOO:plan", &objects[0], &objects[1], &objects[2])) return NULL;
    if (!get_arrays(3, expected, objects, arrays)) return NULL;
    Plan *k = PyMem_Calloc(1, sizeof(Plan));
    const char *problem = k ? plan_fill(k, arrays) : "there is no memory for the plan";
    release_arrays(3, arrays);
    PyObject *capsule = NULL;
    if (problem)
        PyErr_Format(PyExc_ValueError, "the arrays are not those of a plan: %s", problem);
    else
        capsule = PyCapsule_New(k, PLAN, plan_destructor);
    if (!capsule) plan_free(k);
    return capsule;
}

/* Return whether each array has n x sizes[i] items. */
static int lengths_match(int count, const Py_buffer *arrays, const Py_ssize_t *sizes, Py_ssize_t n) {
    for (int i = 0; i < count; i++) {
        Py_ssize_t items;
        if (__builtin_mul_overflow(n, sizes[i], &items) || count_items(arrays + i) != items) return 0;
    }
    return 1;
}

/* Get the buffers of a context of n objects: Context of lifting/history.py. `views` holds those that are there, of
   its states, rows, up and to_view. Returns 1, or 0 with an exception set and no buffer held. */
static int get_context(const Plan *k, Py_ssize_t n, PyObject *tuple, Context *context, Py_buffer views[4]) {
    static const ArrayArgument expected[4] = {
        {"states", FLOAT64, 1}, {"rows", INT32, 0}, {"up", FLOAT64, 0}, {"to_view", FLOAT64, 0}};
    PyObject *objects[4];
    int held[4] = {1, 1, 0, 0}, i;
    memset(views, 0, 4 * sizeof(Py_buffer));
    if (!PyTuple_Check(tuple)) {
        PyErr_SetString(PyExc_TypeError, "the context must be a tuple");
        return 0;
    }
    if (!parse_arguments(tuple, "OOdOO:context", &objects[0], &objects[1], &context->time, &objects[2], &objects[3])) return 0;
    for (i = 0; i < 4; i++) {
        held[i] = objects[i] != Py_None || i < 2;
        if (held[i] && !get_arrays(1, expected + i, objects + i, views + i)) break;
    }
    if (i == 4) {
        Py_ssize_t size = state_size(k), states = count_items(views), turned;
        int sound = states % size == 0 && count_items(views + 1) == n && isfinite(context->time);
        sound = sound && (!held[2] || count_items(views + 2) == 3);
        sound = sound && !__builtin_mul_overflow(n, 9, &turned) && (!held[3] || count_items(views + 3) == turned);
        context->states = views[0].buf, context->rows = views[1].buf, context->capacity = states / size;
        context->up = views[2].buf, context->to_view = views[3].buf;
        for (Py_ssize_t row = 0; sound && row < n; row++) sound = context->rows[row] < context->capacity;
        if (sound) return 1;
        PyErr_SetString(PyExc_ValueError, "the context does not fit the plan and the objects");
    }
    for (int held_too = 0; held_too < i; held_too++)
        if (held[held_too]) PyBuffer_Release(views + held_too);
    return 0;
}

/* lift(plan, points, confidence, perspective, context, shapes, rotations, scale, translation, residual, confidence,
   wrong, not_lifted): fill the last eight: the arrays of `lifting.Lifted`, float32 but for wrong (n, p) of bool,
   and not_lifted (n,) of bool. context: None, or a Context of lifting/history.py, whose states are updated.

   The GIL is held: a lift takes less than waiting for the GIL does, and the scratch memory of a plan serves one
   lift at a time. The busy flag also rejects a nested lift with the same plan, which the buffer method of an
   argument could start. */
static PyObject *lift_entry(PyObject *Py_UNUSED(module), PyObject *args) {
    static const ArrayArgument expected[10] = {
        {"points", FLOAT32, 0},    {"confidence", FLOAT32, 0}, {"shapes", FLOAT32, 1},
        {"rotations", FLOAT32, 1}, {"scale", FLOAT32, 1},      {"translation", FLOAT32, 1},
        {"residual", FLOAT32, 1},  {"confidence", FLOAT32, 1}, {"wrong", BOOL, 1},
        {"not_lifted", BOOL, 1}};
    PyObject *capsule, *tuple, *o[10];
    Py_buffer arrays[10], views[4];
    Context context;
    int perspective, lifted = 0;
    if (!parse_arguments(args, "OOOpOOOOOOOOO:lift", &capsule, &o[0], &o[1], &perspective, &tuple, &o[2], &o[3], &o[4],
                         &o[5], &o[6], &o[7], &o[8], &o[9]))
        return NULL;
    Plan *k = PyCapsule_GetPointer(capsule, PLAN);
    if (!k) return NULL;
    if (__atomic_exchange_n(&k->busy, 1, __ATOMIC_ACQUIRE))
        return PyErr_Format(PyExc_RuntimeError, "the plan is in use by another lift");
    if (get_arrays(10, expected, o, arrays)) {
        Py_ssize_t n = count_items(arrays + 9), p = k->p;
        const Py_ssize_t sizes[10] = {2 * p, p, 3 * p, 9, 1, 2, 1, p, p, 1};
        float *outputs[6];
        for (int i = 0; i < 6; i++) outputs[i] = arrays[2 + i].buf;
        int has_context = tuple != Py_None;
        if (!lengths_match(10, arrays, sizes, n))
            PyErr_SetString(PyExc_ValueError, "the arrays do not fit the plan and each other");
        else if (!has_context || get_context(k, n, tuple, &context, views)) {
            lift(k, n, arrays[0].buf, arrays[1].buf, perspective, has_context ? &context : NULL, outputs,
                 arrays[8].buf, arrays[9].buf);
            lifted = 1;
            for (int i = 0; has_context && i < 4; i++)
                if (views[i].obj) PyBuffer_Release(views + i);
        }
        release_arrays(10, arrays);
    }
    __atomic_store_n(&k->busy, 0, __ATOMIC_RELEASE);
    if (!lifted) return NULL;
    Py_RETURN_NONE;
}

/* Set `sum` to the first byte beyond all that is read of n items, each `step` bytes after the one before; n >= 1. */
static int add_steps(Py_ssize_t n, Py_ssize_t step, Py_ssize_t *sum) {
    Py_ssize_t bytes;
    return step >= 0 && !__builtin_mul_overflow(n - 1, step, &bytes) && !__builtin_add_overflow(*sum, bytes, sum);
}

/* decode_keypoints(data, (messages, message_step), (objects, keypoints), (object_step, point_step), (x, y, confidence),
   max_coordinate, min_confidence, points, confidence): fill the last two, (messages objects, keypoints, 2) and without the 2.

   Steps and offsets are in bytes; an offset of confidence below 0: there is none. */
static PyObject *decode_keypoints_entry(PyObject *Py_UNUSED(module), PyObject *args) {
    static const ArrayArgument expected[3] = {{"data", BYTES, 0}, {"points", FLOAT32, 1}, {"confidence", FLOAT32, 1}};
    PyObject *objects[3];
    Py_buffer arrays[3];
    Py_ssize_t messages, message_step, n, q, object_step, point_step, offset[3], count, end = 0;
    float max_coordinate, min_confidence;
    if (!parse_arguments(args, "O(nn)(nn)(nn)(nnn)ffOO:decode_keypoints", &objects[0], &messages, &message_step, &n, &q,
                         &object_step, &point_step, &offset[0], &offset[1], &offset[2], &max_coordinate, &min_confidence,
                         &objects[1], &objects[2]))
        return NULL;
    if (!get_arrays(3, expected, objects, arrays)) return NULL;
    for (int i = 0; i < 3; i++) end = offset[i] > end ? offset[i] : end;
    int sound = messages >= 0 && n >= 0 && q >= 0 && offset[0] >= 0 && offset[1] >= 0;
    sound = sound && !__builtin_mul_overflow(messages, n, &count) && !__builtin_mul_overflow(count, q, &count);
    const Py_ssize_t sizes[2] = {2, 1};
    sound = sound && lengths_match(2, arrays + 1, sizes, count);
    if (sound && count) {
        sound = add_steps(messages, message_step, &end) && add_steps(n, object_step, &end) &&
                add_steps(q, point_step, &end) && !__builtin_add_overflow(end, (Py_ssize_t)sizeof(float), &end) &&
                end <= arrays[0].len;
        CloudLayout layout = {n, q, {offset[0], offset[1], offset[2]}, point_step, object_step};
        for (Py_ssize_t m = 0; sound && m < messages; m++)
            decode_keypoints((const char *)arrays[0].buf + m * message_step, &layout, max_coordinate, min_confidence,
                              (float *)arrays[1].buf + 2 * m * n * q, (float *)arrays[2].buf + m * n * q);
    }
    release_arrays(3, arrays);
    if (!sound) return PyErr_Format(PyExc_ValueError, "the arrays do not fit the data");
    Py_RETURN_NONE;
}

/* Return whether the arrays have the lengths of n detections and m tracks; `arrays` are the constants, points and
   confidence (n), passed, points, age, velocity and size (m). q is the number of keypoints. */
static int tracks_match(const Py_buffer *arrays, Py_ssize_t q, Py_ssize_t *n, Py_ssize_t *m) {
    if (q < 1 || q > MAX_KEYPOINTS) return 0;
    *n = count_items(arrays + 2) / q, *m = count_items(arrays + 3);
    const Py_ssize_t of_detection[2] = {2 * q, q}, of_track[5] = {1, 2 * q, q, 2, 1};
    return count_items(arrays) == TRACKING_CONSTANTS && lengths_match(2, arrays + 1, of_detection, *n) &&
           lengths_match(5, arrays + 3, of_track, *m);
}

static const ArrayArgument TRACK_ARGUMENTS[8] = {{"constants", FLOAT32, 0}, {"points", FLOAT32, 0},  {"confidence", FLOAT32, 0},
                                                 {"passed", FLOAT32, 0},    {"points", FLOAT32, 1},  {"age", FLOAT32, 1},
                                                 {"velocity", FLOAT32, 1},  {"size", FLOAT32, 1}};

/* match_tracks(constants, points, confidence, passed, track_points, age, velocity, size, sigma, score, shift, best): fill
   the last three, (n, m), (n, m, 2) and (n,) of int32. */
static PyObject *match_tracks_entry(PyObject *Py_UNUSED(module), PyObject *args) {
    static const ArrayArgument expected[4] = {{"sigma", FLOAT32, 0}, {"score", FLOAT32, 1}, {"shift", FLOAT32, 1}, {"best", INT32, 1}};
    PyObject *o[12];
    Py_buffer arrays[12];
    Py_ssize_t n, m, q, pairs;
    if (!parse_arguments(args, "OOOOOOOOOOOO:match_tracks", &o[0], &o[1], &o[2], &o[3], &o[4], &o[5], &o[6], &o[7], &o[8],
                         &o[9], &o[10], &o[11]))
        return NULL;
    if (!get_arrays(8, TRACK_ARGUMENTS, o, arrays)) return NULL;
    if (!get_arrays(4, expected, o + 8, arrays + 8)) return release_arrays(8, arrays), NULL;
    q = count_items(arrays + 8);
    const Py_ssize_t sizes[2] = {1, 2};
    int sound = tracks_match(arrays, q, &n, &m) && !__builtin_mul_overflow(n, m, &pairs) &&
                lengths_match(2, arrays + 9, sizes, pairs) && count_items(arrays + 11) == n;
    if (sound) {
        Detections detections = {n, q, arrays[1].buf, arrays[2].buf};
        TrackArrays tracks = {m, arrays[4].buf, arrays[5].buf, arrays[6].buf, arrays[7].buf, arrays[3].buf};
        match_tracks(arrays[0].buf, arrays[8].buf, &detections, &tracks, arrays[9].buf, arrays[10].buf, arrays[11].buf);
    }
    release_arrays(12, arrays);
    if (!sound) return PyErr_Format(PyExc_ValueError, "the arrays do not fit each other");
    Py_RETURN_NONE;
}

/* update_tracks(constants, points, confidence, passed, track_points, age, velocity, size, assigned, shift): change the
   arrays of the tracks; assigned (n,) int32, below 0: none. */
static PyObject *update_tracks_entry(PyObject *Py_UNUSED(module), PyObject *args) {
    static const ArrayArgument expected[2] = {{"assigned", INT32, 0}, {"shift", FLOAT32, 0}};
    PyObject *o[10];
    Py_buffer arrays[10];
    Py_ssize_t n, m, q, pairs;
    if (!parse_arguments(args, "OOOOOOOOOO:update_tracks", &o[0], &o[1], &o[2], &o[3], &o[4], &o[5], &o[6], &o[7], &o[8],
                         &o[9]))
        return NULL;
    if (!get_arrays(8, TRACK_ARGUMENTS, o, arrays)) return NULL;
    if (!get_arrays(2, expected, o + 8, arrays + 8)) return release_arrays(8, arrays), NULL;
    m = count_items(arrays + 3), n = count_items(arrays + 8), q = m ? count_items(arrays + 5) / m : 1;
    const Py_ssize_t sizes[1] = {2};
    Py_ssize_t detections_too;
    int sound = m > 0 && tracks_match(arrays, q, &detections_too, &m) && detections_too == n &&
                !__builtin_mul_overflow(n, m, &pairs) && lengths_match(1, arrays + 9, sizes, pairs);
    const int *assigned = arrays[8].buf;
    for (Py_ssize_t i = 0; sound && i < n; i++) sound = assigned[i] < m;
    if (sound) {
        Detections detections = {n, q, arrays[1].buf, arrays[2].buf};
        TrackArrays tracks = {m, arrays[4].buf, arrays[5].buf, arrays[6].buf, arrays[7].buf, arrays[3].buf};
        update_tracks(arrays[0].buf, &detections, assigned, arrays[9].buf, &tracks);
    }
    release_arrays(10, arrays);
    if (!sound) return PyErr_Format(PyExc_ValueError, "the arrays do not fit each other");
    Py_RETURN_NONE;
}

/* steady_depths(time, constants, states, rows, shapes, rotations): change the last two, (n, p, 3) and (n, 3, 3), and the rows of
   the states (capacity, 1 + 7 p); rows (n,) int32, below 0: none. */
static PyObject *steady_depths_entry(PyObject *Py_UNUSED(module), PyObject *args) {
    static const ArrayArgument expected[5] = {
        {"constants", FLOAT64, 0}, {"states", FLOAT64, 1}, {"rows", INT32, 0}, {"shapes", FLOAT32, 1}, {"rotations", FLOAT32, 1}};
    PyObject *o[5];
    Py_buffer arrays[5];
    double time;
    if (!parse_arguments(args, "dOOOOO:steady_depths", &time, &o[0], &o[1], &o[2], &o[3], &o[4])) return NULL;
    if (!get_arrays(5, expected, o, arrays)) return NULL;
    Py_ssize_t n = count_items(arrays + 2), items = count_items(arrays + 3), nine;
    Py_ssize_t p = n > 0 ? items / n / 3 : 0, of_object[1] = {3 * p};
    int sound = p > 0 && count_items(arrays) == DEPTH_CONSTANTS && lengths_match(1, arrays + 3, of_object, n);
    sound = sound && !__builtin_mul_overflow(n, 9, &nine) && count_items(arrays + 4) == nine;
    Py_ssize_t capacity = sound ? count_items(arrays + 1) / (1 + 7 * p) : 0;
    const int *rows = arrays[2].buf;
    for (Py_ssize_t i = 0; sound && i < n; i++) sound = rows[i] < capacity;
    if (sound) steady_depths(arrays[0].buf, time, n, p, arrays[1].buf, rows, arrays[3].buf, arrays[4].buf);
    release_arrays(5, arrays);
    if (!sound) return PyErr_Format(PyExc_ValueError, "the arrays do not fit each other");
    Py_RETURN_NONE;
}

/* joint_frames(indices, constants, directions, rotations, angles, (n, j)): fill rotations (n, j, 3, 3) of the joints that
   the indices name, and angles (n, a), from the directions (n, m, 3). */
static PyObject *joint_frames_entry(PyObject *Py_UNUSED(module), PyObject *args) {
    static const ArrayArgument expected[5] = {
        {"indices", INT32, 0}, {"constants", FLOAT64, 0}, {"directions", FLOAT64, 0}, {"rotations", FLOAT64, 1}, {"angles", FLOAT64, 1}};
    PyObject *o[5];
    Py_buffer arrays[5];
    Py_ssize_t n, j;
    if (!parse_arguments(args, "OOOOO(nn):joint_frames", &o[0], &o[1], &o[2], &o[3], &o[4], &n, &j)) return NULL;
    if (!get_arrays(5, expected, o, arrays)) return NULL;
    int sound = n > 0 && j > 0 && count_items(arrays) % JOINT_INDICES == 0 && count_items(arrays + 2) % 3 == 0;
    JointTree tree = {0};
    if (sound) {
        Py_ssize_t k = count_items(arrays) / JOINT_INDICES, vectors = count_items(arrays + 2) / 3;
        tree = (JointTree){k, j, vectors / n, count_items(arrays + 4) / n, arrays[0].buf, arrays[1].buf};
        const Py_ssize_t of_tree[1] = {JOINT_CONSTANTS};
        Py_ssize_t of_object[3] = {3 * tree.m, 0, tree.a};
        sound = !__builtin_mul_overflow(9, j, &of_object[1]) && lengths_match(1, arrays + 1, of_tree, k) &&
                lengths_match(3, arrays + 2, of_object, n) && joints_are_sound(&tree);
    }
    if (sound) joint_frames(&tree, n, arrays[2].buf, arrays[3].buf, arrays[4].buf);
    release_arrays(5, arrays);
    if (!sound) return PyErr_Format(PyExc_ValueError, "the arrays do not fit each other");
    Py_RETURN_NONE;
}

/* quaternions(rotations, quaternions): fill the second, (n, 4), from the first, (n, 3, 3). */
static PyObject *quaternions_entry(PyObject *Py_UNUSED(module), PyObject *args) {
    static const ArrayArgument expected[2] = {{"rotations", FLOAT64, 0}, {"quaternions", FLOAT64, 1}};
    static const Py_ssize_t sizes[2] = {9, 4};
    PyObject *o[2];
    Py_buffer arrays[2];
    if (!parse_arguments(args, "OO:quaternions", &o[0], &o[1])) return NULL;
    if (!get_arrays(2, expected, o, arrays)) return NULL;
    Py_ssize_t n = count_items(arrays + 1) / 4;
    int sound = lengths_match(2, arrays, sizes, n);
    if (sound) rotations_to_quaternions(n, arrays[0].buf, arrays[1].buf);
    release_arrays(2, arrays);
    if (!sound) return PyErr_Format(PyExc_ValueError, "the arrays do not fit each other");
    Py_RETURN_NONE;
}

/* choose_vectors(bytes) -> bytes: for tests, which try them all. */
static PyObject *choose(PyObject *Py_UNUSED(module), PyObject *bytes) {
    long requested = PyLong_AsLong(bytes);
    if (requested == -1 && PyErr_Occurred()) return overflow_to_value_error();
    return PyLong_FromLong(choose_vectors(requested < 16 ? 16 : requested < 64 ? (int)requested : 64));
}

/* The module has no state of its own. `vector_bytes` belongs to the process: it says what the processor can do. */
static int module_exec(PyObject *module) {
    choose_vectors(64);
    return PyModule_AddIntMacro(module, FLOATS) || PyModule_AddIntMacro(module, DOUBLES) ||
                   PyModule_AddIntMacro(module, MAX_LAYERS) || PyModule_AddIntMacro(module, MAX_KEYPOINTS) ||
                   PyModule_AddIntMacro(module, MAX_WIDTH)
               ? -1
               : 0;
}

static PyMethodDef methods[] = {{"plan", plan, METH_VARARGS, NULL},
                                {"lift", lift_entry, METH_VARARGS, NULL},
                                TRAINING_METHODS,
                                {"decode_keypoints", decode_keypoints_entry, METH_VARARGS, NULL},
                                {"match_tracks", match_tracks_entry, METH_VARARGS, NULL},
                                {"update_tracks", update_tracks_entry, METH_VARARGS, NULL},
                                {"steady_depths", steady_depths_entry, METH_VARARGS, NULL},
                                {"joint_frames", joint_frames_entry, METH_VARARGS, NULL},
                                {"quaternions", quaternions_entry, METH_VARARGS, NULL},
                                {"choose_vectors", choose, METH_O, NULL},
                                {NULL, NULL, 0, NULL}};
static PyModuleDef_Slot slots[] = {{Py_mod_exec, (void *)module_exec}, {0, NULL}};
static PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_kernel", NULL, 0, methods, slots, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__kernel(void) { return PyModuleDef_Init(&definition); }
