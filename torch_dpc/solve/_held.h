/* The symmetric system on the directions that the sets hold, W'(G + diag reach) W + diag curvature.
 *
 * Intervals hold a row, blocks the directions of _sets.h. The rows of all held intervals and blocks are gathered, the
 * blocks rotated in place, and the free directions of cones' boundaries dropped.
 */
#ifndef TORCH_DPC_HELD_H
#define TORCH_DPC_HELD_H

#include "_sets.h"

#define ROOT_HALF 0.70710678118654752440

/* The held directions of a sample: `rows` in the workspace lists the held intervals first, then the rows of every block
 * that is not OFF, in order. */
typedef struct {
    int64_t rows, intervals; /* lengths of both parts of the list together, and of the first */
} Held;

/* Append the rows of the blocks that are not OFF. */
INLINE Held list_blocks(const Sets *sets, Workspace *w, int64_t intervals) {
    Held held = {intervals, intervals};
    for (int64_t b = 0; b < sets->blocks; b++) {
        if (w->curved.state[b] == OFF) continue;
        for (int64_t j = sets->start[b]; j < sets->start[b + 1]; j++) w->rows[held.rows++] = sets->rows[j];
    }
    return held;
}

/* Write the states of all blocks at x. */
INLINE void block_states_at(const Sets *sets, Workspace *w, const double *x, const double *gamma) {
    Curved *c = &w->curved;
    for (int64_t b = 0; b < sets->blocks; b++) {
        const BlockState found = block_state_at(sets, b, x, gamma[sets->rows[sets->start[b]]], c->reflector);
        c->state[b] = found.state, c->curvature[b] = found.curvature, c->sign[b] = found.sign;
    }
}

/* (I - h h') x, the Householder reflection of a block. */
INLINE void reflect(const double *restrict h, double *restrict x, int64_t size) {
    double product = 0.0;
    for (int64_t j = 0; j < size; j++) product += h[j] * x[j];
    for (int64_t j = 0; j < size; j++) x[j] -= product * h[j];
}

/* Turn the entries of a cone's bound and of its first direction, which is -sign n, to (1, n)/sqrt2 and (1, -n)/sqrt2
 * (up to a sign); a reflection. */
INLINE void turn(double sign, double *bound, double *first) {
    const double head = *bound, rest = sign * *first;
    *bound = ROOT_HALF * (head - rest);
    *first = -ROOT_HALF * sign * (head + rest);
}

/* W x, x the coordinates in the basis of a block. */
INLINE void from_basis(const Sets *sets, const Curved *c, int64_t block, double *x) {
    const int is_edge = c->state[block] == EDGE;
    const int64_t from = sets->start[block] + is_edge;
    if (is_edge) turn(c->sign[block], x, x + 1);
    reflect(c->reflector + from, x + is_edge, sets->start[block + 1] - from);
}

/* W'x for `count` vectors x, the entries of a block, `stride` apart; `size` is known where this is compiled, or 0. */
INLINE void reflect_each(const int size, int64_t any, const double *h, double *x, int64_t stride, int64_t count) {
    for (int64_t i = 0; i < count; i++) reflect(h, x + i * stride, size ? size : any);
}

INLINE void columns_to_basis(
    const Sets *sets, const Curved *c, int64_t block, double *x, int64_t stride, int64_t count) {
    const int is_edge = c->state[block] == EDGE;
    const int64_t from = sets->start[block] + is_edge, size = sets->start[block + 1] - from;
    const double *h = c->reflector + from;
    if (size == 2) reflect_each(2, size, h, x + is_edge, stride, count);
    else if (size == 3) reflect_each(3, size, h, x + is_edge, stride, count);
    else reflect_each(0, size, h, x + is_edge, stride, count);
    for (int64_t i = 0; is_edge && i < count; i++) turn(c->sign[block], x + i * stride, x + i * stride + 1);
}

/* W' times the rows of a block, `stride` apart, of which `width` columns are used. */
INLINE void rows_to_basis(
    const Sets *sets, const Curved *c, int64_t block, double *x, int64_t stride, int64_t width) {
    const int is_edge = c->state[block] == EDGE;
    const int64_t from = sets->start[block] + is_edge, size = sets->start[block + 1] - from;
    const double *h = c->reflector + from, sign = c->sign[block];
    double *rest = x + is_edge * stride;
    for (int64_t b = 0; b < width; b += WIDTH) {
        vec product = spread(0.0);
        for (int64_t j = 0; j < size; j++) product += spread(h[j]) * load(rest + j * stride + b);
        for (int64_t j = 0; j < size; j++)
            store(rest + j * stride + b, load(rest + j * stride + b) - product * spread(h[j]));
        if (!is_edge) continue;
        const vec head = load(x + b), first = spread(sign) * load(rest + b);
        store(x + b, spread(ROOT_HALF) * (head - first));
        store(rest + b, spread(-ROOT_HALF * sign) * (head + first));
    }
}

