/* The dual active set method for intervals, hard and priced (Goldfarb, Idnani 1983): slower, and finite. */
#ifndef TORCH_DPC_GOLDFARB_IDNANI_H
#define TORCH_DPC_GOLDFARB_IDNANI_H

#include "_primal_dual.h"

/* A row that moves its multiplier towards the sign `direction` until v is on `bound`, while held rows stay on theirs. */
typedef struct {
    int64_t row, direction, side; /* `side` is where it will be: HELD or -HELD */
    double bound, missing;        /* how far v is on the wrong side of the bound */
    double to_end;                /* what its multiplier may move until it reaches an end: zero, or its price */
    double slope;                 /* v of the row falls by this for each unit */
    double to_blocking;           /* units until the multiplier of a held row reaches an end */
    int64_t blocking;             /* the place of that row in the list; -1 if there is none */
} Entering;

/* What row i, which is not held, has to do; nothing is missing if it is on the right side of its bounds. */
INLINE Entering entering(const Workspace *w, int64_t i) {
    const double over = w->v[i] - w->upper[i], under = w->lower[i] - w->v[i], price = w->price[i];
    const double width = w->lower[i] == w->upper[i] ? 2.0 * price : price; /* of a multiplier's range on one side */
    if (w->side[i] == BEYOND) return (Entering){i, -1, HELD, w->upper[i], -over, width, 0.0, 0.0, -1};
    if (w->side[i] == -BEYOND) return (Entering){i, 1, -HELD, w->lower[i], -under, width, 0.0, 0.0, -1};
    if (over > under) return (Entering){i, 1, HELD, w->upper[i], over, price, 0.0, 0.0, -1};
    return (Entering){i, -1, -HELD, w->lower[i], under, price, 0.0, 0.0, -1};
}

/* Return the row with the largest violation in the metric of G, or -1 if there is none. */
INLINE int64_t most_violated(const Workspace *w, const Settings *settings) {
    int64_t found = -1;
    double most = 0.0;
    for (int64_t i = 0; i < w->n; i++) {
        if (is_held(w->side[i]) || w->skipped[i]) continue;
        const Entering e = entering(w, i);
        const double weighted = e.missing * e.missing * w->inverse_diagonal[i];
        if (!(e.missing > slack_at(settings, e.bound)) || weighted < most) continue;
        if (w->inverse_diagonal[i] == 0.0) return i;
        most = weighted, found = i;
    }
    return found;
}

/* How far the multiplier of a held row can move at a given rate before it reaches an end. */
INLINE double room_of(const Workspace *w, int64_t i, double rate) {
    const double sign = (double)w->side[i], lam = w->lam[i];
    if (rate == 0.0) return INFINITY;
    if (w->lower[i] == w->upper[i]) return fmax(w->price[i] - copysign(lam, lam * rate), 0.0) / fabs(rate);
    return fmax(rate * sign < 0.0 ? lam * sign : w->price[i] - lam * sign, 0.0) / fabs(rate);
}

/* The ratio test along x = G_AA^-1 G_Ai, by which the held multipliers fall. Return 0 if the held rows are dependent. */
INLINE int ratio_test(const Intervals *p, Workspace *w, int64_t k, int64_t same, Entering *e) {
    const double *row = p->G + e->row * w->n;
    for (int64_t j = 0; j < k; j++) w->rhs[w->rows[j]] = row[w->rows[j]];
    if (!solve_rows(w, p->G, k, same, p->settings->least_pivot)) return 0;
    e->slope = row[e->row], e->to_blocking = INFINITY, e->blocking = -1;
    for (int64_t j = 0; j < k; j++) {
        const int64_t i = w->rows[j];
        e->slope -= row[i] * w->x[j];
        const double length = room_of(w, i, -(double)e->direction * w->x[j]);
        if (length < e->to_blocking) e->to_blocking = length, e->blocking = j;
    }
    return 1;
}

/* Move all multipliers by `length` units of the entering row's. */
INLINE void advance(Workspace *w, int64_t k, Entering *e, double length) {
    const double step = length * (double)e->direction;
    for (int64_t j = 0; j < k; j++) w->lam[w->rows[j]] -= step * w->x[j];
    w->lam[e->row] += step;
    e->missing -= length * e->slope;
    e->to_end -= length;
}

/* Put a row at the end that its multiplier has reached: zero, or the price on one side. */
INLINE void put_at_end(Workspace *w, int64_t i) {
    const int is_at_price = fabs(w->lam[i]) > 0.5 * w->price[i]; /* never at an infinite price */
    w->side[i] = !is_at_price ? FREE : w->lam[i] > 0.0 ? BEYOND : -BEYOND;
    w->lam[i] = !is_at_price ? 0.0 : copysign(w->price[i], w->lam[i]);
}

INLINE int64_t remove_blocking(Workspace *w, int64_t k, const Entering *e) {
    put_at_end(w, w->rows[e->blocking]);
    memmove(w->rows + e->blocking, w->rows + e->blocking + 1, (size_t)(k - 1 - e->blocking) * sizeof(int64_t));
    return k - 1;
}

/* Move the multiplier of row i until v is on its bound and the row joins the list, or until the multiplier is at an
 * end. Return the new length of the list, and in `same` how many columns of U fit it; -1 if there is no solution, or
 * rows are dependent. */
INLINE int64_t add_row(const Intervals *p, Workspace *w, int64_t i, int64_t k, int64_t *same, int64_t *steps, int64_t most) {
    const Settings *settings = p->settings;
    Entering e = entering(w, i);
    for (int has_moved = 0; ++*steps <= most; has_moved = 1) {
        if (!ratio_test(p, w, k, *same, &e)) return -1;
        *same = k;
        const int is_dependent = !(e.slope > settings->least_pivot * w->diagonal[i]);
        if (is_dependent && !has_moved && e.missing <= settings->touching * (1.0 + fabs(e.bound))) {
            w->skipped[i] = 1; /* the held rows keep it at its bound, up to rounding */
            return k;
        }
        if (is_dependent) e.slope = 0.0;
        const double whole = is_dependent ? INFINITY : e.missing / e.slope;
        const double length = fmin(whole, fmin(e.to_blocking, e.to_end));
        if (length == INFINITY) return -1;
        if (length == whole) {
            w->rows[k++] = i;
            w->side[i] = e.side;
        } else {
            const int is_blocked = e.to_blocking <= e.to_end;
            advance(w, k, &e, length);
            if (is_blocked) {
                *same = e.blocking;
                k = remove_blocking(w, k, &e);
                continue;
            }
            put_at_end(w, i);
        }
        memset(w->skipped, 0, bytes(w->n));
        if (!hold_rows(p, w, k, *same)) return -1;
        return *same = k;
    }
    return -1;
}

/* The dual active set method (Goldfarb, Idnani 1983): slower, and finite. Rows join one by one, every multiplier stays
 * between its ends, and a row whose multiplier reaches an end leaves. Return 0 if it ends without a solution. */
INLINE int goldfarb_idnani(const Intervals *p, Workspace *w, int64_t *steps) {
    const int64_t n = w->n, most = 8 * n + 100;
    int64_t k = 0, same = 0, i;
    memcpy(w->v, p->v0, bytes(n));
    memset(w->lam, 0, bytes(n));
    memset(w->side, 0, bytes(n));
    memset(w->skipped, 0, bytes(n));
    while ((i = most_violated(w, p->settings)) >= 0)
        if ((k = add_row(p, w, i, k, &same, steps, most)) < 0) return 0;
    return 1;
}

#endif
