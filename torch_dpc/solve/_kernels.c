/* The small systems of one sample after the other, without the dispatch of an array library.
 *
 *     solve_boxes   lam with  v = v0 - G lam,  v - Proj(v + lam) = 0,  the projection on a box
 *     solve_sets    the same for priced intervals, balls and cones
 *     solve_held    W (W'G W + diag curvature)^-1 W' rhs, W the directions that the sets hold at a solution
 *     plan          the whole of a small call: v0 = V theta, lam, v, and the residual
 *     plan_adjoint  and of its backward: V'(v_bar + S (lam_bar - G v_bar)), S as in solve_held
 *     judge_sets    what the sets say of multipliers: v, its distance from them, weak and active rows
 *     solve_active  s_A = G_AA^-1 rhs_A, zero elsewhere
 *     adjoint       v_bar + s,  s_A = G_AA^-1 (lam_bar - G v_bar)_A
 *
 * G is symmetric, one for all samples or one for each. kernels.py describes the arguments, and what becomes of samples
 * that did not succeed. newton.py and active_set.py hold the same mathematics for other devices.
 *
 *     _vector.h     vectors, and products with rows of G
 *     _system.h     one symmetric system
 *     _settings.h   tolerances and limits
 *     _sets.h       intervals, balls and cones
 *     _held.h       the system on the directions that they hold
 *     _intervals.h  the solve of one sample for intervals
 *     _newton.h     and for all sets
 *     _solution.h   and what the sets say of it
 *     _batch.h      batches and threads
 *     here          arguments
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include "_batch.h"

/* --- arguments ---------------------------------------------------------------------------------------------------- */

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

/* Take the tuple (G, V, per_theta, moved, unit, error_of_theta, error_of_lam) and vectors `(count, n)` that say what n
 * is, which is above 0. */
