/* Search for the preferred collision-free arms at given palm poses.
 *
 * An arm is one configuration of the arm's joints; a hand is one row of the input: a palm pose with
 * a hand posture. All arms in closed form, at given samples of the redundancy (swivel angle, swept
 * joint), are sorted by the preference, and `lanes` of them at a time are checked for collisions
 * until one is free. The redundancy is then refined around that sample, on the same branch. If no
 * arm is collision-free, a second level of samples is tried before the next hand.
 *
 * The compiled kernels are called through pointers. The file is compiled after the code that
 * declares `scalar`, `map_job` and `clearance_job`. A freestanding solver (FREESTANDING) defines
 * how kernels are declared and called (KERNEL, CALL), how zeroed memory is allocated and released
 * (ROOM, GIVE_BACK), and the member of a job that points to its static memory (OWN_MEMORY).
 */
#include <math.h>
#include <stdint.h>
#include <string.h>

#ifndef FREESTANDING
#include <stdlib.h>
#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif
enum { DONE = 0, SLICE_OVER = 1, NO_MEMORY = -1 };
#define KERNEL(name, work) int (*name)(work *)
#define CALL(kernel, work) kernel(work)
#define ROOM(bytes) calloc(bytes, 1)
#define GIVE_BACK(block) free(block)
#define OWN_MEMORY
#endif

/* Preferences, the values of `order`. */
enum { FAR_FROM_LIMITS, NEAR_START, MEASURED, CLEAREST };
/* Numbers of a palm pose in the input of `arms`: rotation and origin. */
enum { PALM = 12, LEVELS = 2 };

#define FULL_TURN (scalar) 6.283185307179586

typedef struct {
  KERNEL(arms, map_job);       /* rotation, origin, redundancy -> n_rows arms, a branch each,
                                  and their reach margins; negative: no arm */
  KERNEL(measure, map_job);    /* q -> score, higher is better; for MEASURED */
  KERNEL(check, clearance_job);
  clearance_job *clearance;    /* pairs to check; NULL: none */
  int64_t lanes;               /* number of configurations that are checked together */
  int64_t order;               /* preference */
  int64_t n_q, n_arm, n_redundancy, n_rows;
  int64_t n_groups;            /* 1: return the best arm; n_rows + 1: the best arm of every
                                  branch, and the arm in q as a group of its own */
  int64_t n_samples[LEVELS], n_offsets;
  const scalar *samples[LEVELS]; /* rows of n_redundancy; a refinement varies the last column */
  const scalar *offsets;       /* of the refinement around the chosen sample */
  const int64_t *columns;      /* of the arm in q */
  const scalar *lower, *upper; /* bounds of the arm, which are enforced */
  const scalar *low, *range;   /* joint limits of the arm, used in scores only */
  const scalar *q, *palms, *starts; /* rows of n_q, 16 and n_q */
  const int64_t *owner;        /* number of the target of each hand; the hands of a target are
                                  contiguous, and after its first hand with an arm the rest are
                                  skipped; NULL: no hand is skipped */
  const scalar *clearance_bounds; /* of each hand: upper bound of the clearance of its arms */
  const scalar *poses;         /* poses of the movable solids of the scene */
  int64_t pose_step;           /* numbers from the poses of a hand to those of the next;
                                  0: all hands share them */
  scalar margin, rounding;     /* required clearance, and the allowed rounding error below it */
  scalar min_limit_margin;     /* smallest distance of a joint from its bounds; a negative one
                                  allows for rounding errors */
  int64_t count;
  scalar *best_arms;            /* rows of n_groups arms */
  scalar *score;               /* rows of n_groups: score; -inf: no arm. With CLEAREST it is the
                                  clearance minus `margin` */
  int64_t *arms_tried;             /* number of arms within bounds */
  OWN_MEMORY
} arm_search_job;

/* Candidate arms and their scores. */
typedef struct {
  int64_t count;
  scalar *arms, *score;
  int64_t *arm, *sample, *group; /* offset in `arms`, row of the samples, branch or the group
                                  of the given arm */
  char *used;
} pool;

typedef struct {
  pool all, local;
  scalar *samples, *rows, *least;
  int64_t *closest, *picked;
} scratch;

static int64_t max_pool_size(const arm_search_job *job, int is_local) {
  int64_t samples = is_local ? job->n_offsets : job->n_samples[0];
  if (!is_local && job->n_samples[1] > samples) samples = job->n_samples[1];
  return samples * job->n_rows + 1;
}

