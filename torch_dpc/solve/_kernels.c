/* The small systems of one sample after the other, without the dispatch of an array library.
 *
 *     solve_boxes   lam with  v = v0 - G lam,  v - Proj(v + lam) = 0,  the projection on a box
 *     solve_sets    the same for priced intervals, balls and cones
 *     solve_held    W (W'G W + diag curvature)^-1 W' rhs, W the directions that the sets hold at a solution
 *     plan          the whole of a small call: v0 = V theta, lam, v, and the residual
 *     plan_adjoint  and of its backward: V'(v_bar + S (lam_bar - G v_bar)), S as in solve_held
 *     plan_one, adjoint_one   both for one sample, from the addresses of its windows
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
 *     _primal_dual.h, _goldfarb_idnani.h, _intervals.h    the solve of one sample for intervals
 *     _newton.h     and for all sets
 *     _solution.h   and what the sets say of it
 *     _batch.h      a sample of a batch
 *     _threads.h    all of them
 *     _arguments.h  Python's arguments
 *     _windows.h    the windows of one sample
 */
#include "_windows.h"

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
    {"plan_one", FUNCTION(plan_one), METH_FASTCALL,
     "plan_one(map, sets, windows, theta, v, lam, active, weak, info, settings, threads)"},
    {"adjoint_one", FUNCTION(adjoint_one), METH_FASTCALL,
     "adjoint_one(map, sets, v, lam, active, weak, windows, bars, theta_bar, settings, threads)"},
    {"holds", FUNCTION(holds), METH_FASTCALL, "holds(address, numbers)"},
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
