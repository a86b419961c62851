/* The solve of one sample for boxes: lam with  v = v0 - G lam = Proj(v + lam).
 *
 * A sweep of coordinate descent on the multipliers finds a first set of active rows, and the primal-dual active set
 * method goes on from there; where its sets cycle, or depend on each other, the dual active set method begins anew.
 */
#include <float.h>
#include <math.h>

#include "_system.h"

/* Sweeps of coordinate descent before the first step: one leaves 2.8 steps a sample of the masses of 3.5. */
enum { SWEEPS = 1 };

INLINE double clip(double x, double lower, double upper) { return x > upper ? upper : x < lower ? lower : x; }

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
        const mask now = (mask)(pushed < load(s->below + i)) - (mask)(pushed > load(s->above + i));
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

/* What raising the multiplier of a row does, towards `sign`. */
typedef struct {
    double own;      /* v of the row falls by this for each unit */
    double shortest; /* so far, until a multiplier of the list comes to zero */
    int64_t leaves;  /* whose, by its place in the list */
} Way;

/* Look from row i along x = G_AA^-1 G_Ai, by which the multipliers of the list fall; 0 where G is not to be trusted. */
INLINE int look(const Boxes *p, Scratch *s, int64_t i, int64_t sign, int64_t k, int64_t same, Way *way) {
    const double *row = p->G + i * s->n;
    for (int64_t j = 0; j < k; j++) s->rhs[s->rows[j]] = row[s->rows[j]];
    const int kept = make_room(s, k + 1);
    if (kept < 0 || !factor(s, p->G, k, kept ? same : 0, p->standing_out)) return 0;
    substitute(s, k);
    *way = (Way){row[i], INFINITY, -1};
    for (int64_t j = 0; j < k; j++) {
        const int64_t other = s->rows[j];
        way->own -= row[other] * s->x[j];
        const double falls = (double)(sign * s->side[other]) * s->x[j];
        if (!(falls > 0.0) || s->lower[other] == s->upper[other]) continue; /* tight: either sign will do */
        const double length = fmax(s->lam[other] * (double)s->side[other], 0.0) / falls;
        if (length < way->shortest) way->shortest = length, way->leaves = j;
    }
    return 1;
}

/* Let row i join the list: raise its multiplier until v is on the bound. Return the new length of the list, with `same`
 * how many columns of U fit it; -1 where nothing can give way, or no system is to be trusted. */
INLINE int64_t join(const Boxes *p, Scratch *s, int64_t i, int64_t k, int64_t *same, int64_t *steps, int64_t most_steps) {
    const int64_t n = s->n, sign = s->v[i] > s->upper[i] ? 1 : -1;
    const double bound = sign > 0 ? s->upper[i] : s->lower[i], length_of_row = p->G[i * n + i];
    double missing = fabs(s->v[i] - bound);
    while (++*steps <= most_steps) {
        Way way;
        if (!look(p, s, i, sign, k, *same, &way)) return -1;
        *same = k;
        const int dependent = !(way.own > p->standing_out * p->standing_out * length_of_row);
        if (dependent && s->lam[i] == 0.0 && missing <= p->touching * (1.0 + fabs(bound))) {
            s->next[i] = 1; /* the others hold it there, up to rounding */
            return k;
        }
        const double whole = dependent ? INFINITY : missing / way.own, length = fmin(whole, way.shortest);
        if (length == INFINITY) return -1;
        if (whole <= way.shortest) {
            s->rows[k++] = i;
            s->side[i] = sign;
            memset(s->next, 0, (size_t)n * sizeof(int64_t));
            if (!resolve(p, s, k, *same)) return -1;
            return *same = k;
        }
        for (int64_t j = 0; j < k; j++) s->lam[s->rows[j]] -= length * (double)sign * s->x[j];
        s->lam[i] += length * (double)sign;
        if (!dependent) missing -= length * way.own;
        s->lam[s->rows[way.leaves]] = 0.0;
        s->side[s->rows[way.leaves]] = 0;
        k--;
        memmove(s->rows + way.leaves, s->rows + way.leaves + 1, (size_t)(k - way.leaves) * sizeof(int64_t));
        *same = way.leaves;
    }
    return -1;
}

/* The dual active set method (Goldfarb, Idnani 1983), slower and finite: rows join one by one, each multiplier keeps its
 * sign, and a row whose multiplier comes to zero on the way is let go. 0 where it ends without a solution. */
INLINE int climb(const Boxes *p, Scratch *s, int64_t *steps) {
    const int64_t n = s->n, most_steps = 8 * n + 100;
    int64_t k = 0, same = 0, i;
    memcpy(s->v, p->v0, (size_t)n * sizeof(double));
    memset(s->lam, 0, (size_t)n * sizeof(double));
    memset(s->side, 0, (size_t)n * sizeof(int64_t));
    memset(s->next, 0, (size_t)n * sizeof(int64_t));
    while ((i = furthest(s, p->hysteresis)) >= 0)
        if ((k = join(p, s, i, k, &same, steps, most_steps)) < 0) return 0;
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
