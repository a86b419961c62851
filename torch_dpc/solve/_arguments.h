/* Python's arguments: arrays, sets, the reduced problem and settings, taken with their shapes checked.
 *
 * Every function returns 0, or NULL or -1 as it says, with an exception set if an argument does not fit.
 */
#ifndef TORCH_DPC_ARGUMENTS_H
#define TORCH_DPC_ARGUMENTS_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include "_threads.h"

enum { MAX_BUFFERS = 24 };

typedef struct {
    Py_buffer views[MAX_BUFFERS];
    int count;
} Buffers;

static void release(Buffers *b) {
    while (b->count) PyBuffer_Release(&b->views[--b->count]);
}

static int misfit(const char *name) {
    PyErr_Format(PyExc_ValueError, "`%s` does not fit the other arguments.", name);
    return 0;
}

/* Take a contiguous array of type 'd' (float64), 'q' (int64) or '?' (bool); NULL with an exception if it is not one. */
static Py_buffer *take(Buffers *b, PyObject *object, const char *name, char type, int flags) {
    Py_buffer *view = &b->views[b->count];
    if (PyObject_GetBuffer(object, view, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | flags) < 0) return NULL;
    b->count++;
    const char *format = view->format ? view->format : "B";
    const int is_int64 = type == 'q' && view->itemsize == 8 && (*format == 'q' || *format == 'l');
    if (format[1] == 0 && (*format == type || is_int64)) return view;
    PyErr_Format(PyExc_ValueError, "`%s` must have items of type '%c', got '%s'.", name, type, format);
    return NULL;
}

/* Take G, `(n, n)` or `(count, n, n)`, and vectors `(count, n)`, which say what count and n are. */
static int take_problem(Buffers *b, PyObject *G, PyObject *vectors, const char *name, Batch *batch, Numbers *numbers) {
    const Py_buffer *v = take(b, vectors, name, 'd', 0);
    if (!v) return 0;
    if (v->ndim != 2) return misfit(name);
    batch->count = v->shape[0], batch->n = v->shape[1];
    *numbers = (Numbers){v->buf, batch->n};
    const Py_buffer *matrix = take(b, G, "G", 'd', 0);
    if (!matrix) return 0;
    if (matrix->ndim != 2 && matrix->ndim != 3) return misfit("G");
    const int is_shared = matrix->ndim == 2;
    const Py_ssize_t *shape = matrix->shape + !is_shared;
    if (shape[0] != batch->n || shape[1] != batch->n) return misfit("G");
    if (!is_shared && matrix->shape[0] != batch->count) return misfit("G");
    batch->G = (Numbers){matrix->buf, is_shared ? 0 : batch->n * batch->n};
    return 1;
}

/* Take numbers `(count, size)`, or `(size,)` for all samples if `may_be_shared`. */
static int take_rows(
    Buffers *b, PyObject *object, const char *name, const Batch *batch, int may_be_shared, int64_t size,
    Numbers *numbers) {
    const Py_buffer *view = take(b, object, name, 'd', 0);
    if (!view) return 0;
    const int is_shared = may_be_shared && view->ndim == 1;
    if (!is_shared && (view->ndim != 2 || view->shape[0] != batch->count)) return misfit(name);
    if (view->shape[view->ndim - 1] != size) return misfit(name);
    *numbers = (Numbers){view->buf, is_shared ? 0 : size};
    return 1;
}

/* Take an array to write to, `(count, width)`. */
static int take_table(
    Buffers *b, PyObject *object, const char *name, char type, const Batch *batch, int64_t width, void **table) {
    const Py_buffer *view = take(b, object, name, type, PyBUF_WRITABLE);
    if (!view) return 0;
    if (view->ndim != 2 || view->shape[0] != batch->count || view->shape[1] != width) return misfit(name);
    *table = view->buf;
    return 1;
}

static int take_result(Buffers *b, PyObject *object, const char *name, Batch *batch) {
    void *table;
    if (!take_table(b, object, name, 'd', batch, batch->n, &table)) return 0;
    batch->result = table;
    return 1;
}