static int64_t max_arms(const arm_search_job *job) {
  return max_pool_size(job, 0) > max_pool_size(job, 1) ? max_pool_size(job, 0)
                                                       : max_pool_size(job, 1);
}

/* Return the bytes of the scratch memory: the sum of the sizes in lay_out. */
static size_t scratch_size(const arm_search_job *job) {
  const int64_t width = job->n_arm + 1, most = max_arms(job);
  const int64_t integers = 6 * most + 2 * job->lanes;
  const int64_t numbers = 2 * most * (width + 1) + most * (PALM + job->n_redundancy)
                        + (most + job->lanes) * job->n_q + job->lanes;
  return (size_t) integers * sizeof(int64_t) + (size_t) numbers * sizeof(scalar)
       + 2 * (size_t) most;
}

static void lay_out(const arm_search_job *job, scratch *space, char *next) {
  const int64_t width = job->n_arm + 1, most = max_arms(job);
  pool *pools[] = {&space->all, &space->local};
  int i;
#define TAKE(pointer, type, size) \
  (pointer) = (type *) next;      \
  next += (size_t) (size) * sizeof(type)
  /* In the order of descending alignment. */
  for (i = 0; i < 2; ++i) {
    TAKE(pools[i]->arm, int64_t, most);
    TAKE(pools[i]->sample, int64_t, most);
    TAKE(pools[i]->group, int64_t, most);
  }
  TAKE(space->closest, int64_t, job->lanes);
  TAKE(space->picked, int64_t, job->lanes);
  for (i = 0; i < 2; ++i) {
    TAKE(pools[i]->arms, scalar, most * width);
    TAKE(pools[i]->score, scalar, most);
  }
  TAKE(space->samples, scalar, most * (PALM + job->n_redundancy));
  TAKE(space->rows, scalar, (most + job->lanes) * job->n_q);
  TAKE(space->least, scalar, job->lanes);
  for (i = 0; i < 2; ++i) {
    TAKE(pools[i]->used, char, most);
  }
#undef TAKE
}

static int run_map(const arm_search_job *job, KERNEL(kernel, map_job), const scalar *in,
                   int64_t in_width, scalar *out, int64_t out_width, int64_t count) {
  const scalar *inputs[1];
  scalar *outputs[1];
  map_job map = {0};
  int code;
  inputs[0] = in;
  outputs[0] = out;
  map.inputs = inputs;
  map.input_steps = &in_width;
  map.outputs = outputs;
  map.output_steps = &out_width;
  map.count = count;
  map.slice = 1; /* s */
  (void) job; /* CALL of a freestanding solver uses it */
  do code = CALL(kernel, &map);
  while (code == SLICE_OVER);
  return code;
}

/* Shift fixed joints by full turns to their position and, with NEAR_START, the others towards the
 * start; then clamp the arm to its bounds. Returns 0 if a joint is outside its bounds by more than
 * rounding. */
static int clamp_and_check(const arm_search_job *job, scalar *arm, const scalar *start) {
  int64_t j;
  for (j = 0; j < job->n_arm; ++j) {
    const scalar low = job->lower[j], high = job->upper[j];
    scalar x = arm[j];
    if (low >= high) {
      x += FULL_TURN * floor((low - x) / FULL_TURN + (scalar) 0.5);
    } else if (job->order == NEAR_START) {
      const scalar turns = floor((start[job->columns[j]] - x) / FULL_TURN + (scalar) 0.5);
      const scalar shifted = x + FULL_TURN * turns;
      if (shifted >= low && shifted <= high) x = shifted;
    }
    if (!(x - low >= job->min_limit_margin && high - x >= job->min_limit_margin)) return 0;
    arm[j] = x < low ? low : x > high ? high : x;
  }
  return 1;
}

static scalar arm_score(const arm_search_job *job, const scalar *arm, const scalar *start) {
  scalar score = job->order == NEAR_START ? 0 : INFINITY;
  int64_t j;
  for (j = 0; j < job->n_arm; ++j) {
    const scalar range = job->range[j];
    if (job->order == NEAR_START) {
      const scalar offset = (arm[j] - start[job->columns[j]]) / range;
      score -= offset * offset;
    } else {
      const scalar below = arm[j] - job->low[j], above = job->low[j] + range - arm[j];
      const scalar margin = (below < above ? below : above) / ((scalar) 0.5 * range);
      if (margin < score) score = margin;
    }
  }
  return score;
}

static void set_configuration(const arm_search_job *job, int64_t hand, const scalar *arm,
                              scalar *q) {
  int64_t j;
  memcpy(q, job->q + hand * job->n_q, (size_t) job->n_q * sizeof(scalar));
  for (j = 0; j < job->n_arm; ++j) q[job->columns[j]] = arm[j];
}

