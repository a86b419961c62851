/* One sample whose sets are intervals, hard or priced: lam with  v = v0 - G lam,  and for every row i
 *
 *     lower_i <= v_i <= upper_i where lam_i = 0,      v_i >= upper_i where lam_i = price_i,
 *     v_i = upper_i where 0 < lam_i < price_i,        and the mirror image of both at the lower bound.
 *
 * A hard interval has an infinite price. A row is free, held at a bound, or beyond it with its multiplier at the price.
 * One sweep of coordinate descent on the multipliers gives a first guess, and the primal-dual active set method takes it
 * from there.
 */
#ifndef TORCH_DPC_PRIMAL_DUAL_H
#define TORCH_DPC_PRIMAL_DUAL_H

#include <float.h>

#include "_sets.h"

/* Sweeps of coordinate descent before the first step: one saves 0.7 of 3.5 steps on the masses, a second one none. */
enum { SWEEPS = 1 };
/* Where a row is. The sign is that of its multiplier. */
enum { FREE = 0, HELD = 1, BEYOND = 2 };

/* The problem of one sample; price is NULL if every interval is hard. */
typedef struct {
    const double *G, *v0, *lower, *upper, *price;
    const Settings *settings;
} Intervals;

INLINE double slack_at(const Settings *settings, double bound) { return settings->hysteresis * (1.0 + fabs(bound)); }

/* Copy the diagonal of G; once for all samples that share it. */
INLINE void prepare_diagonal(const Intervals *p, Workspace *w) {
    if (w->diagonal_source == p->G) return;
    w->diagonal_source = p->G;
    for (int64_t i = 0; i < w->n; i++) {
        w->diagonal[i] = p->G[i * w->n + i];
        w->inverse_diagonal[i] = w->diagonal[i] > DBL_MIN ? 1.0 / w->diagonal[i] : 0.0;
    }
}

/* Copy the bounds, and what v and lam are compared with; once for all samples that share them. */
INLINE void prepare(const Intervals *p, Workspace *w) {
    const int knows_diagonal = w->diagonal_source == p->G;
    prepare_diagonal(p, w);
    if (knows_diagonal && w->lower_source == p->lower && w->upper_source == p->upper && w->price_source == p->price) return;
    w->lower_source = p->lower, w->upper_source = p->upper, w->price_source = p->price;
    for (int64_t i = 0; i < round_up(w->n, WIDTH); i++) {
        const double lower = i < w->n ? p->lower[i] : -INFINITY, upper = i < w->n ? p->upper[i] : INFINITY;
        const double price = p->price && i < w->n ? p->price[i] : INFINITY;
        const double reach = price < INFINITY ? w->diagonal[i] * price : INFINITY;
        const int is_tight = lower == upper; /* always held */
        w->lower[i] = lower, w->upper[i] = upper, w->price[i] = price;
        w->below[i] = is_tight ? -INFINITY : lower - slack_at(p->settings, lower);
        w->above[i] = is_tight ? -INFINITY : upper + slack_at(p->settings, upper);
        w->bottom[i] = lower - reach, w->top[i] = upper + reach;
        w->from_held[i] = is_tight ? HELD + BEYOND : BEYOND - HELD;
    }
}

/* Improve lam by coordinate descent on the dual, 1/2 lam'G lam - v0'lam + (support of the box at lam), |lam| <= price,
 * and keep v = v0 - G lam. */
INLINE void coordinate_descent(const Intervals *p, Workspace *w, int sweeps) {
    const int64_t n = w->n;
    double *restrict v = w->v, *restrict lam = w->lam;
    const double *restrict lower = w->lower, *restrict upper = w->upper, *restrict price = w->price;
    for (int sweep = 0; sweep < sweeps; sweep++) {
        int moved = 0;
        for (int64_t i = 0; i < n; i++) {
            const double v_i = v[i], before = lam[i];
            if ((before == 0.0) & (v_i >= lower[i]) & (v_i <= upper[i])) continue;
            const double *restrict row = p->G + i * n;
            const double free_v = v_i + row[i] * before;
            const double wanted = (free_v - clip(free_v, lower[i], upper[i])) * w->inverse_diagonal[i];
            const double step = clip(wanted, -price[i], price[i]) - before;
            if (step == 0.0) continue;
            subtract_scaled(v, step, row, n);
            lam[i] += step;
            moved = 1;
        }
        if (!moved) return;
    }
}

/* --- the primal-dual active set method ---------------------------------------------------------------------------- */

/* Classify every row by v + lam, in `side`; return whether that repeats `before`. Hard intervals. */
INLINE int classify_hard(const Workspace *w, int64_t *side, const int64_t *before) {
    mask differ = {0};
    for (int64_t i = 0; i < w->n; i += WIDTH) {
        const vec pushed = load(w->v + i) + load(w->diagonal + i) * load(w->lam + i);
        const mask now = (mask)(pushed < load(w->below + i)) - (mask)(pushed > load(w->above + i));
        mask old;
        memcpy(&old, before + i, sizeof old);
        differ |= now ^ old;
        memcpy(side + i, &now, sizeof now);
    }
    return !any(differ);
}

