/* A batch of samples, and what each entry point does with one of them. */
#ifndef TORCH_DPC_BATCH_H
#define TORCH_DPC_BATCH_H

#include "_solution.h"

/* Numbers for every sample: `stride` after each other, or 0 if all samples share them. `data` is NULL if not given. */
typedef struct {
    const double *data;
    int64_t stride;
} Numbers;

INLINE const double *of_sample(const Numbers *numbers, int64_t i) {
    return numbers->data ? numbers->data + i * numbers->stride : NULL;
}

/* The sets of all samples, as `Sets` are those of one. */
typedef struct {
    Numbers lower, upper, price, center, radius;
    int64_t blocks;
    const int64_t *kind, *start, *rows;
} BatchSets;

/* The reduced problem, with rows of v in units of their own: v = V theta - G lam. One for all samples. */
typedef struct {
    int64_t n_theta;
    const double *V;                     /* (n, n_theta) */
    const double *per_theta;             /* (n_theta): theta in units */
    const double *moved;                 /* (n): G_ii, and what the error of the map is relative to */
    const double *unit;                  /* (n): of v, powers of two */
    double error_of_theta, error_of_lam; /* of a row of v, relative to theta and to lam in units */
    double rounding;                     /* of an entry of G, if multipliers meet no other error; else 0 */
} Map;

/* The arguments of every entry point; what one does not take stays empty. */
typedef struct {
    int64_t count, n;
    Numbers G;
    const Settings *settings;
    BatchSets sets;
    Map map;                     /* plan, plan_adjoint */
    Numbers theta;               /* (count, n_theta): plan */
    Numbers v0;                  /* solve, plan; the latter computes it if it is missing */
    Numbers rhs;                 /* solve_active, solve_held */
    Numbers v, lam;              /* solve_held: the solution; judge: lam */
    Numbers raw;                 /* judge: v0 - G lam */
    Numbers v_bar, lam_bar;      /* adjoint; lam_bar may be missing, and is then zero */
    const unsigned char *active; /* (count, n): solve_active, adjoint, plan_adjoint */
    const unsigned char *weak;   /* (count, n): solve_held, plan_adjoint */
    double *result;              /* (count, n): lam, the solution, the adjoint, or v */
    double *missed;              /* (count, n): judge */
    unsigned char *is_weak, *is_active; /* (count, n): judge, plan */
    double *result_lam;          /* (count, n): plan */
    double *info;                /* (count, 5): plan; status, iterations, residual, both counts */
    double *theta_bar;           /* (count, n_theta), or NULL: plan_adjoint */
    int64_t *counts;             /* (count, 2): judge */
    int64_t *iterations;         /* (count), or NULL */
    unsigned char *succeeded;    /* (count) */
} Batch;

INLINE Intervals intervals_of_sample(const Batch *b, int64_t i) {
    return (Intervals){
        .G = of_sample(&b->G, i),
        .v0 = of_sample(&b->v0, i),
        .lower = of_sample(&b->sets.lower, i),
        .upper = of_sample(&b->sets.upper, i),
        .price = of_sample(&b->sets.price, i),
        .settings = b->settings,
    };
}

/* The sets of a sample, its intervals from the workspace. */
INLINE Sets sets_of_sample(const Batch *b, const Workspace *w, int64_t i) {
    return (Sets){
        .lower = w->lower,
        .upper = w->upper,
        .price = w->price,
        .blocks = b->sets.blocks,
        .kind = b->sets.kind,
        .start = b->sets.start,
        .rows = b->sets.rows,
        .center = of_sample(&b->sets.center, i),
        .radius = of_sample(&b->sets.radius, i),
    };
}

/* Leave lam in the workspace; return whether it is the solution. */
INLINE int solve_one(const Batch *b, Workspace *w, int64_t i, const double *v0, int64_t *iterations) {
    Intervals intervals = intervals_of_sample(b, i);
    intervals.v0 = v0;
    if (b->sets.blocks == 0 && solve_intervals(&intervals, w, iterations)) return 1;
    if (b->sets.blocks == 0 && !intervals.price) return 0;
    prepare(&intervals, w);
    const Sets sets = sets_of_sample(b, w, i);
    return solve_curved(&(Problem){intervals.G, v0, &sets, b->settings}, w, iterations);
}

INLINE void solve_sample(const Batch *b, Workspace *w, int64_t i) {
    b->succeeded[i] = (unsigned char)solve_one(b, w, i, of_sample(&b->v0, i), b->iterations + i);
    memcpy(b->result + i * b->n, w->lam, bytes(b->n));
}