/* Add an arm to a pool if it is within its bounds. */
static void add_arm(const arm_search_job *job, int64_t hand, pool *to, int64_t arm, int64_t sample,
                    int64_t group) {
  const scalar *start = job->starts + hand * job->n_q;
  scalar *values = to->arms + arm;
  const int64_t i = to->count;
  if (!clamp_and_check(job, values, start)) return;
  to->score[i] = arm_score(job, values, start);
  to->arm[i] = arm;
  to->sample[i] = sample;
  to->group[i] = group;
  to->used[i] = 0;
  ++to->count;
}

/* Compute the arms at `count` samples; only those of one branch unless `branch` is negative. */
static int compute_arms(const arm_search_job *job, scratch *space, int64_t hand, pool *to,
                        int64_t count, int64_t branch) {
  const int64_t width = PALM + job->n_redundancy, size = job->n_rows * (job->n_arm + 1);
  const scalar *palm = job->palms + 16 * hand;
  int64_t i, k, s;
  int code;
  for (s = 0; s < count; ++s) {
    scalar *sample = space->samples + s * width;
    for (i = 0; i < 3; ++i) {
      for (k = 0; k < 3; ++k) sample[3 * i + k] = palm[4 * i + k];
      sample[9 + i] = palm[4 * i + 3];
    }
  }
  to->count = 0;
  code = run_map(job, job->arms, space->samples, width, to->arms, size, count);
  if (code != DONE) return code;
  for (s = 0; s < count; ++s) {
    const scalar *reach_margin = to->arms + s * size + job->n_rows * job->n_arm;
    for (k = 0; k < job->n_rows; ++k) {
      if ((branch < 0 || k == branch) && reach_margin[k] >= 0) {
        add_arm(job, hand, to, s * size + k * job->n_arm, s, k);
      }
    }
  }
  return DONE;
}

static int measure_arms(const arm_search_job *job, scratch *space, int64_t hand, pool *candidates) {
  int64_t i;
  if (job->order != MEASURED) return DONE;
  for (i = 0; i < candidates->count; ++i) {
    set_configuration(job, hand, candidates->arms + candidates->arm[i],
                      space->rows + i * job->n_q);
  }
  if (!candidates->count) return DONE;
  return run_map(job, job->measure, space->rows, job->n_q, candidates->score, 1,
                 candidates->count);
}

/* Find the best collision-free arm of a group with a score above `best_score`; `best` is its
 * index or -1. */
static int best_free_arm(const arm_search_job *job, scratch *space, int64_t hand, pool *from,
                      int64_t group, scalar *best_score, int64_t *best) {
  const int clearest = job->order == CLEAREST;
  clearance_job *clearance = job->clearance;
  const int64_t max_picked = clearance ? job->lanes : 1;
  *best = -1;
  for (;;) {
    const scalar min_score = clearest ? -INFINITY : *best_score;
    int64_t count = 0, i, n, *picked = space->picked;
    int code;
    for (i = 0; i < from->count; ++i) {
      const scalar score = from->score[i];
      if (from->used[i] || !(score > min_score)) continue;
      if (job->n_groups > 1 && from->group[i] != group) continue;
      if (count == max_picked && !(score > from->score[picked[count - 1]])) continue;
      if (count < max_picked) ++count;
      for (n = count - 1; n > 0 && score > from->score[picked[n - 1]]; --n) {
        picked[n] = picked[n - 1];
      }
      picked[n] = i;
    }
    if (!count) return DONE;
    for (n = 0; n < count; ++n) {
      from->used[picked[n]] = 1;
      set_configuration(job, hand, from->arms + from->arm[picked[n]], space->rows + n * job->n_q);
    }
    if (!clearance) {
      *best = space->picked[0];
      *best_score = from->score[*best];
      return DONE;
    }
    clearance->q = space->rows;
    clearance->poses = job->poses + hand * job->pose_step;
    clearance->pose_step = 0;
    clearance->max_distance = clearest ? INFINITY : job->margin;
    clearance->stop_below = clearest ? *best_score + job->margin : job->margin - job->rounding;
    clearance->distances = space->least;
    clearance->closest_pairs = space->closest;
    clearance->count = count;
    clearance->next = 0;
    do code = CALL(job->check, clearance);
    while (code == SLICE_OVER);
    if (code != DONE) return code;
    for (n = 0; n < count; ++n) {
      scalar surplus = space->least[n] - job->margin;
      /* Clearances at the bound of their hand are equal: the larger limit margin wins. */
      if (clearest && surplus > job->clearance_bounds[hand]) {
        surplus = job->clearance_bounds[hand];
      }
      i = space->picked[n];
      if (clearest ? surplus > *best_score : surplus >= -job->rounding) {
        *best = i;
        *best_score = clearest ? surplus : from->score[i];
        if (!clearest) return DONE;
      }
    }
    if (clearest && *best_score >= job->clearance_bounds[hand]) return DONE;
  }
}

