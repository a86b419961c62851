/* One sample whose sets are intervals, balls and cones: lam with  v = v0 - G lam,  lam = (x - P(x)) / gamma  at
 * x = v + gamma lam (_sets.h).
 *
 * Newton's method on the difference of both sides, halving its steps, takes most samples. If it stalls, or the held
 * directions are dependent, the proximal point method on the dual takes over: lam' solves the problem with G + diag reach
 * in place of G and v0 + reach lam in place of v0. It converges for every convex set that has a solution (Rockafellar
 * 1976; it is the augmented Lagrangian method of the primal). Each of its problems minimises a smooth, strongly convex
 * function, so that Newton's method with a line search solves it from everywhere (Li, Sun, Toh 2018).
 */
#ifndef TORCH_DPC_NEWTON_H
#define TORCH_DPC_NEWTON_H

#include <float.h>

#include "_held.h"
#include "_intervals.h"

typedef struct {
    const double *G, *v0;
    const Sets *sets;
    const Settings *settings;
} Problem;

/* out = base - G x, x mostly zeros. */
INLINE void subtract_product(const Problem *p, Workspace *w, double *out, const double *base, const double *x) {
    int64_t k = 0;
    for (int64_t i = 0; i < w->n; i++)
        if (x[i] != 0.0) w->curved.places[k] = i, w->curved.packed[k++] = x[i];
    subtract_rows(out, base, p->G, w->n, w->curved.places, w->curved.packed, k);
}

/* gamma: the diagonal of G, its largest entry in every block, and never too small. */
INLINE void scale_multipliers(const Sets *sets, Workspace *w) {
    double *gamma = w->curved.gamma, largest = 0.0;
    for (int64_t i = 0; i < w->n; i++) largest = fmax(largest, gamma[i] = w->diagonal[i]);
    const double least = fmax(1e-6 * largest, DBL_MIN);
    for (int64_t i = 0; i < w->n; i++) gamma[i] = fmax(gamma[i], least);
    for (int64_t b = 0; b < sets->blocks; b++) {
        double most = 0.0;
        for (int64_t j = sets->start[b]; j < sets->start[b + 1]; j++) most = fmax(most, gamma[sets->rows[j]]);
        for (int64_t j = sets->start[b]; j < sets->start[b + 1]; j++) gamma[sets->rows[j]] = most;
    }
}

/* The size of F = v - P(v + gamma lam), relative to 1 + |v|; also write x and the multipliers that follow from it. */
INLINE double residual_at(const Problem *p, Workspace *w, const double *v, const double *lam) {
    Curved *c = &w->curved;
    double squares = 0.0;
    for (int64_t i = 0; i < w->n; i++) c->pushed[i] = v[i] + c->gamma[i] * lam[i];
    multipliers_at(p->sets, w->n, c->pushed, c->gamma, c->updated);
    for (int64_t i = 0; i < w->n; i++) {
        const double F = c->gamma[i] * (c->updated[i] - lam[i]);
        squares += F * F;
    }
    return sqrt(squares) / (1.0 + sqrt(dot(v, v, w->n)));
}

/* List what is held at x and the rows beyond their price, whose multipliers are known. */
INLINE Held list_held_at(const Problem *p, Workspace *w, const double *x, const double *gamma, const double *origin) {
    const Sets *sets = p->sets;
    int64_t k = 0;
    memset(w->curved.target, 0, bytes(w->n));
    memcpy(w->start, origin, bytes(w->n));
    for (int64_t i = 0; i < w->n; i++) {
        const double lower = sets->lower[i], upper = sets->upper[i], price = sets->price[i];
        const double pull = x[i] - clip(x[i], lower, upper);
        if (fabs(pull) > gamma[i] * price) {
            w->curved.target[i] = copysign(price, pull);
            subtract_scaled(w->start, w->curved.target[i], p->G + i * w->n, w->n);
        } else if (pull != 0.0 || lower == upper) {
            w->rows[k++] = i;
        }
    }
    return list_blocks(sets, w, k);
}

/* An entry of the direction n of a ball, from the reflector (n + sign e_1) / sqrt(1 + |n_1|). */
INLINE double normal_at(const Sets *sets, const Curved *c, int64_t block, int64_t place) {
    const int64_t first = sets->start[block];
    const double n = fabs(c->reflector[first]) * c->reflector[place];
    return place == first ? n - c->sign[block] : n;
}

/* Write where Newton's step from x leads, in `target` and `v_target`, for G + diag reach and `origin` in place of v0;
 * reach may be NULL, for zero. Return 0 if the held directions are dependent. */