/* result = W (W'G W + diag curvature)^-1 W' rhs, W the directions that the sets hold at the solution. */
INLINE void solve_held_sample(const Batch *b, Workspace *w, int64_t i) {
    const Intervals intervals = intervals_of_sample(b, i);
    const double *G = intervals.G, *rhs = of_sample(&b->rhs, i);
    double *result = b->result + i * b->n;
    memset(result, 0, bytes(b->n));
    b->succeeded[i] = 0;
    if (!reserve_curved(w)) return;
    prepare(&intervals, w);
    const Sets sets = sets_of_sample(b, w, i);
    scale_multipliers(&sets, w);
    const Held held = list_held_at_solution(
        &sets, w, of_sample(&b->v, i), of_sample(&b->lam, i), NULL, b->weak + i * b->n);
    for (int64_t j = 0; j < held.rows; j++) w->rhs[w->rows[j]] = rhs[w->rows[j]];
    b->succeeded[i] = (unsigned char)solve_held(&sets, w, G, NULL, held, b->settings->least_pivot);
    for (int64_t j = 0; b->succeeded[i] && j < held.rows; j++) result[w->rows[j]] = w->x[j];
}

INLINE void judge_sample(const Batch *b, Workspace *w, int64_t i) {
    const Intervals intervals = intervals_of_sample(b, i);
    b->succeeded[i] = (unsigned char)reserve_curved(w);
    if (!b->succeeded[i]) return;
    prepare(&intervals, w);
    const Sets sets = sets_of_sample(b, w, i);
    scale_multipliers(&sets, w);
    const int64_t at = i * b->n;
    const Verdict verdict = {b->result + at, b->missed + at, b->is_weak + at, b->is_active + at, b->counts + 2 * i};
    judge(&sets, w, of_sample(&b->raw, i), of_sample(&b->lam, i), b->settings->weakness, &verdict);
}

/* The largest entry of |G| |lam|. Overwrites `pushed`. */
INLINE double largest_of_absolute_product(Workspace *w, const double *G) {
    double *total = w->curved.pushed, largest = 0.0;
    memset(total, 0, bytes(w->n));
    for (int64_t j = 0; j < w->n; j++) {
        if (w->lam[j] == 0.0) continue;
        for (int64_t i = 0; i < w->n; i++) total[i] += fabs(G[j * w->n + i] * w->lam[j]);
    }
    for (int64_t i = 0; i < w->n; i++) largest = total[i] > largest ? total[i] : largest;
    return largest;
}

enum { INFO = 5 };                  /* columns of `info` */
enum { SOLVED = 0, FAILED = 2 }; /* its status, as torch_dpc.Status has it */

/* Solve one sample and judge it: everything of a plan but a certificate. */
INLINE void plan_sample(const Batch *b, Workspace *w, int64_t i) {
    const Map *map = &b->map;
    const int64_t n = b->n, at = i * n;
    const double *theta = of_sample(&b->theta, i), *v0 = of_sample(&b->v0, i), *G = of_sample(&b->G, i);
    double *info = b->info + INFO * i, largest = 0.0, missed = 0.0, of_lam = 0.0;
    int64_t iterations = 0, counts[2];
    b->succeeded[i] = 0;
    if (!reserve_curved(w)) return;
    if (!v0) {
        multiply(w->v0, map->V, theta, n, map->n_theta);
        v0 = w->v0;
    }
    const int solved = solve_one(b, w, i, v0, &iterations);
    const Intervals intervals = intervals_of_sample(b, i);
    prepare(&intervals, w);
    const Sets sets = sets_of_sample(b, w, i);
    scale_multipliers(&sets, w);
    subtract_product(&(Problem){G, v0, &sets, b->settings}, w, w->v, v0, w->lam);
    const Verdict verdict = {b->result + at, w->curved.trial, b->is_weak + at, b->is_active + at, counts};
    judge(&sets, w, w->v, w->lam, b->settings->weakness, &verdict);
    for (int64_t j = 0; j < map->n_theta; j++) largest = fmax(largest, fabs(theta[j] * map->per_theta[j]));
    for (int64_t j = 0; j < n; j++) {
        missed = !(w->curved.trial[j] <= missed) ? w->curved.trial[j] : missed; /* NaN stays */
        of_lam += map->error_of_lam * fabs(w->lam[j]) * map->moved[j]; /* as if the worst row met every multiplier */
        b->result[at + j] *= map->unit[j];
        b->result_lam[at + j] = w->lam[j] / map->unit[j];
    }
    double error = map->error_of_theta * largest + of_lam;
    if (!(missed + error <= b->settings->convincing) && map->rounding > 0.0)
        error += fmin(0.0, map->rounding * largest_of_absolute_product(w, G) - of_lam);
    b->succeeded[i] = solved && missed + error <= b->settings->convincing;
    info[0] = b->succeeded[i] ? SOLVED : FAILED;
    info[1] = (double)iterations;
    info[2] = missed;
    info[3] = (double)counts[0], info[4] = (double)counts[1];
}

