/* The small systems of one sample after the other, without the dispatch of an array library.
 *
 *     solve_boxes   lam with  v = v0 - G lam,  v - Proj(v + lam) = 0,  the projection on a box
 *     solve_active  s_A = G_AA^-1 rhs_A, zero elsewhere
 *     adjoint       v_bar + s,  s_A = G_AA^-1 (lam_bar - G v_bar)_A
 *
 * kernels.py says what the arguments are and what is done with the samples that are flagged; newton.py and
 * active_set.py hold the same mathematics for other devices. G is symmetric, one for all samples or one each.
 *
 * _system.h: one system; _boxes.h: the solve of one sample; _batch.h: batches and threads; here: the arguments.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include "_batch.h"

enum { MOST_BUFFERS = 7 };

typedef struct {
    Py_buffer views[MOST_BUFFERS];
    int held;
} Buffers;

static void release(Buffers *b) {
    while (b->held) PyBuffer_Release(&b->views[--b->held]);
}

/* Take a contiguous array of the kind ('d' float64, 'q' int64, '?' bool); NULL with an exception where it is not one. */
static Py_buffer *take(Buffers *b, PyObject *object, const char *name, char kind, int writable) {
    Py_buffer *view = &b->views[b->held];
    if (PyObject_GetBuffer(object, view, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | (writable ? PyBUF_WRITABLE : 0)) < 0) return NULL;
    b->held++;
    const char *format = view->format;
    const int is_int64 = kind == 'q' && view->itemsize == 8 && (*format == 'q' || *format == 'l');
    if (format[1] == 0 && (*format == kind || is_int64)) return view;
    PyErr_Format(PyExc_ValueError, "`%s` must have items of type '%c', got '%s'.", name, kind, view->format);
    return NULL;
}

static int refuse(const char *name) {
    PyErr_Format(PyExc_ValueError, "`%s` does not fit the other arguments.", name);
    return 0;
}

/* Whether an array is (count, n). */
static int fits(const Py_buffer *view, const char *name, int64_t count, int64_t n) {
    return (view->ndim == 2 && view->shape[0] == count && view->shape[1] == n) || refuse(name);
}

static int fits_flat(const Py_buffer *view, const char *name, int64_t count) {
    return (view->ndim == 1 && view->shape[0] == count) || refuse(name);
}

/* Read count and n off the vectors, and G, `(n, n)` or `(count, n, n)`. */
static int take_matrix(Buffers *b, PyObject *object, const Py_buffer *vectors, const char *name, Batch *batch) {
    if (vectors->ndim != 2) return refuse(name);
    batch->count = vectors->shape[0], batch->n = vectors->shape[1];
    const Py_buffer *G = take(b, object, "G", 'd', 0);
    if (!G) return 0;
    const Py_ssize_t *own = G->shape + (G->ndim == 3);
    if ((G->ndim != 2 && G->ndim != 3) || own[0] != batch->n || own[1] != batch->n) return refuse("G");
    if (G->ndim == 3 && G->shape[0] != batch->count) return refuse("G");
    batch->G = G->buf, batch->G_stride = G->ndim == 3 ? batch->n * batch->n : 0;
    return 1;
}

static PyObject *run_without_gil(const Batch *batch, Work *work, int64_t threads) {
    Py_BEGIN_ALLOW_THREADS;
    run(batch, work, threads);
    Py_END_ALLOW_THREADS;
    Py_RETURN_NONE;
}

static int has_arguments(Py_ssize_t got, Py_ssize_t expected) {
    if (got == expected) return 1;
    PyErr_Format(PyExc_TypeError, "expected %zd arguments, got %zd.", expected, got);
    return 0;
}

