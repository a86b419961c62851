/* The symmetric system of one sample, G_AA x = rhs_A, and the memory that a sample needs.
 *
 * G_AA = L D L' is eliminated in the order of the list A of active rows: U = D L' lies row by row, and the right-hand
 * side is its last column, so that the elimination also computes y in U x = y.
 */
#ifndef TORCH_DPC_SYSTEM_H
#define TORCH_DPC_SYSTEM_H

#include <stdlib.h>

#include "_vector.h"

enum { CACHE_LINE = 64 }; /* bytes; a vector that crosses a line costs twice */

/* The memory of sets with curved blocks; made only if there are any. Vectors have N entries. */
typedef struct {
    void *memory;
    double *gamma, *reach;      /* scale of the multipliers; what is added to the diagonal of G */
    double *origin;             /* v0, plus reach times the multipliers that the proximal point method starts from */
    double *pushed, *updated;   /* v + gamma lam, and the multipliers that follow from it */
    double *target, *v_target;  /* where a Newton step leads, and v there */
    double *best, *proximal;    /* the best multipliers yet; the center of the proximal point method */
    double *trial, *v_trial;    /* along the step */
    double *reflector, *curvature, *sign; /* the held directions of the blocks, see _sets.h */
    double *packed;             /* entries of a sparse vector */
    int64_t *places;            /* and where they are */
    int64_t *state;             /* of the blocks */
} Curved;

enum { CURVED_VECTORS = 17 };

/* The memory of one thread. Vectors have N entries, and zeros after them up to a whole block. */
typedef struct {
    void *vectors_memory, *U_memory; /* what is to be freed */
    int64_t n;                       /* N */
    int64_t capacity;                /* rows and columns of U, the right-hand side included; a multiple of BLOCK */
    double *U;                       /* (capacity, capacity), upper triangular */
    int64_t *rows;                   /* the active rows */
    double *inverse_pivots;          /* of U, in the order of `rows` */
    double *rhs;                     /* the right-hand side, by row of G */
    double *x;                       /* the solution, in the order of `rows` */
    double *v, *lam;                 /* the iterate */
    double *v0;                      /* the unconstrained minimiser, if the kernel computes it */
    double *start;                   /* v0 less what the multipliers that are known take of it */
    double *lower, *upper, *price;   /* the intervals */
    double *below, *above;           /* what v + lam must pass for a row to be held at its bound */
    double *top, *bottom;            /* what v + G_ii lam must pass for a row to be beyond its bound */
    double *diagonal;                /* G_ii */
    double *inverse_diagonal;        /* 1 / G_ii; 0 if nothing moves the row */
    const double *lower_source, *upper_source, *price_source, *diagonal_source; /* what these were copied from */
    int64_t *from_held;              /* steps of `side` from where `below` puts a row to beyond its lower bound */
    int64_t *side, *new_side;        /* where each row is, see _intervals.h */
    int64_t *skipped;                /* rows that `goldfarb_idnani` passes over */
    Curved curved;
} Workspace;

enum { VECTORS = 21 }; /* of a workspace */

static int64_t round_up(int64_t n, int64_t to) { return (n + to - 1) / to * to; }

/* Allocate `count` items of 8 bytes, aligned; NULL without memory. `*memory` is what to free. */
static void *allocate(void **memory, int64_t count) {
    size_t size;
    if (count < 0 || __builtin_mul_overflow((size_t)count, sizeof(double), &size) ||
        __builtin_add_overflow(size, (size_t)CACHE_LINE, &size))
        return *memory = NULL;
    *memory = malloc(size);
    return *memory ? (char *)*memory + (CACHE_LINE - (uintptr_t)*memory % CACHE_LINE) : NULL;
}

static void free_workspace(Workspace *w) {
    free(w->curved.memory);
    free(w->U_memory);
    free(w->vectors_memory);
}