/* The same for intervals with a price. A multiplier counts as the displacement that it makes alone, G_ii lam_i; a row
 * beyond its bound stays there until rounding cannot explain it. */
INLINE int classify_priced(const Settings *settings, const Workspace *w, int64_t *side, const int64_t *before) {
    mask differ = {0};
    const vec hysteresis = spread(settings->hysteresis);
    for (int64_t i = 0; i < w->n; i += WIDTH) {
        const vec v = load(w->v + i), pushed = v + load(w->diagonal + i) * load(w->lam + i);
        mask old, from_held;
        memcpy(&old, before + i, sizeof old);
        memcpy(&from_held, w->from_held + i, sizeof from_held);
        const vec slack = hysteresis * (spread(1.0) + absolute(v));
        const vec top = load(w->top + i) + negate_where((mask)(old == BEYOND), slack);
        const vec bottom = load(w->bottom + i) - negate_where((mask)(old == -BEYOND), slack);
        const mask now = (mask)(pushed < load(w->below + i)) - (mask)(pushed > load(w->above + i)) -
                         (mask)(pushed > top) - ((mask)(pushed < bottom) & from_held);
        differ |= now ^ old;
        memcpy(side + i, &now, sizeof now);
    }
    return !any(differ);
}

INLINE int classify(const Intervals *p, const Workspace *w, int64_t *side, const int64_t *before) {
    return p->price ? classify_priced(p->settings, w, side, before) : classify_hard(w, side, before);
}

INLINE int is_held(int64_t side) { return side == HELD || side == -HELD; }

/* List the held rows of `new_side`, those of before first and in their old order. Return how many, and in `same` how
 * many at the front of the list did not change. */
INLINE int64_t list_held(Workspace *w, int64_t k, int64_t *same) {
    int64_t kept = 0;
    *same = k;
    for (int64_t j = 0; j < k; j++) {
        if (is_held(w->new_side[w->rows[j]])) w->rows[kept++] = w->rows[j];
        else if (*same == k) *same = j;
    }
    if (*same > kept) *same = kept;
    for (int64_t i = 0; i < w->n; i++)
        if (is_held(w->new_side[i]) && !is_held(w->side[i])) w->rows[kept++] = i;
    return kept;
}

/* Return v0 less what the rows beyond their bounds take of it, and write their multipliers. */
INLINE const double *shifted_start(const Intervals *p, Workspace *w) {
    if (!p->price) return p->v0;
    int is_shifted = 0;
    for (int64_t i = 0; i < w->n; i++) {
        if (w->side[i] != BEYOND && w->side[i] != -BEYOND) continue;
        if (!is_shifted) memcpy(w->start, p->v0, bytes(w->n));
        is_shifted = 1;
        w->lam[i] = w->side[i] > 0 ? w->price[i] : -w->price[i];
        subtract_scaled(w->start, w->lam[i], p->G + i * w->n, w->n);
    }
    return is_shifted ? w->start : p->v0;
}

/* Solve for lam and v with the k rows listed at their bounds; the first `same` columns of U are known.
 * Return 0 if the rows are dependent. */
INLINE int hold_rows(const Intervals *p, Workspace *w, int64_t k, int64_t same) {
    memset(w->lam, 0, bytes(w->n));
    const double *start = shifted_start(p, w);
    for (int64_t j = 0; j < k; j++) {
        const int64_t i = w->rows[j];
        w->rhs[i] = start[i] - (w->side[i] > 0 ? w->upper[i] : w->lower[i]);
    }
    if (!solve_rows(w, p->G, k, same, p->settings->least_pivot)) return 0;
    subtract_rows(w->v, start, p->G, w->n, w->rows, w->x, k);
    for (int64_t j = 0; j < k; j++) w->lam[w->rows[j]] = w->x[j];
    return 1;
}

/* The primal-dual active set method (Hintermueller, Ito, Kunisch 2002) from the v and lam of the workspace.
 * Return 0 if the sets do not repeat within the steps, or rows are dependent. */
INLINE int primal_dual(const Intervals *p, Workspace *w, int64_t *steps) {
    int64_t k = 0, same = 0;
    memset(w->side, 0, bytes(w->n));
    classify(p, w, w->new_side, w->side);
    for (int64_t step = 0; step < p->settings->primal_dual_steps; step++) {
        k = list_held(w, k, &same);
        int64_t *const before = w->side;
        w->side = w->new_side, w->new_side = before;
        if (!hold_rows(p, w, k, same)) return 0;
        ++*steps;
        if (classify(p, w, w->new_side, w->side)) return 1;
    }
    return 0;
}

#endif
