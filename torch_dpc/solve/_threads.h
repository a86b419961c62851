/* A batch of samples, one after the other or shared by threads.
 *
 * Samples are independent, and each is computed by one thread in one order: a result depends neither on the number of
 * threads nor on the other samples.
 */
#ifndef TORCH_DPC_THREADS_H
#define TORCH_DPC_THREADS_H

#include "_batch.h"

#if !defined(_WIN32)
#define HAS_THREADS 1
#include <pthread.h>
#include <stdatomic.h>
#endif

/* Samples that a thread takes at once, and samples for each thread that make it worth its start. */
enum { CHUNK = 16, SAMPLES_PER_THREAD = 48 };

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
#if defined(__x86_64__) && !defined(TORCH_DPC_PLAIN)
ENTRY_POINTS(avx2, __attribute__((target("avx2,fma"))))
#endif

static Work *solve_work = solve_any, *solve_held_work = solve_held_any, *judge_work = judge_any;
static Work *plan_work = plan_any, *plan_adjoint_work = plan_adjoint_any;
static Work *solve_active_work = solve_active_any, *adjoint_work = adjoint_any;
static const char *instructions = "any";

static void choose_instructions(void) {
#if defined(__x86_64__) && !defined(TORCH_DPC_PLAIN)
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