/* Return 0 without memory. */
static int new_workspace(Workspace *w, int64_t n) {
    int64_t count;
    *w = (Workspace){.n = n};
    if (n < 0 || n > INT64_MAX - BLOCK) return 0;
    const int64_t width = round_up(n + 1, BLOCK);
    if (__builtin_mul_overflow(VECTORS, width, &count)) return 0;
    double *next = allocate(&w->vectors_memory, count);
    if (!next) return 0;
    memset(next, 0, bytes(count));
    double **vectors[] = {&w->inverse_pivots, &w->rhs,   &w->x,   &w->v,      &w->lam,      &w->start, &w->lower, &w->upper,
                          &w->price,          &w->below, &w->above, &w->top, &w->bottom, &w->diagonal, &w->inverse_diagonal, &w->v0};
    int64_t **integers[] = {&w->rows, &w->from_held, &w->side, &w->new_side, &w->skipped};
    for (size_t i = 0; i < sizeof vectors / sizeof *vectors; i++, next += width) *vectors[i] = next;
    for (size_t i = 0; i < sizeof integers / sizeof *integers; i++, next += width) *integers[i] = (int64_t *)(void *)next;
    return 1;
}

/* Make the memory for curved blocks, if it is not there yet; return 0 without memory. */
static int reserve_curved(Workspace *w) {
    Curved *c = &w->curved;
    const int64_t width = round_up(w->n + 1, BLOCK);
    int64_t count;
    if (c->memory) return 1;
    if (__builtin_mul_overflow(CURVED_VECTORS, width, &count)) return 0;
    double *next = allocate(&c->memory, count);
    if (!next) return 0;
    memset(next, 0, bytes(count));
    double **vectors[] = {&c->gamma, &c->reach,   &c->origin, &c->pushed,  &c->updated,   &c->target,    &c->v_target, &c->best,
                          &c->proximal, &c->trial, &c->v_trial, &c->reflector, &c->curvature, &c->sign, &c->packed};
    int64_t **integers[] = {&c->places, &c->state};
    for (size_t i = 0; i < sizeof vectors / sizeof *vectors; i++, next += width) *vectors[i] = next;
    for (size_t i = 0; i < sizeof integers / sizeof *integers; i++, next += width) *integers[i] = (int64_t *)(void *)next;
    return 1;
}

/* Make U large enough for k rows and a right-hand side.
 * Return 1 if what U held is still there, 0 if not, and -1 without memory. */
static int reserve(Workspace *w, int64_t k) {
    if (k < w->capacity) return 1;
    const int64_t capacity = round_up(k + k / 2 + 1, BLOCK);
    int64_t count;
    free(w->U_memory);
    w->U_memory = NULL;
    w->U = __builtin_mul_overflow(capacity, capacity, &count) ? NULL : allocate(&w->U_memory, count);
    w->capacity = w->U ? capacity : 0;
    return w->U ? 0 : -1;
}

/* The first column to compute in row i, a whole vector. What lies left of the diagonal is rounding, and never used. */
INLINE int64_t first_column(int64_t i, int64_t first) { return (i > first ? i : first) / WIDTH * WIDTH; }

/* Write G_AA from column `first` on, and the right-hand side as column k. */
INLINE void gather(Workspace *w, const double *G, int64_t k, int64_t first) {
    const int64_t end = round_up(k + 1, BLOCK), *rows = w->rows;
    for (int64_t i = 0; i < k; i++) {
        double *Ui = w->U + i * w->capacity;
        const double *Gi = G + rows[i] * w->n;
        for (int64_t c = first_column(i, first); c < k; c++) Ui[c] = Gi[rows[c]];
        Ui[k] = w->rhs[rows[i]];
        for (int64_t c = k + 1; c < end; c++) Ui[c] = 0.0;
    }
}

