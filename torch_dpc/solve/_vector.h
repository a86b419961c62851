/* Vectors of four numbers, and products of vectors with rows of a matrix.
 *
 * The vector types are GCC's, which clang knows too. Wider vectors are no faster here. */
#ifndef TORCH_DPC_VECTOR_H
#define TORCH_DPC_VECTOR_H

#include <stdint.h>
#include <string.h>

/* Functions on the inner path are inlined, so that each is compiled for the vector instructions of its caller.
 * TORCH_DPC_PLAIN leaves that, and all but the common instructions, to a build that has to be quick to compile. */
#ifdef TORCH_DPC_PLAIN
#define INLINE static
#else
#define INLINE static inline __attribute__((always_inline))
#endif

enum { WIDTH = 4, BLOCK = 4 * WIDTH }; /* numbers in a vector, and in the blocks of columns that a loop works on */
typedef double vec __attribute__((vector_size(4 * sizeof(double))));
typedef int64_t mask __attribute__((vector_size(4 * sizeof(int64_t)))); /* of comparisons: 0 or -1 */

INLINE vec load(const double *p) {
    vec x;
    memcpy(&x, p, sizeof x);
    return x;
}

INLINE void store(double *p, vec x) { memcpy(p, &x, sizeof x); }

INLINE vec spread(double s) { return (vec){s, s, s, s}; }

INLINE double sum(vec x) { return (x[0] + x[2]) + (x[1] + x[3]); }

INLINE vec absolute(vec x) { return (vec)((mask)x & (mask){INT64_MAX, INT64_MAX, INT64_MAX, INT64_MAX}); }

INLINE vec negate_where(mask m, vec x) {
    return (vec)((mask)x ^ (m & (mask){INT64_MIN, INT64_MIN, INT64_MIN, INT64_MIN}));
}

INLINE int any(mask m) { return (m[0] | m[1] | m[2] | m[3]) != 0; }

INLINE size_t bytes(int64_t doubles) { return (size_t)doubles * sizeof(double); }

INLINE double dot(const double *restrict x, const double *restrict y, int64_t n) {
    vec a = spread(0.0), b = a;
    int64_t i = 0;
    for (; i + 2 * WIDTH <= n; i += 2 * WIDTH) {
        a += load(x + i) * load(y + i);
        b += load(x + i + WIDTH) * load(y + i + WIDTH);
    }
    double total = sum(a + b);
    for (; i < n; i++) total += x[i] * y[i];
    return total;
}

/* out_i = the product of row i of M, which is (m, n), with x; each as `dot` computes it, four side by side. */
INLINE void multiply(double *restrict out, const double *restrict M, const double *restrict x, int64_t m, int64_t n) {
    const int64_t whole = n / (2 * WIDTH) * (2 * WIDTH);
    int64_t i = 0;
    for (; i + 4 <= m; i += 4) {
        const double *row = M + i * n;
        vec a[4], b[4];
        for (int t = 0; t < 4; t++) a[t] = b[t] = spread(0.0);
        for (int64_t c = 0; c < whole; c += 2 * WIDTH) {
            const vec x0 = load(x + c), x1 = load(x + c + WIDTH);
            for (int t = 0; t < 4; t++) {
                a[t] += load(row + t * n + c) * x0;
                b[t] += load(row + t * n + c + WIDTH) * x1;
            }
        }
        for (int t = 0; t < 4; t++) {
            out[i + t] = sum(a[t] + b[t]);
            for (int64_t c = whole; c < n; c++) out[i + t] += row[t * n + c] * x[c];
        }
    }
    for (; i < m; i++) out[i] = dot(M + i * n, x, n);
}

/* y -= scale * x. */
INLINE void subtract_scaled(double *restrict y, double scale, const double *restrict x, int64_t n) {
    const vec s = spread(scale);
    int64_t c = 0;
    for (; c + WIDTH <= n; c += WIDTH) store(y + c, load(y + c) - s * load(x + c));
    for (; c < n; c++) y[c] -= scale * x[c];
}

/* The columns c to c + count * WIDTH of `subtract_rows`. */
INLINE void subtract_columns(
    const int count, double *restrict out, const double *restrict base, const double *restrict G, int64_t n,
    const int64_t *restrict rows, const double *restrict x, int64_t k, int64_t c) {
    vec a[8];
    for (int t = 0; t < count; t++) a[t] = load(base + c + WIDTH * t);
    for (int64_t j = 0; j < k; j++) {
        const double *row = G + rows[j] * n + c;
        const vec scale = spread(x[j]);
        for (int t = 0; t < count; t++) a[t] -= scale * load(row + WIDTH * t);
    }
    for (int t = 0; t < count; t++) store(out + c + WIDTH * t, a[t]);
}

/* out = base - the sum over j < k of x_j times row `rows[j]` of G, which is (n, n). */
INLINE void subtract_rows(
    double *restrict out, const double *restrict base, const double *restrict G, int64_t n, const int64_t *restrict rows,
    const double *restrict x, int64_t k) {
    int64_t c = 0;
    if (n < WIDTH) {
        memcpy(out, base, bytes(n));
        for (int64_t j = 0; j < k; j++)
            for (int64_t i = 0; i < n; i++) out[i] -= x[j] * G[rows[j] * n + i];
        return;
    }
    for (; c + 8 * WIDTH <= n; c += 8 * WIDTH) subtract_columns(8, out, base, G, n, rows, x, k, c);
    for (; c + 2 * WIDTH <= n; c += 2 * WIDTH) subtract_columns(2, out, base, G, n, rows, x, k, c);
    for (; c < n; c += WIDTH) {
        if (c + WIDTH > n) c = n - WIDTH; /* the last columns; some are computed twice, with the same result */
        subtract_columns(1, out, base, G, n, rows, x, k, c);
    }
}

#endif
