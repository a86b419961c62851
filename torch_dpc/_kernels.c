/* The small systems of one sample after the other, without the dispatch of an array library.
 *
 *     solve_boxes   lam with  v = v0 - G lam,  v - Proj(v + lam) = 0,  the projection on a box: primal-dual active set
 *     solve_active  s_A = G_AA^-1 rhs_A, zero elsewhere
 *     adjoint       v_bar + s,  s_A = G_AA^-1 (lam_bar - G v_bar)_A
 *
 * kernels.py says what the arguments are and what is done with the samples that are flagged; newton.py and
 * active_set.py hold the same mathematics for other devices. G is symmetric, one for all samples or one each. Samples
 * are independent and each is computed by one thread in one order: results do not depend on threads or neighbours.
 *
 * A system is solved by elimination in the order of the list A, U x = y with U = D L' for G_AA = L D L'. U lies row by
 * row, and y is its last column: eliminating solves for it in passing. Vectors are GCC's, which clang knows too.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <float.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if !defined(_WIN32)
#define HAS_THREADS 1
#include <pthread.h>
#include <stdatomic.h>
#endif

#define INLINE static inline __attribute__((always_inline))
enum { WIDTH = 4, BLOCK = 4 * WIDTH }; /* twice as wide gains nothing here; columns of U are worked on by blocks */
typedef double vec __attribute__((vector_size(4 * sizeof(double))));
typedef int64_t mask __attribute__((vector_size(4 * sizeof(int64_t)))); /* of comparisons: 0 or -1 */

/* Sweeps of coordinate descent before the first step: one leaves 2.8 steps a sample of the masses of 3.5. */
enum { SWEEPS = 1 };
/* Samples that a thread takes at once, and how many a batch needs before a second thread is worth its start. */
enum { CHUNK = 16, ENOUGH = 96 };

INLINE vec load(const double *p) {
    vec x;
    memcpy(&x, p, sizeof x);
    return x;
}

INLINE void store(double *p, vec x) { memcpy(p, &x, sizeof x); }

INLINE vec spread(double s) { return (vec){s, s, s, s}; }

INLINE double sum(vec x) { return (x[0] + x[2]) + (x[1] + x[3]); }

INLINE int any(mask m) { return (m[0] | m[1] | m[2] | m[3]) != 0; }

INLINE double clip(double x, double lower, double upper) { return x > upper ? upper : x < lower ? lower : x; }

/* --- one system on the active rows ------------------------------------------------------------------------------- */

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

/* --- the solve for boxes ----------------------------------------------------------------------------------------- */

typedef struct {
    const double *G, *v0, *lower, *upper;
    double hysteresis, standing_out, touching;
    int64_t max_steps;
} Boxes;

/* Take in the bounds and the diagonal of G; where all samples share them, once. */
INLINE void take_in(const Boxes *p, Scratch *s) {
    for (int64_t i = 0; s->own_of != p->G && i < s->n; i++) {
        const double own = p->G[i * s->n + i];
        s->per_own[i] = own > DBL_MIN ? 1.0 / own : 0.0;
    }
    s->own_of = p->G;
    if (s->bounds_of == p->lower) return;
    s->bounds_of = p->lower;
    for (int64_t i = 0; i < rounded(s->n, WIDTH); i++) {
        const double lower = i < s->n ? p->lower[i] : -INFINITY, upper = i < s->n ? p->upper[i] : INFINITY;
        s->lower[i] = lower, s->upper[i] = upper;
        s->below[i] = lower == upper ? -INFINITY : lower - p->hysteresis * (1.0 + fabs(lower));
        s->above[i] = lower == upper ? -INFINITY : upper + p->hysteresis * (1.0 + fabs(upper)); /* tight: always held */
    }
}