INLINE int newton_step(
    const Problem *p, Workspace *w, const double *x, const double *gamma, const double *reach, const double *origin) {
    const Sets *sets = p->sets;
    Curved *c = &w->curved;
    block_states_at(sets, w, x, gamma);
    const Held held = list_held_at(p, w, x, gamma, origin);
    for (int64_t j = 0; j < held.intervals; j++) {
        const int64_t i = w->rows[j];
        w->rhs[i] = w->start[i] - (x[i] > sets->upper[i] ? sets->upper[i] : sets->lower[i]);
    }
    for (int64_t b = 0; b < sets->blocks; b++) {
        for (int64_t j = sets->start[b]; j < sets->start[b + 1] && c->state[b] != OFF; j++) {
            const int64_t i = sets->rows[j];
            w->rhs[i] = w->start[i];
            if (sets->kind[b] != BALL) continue;
            w->rhs[i] -= sets->center[j];
            if (c->state[b] == ROUNDED) w->rhs[i] -= sets->radius[b] * normal_at(sets, c, b, j);
        }
    }
    if (!solve_held(sets, w, p->G, reach, held, p->settings->least_pivot)) return 0;
    for (int64_t j = 0; j < held.rows; j++) c->target[w->rows[j]] = w->x[j];
    subtract_product(p, w, c->v_target, origin, c->target);
    return 1;
}

/* Move `trial` and `v_trial` to a fraction of the way from lam and v to the target. */
INLINE void go(Workspace *w, double fraction) {
    Curved *c = &w->curved;
    for (int64_t i = 0; i < w->n; i++) {
        c->trial[i] = w->lam[i] + fraction * (c->target[i] - w->lam[i]);
        c->v_trial[i] = w->v[i] + fraction * (c->v_target[i] - w->v[i]);
    }
}

/* Newton's method on F from lam and v of the workspace. Return the size of F at the end. */
INLINE double newton(const Problem *p, Workspace *w, int64_t *steps) {
    const Settings *settings = p->settings;
    Curved *c = &w->curved;
    double size = residual_at(p, w, w->v, w->lam);
    for (int64_t step = 0; step < settings->newton_steps && size > settings->converged; step++) {
        if (!newton_step(p, w, c->pushed, c->gamma, NULL, p->v0)) break;
        ++*steps;
        double fraction = 1.0, size_trial = INFINITY;
        for (int64_t halving = 0; halving < settings->halvings; halving++, fraction *= 0.5) {
            go(w, fraction);
            size_trial = residual_at(p, w, c->v_trial, c->trial);
            if (size_trial < (1.0 - 1e-4 * fraction) * size) break;
        }
        if (!(size_trial < size)) break;
        size = size_trial;
        memcpy(w->lam, c->trial, bytes(w->n));
        memcpy(w->v, c->v_trial, bytes(w->n));
    }
    return size;
}

/* A sweep of block coordinate descent on the dual from lam = 0, which keeps v = v0 - G lam. A block takes one proximal
 * gradient step, with a bound of the largest eigenvalue of its part of G. */
INLINE void block_descent(const Problem *p, Workspace *w) {
    const Sets *sets = p->sets;
    const Intervals intervals = {p->G, p->v0, sets->lower, sets->upper, sets->price, p->settings};
    memcpy(w->v, p->v0, bytes(w->n));
    memset(w->lam, 0, bytes(w->n));
    coordinate_descent(&intervals, w, SWEEPS);
    for (int64_t b = 0; b < sets->blocks; b++) {
        double largest = DBL_MIN;
        for (int64_t j = sets->start[b]; j < sets->start[b + 1]; j++) {
            double total = 0.0;
            for (int64_t k = sets->start[b]; k < sets->start[b + 1]; k++)
                total += fabs(p->G[sets->rows[j] * w->n + sets->rows[k]]);
            largest = fmax(largest, total);
        }
        block_multipliers_at(sets, b, w->v, largest, w->lam);
        for (int64_t j = sets->start[b]; j < sets->start[b + 1]; j++) {
            const int64_t i = sets->rows[j];
            if (w->lam[i] != 0.0) subtract_scaled(w->v, w->lam[i], p->G + i * w->n, w->n);
        }
    }
}

/* --- the proximal point method ------------------------------------------------------------------------------------ */

/* The slope of the smooth function along the way to the target, from the multipliers `lam` and what follows from them. */
INLINE double slope_at(Workspace *w, const double *lam) {
    const Curved *c = &w->curved;
    double slope = 0.0;
    for (int64_t i = 0; i < w->n; i++) slope += (lam[i] - c->updated[i]) * (w->v[i] - c->v_target[i]);
    return slope;
}

