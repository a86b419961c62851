/* What the sets say of multipliers that were found: which rows hold the plan, and how. weakness.py has the rule. */
#ifndef TORCH_DPC_SOLUTION_H
#define TORCH_DPC_SOLUTION_H

#include "_newton.h"

/* Results for one sample. */
typedef struct {
    double *v, *missed;           /* (N): P(raw + gamma lam), and how far raw is from it, relative to 1 + |v| */
    unsigned char *weak, *active; /* (N): multipliers that count as zero; held directions */
    int64_t *counts;              /* (2): held directions; bounds that v touches with a multiplier of zero */
} Verdict;

/* Whether an interval is a point that the multiplier `pull / gamma` does not move its row from. */
INLINE int is_pinned(const Sets *sets, int64_t row, double pull, double most) {
    return sets->lower[row] == sets->upper[row] && (sets->price[row] == INFINITY || pull <= most);
}

/* Whether an interval holds its row at x = v + gamma lam. One of zero width does so without a multiplier. */
INLINE int is_row_held(const Sets *sets, int64_t row, double x, double gamma) {
    const double pull = fabs(x - clip(x, sets->lower[row], sets->upper[row]));
    const double most = gamma * sets->price[row];
    return is_pinned(sets, row, pull, most) || (pull > 0.0 && pull <= most);
}

/* List what is held at a solution, for derivatives: what is `weak` counts as free, a block if all of it is. `active`
 * says which intervals hold their row; NULL if v and lam have to. */
INLINE Held list_held_at_solution(
    const Sets *sets, Workspace *w, const double *v, const double *lam, const unsigned char *active,
    const unsigned char *weak) {
    Curved *c = &w->curved;
    int64_t k = 0;
    for (int64_t i = 0; i < w->n; i++) {
        c->pushed[i] = v[i] + c->gamma[i] * lam[i];
        const int is_bounded = sets->lower[i] > -INFINITY || sets->upper[i] < INFINITY; /* rows of blocks are not */
        const int is_held = active ? active[i] : !weak[i] && is_row_held(sets, i, c->pushed[i], c->gamma[i]);
        if (is_bounded && is_held) w->rows[k++] = i;
    }
    block_states_at(sets, w, c->pushed, c->gamma);
    for (int64_t b = 0; b < sets->blocks; b++) {
        int is_weak = 1;
        for (int64_t j = sets->start[b]; j < sets->start[b + 1]; j++) is_weak &= weak[sets->rows[j]];
        if (is_weak) c->state[b] = OFF;
    }
    return list_blocks(sets, w, k);
}

/* Judge one block: project it, make its rows weak together, mark its held directions, and count. */
INLINE void judge_block(
    const Sets *sets, Workspace *w, int64_t block, const double *raw, const double *lam, double weakness,
    const Verdict *verdict) {
    const Curved *c = &w->curved;
    const int64_t from = sets->start[block], to = sets->start[block + 1], *rows = sets->rows;
    const int is_ball = sets->kind[block] == BALL;
    int is_weak = !(is_ball && sets->radius[block] == 0.0);
    double largest = 0.0;
    for (int64_t j = from; j < to; j++) {
        const int64_t i = rows[j];
        const double v = verdict->v[i] = c->pushed[i] - c->gamma[i] * c->updated[i];
        is_weak &= fabs(lam[i] * w->diagonal[i]) <= weakness * (1.0 + fabs(v));
        largest = fmax(largest, fabs(v));
    }
    const State state = is_weak ? OFF : (State)c->state[block];
    for (int64_t j = from; j < to; j++) {
        const int64_t i = rows[j];
        verdict->missed[i] = fabs(raw[i] - verdict->v[i]) / (1.0 + largest);
        verdict->weak[i] = (unsigned char)is_weak;
        verdict->active[i] = state == WHOLE || (state != OFF && j == from); /* of a curved boundary, its normal alone */
        verdict->counts[0] += verdict->active[i];
    }
    const double bound = is_ball ? sets->radius[block] : verdict->v[rows[from]];
    const double slack = bound - distance_of(sets, block, verdict->v);
    verdict->counts[1] += is_weak && fabs(slack) <= weakness * (1.0 + largest);
}

/* Judge multipliers, given raw = v0 - G lam, computed elsewhere. */
INLINE void judge(
    const Sets *sets, Workspace *w, const double *raw, const double *lam, double weakness, const Verdict *verdict) {
    Curved *c = &w->curved;
    const int64_t n = w->n;
    verdict->counts[0] = verdict->counts[1] = 0;
    for (int64_t i = 0; i < n; i++) c->pushed[i] = raw[i] + c->gamma[i] * lam[i];
    multipliers_at(sets, n, c->pushed, c->gamma, c->updated);
    block_states_at(sets, w, c->pushed, c->gamma);
    for (int64_t i = 0; i < n; i++) { /* as if all sets were intervals */
        const double x = c->pushed[i], nearest = clip(x, sets->lower[i], sets->upper[i]);
        const double most = c->gamma[i] * sets->price[i], pull = x - nearest;
        verdict->v[i] = fabs(pull) <= most ? nearest : x - copysign(most, pull);
        const double v = verdict->v[i], reach = weakness * (1.0 + fabs(v));
        verdict->missed[i] = fabs(raw[i] - v) / (1.0 + fabs(v));
        verdict->weak[i] = fabs(lam[i] * w->diagonal[i]) <= reach && !is_pinned(sets, i, fabs(pull), most);
        verdict->active[i] = !verdict->weak[i] && is_row_held(sets, i, x, c->gamma[i]);
        verdict->counts[0] += verdict->active[i];
        verdict->counts[1] += verdict->weak[i] && fabs(fmin(v - sets->lower[i], sets->upper[i] - v)) <= reach;
    }
    for (int64_t b = 0; b < sets->blocks; b++) judge_block(sets, w, b, raw, lam, weakness, verdict);
}

#endif