/* Take an array to write to, one item of the type for each sample. */
static int take_counts(Buffers *b, PyObject *object, const char *name, char type, const Batch *batch, void **counts) {
    const Py_buffer *view = take(b, object, name, type, PyBUF_WRITABLE);
    if (!view) return 0;
    if (view->ndim != 1 || view->shape[0] != batch->count) return misfit(name);
    *counts = view->buf;
    return 1;
}

static int take_succeeded(Buffers *b, PyObject *object, const char *name, Batch *batch) {
    void *counts;
    if (!take_counts(b, object, name, '?', batch, &counts)) return 0;
    batch->succeeded = counts;
    return 1;
}

/* Take flags `(count, n)`. */
static int take_flags(Buffers *b, PyObject *object, const char *name, const Batch *batch, const unsigned char **flags) {
    const Py_buffer *view = take(b, object, name, '?', 0);
    if (!view) return 0;
    if (view->ndim != 2 || view->shape[0] != batch->count || view->shape[1] != batch->n) return misfit(name);
    *flags = view->buf;
    return 1;
}

/* Take int64 numbers `(size,)`; any size is right if it is negative. Return the size, or -1 with an exception. */
static int64_t take_integers(Buffers *b, PyObject *object, const char *name, int64_t size, const int64_t **integers) {
    const Py_buffer *view = take(b, object, name, 'q', 0);
    if (!view) return -1;
    if (view->ndim != 1 || (size >= 0 && view->shape[0] != size)) return misfit(name) - 1;
    *integers = view->buf;
    return view->shape[0];
}

/* Whether the blocks are disjoint sets of rows, none of them empty. */
static int are_blocks(const BatchSets *sets, int64_t count, int64_t n) {
    if (sets->start[0] != 0 || sets->start[sets->blocks] != count || count > n) return 0;
    for (int64_t b = 0; b < sets->blocks; b++) {
        if (sets->kind[b] != BALL && sets->kind[b] != CONE) return 0;
        if (sets->start[b] >= sets->start[b + 1]) return 0;
    }
    unsigned char *taken = calloc((size_t)n + 1, 1);
    int are_disjoint = taken != NULL;
    for (int64_t j = 0; are_disjoint && j < count; j++) {
        const int64_t row = sets->rows[j];
        are_disjoint = row >= 0 && row < n && !taken[row];
        if (are_disjoint) taken[row] = 1;
    }
    free(taken);
    return are_disjoint;
}

/* Whether the intervals of the rows of blocks are everything. */
static int are_unbounded(const Batch *b, int64_t count) {
    const BatchSets *sets = &b->sets;
    const int is_shared = sets->lower.stride == 0 && sets->upper.stride == 0;
    for (int64_t i = 0; i < (is_shared && b->count > 1 ? 1 : b->count); i++) {
        const double *lower = of_sample(&sets->lower, i), *upper = of_sample(&sets->upper, i);
        for (int64_t j = 0; j < count; j++)
            if (lower[sets->rows[j]] != -INFINITY || upper[sets->rows[j]] != INFINITY) return 0;
    }
    return 1;
}

/* Take the tuple (lower, upper, price, kind, start, rows, center, radius); price may be None. */
static int take_sets(Buffers *b, PyObject *object, Batch *batch) {
    BatchSets *sets = &batch->sets;
    if (!PyTuple_Check(object) || PyTuple_GET_SIZE(object) != 8) return misfit("sets");
    PyObject *const *parts = PySequence_Fast_ITEMS(object);
    if (!take_rows(b, parts[0], "lower", batch, 1, batch->n, &sets->lower)) return 0;
    if (!take_rows(b, parts[1], "upper", batch, 1, batch->n, &sets->upper)) return 0;
    if (parts[2] != Py_None && !take_rows(b, parts[2], "price", batch, 1, batch->n, &sets->price)) return 0;
    if ((sets->blocks = take_integers(b, parts[3], "kind", -1, &sets->kind)) < 0) return 0;
    if (take_integers(b, parts[4], "start", sets->blocks + 1, &sets->start) < 0) return 0;
    const int64_t count = take_integers(b, parts[5], "rows", -1, &sets->rows);
    if (count < 0) return 0;
    if (!take_rows(b, parts[6], "center", batch, 1, count, &sets->center)) return 0;
    if (!take_rows(b, parts[7], "radius", batch, 1, sets->blocks, &sets->radius)) return 0;
    if (!are_blocks(sets, count, batch->n)) return misfit("rows");
    return are_unbounded(batch, count) || misfit("lower");
}