/* Improve lam by coordinate descent on 1/2 lam'G lam - v0'lam + (support of the box at lam), and v = v0 - G lam. */
INLINE void descend(const Boxes *p, Scratch *s, int sweeps) {
    const int64_t n = s->n;
    double *restrict v = s->v, *restrict lam = s->lam;
    const double *restrict lower = s->lower, *restrict upper = s->upper;
    for (int sweep = 0; sweep < sweeps; sweep++) {
        int moved = 0;
        for (int64_t i = 0; i < n; i++) {
            const double here = v[i], before = lam[i];
            if ((before == 0.0) & (here >= lower[i]) & (here <= upper[i])) continue;
            const double *restrict row = p->G + i * n;
            const double free = here + row[i] * before;
            const double step = (free - clip(free, lower[i], upper[i])) * s->per_own[i] - before;
            if (step == 0.0) continue;
            const vec scale = spread(step);
            int64_t c = 0;
            for (; c + WIDTH <= n; c += WIDTH) store(v + c, load(v + c) - scale * load(row + c));
            for (; c < n; c++) v[c] -= step * row[c];
            lam[i] += step;
            moved = 1;
        }
        if (!moved) return;
    }
}

/* Write the side on which v + lam pushes each row past its bounds; return whether it is that of before. */
INLINE int push(const Scratch *s, int64_t *side, const int64_t *before) {
    mask differ = {0};
    for (int64_t i = 0; i < s->n; i += WIDTH) {
        const vec pushed = load(s->v + i) + load(s->lam + i);
        const mask now = (pushed < load(s->below + i)) - (pushed > load(s->above + i));
        mask old;
        memcpy(&old, before + i, sizeof old);
        differ |= now ^ old;
        memcpy(side + i, &now, sizeof now);
    }
    return !any(differ);
}

/* List the rows that are held, those of before first and in their old order; return how many, and in `same` how many
 * at the front did not change. */
INLINE int64_t relist(Scratch *s, int64_t k, int64_t *same) {
    int64_t kept = 0;
    *same = k;
    for (int64_t j = 0; j < k; j++) {
        if (s->next[s->rows[j]] == 0) {
            if (*same == k) *same = j;
        } else {
            s->rows[kept++] = s->rows[j];
        }
    }
    if (*same > kept) *same = kept;
    for (int64_t i = 0; i < s->n; i++)
        if (s->next[i] != 0 && s->side[i] == 0) s->rows[kept++] = i;
    return kept;
}

/* lam and v of the rows listed, whose first `same` columns of U are there already; 0 where they are not to be trusted. */
INLINE int resolve(const Boxes *p, Scratch *s, int64_t k, int64_t same) {
    const int kept = make_room(s, k);
    if (kept < 0) return 0;
    for (int64_t j = 0; j < k; j++) {
        const int64_t i = s->rows[j];
        s->rhs[i] = p->v0[i] - (s->side[i] > 0 ? s->upper[i] : s->lower[i]);
    }
    if (!factor(s, p->G, k, kept ? same : 0, p->standing_out)) return 0;
    substitute(s, k);
    subtract_rows(s->v, p->v0, p->G, s->n, s->rows, s->x, k);
    memset(s->lam, 0, (size_t)s->n * sizeof(double));
    for (int64_t j = 0; j < k; j++) s->lam[s->rows[j]] = s->x[j];
    return 1;
}

/* The primal-dual active set method from v and lam in the scratch; 0 where the sets do not repeat, or are dependent. */
INLINE int pivot(const Boxes *p, Scratch *s, int64_t *steps) {
    int64_t k = 0, same = 0;
    memset(s->side, 0, (size_t)s->n * sizeof(int64_t));
    push(s, s->next, s->side);
    for (int64_t step = 0; step < p->max_steps; step++) {
        k = relist(s, k, &same);
        int64_t *held = s->next;
        s->next = s->side, s->side = held;
        if (!resolve(p, s, k, same)) return 0;
        ++*steps;
        if (push(s, s->next, s->side)) return 1;
    }
    return 0;
}

