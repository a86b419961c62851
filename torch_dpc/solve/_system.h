/* One symmetric system on the active rows of a sample, and products with rows of G.
 *
 * A system is solved by elimination in the order of the list A, U x = y with U = D L' for G_AA = L D L'. U lies row by
 * row, and y is its last column: eliminating solves for it in passing. Vectors are GCC's, which clang knows too.
 */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define INLINE static inline __attribute__((always_inline))
enum { WIDTH = 4, BLOCK = 4 * WIDTH }; /* twice as wide gains nothing here; columns of U are worked on by blocks */
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

INLINE int any(mask m) { return (m[0] | m[1] | m[2] | m[3]) != 0; }

typedef struct {
    void *block, *U_block; /* what holds all below, and U */
    int64_t n;       /* N */
    int64_t room;    /* rows and columns of U that fit, the right-hand side included; a multiple of BLOCK */
    double *U;       /* (room, room), upper triangular */
    int64_t *rows;   /* (N) the active rows */
    double *inverse; /* (N) of the diagonal of U */
    double *rhs;     /* (N) right-hand side, by row of G */
    double *x;       /* (N) the solution, in the order of `rows` */
    double *v, *lam; /* (N) */
    double *lower, *upper, *below, *above; /* (N) the bounds, and what v + lam must pass for a row to be held */
    double *per_own;                       /* (N) 1 / G_ii, or 0 where nothing moves the row */
    const double *bounds_of, *own_of;      /* whose lower bounds and G these are */
    int64_t *side, *next;                  /* (N) 1, 0 or -1: held at the upper bound, free, held at the lower one */
} Scratch;

static int64_t rounded(int64_t n, int64_t to) { return (n + to - 1) / to * to; }

enum { LINE = 64 }; /* bytes of a cache line: a vector that crosses one costs twice */

/* `count` items of 8 bytes; `*block` is what to free. */
static void *aligned(void **block, int64_t count) {
    *block = malloc((size_t)count * 8 + LINE);
    return *block ? (char *)*block + (LINE - (uintptr_t)*block % LINE) : NULL;
}

static void scratch_free(Scratch *s) {
    free(s->U_block);
    free(s->block);
}

/* All vectors are longer than N by up to a block of zeros. */
static int scratch_new(Scratch *s, int64_t n) {
    const int64_t wide = rounded(n + 1, BLOCK);
    *s = (Scratch){.n = n};
    s->rows = aligned(&s->block, 13 * wide);
    if (!s->rows) return 0;
    memset(s->rows, 0, (size_t)(13 * wide) * sizeof(double));
    double *next = (double *)(s->rows + wide);
    double **parts[] = {&s->inverse, &s->rhs,   &s->x,     &s->v,     &s->lam,
                        &s->lower,   &s->upper, &s->below, &s->above, &s->per_own};
    for (size_t i = 0; i < sizeof parts / sizeof *parts; i++, next += wide) *parts[i] = next;
    s->side = (int64_t *)next;
    s->next = s->side + wide;
    return 1;
}

/* Make room for k rows and a right-hand side; return whether what U held is still there, or -1 without memory. */
static int make_room(Scratch *s, int64_t k) {
    if (k < s->room) return 1;
    const int64_t room = rounded(k + k / 2 + 1, BLOCK);
    free(s->U_block);
    s->U = aligned(&s->U_block, room * room);
    s->room = s->U ? room : 0;
    return s->U ? 0 : -1;
}

/* Subtract from `count` vectors of row i of U, at column c, what the rows above contribute. */
INLINE void eliminate(const int count, const Scratch *s, int64_t i, int64_t c) {
    const int64_t ld = s->room;
    const double *above = s->U + c, *column = s->U + i, *inverse = s->inverse;
    vec a[4], b[4];
    for (int t = 0; t < count; t++) a[t] = load(above + i * ld + WIDTH * t), b[t] = spread(0.0);
    int64_t l = 0;
    for (; l + 1 < i; l += 2) { /* two sums: one would wait for itself */
        const vec p = spread(column[l * ld] * inverse[l]), q = spread(column[l * ld + ld] * inverse[l + 1]);
        for (int t = 0; t < count; t++) a[t] -= p * load(above + l * ld + WIDTH * t);
        for (int t = 0; t < count; t++) b[t] -= q * load(above + l * ld + ld + WIDTH * t);
    }
    if (l < i) {
        const vec p = spread(column[l * ld] * inverse[l]);
        for (int t = 0; t < count; t++) a[t] -= p * load(above + l * ld + WIDTH * t);
    }
    for (int t = 0; t < count; t++) store(s->U + i * ld + c + WIDTH * t, a[t] + b[t]);
}