/* v0_bar = v_bar + S (lam_bar - G v_bar), and theta_bar = V' v0_bar; see `solve_held_sample` for S. */
INLINE void plan_adjoint_sample(const Batch *b, Workspace *w, int64_t i) {
    const Map *map = &b->map;
    const int64_t n = b->n;
    const Intervals intervals = intervals_of_sample(b, i);
    const double *G = intervals.G, *v = of_sample(&b->v, i), *lam = of_sample(&b->lam, i);
    const double *v_bar = of_sample(&b->v_bar, i), *lam_bar = of_sample(&b->lam_bar, i);
    double *v0_bar = b->result + i * n;
    b->succeeded[i] = 0;
    if (!reserve_curved(w)) return;
    prepare(&intervals, w);
    const Sets sets = sets_of_sample(b, w, i);
    scale_multipliers(&sets, w);
    double *v_units = w->curved.trial, *lam_units = w->curved.target, *bar = w->curved.v_trial;
    for (int64_t j = 0; j < n; j++) {
        v_units[j] = v[j] / map->unit[j], lam_units[j] = lam[j] * map->unit[j];
        bar[j] = v_bar[j] * map->unit[j];
    }
    const Held held = list_held_at_solution(&sets, w, v_units, lam_units, b->active + i * n, b->weak + i * n);
    for (int64_t j = 0; j < held.rows; j++) {
        const int64_t row = w->rows[j];
        w->rhs[row] = (lam_bar ? lam_bar[row] / map->unit[row] : 0.0) - dot(G + row * n, bar, n);
    }
    if (!solve_held(&sets, w, G, NULL, held, b->settings->least_pivot)) return;
    b->succeeded[i] = 1;
    for (int64_t j = 0; j < held.rows; j++) bar[w->rows[j]] += w->x[j];
    for (int64_t j = 0; j < n; j++) v0_bar[j] = bar[j] / map->unit[j];
    if (!b->theta_bar) return;
    double *theta_bar = b->theta_bar + i * map->n_theta;
    memset(theta_bar, 0, bytes(map->n_theta));
    for (int64_t j = 0; j < n; j++)
        if (bar[j] != 0.0) subtract_scaled(theta_bar, -bar[j], map->V + j * map->n_theta, map->n_theta);
}

INLINE int64_t list_active(const Batch *b, Workspace *w, int64_t i) {
    int64_t k = 0;
    for (int64_t j = 0; j < b->n; j++)
        if (b->active[i * b->n + j]) w->rows[k++] = j;
    return k;
}

/* result_A += G_AA^-1 rhs_A. */
INLINE void add_solution(const Batch *b, Workspace *w, int64_t i, int64_t k) {
    const int solved = solve_rows(w, of_sample(&b->G, i), k, 0, b->settings->least_pivot);
    b->succeeded[i] = (unsigned char)solved;
    for (int64_t j = 0; solved && j < k; j++) b->result[i * b->n + w->rows[j]] += w->x[j];
}

INLINE void solve_active_sample(const Batch *b, Workspace *w, int64_t i) {
    const double *rhs = of_sample(&b->rhs, i);
    const int64_t k = list_active(b, w, i);
    for (int64_t j = 0; j < k; j++) w->rhs[w->rows[j]] = rhs[w->rows[j]];
    memset(b->result + i * b->n, 0, bytes(b->n));
    add_solution(b, w, i, k);
}

INLINE void adjoint_sample(const Batch *b, Workspace *w, int64_t i) {
    const double *G = of_sample(&b->G, i), *v_bar = of_sample(&b->v_bar, i), *lam_bar = of_sample(&b->lam_bar, i);
    const int64_t k = list_active(b, w, i);
    for (int64_t j = 0; j < k; j++) {
        const int64_t row = w->rows[j];
        w->rhs[row] = (lam_bar ? lam_bar[row] : 0.0) - dot(G + row * b->n, v_bar, b->n);
    }
    memcpy(b->result + i * b->n, v_bar, bytes(b->n));
    add_solution(b, w, i, k);
}

#endif