/* Write the multipliers that follow from v, and return how far they are from lam, as a displacement relative to 1 + |v|. */
INLINE double update_from(const Problem *p, Workspace *w, const double *v, const double *lam) {
    Curved *c = &w->curved;
    double squares = 0.0;
    multipliers_at(p->sets, w->n, v, c->reach, c->updated);
    for (int64_t i = 0; i < w->n; i++) {
        const double change = c->gamma[i] * (c->updated[i] - lam[i]);
        squares += change * change;
    }
    return sqrt(squares) / (1.0 + sqrt(dot(v, v, w->n)));
}

/* Solve one problem of the proximal point method, from lam of the workspace; `updated` is its solution. Here v is
 * origin - G lam. Return the steps that it took. */
INLINE int64_t solve_proximal(const Problem *p, Workspace *w, double penalty) {
    const Settings *settings = p->settings;
    Curved *c = &w->curved;
    const double rounding = 10.0 * DBL_EPSILON * penalty;
    int64_t steps = 0;
    subtract_product(p, w, w->v, c->origin, w->lam);
    double left = INFINITY;
    for (int64_t stalled = 0; steps < settings->inner_steps && stalled < 3; steps++) {
        const double size = update_from(p, w, w->v, w->lam);
        if (!(size > fmax(settings->converged, rounding))) break;
        stalled = size < 0.5 * left ? 0 : stalled + (size < 100.0 * rounding);
        left = fmin(left, size);
        if (!newton_step(p, w, w->v, c->reach, c->reach, c->origin)) break;
        const double start = slope_at(w, w->lam);
        double low = 0.0, high = 1.0, fraction = 1.0;
        for (int64_t i = 0; i < settings->bisections; i++) { /* the slope grows from below zero: find its zero */
            go(w, fraction);
            update_from(p, w, c->v_trial, c->trial);
            const double slope = slope_at(w, c->trial);
            if (slope > 0.1 * fabs(start)) high = fraction;
            else if (slope < -0.5 * fabs(start) && fraction < 1.0) low = fraction;
            else break;
            fraction = 0.5 * (low + high);
        }
        memcpy(w->lam, c->trial, bytes(w->n));
        memcpy(w->v, c->v_trial, bytes(w->n));
    }
    update_from(p, w, w->v, w->lam);
    return steps;
}

/* The proximal point method from lam = 0, which leaves the best multipliers of any round, and v, in the workspace. */
INLINE void proximal_point(const Problem *p, Workspace *w, int64_t *steps) {
    const Settings *settings = p->settings;
    Curved *c = &w->curved;
    double penalty = 1.0, best = INFINITY;
    memset(w->lam, 0, bytes(w->n));
    memset(c->best, 0, bytes(w->n));
    for (int64_t round = 0, idle = 0; round < settings->rounds && idle < settings->patience; round++) {
        for (int64_t i = 0; i < w->n; i++) {
            c->reach[i] = c->gamma[i] / penalty;
            c->origin[i] = p->v0[i] + c->reach[i] * w->lam[i];
        }
        const int64_t spent = solve_proximal(p, w, penalty);
        *steps += spent;
        memcpy(w->lam, c->updated, bytes(w->n));
        subtract_product(p, w, w->v, p->v0, w->lam);
        const double size = residual_at(p, w, w->v, w->lam);
        idle = size < 0.5 * best ? 0 : idle + 1;
        if (size < best) best = size, memcpy(c->best, w->lam, bytes(w->n));
        if (best < settings->close) break;
        /* A problem that took many steps is hard enough: multipliers that move closer make the next one easier. */
        if (spent == settings->inner_steps) penalty /= settings->growth;
        else if (spent < settings->inner_steps / 2) penalty = fmin(penalty * settings->growth, settings->largest_penalty);
    }
    memcpy(w->lam, c->best, bytes(w->n));
    subtract_product(p, w, w->v, p->v0, w->lam);
}

/* Leave lam in the workspace; return whether it is the solution. */
INLINE int solve_curved(const Problem *p, Workspace *w, int64_t *steps) {
    double total = 0.0;
    *steps = 0;
    memset(w->lam, 0, bytes(w->n));
    for (int64_t i = 0; i < w->n; i++) total += p->v0[i];
    if (!isfinite(total) || !reserve_curved(w)) return 0;
    scale_multipliers(p->sets, w);
    block_descent(p, w);
    if (newton(p, w, steps) <= p->settings->good) return 1;
    proximal_point(p, w, steps);
    return newton(p, w, steps) <= p->settings->good;
}

#endif
