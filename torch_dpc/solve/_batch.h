/* A batch of samples, one after the other or shared by threads.
 *
 * Samples are independent and each is computed by one thread in one order: results do not depend on threads or
 * neighbours.
 */
#include "_boxes.h"

#if !defined(_WIN32)
#define HAS_THREADS 1
#include <pthread.h>
#include <stdatomic.h>
#endif

/* Samples that a thread takes at once, and how many a batch needs before a second thread is worth its start. */
enum { CHUNK = 16, ENOUGH = 96 };

typedef struct {
    int64_t count, n;
    const double *G;
    int64_t G_stride; /* 0 where all samples share one */
    const double *v, *lower, *upper; /* v0, rhs or v_bar; lower is lam_bar in `adjoint`, or NULL */
    int64_t bound_stride;
    const unsigned char *active;
    double *out;
    int64_t *steps;
    unsigned char *good;
    double hysteresis, standing_out, touching;
    int64_t max_steps;
} Batch;

INLINE void boxes_of(const Batch *b, Scratch *s, int64_t i) {
    const Boxes p = {
        b->G + i * b->G_stride,     b->v + i * b->n, b->lower + i * b->bound_stride, b->upper + i * b->bound_stride,
        b->hysteresis,              b->standing_out, b->touching, b->max_steps,
    };
    b->good[i] = (unsigned char)solve_one(&p, s, b->steps + i);
    memcpy(b->out + i * b->n, s->lam, (size_t)b->n * sizeof(double));
}

INLINE void active_of(const Batch *b, Scratch *s, int64_t i, int is_adjoint) {
    const int64_t n = b->n;
    const double *G = b->G + i * b->G_stride, *v = b->v + i * n;
    const double *lam_bar = b->lower ? b->lower + i * n : NULL;
    double *out = b->out + i * n;
    int64_t k = 0;
    for (int64_t j = 0; j < n; j++)
        if (b->active[i * n + j]) s->rows[k++] = j;
    for (int64_t j = 0; j < k; j++) {
        const int64_t row = s->rows[j];
        s->rhs[row] = is_adjoint ? (lam_bar ? lam_bar[row] : 0.0) - dot(G + row * n, v, n) : v[row];
    }
    if (is_adjoint) memcpy(out, v, (size_t)n * sizeof(double));
    else memset(out, 0, (size_t)n * sizeof(double));
    b->good[i] = make_room(s, k) >= 0 && factor(s, G, k, 0, b->standing_out);
    if (!b->good[i]) return;
    substitute(s, k);
    for (int64_t j = 0; j < k; j++) out[s->rows[j]] += s->x[j];
}

/* The bodies, and once more for processors with wider vectors; `pick` looks which this one is. */
typedef void Work(const Batch *, Scratch *, int64_t, int64_t);
#define BODIES(name, attribute)                                                                                \
    attribute static void boxes_##name(const Batch *b, Scratch *s, int64_t from, int64_t to) {                 \
        for (int64_t i = from; i < to; i++) boxes_of(b, s, i);                                                 \
    }                                                                                                          \
    attribute static void active_##name(const Batch *b, Scratch *s, int64_t from, int64_t to) {                \
        for (int64_t i = from; i < to; i++) active_of(b, s, i, 0);                                             \
    }                                                                                                          \
    attribute static void adjoint_##name(const Batch *b, Scratch *s, int64_t from, int64_t to) {               \
        for (int64_t i = from; i < to; i++) active_of(b, s, i, 1);                                             \
    }
BODIES(any, )
#if defined(__x86_64__)
BODIES(avx2, __attribute__((target("avx2,fma"))))
#endif

static Work *boxes_work = boxes_any, *active_work = active_any, *adjoint_work = adjoint_any;
static const char *widest = "any";

static void pick(void) {
#if defined(__x86_64__)
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"))
        boxes_work = boxes_avx2, active_work = active_avx2, adjoint_work = adjoint_avx2, widest = "avx2";
#endif
}

static void flag(const Batch *b, int64_t from, int64_t to) { /* no memory */
    memset(b->out + from * b->n, 0, (size_t)((to - from) * b->n) * sizeof(double));
    memset(b->good + from, 0, (size_t)(to - from));
    if (b->steps) memset(b->steps + from, 0, (size_t)(to - from) * sizeof(int64_t));
}

#ifdef HAS_THREADS
/* A job outlives the call that made it where a helper starts late; such a helper finds no sample left and touches
 * nothing but the job. The caller waits for samples that were taken, never for a thread to start. */
typedef struct {
    Batch batch;
    Work *work;
    atomic_llong taken, done;
    atomic_int users;
    pthread_mutex_t lock;
    pthread_cond_t all_done;
} Job;

static void leave(Job *job) {
    if (atomic_fetch_sub(&job->users, 1) > 1) return;
    pthread_mutex_destroy(&job->lock);
    pthread_cond_destroy(&job->all_done);
    free(job);
}

static void take_chunks(Job *job) {
    const int64_t count = job->batch.count;
    Scratch s;
    int ready = -1;
    for (;;) {
        const int64_t from = atomic_fetch_add(&job->taken, CHUNK);
        if (from >= count) break;
        const int64_t to = from + CHUNK < count ? from + CHUNK : count;
        if (ready < 0) ready = scratch_new(&s, job->batch.n);
        if (ready) job->work(&job->batch, &s, from, to);
        else flag(&job->batch, from, to);
        if (atomic_fetch_add(&job->done, to - from) + (to - from) == count) {
            pthread_mutex_lock(&job->lock);
            pthread_cond_signal(&job->all_done);
            pthread_mutex_unlock(&job->lock);
        }
    }
    if (ready >= 0) scratch_free(&s);
}

static void *help(void *job) {
    take_chunks(job);
    leave(job);
    return NULL;
}

static int run_in_threads(const Batch *batch, Work *work, int64_t threads) {
    Job *job = malloc(sizeof *job);
    if (!job) return 0;
    job->batch = *batch, job->work = work;
    atomic_init(&job->taken, 0), atomic_init(&job->done, 0), atomic_init(&job->users, 1);
    pthread_mutex_init(&job->lock, NULL);
    pthread_cond_init(&job->all_done, NULL);
    pthread_attr_t detached;
    pthread_attr_init(&detached);
    pthread_attr_setdetachstate(&detached, PTHREAD_CREATE_DETACHED);
    for (int64_t t = 1; t < threads; t++) {
        pthread_t helper;
        atomic_fetch_add(&job->users, 1);
        if (pthread_create(&helper, &detached, help, job) != 0) {
            atomic_fetch_sub(&job->users, 1);
            break;
        }
    }
    pthread_attr_destroy(&detached);
    take_chunks(job);
    pthread_mutex_lock(&job->lock);
    while (atomic_load(&job->done) < batch->count) pthread_cond_wait(&job->all_done, &job->lock);
    pthread_mutex_unlock(&job->lock);
    leave(job);
    return 1;
}
#endif

static void run(const Batch *batch, Work *work, int64_t threads) {
#ifdef HAS_THREADS
    const int64_t useful = batch->count / (ENOUGH / 2);
    if (threads > useful) threads = useful;
    if (threads > 1 && run_in_threads(batch, work, threads)) return;
#endif
    Scratch s;
    if (scratch_new(&s, batch->n)) work(batch, &s, 0, batch->count);
    else flag(batch, 0, batch->count);
    scratch_free(&s);
}