/* The row that is furthest outside its bounds, in the metric of G; -1 where none is. `next` marks rows to leave out. */
INLINE int64_t furthest(const Scratch *s, double hysteresis) {
    int64_t found = -1;
    double most = 0.0;
    for (int64_t i = 0; i < s->n; i++) {
        const double over = s->v[i] - s->upper[i], under = s->lower[i] - s->v[i], by = over > under ? over : under;
        if (!(by > 0.0) || by * by * s->per_own[i] < most || s->side[i] != 0 || s->next[i] != 0) continue;
        if (by <= hysteresis * (1.0 + fabs(over > under ? s->upper[i] : s->lower[i]))) continue;
        if (s->per_own[i] == 0.0) return i;
        most = by * by * s->per_own[i], found = i;
    }
    return found;
}

/* The dual active set method (Goldfarb, Idnani 1983), slower and finite: rows join one by one, each multiplier keeps its
 * sign, and a row whose multiplier comes to zero on the way is let go. 0 where it ends without a solution. */
INLINE int climb(const Boxes *p, Scratch *s, int64_t *steps) {
    const int64_t n = s->n, most_steps = 8 * n + 100;
    int64_t k = 0, same = 0, joins;
    memcpy(s->v, p->v0, (size_t)n * sizeof(double));
    memset(s->lam, 0, (size_t)n * sizeof(double));
    memset(s->side, 0, (size_t)n * sizeof(int64_t));
    memset(s->next, 0, (size_t)n * sizeof(int64_t));
    while ((joins = furthest(s, p->hysteresis)) >= 0) {
        const double *row = p->G + joins * n;
        const int64_t sign = s->v[joins] > s->upper[joins] ? 1 : -1;
        const double bound = sign > 0 ? s->upper[joins] : s->lower[joins];
        double missing = fabs(s->v[joins] - bound);
        for (;;) {
            if (++*steps > most_steps) return 0;
            /* Raising lam of the row by 1 lowers those of the list by x = G_AA^-1 G_Ai, and v of the row by `own`. */
            for (int64_t j = 0; j < k; j++) s->rhs[s->rows[j]] = row[s->rows[j]];
            const int kept = make_room(s, k + 1);
            if (kept < 0 || !factor(s, p->G, k, kept ? same : 0, p->standing_out)) return 0;
            same = k;
            substitute(s, k);
            double own = row[joins], shortest = INFINITY;
            int64_t leaves = -1;
            for (int64_t j = 0; j < k; j++) {
                const int64_t i = s->rows[j];
                own -= row[i] * s->x[j];
                const double falls = (double)(sign * s->side[i]) * s->x[j];
                if (!(falls > 0.0) || s->lower[i] == s->upper[i]) continue; /* tight: either sign will do */
                const double length = fmax(s->lam[i] * (double)s->side[i], 0.0) / falls;
                if (length < shortest) shortest = length, leaves = j;
            }
            const int dependent = !(own > p->standing_out * p->standing_out * row[joins]);
            if (dependent && s->lam[joins] == 0.0 && missing <= p->touching * (1.0 + fabs(bound))) {
                s->next[joins] = 1; /* the others hold it there, up to rounding */
                break;
            }
            const double whole = dependent ? INFINITY : missing / own;
            const double length = fmin(whole, shortest);
            if (length == INFINITY) return 0; /* nothing can give way: no solution, or none to be trusted */
            if (whole <= shortest) {
                s->rows[k++] = joins;
                s->side[joins] = sign;
                if (!resolve(p, s, k, same)) return 0;
                same = k;
                memset(s->next, 0, (size_t)n * sizeof(int64_t));
                break;
            }
            for (int64_t j = 0; j < k; j++) s->lam[s->rows[j]] -= length * (double)sign * s->x[j];
            s->lam[joins] += length * (double)sign;
            if (!dependent) missing -= length * own;
            s->lam[s->rows[leaves]] = 0.0;
            s->side[s->rows[leaves]] = 0;
            memmove(s->rows + leaves, s->rows + leaves + 1, (size_t)(k - leaves - 1) * sizeof(int64_t));
            k--;
            if (same > leaves) same = leaves;
        }
    }
    return 1;
}