/* Take an array `(rows, columns)`, or `(columns,)` if rows is 0. */
static int take_constant(
    Buffers *b, PyObject *object, const char *name, int64_t rows, int64_t columns, const double **data) {
    const Py_buffer *view = take(b, object, name, 'd', 0);
    if (!view) return 0;
    if (view->ndim != 1 + (rows > 0) || view->shape[view->ndim - 1] != columns) return misfit(name);
    if (rows > 0 && view->shape[0] != rows) return misfit(name);
    *data = view->buf;
    return 1;
}

/* Take the tuple (G, V, per_theta, moved, unit, error_of_theta, error_of_lam, rounding) and vectors `(count, n)` that say
 * what n is, which is above 0. */
static int take_map(Buffers *b, PyObject *object, int64_t count, int64_t n, Batch *batch) {
    Map *map = &batch->map;
    if (!PyTuple_Check(object) || PyTuple_GET_SIZE(object) != 8) return misfit("map");
    PyObject *const *parts = PySequence_Fast_ITEMS(object);
    batch->count = count, batch->n = n;
    const double *G;
    const Py_buffer *V = take(b, parts[1], "V", 'd', 0);
    if (!V) return 0;
    if (V->ndim != 2 || V->shape[0] != n || n < 1) return misfit("V");
    map->V = V->buf, map->n_theta = V->shape[1];
    if (!take_constant(b, parts[0], "G", n, n, &G)) return 0;
    batch->G = (Numbers){G, 0};
    if (!take_constant(b, parts[2], "per_theta", 0, map->n_theta, &map->per_theta)) return 0;
    if (!take_constant(b, parts[3], "moved", 0, n, &map->moved)) return 0;
    if (!take_constant(b, parts[4], "unit", 0, n, &map->unit)) return 0;
    map->error_of_theta = PyFloat_AsDouble(parts[5]), map->error_of_lam = PyFloat_AsDouble(parts[6]);
    map->rounding = PyFloat_AsDouble(parts[7]);
    return !PyErr_Occurred();
}

static int has_arguments(Py_ssize_t got, Py_ssize_t expected) {
    if (got == expected) return 1;
    PyErr_Format(PyExc_TypeError, "expected %zd arguments, got %zd.", expected, got);
    return 0;
}

/* --- settings ----------------------------------------------------------------------------------------------------- */

static const char SETTINGS[] = "torch_dpc.solve._kernels.Settings";

static void free_settings(PyObject *capsule) { free(PyCapsule_GetPointer(capsule, SETTINGS)); }

static PyObject *settings(PyObject *self, PyObject *args, PyObject *keywords) {
    (void)self;
    static char *names[] = {"hysteresis", "independence", "touching", "primal_dual_steps", "converged", "good", "close",
                            "newton_steps", "halvings", "rounds", "patience", "inner_steps", "bisections", "growth",
                            "largest_penalty", "weakness", "convincing", NULL};
    double independence;
    Settings s;
    _Static_assert(sizeof(long long) == sizeof s.rounds, "the format L reads an int64_t");
    if (!PyArg_ParseTupleAndKeywords(
            args, keywords, "$dddLdddLLLLLLdddd", names, &s.hysteresis, &independence, &s.touching, &s.primal_dual_steps,
            &s.converged, &s.good, &s.close, &s.newton_steps, &s.halvings, &s.rounds, &s.patience, &s.inner_steps,
            &s.bisections, &s.growth, &s.largest_penalty, &s.weakness, &s.convincing))
        return NULL;
    s.least_pivot = independence * independence;
    Settings *made = malloc(sizeof *made);
    if (!made) return PyErr_NoMemory();
    *made = s;
    PyObject *capsule = PyCapsule_New(made, SETTINGS, free_settings);
    if (!capsule) free(made);
    return capsule;
}

/* Read the last two arguments of every entry point. */
static int take_options(PyObject *const *args, Batch *batch, int64_t *threads) {
    batch->settings = PyCapsule_GetPointer(args[0], SETTINGS);
    if (!batch->settings) return 0;
    *threads = PyLong_AsLongLong(args[1]);
    return !PyErr_Occurred();
}

#endif