static int take_map(Buffers *b, PyObject *object, int64_t count, int64_t n, Batch *batch) {
    Map *map = &batch->map;
    if (!PyTuple_Check(object) || PyTuple_GET_SIZE(object) != 7) return misfit("map");
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

/* --- entry points ------------------------------------------------------------------------------------------------- */

/* Run without the interpreter's lock, and release the arrays. `is_ready` is 0 if an exception is set. */
static PyObject *finish(Buffers *held, int is_ready, const Batch *batch, Work *work, int64_t threads) {
    if (is_ready) {
        Py_BEGIN_ALLOW_THREADS;
        run(batch, work, threads);
        Py_END_ALLOW_THREADS;
    }
    release(held);
    if (!is_ready) return NULL;
    Py_RETURN_NONE;
}

static PyObject *solve_boxes(PyObject *self, PyObject *const *args, Py_ssize_t count) {
    (void)self;
    Buffers held = {.count = 0};
    Batch b = {0};
    int64_t threads = 1;
    void *iterations = NULL;
    if (!has_arguments(count, 9)) return NULL;
    const int is_ready = take_problem(&held, args[0], args[1], "v0", &b, &b.v0) &&
                         take_rows(&held, args[2], "lower", &b, 1, b.n, &b.sets.lower) &&
                         take_rows(&held, args[3], "upper", &b, 1, b.n, &b.sets.upper) &&
                         (b.sets.lower.stride == b.sets.upper.stride || misfit("upper")) &&
                         take_result(&held, args[4], "lam", &b) &&
                         take_counts(&held, args[5], "iterations", 'q', &b, &iterations) &&
                         take_succeeded(&held, args[6], "converged", &b) && take_options(args + 7, &b, &threads);
    b.iterations = iterations;
    return finish(&held, is_ready, &b, solve_work, threads);
}

static PyObject *solve_sets(PyObject *self, PyObject *const *args, Py_ssize_t count) {
    (void)self;
    Buffers held = {.count = 0};
    Batch b = {0};
    int64_t threads = 1;
    void *iterations = NULL;
    if (!has_arguments(count, 8)) return NULL;
    const int is_ready = take_problem(&held, args[0], args[1], "v0", &b, &b.v0) && take_sets(&held, args[2], &b) &&
                         take_result(&held, args[3], "lam", &b) &&
                         take_counts(&held, args[4], "iterations", 'q', &b, &iterations) &&
                         take_succeeded(&held, args[5], "converged", &b) && take_options(args + 6, &b, &threads);
    b.iterations = iterations;
    return finish(&held, is_ready, &b, solve_work, threads);
}

static PyObject *solve_held_directions(PyObject *self, PyObject *const *args, Py_ssize_t count) {
    (void)self;
    Buffers held = {.count = 0};
    Batch b = {0};
    int64_t threads = 1;
    if (!has_arguments(count, 10)) return NULL;
    const int is_ready =
        take_problem(&held, args[0], args[5], "rhs", &b, &b.rhs) && take_sets(&held, args[1], &b) &&
        take_rows(&held, args[2], "v", &b, 0, b.n, &b.v) && take_rows(&held, args[3], "lam", &b, 0, b.n, &b.lam) &&
        take_flags(&held, args[4], "weak", &b, &b.weak) && take_result(&held, args[6], "out", &b) &&
        take_succeeded(&held, args[7], "trusted", &b) && take_options(args + 8, &b, &threads);
    return finish(&held, is_ready, &b, solve_held_work, threads);
}

static PyObject *judge_sets(PyObject *self, PyObject *const *args, Py_ssize_t count) {
    (void)self;
    Buffers held = {.count = 0};
    Batch b = {0};
    int64_t threads = 1;
    void *missed = NULL, *is_weak = NULL, *is_active = NULL, *counts = NULL;
    if (!has_arguments(count, 12)) return NULL;
    const int is_ready =
        take_problem(&held, args[0], args[2], "raw", &b, &b.raw) && take_sets(&held, args[1], &b) &&
        take_rows(&held, args[3], "lam", &b, 0, b.n, &b.lam) && take_result(&held, args[4], "v", &b) &&
        take_table(&held, args[5], "missed", 'd', &b, b.n, &missed) &&
        take_table(&held, args[6], "weak", '?', &b, b.n, &is_weak) &&
        take_table(&held, args[7], "active", '?', &b, b.n, &is_active) &&
        take_table(&held, args[8], "counts", 'q', &b, 2, &counts) && take_succeeded(&held, args[9], "done", &b) &&
        take_options(args + 10, &b, &threads);
    b.missed = missed, b.is_weak = is_weak, b.is_active = is_active, b.counts = counts;
    return finish(&held, is_ready, &b, judge_work, threads);
}

/* Take vectors `(count, width)` that are read first, and say what count and width are. */
static const Py_buffer *take_first(Buffers *b, PyObject *object, const char *name) {
    const Py_buffer *view = take(b, object, name, 'd', 0);
    if (view && view->ndim != 2) return misfit(name), NULL;
    return view;
}

static PyObject *plan(PyObject *self, PyObject *const *args, Py_ssize_t count) {
    (void)self;
    Buffers held = {.count = 0};
    Batch b = {0};
    int64_t threads = 1;
    void *lam = NULL, *is_active = NULL, *is_weak = NULL, *info = NULL;
    if (!has_arguments(count, 12)) return NULL;
    const Py_buffer *theta = take_first(&held, args[2], "theta"), *v = NULL;
    int is_ready = theta && (v = take(&held, args[4], "v", 'd', PyBUF_WRITABLE)) != NULL;
    if (is_ready) is_ready = (v->ndim == 2 && v->shape[0] == theta->shape[0]) || misfit("v");
    is_ready = is_ready && take_map(&held, args[0], v->shape[0], v->shape[1], &b) && take_sets(&held, args[1], &b) &&
               (theta->shape[1] == b.map.n_theta || misfit("theta")) &&
               (args[3] == Py_None || take_rows(&held, args[3], "v0", &b, 0, b.n, &b.v0)) &&
               take_table(&held, args[5], "lam", 'd', &b, b.n, &lam) &&
               take_table(&held, args[6], "active", '?', &b, b.n, &is_active) &&
               take_table(&held, args[7], "weak", '?', &b, b.n, &is_weak) &&
               take_table(&held, args[8], "info", 'd', &b, INFO, &info) &&
               take_succeeded(&held, args[9], "convinces", &b) && take_options(args + 10, &b, &threads);
    if (is_ready) b.theta = (Numbers){theta->buf, b.map.n_theta}, b.result = v->buf;
    b.result_lam = lam, b.is_active = is_active, b.is_weak = is_weak, b.info = info;
    return finish(&held, is_ready, &b, plan_work, threads);
}

static PyObject *plan_adjoint(PyObject *self, PyObject *const *args, Py_ssize_t count) {
    (void)self;
    Buffers held = {.count = 0};
    Batch b = {0};
    int64_t threads = 1;
    void *theta_bar = NULL;
    if (!has_arguments(count, 13)) return NULL;
    const Py_buffer *v_bar = take_first(&held, args[6], "v_bar");
    const int is_ready =
        v_bar && take_map(&held, args[0], v_bar->shape[0], v_bar->shape[1], &b) && take_sets(&held, args[1], &b) &&
        take_rows(&held, args[2], "v", &b, 0, b.n, &b.v) && take_rows(&held, args[3], "lam", &b, 0, b.n, &b.lam) &&
        take_flags(&held, args[4], "active", &b, &b.active) && take_flags(&held, args[5], "weak", &b, &b.weak) &&
        (args[7] == Py_None || take_rows(&held, args[7], "lam_bar", &b, 0, b.n, &b.lam_bar)) &&
        take_result(&held, args[8], "v0_bar", &b) &&
        (args[9] == Py_None || take_table(&held, args[9], "theta_bar", 'd', &b, b.map.n_theta, &theta_bar)) &&
        take_succeeded(&held, args[10], "trusted", &b) && take_options(args + 11, &b, &threads);
    if (is_ready) b.v_bar = (Numbers){v_bar->buf, b.n}, b.theta_bar = theta_bar;
    return finish(&held, is_ready, &b, plan_adjoint_work, threads);
}

static PyObject *solve_active(PyObject *self, PyObject *const *args, Py_ssize_t count) {
    (void)self;
    Buffers held = {.count = 0};
    Batch b = {0};
    int64_t threads = 1;
    if (!has_arguments(count, 7)) return NULL;
    const int is_ready = take_problem(&held, args[0], args[2], "rhs", &b, &b.rhs) &&
                         take_flags(&held, args[1], "active", &b, &b.active) && take_result(&held, args[3], "out", &b) &&
                         take_succeeded(&held, args[4], "trusted", &b) && take_options(args + 5, &b, &threads);
    return finish(&held, is_ready, &b, solve_active_work, threads);
}

static PyObject *adjoint(PyObject *self, PyObject *const *args, Py_ssize_t count) {
    (void)self;
    Buffers held = {.count = 0};
    Batch b = {0};
    int64_t threads = 1;
    if (!has_arguments(count, 8)) return NULL;
    const int is_ready = take_problem(&held, args[0], args[2], "v_bar", &b, &b.v_bar) &&
                         take_flags(&held, args[1], "active", &b, &b.active) &&
                         (args[3] == Py_None || take_rows(&held, args[3], "lam_bar", &b, 0, b.n, &b.lam_bar)) &&
                         take_result(&held, args[4], "out", &b) && take_succeeded(&held, args[5], "trusted", &b) &&
                         take_options(args + 6, &b, &threads);
    return finish(&held, is_ready, &b, adjoint_work, threads);
}

/* --- the module --------------------------------------------------------------------------------------------------- */

#define FUNCTION(name) ((PyCFunction)(void (*)(void))(name))

static PyMethodDef methods[] = {
    {"settings", FUNCTION(settings), METH_VARARGS | METH_KEYWORDS, "settings(**settings)"},
    {"solve_boxes", FUNCTION(solve_boxes), METH_FASTCALL,
     "solve_boxes(G, v0, lower, upper, lam, iterations, converged, settings, threads)"},
    {"solve_sets", FUNCTION(solve_sets), METH_FASTCALL,
     "solve_sets(G, v0, sets, lam, iterations, converged, settings, threads)"},
    {"solve_held", FUNCTION(solve_held_directions), METH_FASTCALL,
     "solve_held(G, sets, v, lam, weak, rhs, out, trusted, settings, threads)"},
    {"judge_sets", FUNCTION(judge_sets), METH_FASTCALL,
     "judge_sets(G, sets, raw, lam, v, missed, weak, active, counts, done, settings, threads)"},
    {"plan", FUNCTION(plan), METH_FASTCALL,
     "plan(map, sets, theta, v0, v, lam, active, weak, info, convinces, settings, threads)"},
    {"plan_adjoint", FUNCTION(plan_adjoint), METH_FASTCALL,
     "plan_adjoint(map, sets, v, lam, active, weak, v_bar, lam_bar, v0_bar, theta_bar, trusted, settings, threads)"},
    {"solve_active", FUNCTION(solve_active), METH_FASTCALL,
     "solve_active(G, active, rhs, out, trusted, settings, threads)"},
    {"adjoint", FUNCTION(adjoint), METH_FASTCALL,
     "adjoint(G, active, v_bar, lam_bar, out, trusted, settings, threads)"},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {
    .m_base = PyModuleDef_HEAD_INIT,
    .m_name = "_kernels",
    .m_doc = "Small systems on the active rows, one sample after the other.",
    .m_size = -1,
    .m_methods = methods,
};

PyMODINIT_FUNC PyInit__kernels(void);

PyMODINIT_FUNC PyInit__kernels(void) {
    choose_instructions();
    PyObject *made = PyModule_Create(&module);
    if (made && PyModule_AddStringConstant(made, "instructions", instructions) < 0) Py_CLEAR(made);
    return made;
}