static PyObject *solve_boxes(PyObject *self, PyObject *const *args, Py_ssize_t nargs) {
    (void)self;
    Buffers held = {.held = 0};
    Batch b = {0};
    PyObject *result = NULL;
    if (!has_arguments(nargs, 12)) return NULL;
    const Py_buffer *v0, *lower = NULL, *upper = NULL, *lam = NULL, *steps = NULL, *good = NULL;
    if (!(v0 = take(&held, args[1], "v0", 'd', 0)) || !take_matrix(&held, args[0], v0, "v0", &b)) goto end;
    if (!(lower = take(&held, args[2], "lower", 'd', 0)) || !(upper = take(&held, args[3], "upper", 'd', 0))) goto end;
    if (!(lam = take(&held, args[4], "lam", 'd', 1)) || !(steps = take(&held, args[5], "iterations", 'q', 1))) goto end;
    if (!(good = take(&held, args[6], "converged", '?', 1))) goto end;
    if (lower->ndim != upper->ndim) {
        refuse("upper");
        goto end;
    }
    if (lower->ndim == 1 ? !fits_flat(lower, "lower", b.n) || !fits_flat(upper, "upper", b.n)
                         : !fits(lower, "lower", b.count, b.n) || !fits(upper, "upper", b.count, b.n))
        goto end;
    if (!fits(lam, "lam", b.count, b.n) || !fits_flat(steps, "iterations", b.count)) goto end;
    if (!fits_flat(good, "converged", b.count)) goto end;
    b.v = v0->buf, b.lower = lower->buf, b.upper = upper->buf, b.bound_stride = lower->ndim == 2 ? b.n : 0;
    b.out = lam->buf, b.steps = steps->buf, b.good = good->buf;
    b.hysteresis = PyFloat_AsDouble(args[7]), b.standing_out = PyFloat_AsDouble(args[8]);
    b.touching = PyFloat_AsDouble(args[9]), b.max_steps = PyLong_AsLongLong(args[10]);
    const int64_t threads = PyLong_AsLongLong(args[11]);
    if (!PyErr_Occurred()) result = run_without_gil(&b, boxes_work, threads);
end:
    release(&held);
    return result;
}

static PyObject *on_active(PyObject *const *args, Py_ssize_t nargs, int is_adjoint) {
    Buffers held = {.held = 0};
    Batch b = {0};
    PyObject *result = NULL;
    if (!has_arguments(nargs, 7 + is_adjoint)) return NULL;
    const Py_buffer *active, *right = NULL, *lam_bar = NULL, *out = NULL, *good = NULL;
    const char *name = is_adjoint ? "v_bar" : "rhs";
    if (!(right = take(&held, args[2], name, 'd', 0)) || !take_matrix(&held, args[0], right, name, &b)) goto end;
    if (!(active = take(&held, args[1], "active", '?', 0)) || !fits(active, "active", b.count, b.n)) goto end;
    if (is_adjoint && args[3] != Py_None) {
        if (!(lam_bar = take(&held, args[3], "lam_bar", 'd', 0)) || !fits(lam_bar, "lam_bar", b.count, b.n)) goto end;
        b.lower = lam_bar->buf;
    }
    args += is_adjoint;
    if (!(out = take(&held, args[3], "out", 'd', 1)) || !fits(out, "out", b.count, b.n)) goto end;
    if (!(good = take(&held, args[4], "trusted", '?', 1)) || !fits_flat(good, "trusted", b.count)) goto end;
    b.active = active->buf, b.v = right->buf, b.out = out->buf, b.good = good->buf;
    b.standing_out = PyFloat_AsDouble(args[5]);
    const int64_t threads = PyLong_AsLongLong(args[6]);
    if (!PyErr_Occurred()) result = run_without_gil(&b, is_adjoint ? adjoint_work : active_work, threads);
end:
    release(&held);
    return result;
}

static PyObject *solve_active(PyObject *self, PyObject *const *args, Py_ssize_t nargs) {
    (void)self;
    return on_active(args, nargs, 0);
}

static PyObject *adjoint(PyObject *self, PyObject *const *args, Py_ssize_t nargs) {
    (void)self;
    return on_active(args, nargs, 1);
}

static PyMethodDef methods[] = {
    {"solve_boxes", (PyCFunction)(void (*)(void))solve_boxes, METH_FASTCALL,
     "solve_boxes(G, v0, lower, upper, lam, iterations, converged, hysteresis, standing_out, touching, "
     "max_steps, threads)"},
    {"solve_active", (PyCFunction)(void (*)(void))solve_active, METH_FASTCALL,
     "solve_active(G, active, rhs, out, trusted, standing_out, threads)"},
    {"adjoint", (PyCFunction)(void (*)(void))adjoint, METH_FASTCALL,
     "adjoint(G, active, v_bar, lam_bar, out, trusted, standing_out, threads)"},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT, "_kernels", "Small systems on the active rows, one sample after the other.", -1, methods,
    NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__kernels(void) {
    pick();
    PyObject *made = PyModule_Create(&module);
    if (made && PyModule_AddStringConstant(made, "instructions", widest) < 0) Py_CLEAR(made);
    return made;
}