INLINE int solve_one(const Boxes *p, Scratch *s, int64_t *steps) {
    *steps = 0;
    double size = 0.0;
    for (int64_t i = 0; i < s->n; i++) size += p->v0[i];
    memset(s->lam, 0, (size_t)s->n * sizeof(double));
    if (!isfinite(size)) return 0;
    take_in(p, s);
    memcpy(s->v, p->v0, (size_t)s->n * sizeof(double));
    descend(p, s, SWEEPS);
    return pivot(p, s, steps) || climb(p, s, steps);
}

/* --- batches ----------------------------------------------------------------------------------------------------- */

typedef struct {
    int64_t count, n;
    const double *G;
    int64_t G_stride; /* 0 where all samples share one */
    const double *v, *lower, *upper; /* v0, rhs or v_bar; lower is lam_bar in `adjoint`, or NULL */
    int64_t bound_stride;
    const unsigned char *active;
    double *out;
    int64_t *steps;
    unsigned char *good;
    double hysteresis, standing_out, touching;
    int64_t max_steps;
} Batch;

INLINE void boxes_of(const Batch *b, Scratch *s, int64_t i) {
    const Boxes p = {
        b->G + i * b->G_stride,     b->v + i * b->n, b->lower + i * b->bound_stride, b->upper + i * b->bound_stride,
        b->hysteresis,              b->standing_out, b->touching, b->max_steps,
    };
    b->good[i] = (unsigned char)solve_one(&p, s, b->steps + i);
    memcpy(b->out + i * b->n, s->lam, (size_t)b->n * sizeof(double));
}

INLINE void active_of(const Batch *b, Scratch *s, int64_t i, int is_adjoint) {
    const int64_t n = b->n;
    const double *G = b->G + i * b->G_stride, *v = b->v + i * n;
    const double *lam_bar = b->lower ? b->lower + i * n : NULL;
    double *out = b->out + i * n;
    int64_t k = 0;
    for (int64_t j = 0; j < n; j++)
        if (b->active[i * n + j]) s->rows[k++] = j;
    for (int64_t j = 0; j < k; j++) {
        const int64_t row = s->rows[j];
        s->rhs[row] = is_adjoint ? (lam_bar ? lam_bar[row] : 0.0) - dot(G + row * n, v, n) : v[row];
    }
    if (is_adjoint) memcpy(out, v, (size_t)n * sizeof(double));
    else memset(out, 0, (size_t)n * sizeof(double));
    b->good[i] = make_room(s, k) >= 0 && factor(s, G, k, 0, b->standing_out);
    if (!b->good[i]) return;
    substitute(s, k);
    for (int64_t j = 0; j < k; j++) out[s->rows[j]] += s->x[j];
}

/* The bodies, and once more for processors with wider vectors; `pick` looks which this one is. */
typedef void Work(const Batch *, Scratch *, int64_t, int64_t);
#define BODIES(name, attribute)                                                                                \
    attribute static void boxes_##name(const Batch *b, Scratch *s, int64_t from, int64_t to) {                 \
        for (int64_t i = from; i < to; i++) boxes_of(b, s, i);                                                 \
    }                                                                                                          \
    attribute static void active_##name(const Batch *b, Scratch *s, int64_t from, int64_t to) {                \
        for (int64_t i = from; i < to; i++) active_of(b, s, i, 0);                                             \
    }                                                                                                          \
    attribute static void adjoint_##name(const Batch *b, Scratch *s, int64_t from, int64_t to) {               \
        for (int64_t i = from; i < to; i++) active_of(b, s, i, 1);                                             \
    }
BODIES(any, )
#if defined(__x86_64__)
BODIES(avx2, __attribute__((target("avx2,fma"))))
#endif