/* Compute the columns from `first` on of U, and y as its column k. Return whether every row of Ct stands out of the
 * span of those before it by the fraction `standing_out` of its length. */
INLINE int factor(Scratch *s, const double *G, int64_t k, int64_t first, double standing_out) {
    const int64_t end = rounded(k + 1, BLOCK), *rows = s->rows;
    for (int64_t i = 0; i < k; i++) {
        double *Ui = s->U + i * s->room;
        const double *Gi = G + rows[i] * s->n;
        /* By whole vectors: what lies left of column i comes out as rounding and is never used. */
        for (int64_t c = (i > first ? i : first) / WIDTH * WIDTH; c < k; c++) Ui[c] = Gi[rows[c]];
        Ui[k] = s->rhs[rows[i]];
        for (int64_t c = k + 1; c < end; c++) Ui[c] = 0.0;
    }
    for (int64_t i = 0; i < k; i++) {
        int64_t c = (i > first ? i : first) / WIDTH * WIDTH;
        for (; c + 4 * WIDTH <= end; c += 4 * WIDTH) eliminate(4, s, i, c);
        if (c + 3 * WIDTH == end) eliminate(3, s, i, c);
        else if (c + 2 * WIDTH == end) eliminate(2, s, i, c);
        else if (c + WIDTH == end) eliminate(1, s, i, c);
        if (i < first) continue;
        const double pivot = s->U[i * s->room + i], length = G[rows[i] * s->n + rows[i]];
        if (!(pivot > standing_out * standing_out * length)) return 0; /* nor is it NaN */
        s->inverse[i] = 1.0 / pivot;
    }
    return 1;
}

/* Solve U x = y. */
INLINE void substitute(Scratch *s, int64_t k) {
    const int64_t ld = s->room, end = rounded(k, WIDTH);
    double *x = s->x;
    for (int64_t i = k; i < end; i++) x[i] = 0.0; /* also what meets column k */
    for (int64_t b = end - WIDTH; b >= 0; b -= WIDTH) {
        const int64_t here = b + WIDTH < k ? WIDTH : k - b;
        double y[WIDTH];
        for (int64_t i = 0; i < here; i++) {
            const double *Ui = s->U + (b + i) * ld;
            vec a = spread(0.0);
            for (int64_t c = b + WIDTH; c < end; c += WIDTH) a += load(Ui + c) * load(x + c);
            y[i] = Ui[k] - sum(a);
        }
        for (int64_t i = here - 1; i >= 0; i--) {
            x[b + i] = y[i] * s->inverse[b + i];
            for (int64_t j = 0; j < i; j++) y[j] -= s->U[(b + j) * ld + b + i] * x[b + i];
        }
    }
}

/* --- products with rows of G ------------------------------------------------------------------------------------- */

/* out = base - sum of x_j times row j of the list, `count` vectors from column c on. */
#define COLUMNS(count)                                                                       \
    {                                                                                        \
        vec a[count];                                                                        \
        for (int t = 0; t < count; t++) a[t] = load(base + c + WIDTH * t);                   \
        for (int64_t j = 0; j < k; j++) {                                                    \
            const double *row = G + rows[j] * n + c;                                         \
            const vec scale = spread(x[j]);                                                  \
            for (int t = 0; t < count; t++) a[t] -= scale * load(row + WIDTH * t);           \
        }                                                                                    \
        for (int t = 0; t < count; t++) store(out + c + WIDTH * t, a[t]);                    \
    }

INLINE void subtract_rows(
    double *restrict out, const double *restrict base, const double *restrict G, int64_t n, const int64_t *restrict rows,
    const double *restrict x, int64_t k) {
    int64_t c = 0;
    if (n < WIDTH) {
        memcpy(out, base, (size_t)n * sizeof(double));
        for (int64_t j = 0; j < k; j++)
            for (int64_t i = 0; i < n; i++) out[i] -= x[j] * G[rows[j] * n + i];
        return;
    }
    for (; c + 8 * WIDTH <= n; c += 8 * WIDTH) COLUMNS(8)
    for (; c + 2 * WIDTH <= n; c += 2 * WIDTH) COLUMNS(2)
    for (; c < n; c += WIDTH) {
        if (c + WIDTH > n) c = n - WIDTH; /* the last ones, some of them once more */
        COLUMNS(1)
    }
}

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
