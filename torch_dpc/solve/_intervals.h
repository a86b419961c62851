/* One sample whose sets are intervals, hard or priced: the primal-dual method from a first guess, and where its sets
 * cycle or its rows are dependent, the dual active set method afresh. */
#ifndef TORCH_DPC_INTERVALS_H
#define TORCH_DPC_INTERVALS_H

#include "_goldfarb_idnani.h"

/* Leave lam in the workspace; return whether it is the solution. */
INLINE int solve_intervals(const Intervals *p, Workspace *w, int64_t *steps) {
    *steps = 0;
    double total = 0.0;
    for (int64_t i = 0; i < w->n; i++) total += p->v0[i];
    memset(w->lam, 0, bytes(w->n));
    if (!isfinite(total)) return 0;
    prepare(p, w);
    memcpy(w->v, p->v0, bytes(w->n));
    coordinate_descent(p, w, SWEEPS);
    return primal_dual(p, w, steps) || goldfarb_idnani(p, w, steps);
}

#endif
