/* Tolerances and limits; kernels.py says why they have their values. */
#ifndef TORCH_DPC_SETTINGS_H
#define TORCH_DPC_SETTINGS_H

#include <stdint.h>

typedef struct {
    double hysteresis;         /* v + lam must pass a bound by this, relative to 1 + |bound|, for its row to be held */
    double least_pivot;        /* directions count as independent if every pivot is above this times its diagonal entry */
    double touching;           /* a row that depends on held rows may miss its bound by this, relative to 1 + |bound| */
    int64_t primal_dual_steps; /* before the dual method takes over */
    double converged;          /* |F| relative to 1 + |v| at which Newton's method ends */
    double good;               /* and at which its result is a solution */
    double close;              /* and at which the proximal point method ends */
    int64_t newton_steps;      /* on F */
    int64_t halvings;          /* of one of them */
    int64_t rounds;            /* of the proximal point method */
    int64_t patience;          /* rounds that it may go on without halving |F| */
    int64_t inner_steps;       /* Newton steps in a round */
    int64_t bisections;        /* of one of them */
    double growth;             /* of the penalty from round to round */
    double largest_penalty;    /* gamma / reach */
    double weakness;           /* displacements and distances up to this, relative to 1 + |v|, count as zero */
    double convincing;         /* the residual of a plan, and the error of the map, that need no second look */
} Settings;

#endif
