/* The rows of a table whose keys are nearest to that of each sample, in order.
 *
 * Expects the macros N_IN, N_KEY, TILE, STEPS and LARGEST; the step is the function that makes a key.
 */
#include <math.h>

typedef struct {
  const double **inputs;       /* first sample of each input */
  const int64_t *input_steps;  /* doubles from one sample to the next, 0 = the same for all */
  const float *tiles;          /* (tiles, N_KEY, TILE) rounded keys of the table */
  int64_t *found;              /* (count, wanted) */
  int64_t rows;                /* of the table */
  int64_t wanted;
  int64_t count;               /* samples */
  int64_t next;                /* first sample not yet done */
  double slice;                /* [s] after which Python gets a look at its signals */
} lookup_job;

/* Rows side by side: a vector of gcc and clang, which they cut to what the machine has. */
#define LANES 8
typedef float lanes __attribute__((vector_size(LANES * sizeof(float))));

static inline float least(const float *values) {
  float found = values[0];
  int j;
  for (j = 1; j < TILE; ++j) found = values[j] < found ? values[j] : found;
  return found;
}

/* |row - key|^2 over the known entries, without the part that all rows share. */
static inline __attribute__((always_inline)) void measure(
    const lookup_job *job, const double *key, float *distance) {
  float twice[N_KEY];
  int known[N_KEY], count = 0, i;
  int64_t start;
  for (i = 0; i < N_KEY; ++i) {
    if (key[i] != key[i]) continue;
    twice[count] = 2 * (float) fmax(fmin(rint(key[i] * STEPS), LARGEST), -LARGEST);
    known[count++] = i * TILE;
  }
  for (start = 0; start < job->rows; start += TILE) {
    const float *tile = job->tiles + start * N_KEY;
    lanes low = {0}, high = {0}, a, b;
    for (i = 0; i < count; ++i) {
      memcpy(&a, tile + known[i], sizeof a);
      memcpy(&b, tile + known[i] + LANES, sizeof b);
      low += a * (a - twice[i]);
      high += b * (b - twice[i]);
    }
    memcpy(distance + start, &low, sizeof low);
    memcpy(distance + start + LANES, &high, sizeof high);
  }
}

static void measure_anywhere(const lookup_job *job, const double *key, float *distance) {
  measure(job, key, distance);
}

#if defined(__x86_64__)
__attribute__((target("avx2")))
static void measure_avx2(const lookup_job *job, const double *key, float *distance) {
  measure(job, key, distance);
}
#endif

/* The nearest one after the other, of equals the first: the tile it is in, then the row. */
static void choose(const lookup_job *job, float *distance, float *nearest, int64_t *found) {
  const int64_t tiles = (job->rows + TILE - 1) / TILE;
  int64_t i, j, place;
  for (j = job->rows; j < tiles * TILE; ++j) distance[j] = INFINITY;
  for (i = 0; i < tiles; ++i) nearest[i] = least(distance + i * TILE);
  for (place = 0; place < job->wanted; ++place) {
    int64_t best = 0;
    float *tile;
    for (i = 1; i < tiles; ++i) best = nearest[i] < nearest[best] ? i : best;
    tile = distance + best * TILE;
    for (j = 0; tile[j] > nearest[best]; ++j) {}
    found[place] = best * TILE + j;
    tile[j] = INFINITY;
    nearest[best] = least(tile);
  }
}

EXPORT int casadi_ik_lookup(lookup_job *job) {
  workspace space;
  int outcome = set_up(&space, N_KEY + 2 * (job->rows + TILE));
  int64_t ticks = 0;
  double limit = 0;
  int i;
  float *distance, *nearest;
  void (*measured)(const lookup_job *, const double *, float *) = measure_anywhere;
  if (outcome != DONE) return outcome;
  distance = (float *) (space.extra + N_KEY);
  nearest = distance + job->rows + TILE;
#if defined(__x86_64__)
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx2")) measured = measure_avx2;
#endif
  if (job->count - job->next > CLOCK_INTERVAL) limit = monotonic() + job->slice;
  for (; job->next < job->count; ++job->next) {
    if (++ticks % CLOCK_INTERVAL == 0 && monotonic() > limit) {
      outcome = SLICE_OVER;
      break;
    }
    for (i = 0; i < N_IN; ++i) space.arg[i] = job->inputs[i] + job->next * job->input_steps[i];
    space.res[0] = space.extra;
    if (STEP(space.arg, space.res, space.iw, space.w, space.mem)) {
      outcome = STEP_FAILED;
      break;
    }
    measured(job, space.extra, distance);
    choose(job, distance, nearest, job->found + job->next * job->wanted);
  }
  give_back(&space);
  return outcome;
}