/* Leave the free directions of cones' boundaries out of the rotated system, in place. Return how many rows are left,
 * and write where they were. */
INLINE int64_t drop_free(const Sets *sets, Workspace *w, Held held) {
    const int64_t k = held.rows, stride = w->capacity;
    int64_t *places = w->curved.places, count = 0, p = held.intervals;
    for (int64_t i = 0; i < held.intervals; i++) places[count++] = i;
    for (int64_t b = 0; b < sets->blocks; b++) {
        const int64_t size = sets->start[b + 1] - sets->start[b];
        if (w->curved.state[b] == OFF) continue;
        for (int64_t i = w->curved.state[b] == EDGE; i < size; i++) places[count++] = p + i;
        p += size;
    }
    if (count == k) return k;
    for (int64_t i = 0; i < count; i++) { /* no row or column moves up: what is read is not yet overwritten */
        const double *from = w->U + places[i] * stride;
        double *to = w->U + i * stride;
        for (int64_t c = first_column(i, 0); c < count; c++) to[c] = from[places[c]];
        to[count] = from[k];
        for (int64_t c = count + 1; c < round_up(count + 1, BLOCK); c++) to[c] = 0.0;
    }
    return count;
}

/* Put the solution back to where the rows were, zero at those that were left out. */
INLINE void restore_free(Workspace *w, int64_t k, int64_t count) {
    if (count == k) return;
    int64_t i = count - 1;
    for (int64_t p = k - 1; p >= 0; p--) {
        const int is_there = i >= 0 && w->curved.places[i] == p;
        w->x[p] = is_there ? w->x[i] : 0.0;
        i -= is_there;
    }
}

/* Bring the gathered system to the bases of the blocks, and add the curvature. */
INLINE void rotate_system(const Sets *sets, Workspace *w, Held held) {
    const Curved *c = &w->curved;
    const int64_t k = held.rows, stride = w->capacity;
    int64_t p = held.intervals;
    for (int64_t b = 0; b < sets->blocks; b++) {
        const int64_t size = sets->start[b + 1] - sets->start[b];
        if (c->state[b] == OFF) continue;
        if (c->state[b] != WHOLE) {
            const int64_t begin = p / WIDTH * WIDTH; /* what lies left of the block is never used */
            rows_to_basis(sets, c, b, w->U + p * stride + begin, stride, round_up(k + 1, WIDTH) - begin);
            columns_to_basis(sets, c, b, w->U + p, stride, p + size);
            const int64_t tangent = p + 1 + (c->state[b] == EDGE);
            for (int64_t i = tangent; i < p + size; i++) w->U[i * stride + i] += c->curvature[b];
        }
        p += size;
    }
}

/* Solve for the multipliers of the held rows, which `x` then has in the order of `rows`, given the right-hand side by
 * row; `reach` (N) is added to the diagonal of G, and NULL is zero. Return 0 if the directions are dependent. */
INLINE int solve_held(
    const Sets *sets, Workspace *w, const double *G, const double *reach, Held held, double least) {
    const int64_t k = held.rows;
    if (reserve(w, k) < 0) return 0;
    const int64_t end = round_up(k + 1, BLOCK), *rows = w->rows;
    int64_t begin = 0, block_end = held.intervals, b = -1; /* a block is needed as a whole, not only above the diagonal */
    for (int64_t i = 0; i < k; i++) {
        double *Ui = w->U + i * w->capacity;
        const double *Gi = G + rows[i] * w->n;
        if (i < held.intervals) begin = i;
        else if (i == block_end) {
            begin = i;
            do b++;
            while (w->curved.state[b] == OFF);
            block_end += sets->start[b + 1] - sets->start[b];
        }
        for (int64_t c = begin / WIDTH * WIDTH; c < k; c++) Ui[c] = Gi[rows[c]];
        if (reach) Ui[i] += reach[rows[i]];
        Ui[k] = w->rhs[rows[i]];
        for (int64_t c = k + 1; c < end; c++) Ui[c] = 0.0;
    }
    rotate_system(sets, w, held);
    const int64_t count = drop_free(sets, w, held);
    if (!factor(w, count, 0, least)) return 0;
    substitute(w, count);
    restore_free(w, k, count);
    int64_t p = held.intervals;
    for (b = 0; b < sets->blocks; b++) {
        if (w->curved.state[b] == OFF) continue;
        if (w->curved.state[b] != WHOLE) from_basis(sets, &w->curved, b, w->x + p);
        p += sets->start[b + 1] - sets->start[b];
    }
    return 1;
}

#endif
