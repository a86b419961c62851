/* One sample from where its windows lie: no array is made, and nothing is copied but the windows themselves. */
#ifndef TORCH_DPC_WINDOWS_H
#define TORCH_DPC_WINDOWS_H

#include "_arguments.h"

/* Float64 numbers of the caller's that are to fill `size` places: repeated as often as it takes, or zeros if there are
 * none. */
typedef struct {
    const double *data;
    int64_t given, size;
} Window;

/* Read one window of the tuple (address, given, size, address, given, size, ...). Return 0 with an exception. */
static int window_at(PyObject *windows, Py_ssize_t i, Window *window) {
    window->data = PyLong_AsVoidPtr(PyTuple_GET_ITEM(windows, 3 * i));
    window->given = PyLong_AsLongLong(PyTuple_GET_ITEM(windows, 3 * i + 1));
    window->size = PyLong_AsLongLong(PyTuple_GET_ITEM(windows, 3 * i + 2));
    if (PyErr_Occurred()) return 0;
    if (window->size < 0 || (window->data && (window->given < 1 || window->size % window->given))) return misfit("windows");
    return 1;
}

/* Write all windows one after the other, `size` numbers in total. Return 0 with an exception. */
static int fill(double *to, int64_t size, PyObject *windows) {
    if (!PyTuple_Check(windows) || PyTuple_GET_SIZE(windows) % 3) return misfit("windows");
    for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(windows) / 3; i++) {
        Window window;
        if (!window_at(windows, i, &window)) return 0;
        if (window.size > size) return misfit("windows");
        if (!window.data) memset(to, 0, bytes(window.size));
        for (int64_t j = 0; window.data && j < window.size; j += window.given)
            memcpy(to + j, window.data, bytes(window.given));
        to += window.size, size -= window.size;
    }
    return size == 0 || misfit("windows");
}

/* Take a vector of `size` items of the type; any size is right if it is negative. Return it, or NULL with an exception. */
static void *take_vector(Buffers *b, PyObject *object, const char *name, char type, int64_t size, int64_t *length) {
    const Py_buffer *view = take(b, object, name, type, PyBUF_WRITABLE);
    if (!view) return NULL;
    if (view->ndim != 1 || (size >= 0 && view->shape[0] != size)) return misfit(name), NULL;
    if (length) *length = view->shape[0];
    return view->buf;
}

/* Run a batch of one sample without the interpreter's lock, release the arrays, and return whether it succeeded. */
static PyObject *finish_one(Buffers *held, int is_ready, Batch *batch, Work *work) {
    unsigned char succeeded = 0;
    batch->succeeded = &succeeded;
    if (is_ready) {
        Py_BEGIN_ALLOW_THREADS;
        run(batch, work, 1);
        Py_END_ALLOW_THREADS;
    }
    release(held);
    return is_ready ? PyBool_FromLong(succeeded) : NULL;
}

/* Whether the memory at an address holds the same bytes as an array. */
static PyObject *holds(PyObject *self, PyObject *const *args, Py_ssize_t count) {
    (void)self;
    Py_buffer numbers;
    if (!has_arguments(count, 2)) return NULL;
    const void *address = PyLong_AsVoidPtr(args[0]);
    if (PyErr_Occurred() || PyObject_GetBuffer(args[1], &numbers, PyBUF_C_CONTIGUOUS) < 0) return NULL;
    const int are_same = numbers.len == 0 || (address && memcmp(address, numbers.buf, (size_t)numbers.len) == 0);
    PyBuffer_Release(&numbers);
    return PyBool_FromLong(are_same);
}

static PyObject *plan_one(PyObject *self, PyObject *const *args, Py_ssize_t count) {
    (void)self;
    Buffers held = {.count = 0};
    Batch b = {0};
    int64_t n = 0, threads;
    double *theta = NULL;
    if (!has_arguments(count, 11)) return NULL;
    const int is_ready = (b.result = take_vector(&held, args[4], "v", 'd', -1, &n)) &&
                         take_map(&held, args[0], 1, n, &b) && take_sets(&held, args[1], &b) &&
                         (theta = take_vector(&held, args[3], "theta", 'd', b.map.n_theta, NULL)) &&
                         (b.result_lam = take_vector(&held, args[5], "lam", 'd', n, NULL)) &&
                         (b.is_active = take_vector(&held, args[6], "active", '?', n, NULL)) &&
                         (b.is_weak = take_vector(&held, args[7], "weak", '?', n, NULL)) &&
                         (b.info = take_vector(&held, args[8], "info", 'd', INFO, NULL)) &&
                         take_options(args + 9, &b, &threads) && fill(theta, b.map.n_theta, args[2]);
    b.theta = (Numbers){theta, b.map.n_theta};
    return finish_one(&held, is_ready, &b, plan_work);
}

static PyObject *adjoint_one(PyObject *self, PyObject *const *args, Py_ssize_t count) {
    (void)self;
    Buffers held = {.count = 0};
    Batch b = {0};
    int64_t n = 0, threads;
    double *bars = NULL;
    if (!has_arguments(count, 11)) return NULL;
    const int is_ready = (bars = take_vector(&held, args[7], "bars", 'd', -1, &n)) && (n % 2 == 0 || misfit("bars")) &&
                         take_map(&held, args[0], 1, n / 2, &b) && take_sets(&held, args[1], &b) &&
                         (b.v.data = take_vector(&held, args[2], "v", 'd', b.n, NULL)) &&
                         (b.lam.data = take_vector(&held, args[3], "lam", 'd', b.n, NULL)) &&
                         (b.active = take_vector(&held, args[4], "active", '?', b.n, NULL)) &&
                         (b.weak = take_vector(&held, args[5], "weak", '?', b.n, NULL)) &&
                         (b.theta_bar = take_vector(&held, args[8], "theta_bar", 'd', b.map.n_theta, NULL)) &&
                         take_options(args + 9, &b, &threads) && fill(bars, n, args[6]);
    if (is_ready) b.v_bar.data = b.result = bars, b.lam_bar.data = bars + b.n;
    return finish_one(&held, is_ready, &b, plan_adjoint_work);
}

#endif