static Work *boxes_work = boxes_any, *active_work = active_any, *adjoint_work = adjoint_any;
static const char *widest = "any";

static void pick(void) {
#if defined(__x86_64__)
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"))
        boxes_work = boxes_avx2, active_work = active_avx2, adjoint_work = adjoint_avx2, widest = "avx2";
#endif
}

static void flag(const Batch *b, int64_t from, int64_t to) { /* no memory */
    memset(b->out + from * b->n, 0, (size_t)((to - from) * b->n) * sizeof(double));
    memset(b->good + from, 0, (size_t)(to - from));
    if (b->steps) memset(b->steps + from, 0, (size_t)(to - from) * sizeof(int64_t));
}

#ifdef HAS_THREADS
/* A job outlives the call that made it where a helper starts late; such a helper finds no sample left and touches
 * nothing but the job. The caller waits for samples that were taken, never for a thread to start. */
typedef struct {
    Batch batch;
    Work *work;
    atomic_llong taken, done;
    atomic_int users;
    pthread_mutex_t lock;
    pthread_cond_t all_done;
} Job;

static void leave(Job *job) {
    if (atomic_fetch_sub(&job->users, 1) > 1) return;
    pthread_mutex_destroy(&job->lock);
    pthread_cond_destroy(&job->all_done);
    free(job);
}

static void take_chunks(Job *job) {
    const int64_t count = job->batch.count;
    Scratch s;
    int ready = -1;
    for (;;) {
        const int64_t from = atomic_fetch_add(&job->taken, CHUNK);
        if (from >= count) break;
        const int64_t to = from + CHUNK < count ? from + CHUNK : count;
        if (ready < 0) ready = scratch_new(&s, job->batch.n);
        if (ready) job->work(&job->batch, &s, from, to);
        else flag(&job->batch, from, to);
        if (atomic_fetch_add(&job->done, to - from) + (to - from) == count) {
            pthread_mutex_lock(&job->lock);
            pthread_cond_signal(&job->all_done);
            pthread_mutex_unlock(&job->lock);
        }
    }
    if (ready >= 0) scratch_free(&s);
}

static void *help(void *job) {
    take_chunks(job);
    leave(job);
    return NULL;
}

static int run_in_threads(const Batch *batch, Work *work, int64_t threads) {
    Job *job = malloc(sizeof *job);
    if (!job) return 0;
    job->batch = *batch, job->work = work;
    atomic_init(&job->taken, 0), atomic_init(&job->done, 0), atomic_init(&job->users, 1);
    pthread_mutex_init(&job->lock, NULL);
    pthread_cond_init(&job->all_done, NULL);
    pthread_attr_t detached;
    pthread_attr_init(&detached);
    pthread_attr_setdetachstate(&detached, PTHREAD_CREATE_DETACHED);
    for (int64_t t = 1; t < threads; t++) {
        pthread_t helper;
        atomic_fetch_add(&job->users, 1);
        if (pthread_create(&helper, &detached, help, job) != 0) {
            atomic_fetch_sub(&job->users, 1);
            break;
        }
    }
    pthread_attr_destroy(&detached);
    take_chunks(job);
    pthread_mutex_lock(&job->lock);
    while (atomic_load(&job->done) < batch->count) pthread_cond_wait(&job->all_done, &job->lock);
    pthread_mutex_unlock(&job->lock);
    leave(job);
    return 1;
}
#endif

static void run(const Batch *batch, Work *work, int64_t threads) {
#ifdef HAS_THREADS
    const int64_t useful = batch->count / (ENOUGH / 2);
    if (threads > useful) threads = useful;
    if (threads > 1 && run_in_threads(batch, work, threads)) return;
#endif
    Scratch s;
    if (scratch_new(&s, batch->n)) work(batch, &s, 0, batch->count);
    else flag(batch, 0, batch->count);
    scratch_free(&s);
}

/* --- Python ------------------------------------------------------------------------------------------------------ */

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