/* Refine the redundancy around the best sample, on the same branch. */
static int refine(const arm_search_job *job, scratch *space, int64_t hand, const scalar *sample,
                  int64_t group, scalar *best_score, scalar *arm) {
  int64_t i, chosen;
  int code;
  for (i = 0; i < job->n_offsets; ++i) {
    scalar *redundancy = space->samples + i * (PALM + job->n_redundancy) + PALM;
    memcpy(redundancy, sample, (size_t) job->n_redundancy * sizeof(scalar));
    redundancy[job->n_redundancy - 1] += job->offsets[i];
  }
  code = compute_arms(job, space, hand, &space->local, job->n_offsets, group);
  if (code == DONE) code = measure_arms(job, space, hand, &space->local);
  if (code == DONE) {
    code = best_free_arm(job, space, hand, &space->local, group, best_score, &chosen);
  }
  if (code == DONE && chosen >= 0) {
    memcpy(arm, space->local.arms + space->local.arm[chosen],
           (size_t) job->n_arm * sizeof(scalar));
  }
  return code;
}

/* Search one level of samples; sets `success` if a collision-free arm was found. */
static int search_level(const arm_search_job *job, scratch *space, int64_t hand, int level,
                        int *success) {
  const int64_t count = job->n_samples[level], width = PALM + job->n_redundancy;
  const int64_t size = job->n_rows * (job->n_arm + 1);
  pool *all = &space->all;
  int64_t i, group, chosen;
  int code, at_bound;
  for (i = 0; i < count; ++i) {
    memcpy(space->samples + i * width + PALM, job->samples[level] + i * job->n_redundancy,
           (size_t) job->n_redundancy * sizeof(scalar));
  }
  code = compute_arms(job, space, hand, all, count, -1);
  if (code != DONE) return code;
  if (!level) {
    scalar *given_arm = all->arms + count * size;
    for (i = 0; i < job->n_arm; ++i) given_arm[i] = job->q[hand * job->n_q + job->columns[i]];
    add_arm(job, hand, all, count * size, -1, job->n_groups - 1);
  }
  job->arms_tried[hand] += all->count;
  code = measure_arms(job, space, hand, all);
  if (code != DONE) return code;
  for (group = 0; group < job->n_groups; ++group) {
    scalar *score = job->score + hand * job->n_groups + group;
    scalar *arm = job->best_arms + (hand * job->n_groups + group) * job->n_arm;
    code = best_free_arm(job, space, hand, all, group, score, &chosen);
    if (code != DONE) return code;
    if (chosen < 0) continue;
    at_bound = job->order == CLEAREST && *score >= job->clearance_bounds[hand];
    if (job->order != CLEAREST || at_bound || *score >= -job->rounding) *success = 1;
    memcpy(arm, all->arms + all->arm[chosen], (size_t) job->n_arm * sizeof(scalar));
    if (all->sample[chosen] < 0 || !job->n_offsets || at_bound) continue;
    code = refine(job, space, hand, job->samples[level] + all->sample[chosen] * job->n_redundancy,
                  all->group[chosen], score, arm);
    if (code != DONE) return code;
  }
  return DONE;
}

EXPORT int casadi_ik_arm_search(arm_search_job *job) {
  scratch space;
  int64_t hand, i;
  char *block = ROOM(scratch_size(job));
  int owner_is_done = 0, code = DONE;
  if (!block) return NO_MEMORY;
  lay_out(job, &space, block);
  for (hand = 0; hand < job->count && code == DONE; ++hand) {
    int level, success = 0;
    job->arms_tried[hand] = 0;
    for (i = 0; i < job->n_groups; ++i) job->score[hand * job->n_groups + i] = -INFINITY;
    if (job->owner && hand && job->owner[hand] == job->owner[hand - 1] && owner_is_done) continue;
    for (level = 0; level < LEVELS && !success && code == DONE; ++level) {
      if (job->n_samples[level]) code = search_level(job, &space, hand, level, &success);
    }
    owner_is_done = success;
  }
  GIVE_BACK(block);
  return code;
}
