/* A batch of samples, one after the other or shared by threads.
 *
 * Samples are independent, and each is computed by one thread in one order: a result depends neither on the number of
 * threads nor on the other samples.
 */
#ifndef TORCH_DPC_BATCH_H
#define TORCH_DPC_BATCH_H

#include "_solution.h"

#if !defined(_WIN32)
#define HAS_THREADS 1
#include <pthread.h>
#include <stdatomic.h>
#endif

/* Samples that a thread takes at once, and samples for each thread that make it worth its start. */
enum { CHUNK = 16, SAMPLES_PER_THREAD = 48 };

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

enum { INFO = 5 };                  /* columns of `info` */
enum { SOLVED = 0, FAILED = 2 }; /* its status, as torch_dpc.Status has it */

/* Solve one sample and judge it: everything of a plan but a certificate. */
INLINE void plan_sample(const Batch *b, Workspace *w, int64_t i) {
    const Map *map = &b->map;
    const int64_t n = b->n, at = i * n;
    const double *theta = of_sample(&b->theta, i), *v0 = of_sample(&b->v0, i), *G = of_sample(&b->G, i);
    double *info = b->info + INFO * i, largest = 0.0, error, missed = 0.0;
    int64_t iterations = 0, counts[2];
    b->succeeded[i] = 0;
    if (!reserve_curved(w)) return;
    if (!v0) {
        for (int64_t j = 0; j < n; j++) w->v0[j] = dot(map->V + j * map->n_theta, theta, map->n_theta);
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
    error = map->error_of_theta * largest;
    for (int64_t j = 0; j < n; j++) {
        missed = !(w->curved.trial[j] <= missed) ? w->curved.trial[j] : missed; /* NaN stays */
        error += map->error_of_lam * fabs(w->lam[j]) * map->moved[j];
        b->result[at + j] *= map->unit[j];
        b->result_lam[at + j] = w->lam[j] / map->unit[j];
    }
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

/* --- the same code for several instruction sets ------------------------------------------------------------------- */

typedef void Work(const Batch *, Workspace *, int64_t from, int64_t to);

#define FOR_SAMPLES(name, sample, attribute)                                                 \
    attribute static void name(const Batch *b, Workspace *w, int64_t from, int64_t to) {     \
        for (int64_t i = from; i < to; i++) sample(b, w, i);                                 \
    }
#define ENTRY_POINTS(instructions, attribute)                                  \
    FOR_SAMPLES(solve_##instructions, solve_sample, attribute)                 \
    FOR_SAMPLES(solve_held_##instructions, solve_held_sample, attribute)       \
    FOR_SAMPLES(judge_##instructions, judge_sample, attribute)                 \
    FOR_SAMPLES(plan_##instructions, plan_sample, attribute)                   \
    FOR_SAMPLES(plan_adjoint_##instructions, plan_adjoint_sample, attribute)   \
    FOR_SAMPLES(solve_active_##instructions, solve_active_sample, attribute)   \
    FOR_SAMPLES(adjoint_##instructions, adjoint_sample, attribute)

ENTRY_POINTS(any, )
#if defined(__x86_64__)
ENTRY_POINTS(avx2, __attribute__((target("avx2,fma"))))
#endif

static Work *solve_work = solve_any, *solve_held_work = solve_held_any, *judge_work = judge_any;
static Work *plan_work = plan_any, *plan_adjoint_work = plan_adjoint_any;
static Work *solve_active_work = solve_active_any, *adjoint_work = adjoint_any;
static const char *instructions = "any";

static void choose_instructions(void) {
#if defined(__x86_64__)
    __builtin_cpu_init();
    if (!__builtin_cpu_supports("avx2") || !__builtin_cpu_supports("fma")) return;
    solve_work = solve_avx2, solve_held_work = solve_held_avx2, judge_work = judge_avx2;
    plan_work = plan_avx2, plan_adjoint_work = plan_adjoint_avx2;
    solve_active_work = solve_active_avx2, adjoint_work = adjoint_avx2;
    instructions = "avx2";
#endif
}

/* --- threads ------------------------------------------------------------------------------------------------------ */

/* Without memory: zeros, and no sample has succeeded. */
static void mark_failed(const Batch *b, int64_t from, int64_t to) {
    memset(b->result + from * b->n, 0, bytes((to - from) * b->n));
    memset(b->succeeded + from, 0, (size_t)(to - from));
    if (b->iterations) memset(b->iterations + from, 0, bytes(to - from));
}

#ifdef HAS_THREADS
/* A job is freed by its last user: a helper may start after the call that made the job has returned. Such a helper
 * finds no sample left, and reads nothing but the job. The caller waits for samples, never for a thread to start. */
typedef struct {
    Batch batch;
    Work *work;
    atomic_llong taken, done; /* samples */
    atomic_int users;
    pthread_mutex_t lock;
    pthread_cond_t all_done;
} Job;

static void release_job(Job *job) {
    if (atomic_fetch_sub(&job->users, 1) > 1) return;
    pthread_mutex_destroy(&job->lock);
    pthread_cond_destroy(&job->all_done);
    free(job);
}

static void take_chunks(Job *job) {
    const int64_t count = job->batch.count;
    Workspace w;
    int has_tried = 0, has_memory = 0;
    for (;;) {
        const int64_t from = atomic_fetch_add(&job->taken, CHUNK);
        if (from >= count) break;
        const int64_t to = from + CHUNK < count ? from + CHUNK : count;
        if (!has_tried) has_memory = new_workspace(&w, job->batch.n), has_tried = 1;
        if (has_memory) job->work(&job->batch, &w, from, to);
        else mark_failed(&job->batch, from, to);
        if (atomic_fetch_add(&job->done, to - from) + (to - from) == count) {
            pthread_mutex_lock(&job->lock);
            pthread_cond_signal(&job->all_done);
            pthread_mutex_unlock(&job->lock);
        }
    }
    if (has_tried) free_workspace(&w);
}

static void *help(void *job) {
    take_chunks(job);
    release_job(job);
    return NULL;
}

static void start_helpers(Job *job, int64_t helpers) {
    pthread_attr_t detached;
    pthread_attr_init(&detached);
    pthread_attr_setdetachstate(&detached, PTHREAD_CREATE_DETACHED);
    while (helpers-- > 0) {
        pthread_t helper;
        atomic_fetch_add(&job->users, 1);
        if (pthread_create(&helper, &detached, help, job) != 0) {
            atomic_fetch_sub(&job->users, 1);
            break;
        }
    }
    pthread_attr_destroy(&detached);
}

/* Return 0 without memory for the job. */
static int run_in_threads(const Batch *batch, Work *work, int64_t threads) {
    Job *job = malloc(sizeof *job);
    if (!job) return 0;
    job->batch = *batch, job->work = work;
    atomic_init(&job->taken, 0), atomic_init(&job->done, 0), atomic_init(&job->users, 1);
    pthread_mutex_init(&job->lock, NULL);
    pthread_cond_init(&job->all_done, NULL);
    start_helpers(job, threads - 1);
    take_chunks(job);
    pthread_mutex_lock(&job->lock);
    while (atomic_load(&job->done) < batch->count) pthread_cond_wait(&job->all_done, &job->lock);
    pthread_mutex_unlock(&job->lock);
    release_job(job);
    return 1;
}
#endif

static void run(const Batch *batch, Work *work, int64_t threads) {
#ifdef HAS_THREADS
    const int64_t useful = batch->count / SAMPLES_PER_THREAD;
    if (threads > useful) threads = useful;
    if (threads > 1 && run_in_threads(batch, work, threads)) return;
#else
    (void)threads;
#endif
    Workspace w;
    if (new_workspace(&w, batch->n)) work(batch, &w, 0, batch->count);
    else mark_failed(batch, 0, batch->count);
    free_workspace(&w);
}

#endif