/* Subtract from `count` vectors of row i of U, at column c, what the rows above contribute. */
INLINE void eliminate(const int count, const Workspace *w, int64_t i, int64_t c) {
    const int64_t stride = w->capacity;
    const double *above = w->U + c, *column = w->U + i, *inverse = w->inverse_pivots;
    vec a[4], b[4];
    for (int t = 0; t < count; t++) a[t] = load(above + i * stride + WIDTH * t), b[t] = spread(0.0);
    int64_t j = 0;
    for (; j + 1 < i; j += 2) { /* two sums, because the terms of one wait for each other */
        const vec p = spread(column[j * stride] * inverse[j]);
        const vec q = spread(column[j * stride + stride] * inverse[j + 1]);
        for (int t = 0; t < count; t++) a[t] -= p * load(above + j * stride + WIDTH * t);
        for (int t = 0; t < count; t++) b[t] -= q * load(above + j * stride + stride + WIDTH * t);
    }
    if (j < i) {
        const vec p = spread(column[j * stride] * inverse[j]);
        for (int t = 0; t < count; t++) a[t] -= p * load(above + j * stride + WIDTH * t);
    }
    for (int t = 0; t < count; t++) store(w->U + i * stride + c + WIDTH * t, a[t] + b[t]);
}

/* Eliminate the gathered matrix; its first `first` columns are eliminated already. Return whether every pivot is above
 * `least` times its diagonal entry: for G_AA, whether every row of Ct has a part outside the span of the rows before
 * it, with more than sqrt(least) of its length. */
INLINE int factor(Workspace *w, int64_t k, int64_t first, double least) {
    const int64_t end = round_up(k + 1, BLOCK);
    for (int64_t i = 0; i < k; i++) {
        const double diagonal = w->U[i * w->capacity + i];
        int64_t c = first_column(i, first);
        for (; c + 4 * WIDTH <= end; c += 4 * WIDTH) eliminate(4, w, i, c);
        if (c + 3 * WIDTH == end) eliminate(3, w, i, c);
        else if (c + 2 * WIDTH == end) eliminate(2, w, i, c);
        else if (c + WIDTH == end) eliminate(1, w, i, c);
        if (i < first) continue;
        const double pivot = w->U[i * w->capacity + i];
        if (!(pivot > least * diagonal)) return 0; /* NaN fails too */
        w->inverse_pivots[i] = 1.0 / pivot;
    }
    return 1;
}

/* Solve U x = y. */
INLINE void substitute(Workspace *w, int64_t k) {
    const int64_t stride = w->capacity, end = round_up(k, WIDTH);
    double *x = w->x;
    for (int64_t i = k; i < end; i++) x[i] = 0.0; /* it meets the right-hand side in column k */
    for (int64_t b = end - WIDTH; b >= 0; b -= WIDTH) {
        const int64_t height = b + WIDTH < k ? WIDTH : k - b;
        double y[WIDTH];
        for (int64_t i = 0; i < height; i++) {
            const double *Ui = w->U + (b + i) * stride;
            vec a = spread(0.0);
            for (int64_t c = b + WIDTH; c < end; c += WIDTH) a += load(Ui + c) * load(x + c);
            y[i] = Ui[k] - sum(a);
        }
        for (int64_t i = height - 1; i >= 0; i--) {
            x[b + i] = y[i] * w->inverse_pivots[b + i];
            for (int64_t j = 0; j < i; j++) y[j] -= w->U[(b + j) * stride + b + i] * x[b + i];
        }
    }
}

/* Solve G_AA x = rhs_A for the k rows listed, of which U holds the first `same` columns already.
 * Return 0 if the rows are dependent or memory is short. */
INLINE int solve_rows(Workspace *w, const double *G, int64_t k, int64_t same, double least) {
    const int kept = reserve(w, k);
    if (kept < 0) return 0;
    const int64_t first = kept ? same : 0;
    gather(w, G, k, first);
    if (!factor(w, k, first, least)) return 0;
    substitute(w, k);
    return 1;
}

#endif
