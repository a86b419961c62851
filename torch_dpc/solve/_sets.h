/* The sets of one sample: intervals on rows, Euclidean balls and second-order cones on blocks of rows.
 *
 * For a scale gamma > 0 of the multipliers, one number in each block, and x = v + gamma lam, a solution satisfies
 * lam = (x - P(x)) / gamma, P the projection on the set (the proximal map of a price): `multipliers_at`.
 *
 * The Jacobian of P says which directions of a block are held, and how the boundary is curved there. In an orthonormal
 * basis W of the held directions,  lam = W y,  W'v = (a constant) + diag(curvature) y:
 *
 *     ball, boundary    n and the tangents      curvature 0 along n, gamma r / (|x - c| - r) along the tangents
 *     cone, boundary    (1, -n)/sqrt2, tangents curvature 0, gamma (s + h) / (s - h);  (1, n)/sqrt2 is free
 *     cone, apex        all                     curvature 0
 *
 * h and s are the first entry of x and the norm of the others, n their direction. W is a Householder reflection.
 */
#ifndef TORCH_DPC_SETS_H
#define TORCH_DPC_SETS_H

#include <math.h>

#include "_settings.h"
#include "_system.h"

enum { BALL = 1, CONE = 2 }; /* kinds of blocks */
typedef enum { OFF, WHOLE, ROUNDED, EDGE } State; /* free; point or apex; boundary of a ball; boundary of a cone */

typedef struct {
    const double *lower, *upper, *price; /* (N) */
    int64_t blocks;
    const int64_t *kind;   /* (blocks) */
    const int64_t *start;  /* (blocks + 1) into `rows` */
    const int64_t *rows;   /* the rows of every block; of a cone, the bound of the others first */
    const double *center;  /* by place in `rows`; of balls */
    const double *radius;  /* (blocks); of balls */
} Sets;

/* A block at a point. */
typedef struct {
    State state;
    double curvature; /* along the tangents */
    double sign;      /* of the first entry of n */
} BlockState;

INLINE double clip(double x, double lower, double upper) { return x > upper ? upper : x < lower ? lower : x; }

/* The distance of a block of x from the center of its ball; for a cone, the norm of all entries but the first. */
INLINE double distance_of(const Sets *sets, int64_t block, const double *x) {
    const int is_ball = sets->kind[block] == BALL;
    double squares = 0.0;
    for (int64_t j = sets->start[block] + !is_ball; j < sets->start[block + 1]; j++) {
        const double away = x[sets->rows[j]] - (is_ball ? sets->center[j] : 0.0);
        squares += away * away;
    }
    return sqrt(squares);
}

/* Write (x - P(x)) / gamma of one block. */
INLINE void block_multipliers_at(const Sets *sets, int64_t block, const double *x, double gamma, double *lam) {
    const int64_t from = sets->start[block], to = sets->start[block + 1], *rows = sets->rows;
    const double distance = distance_of(sets, block, x);
    if (sets->kind[block] == BALL) {
        const double radius = sets->radius[block];
        const double fraction = distance > radius ? (1.0 - radius / distance) / gamma : 0.0;
        for (int64_t j = from; j < to; j++) lam[rows[j]] = fraction * (x[rows[j]] - sets->center[j]);
        return;
    }
    const double head = x[rows[from]];
    double of_head = 0.0, of_rest = 0.0; /* lam as multiples of x */
    if (distance <= -head) of_head = of_rest = 1.0 / gamma;
    else if (distance > head) {
        lam[rows[from]] = 0.5 * (head - distance) / gamma;
        of_rest = 0.5 * (1.0 - head / distance) / gamma;
        for (int64_t j = from + 1; j < to; j++) lam[rows[j]] = of_rest * x[rows[j]];
        return;
    }
    lam[rows[from]] = of_head * head;
    for (int64_t j = from + 1; j < to; j++) lam[rows[j]] = of_rest * x[rows[j]];
}

/* Write (x - P(x)) / gamma for all rows. */
INLINE void multipliers_at(const Sets *sets, int64_t n, const double *x, const double *gamma, double *lam) {
    for (int64_t i = 0; i < n; i++) {
        const double pull = x[i] - clip(x[i], sets->lower[i], sets->upper[i]), price = sets->price[i];
        lam[i] = clip(pull / gamma[i], -price, price);
    }
    for (int64_t b = 0; b < sets->blocks; b++) block_multipliers_at(sets, b, x, gamma[sets->rows[sets->start[b]]], lam);
}

/* Return which directions of a block are held at x, and write the reflector of its basis, by place in `rows`. */
INLINE BlockState block_state_at(const Sets *sets, int64_t block, const double *x, double gamma, double *reflector) {
    const int is_ball = sets->kind[block] == BALL;
    const int64_t from = sets->start[block] + !is_ball, to = sets->start[block + 1];
    const double distance = distance_of(sets, block, x);
    BlockState found = {ROUNDED, 0.0, 1.0};
    if (is_ball) {
        const double radius = sets->radius[block];
        if (radius == 0.0) return (BlockState){WHOLE, 0.0, 1.0};
        if (!(distance > radius)) return (BlockState){OFF, 0.0, 1.0};
        found.curvature = gamma * radius / (distance - radius);
    } else {
        const double head = x[sets->rows[from - 1]];
        if (distance <= head) return (BlockState){OFF, 0.0, 1.0};
        if (distance <= -head) return (BlockState){WHOLE, 0.0, 1.0};
        found.state = EDGE;
        found.curvature = gamma * (distance + head) / (distance - head);
    }
    /* h = (n + sign e_1) / sqrt(1 + |n_1|): I - h h' maps e_1 to -sign n. */
    const double first = (x[sets->rows[from]] - (is_ball ? sets->center[from] : 0.0)) / distance;
    const double scale = 1.0 / sqrt(1.0 + fabs(first));
    found.sign = first < 0.0 ? -1.0 : 1.0;
    reflector[from] = (first + found.sign) * scale;
    for (int64_t j = from + 1; j < to; j++)
        reflector[j] = (x[sets->rows[j]] - (is_ball ? sets->center[j] : 0.0)) * (scale / distance);
    return found;
}

#endif
