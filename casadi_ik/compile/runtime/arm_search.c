/* For hands that stay where they are the preferred arms that touch nothing.
 *
 * All arms in closed form, at given places of what an arm is free in (the swivel of its elbow, its
 * swept joint), are put in the asked order and checked, as many at a time as go side by side, until
 * one is free. Places about that one are then looked at in the same way, on its branch only. Where
 * nothing is free, places between the given ones are looked at before the hand is given up.
 *
 * The compiled kernels are called by pointers. A solver that stands alone (FREESTANDING) says how,
 * and where the memory is: KERNEL, CALL, ROOM, GIVE_BACK, OWN_MEMORY.
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
#define GIVE_BACK(room) free(room)
#define OWN_MEMORY
#endif

enum { FAR_FROM_LIMITS, NEAR_START, MEASURED, CLEAREST };
enum { PALM = 12, LEVELS = 2 };

#define TURN (scalar) 6.283185307179586

typedef struct {
  KERNEL(arms, map_job);       /* rotation, origin, redundancy -> the arm of every side, their slacks */
  KERNEL(measure, map_job);    /* q -> how good it is; for MEASURED */
  KERNEL(check, clearance_job);
  clearance_job *clear;        /* what is checked; NULL: nothing is */
  int64_t lanes;               /* configurations that are checked side by side */
  int64_t order;
  int64_t n_q, n_arm, n_redundancy, n_rows;
  int64_t n_groups;            /* 1: one arm is wanted; else one of every branch, and the given one */
  int64_t n_places[LEVELS], n_closer;
  const scalar *places[LEVELS]; /* rows of n_redundancy, the last of which may be varied */
  const scalar *closer;        /* by how much, about what was chosen */
  const int64_t *columns;      /* of the arm in q */
  const scalar *lower, *upper; /* bounds of the arm */
  const scalar *low, *range;   /* its limits, which order it */
  const scalar *q, *palms, *starts; /* rows of n_q, 16 and n_q */
  const int64_t *owner;        /* of hands next to each other: once one has an arm the others of the
                                  same owner are left out; NULL: none is */
  const scalar *caps;          /* room that no arm of the hand can exceed */
  const scalar *poses;
  int64_t pose_step;           /* numbers from one hand to the next, 0: the same for all */
  scalar margin, rounding;     /* distance to keep, and what it may be short of that */
  scalar allowed;              /* how far a joint may be within its bounds at least: rounding */
  int64_t count;
  scalar *chosen;              /* rows of n_groups arms */
  scalar *score;               /* rows of n_groups: of the arm alone; -inf: there is none */
  int64_t *tried;              /* arms within bounds */
  OWN_MEMORY
} arm_search_job;

/* Arms that were found, and their scores. */
typedef struct {
  int64_t count;
  scalar *found, *score;
  int64_t *arm, *place, *group; /* place in `found`, row of the samples, branch */
  char *used;
} pool;

typedef struct {
  pool all, near;
  scalar *samples, *rows, *least;
  int64_t *closest, *picked;
} scratch;

static int64_t most_arms(const arm_search_job *job, int near) {
  int64_t places = near ? job->n_closer : job->n_places[0];
  if (!near && job->n_places[1] > places) places = job->n_places[1];
  return places * job->n_rows + 1;
}

static int64_t more_arms(const arm_search_job *job) {
  return most_arms(job, 0) > most_arms(job, 1) ? most_arms(job, 0) : most_arms(job, 1);
}

static size_t room(const arm_search_job *job) {
  const int64_t wide = job->n_arm + 1, most = more_arms(job);
  const int64_t whole = 6 * most + 2 * job->lanes;
  const int64_t numbers = 2 * most * (wide + 1) + most * (PALM + job->n_redundancy)
                        + (most + job->lanes) * job->n_q + job->lanes;
  return (size_t) whole * sizeof(int64_t) + (size_t) numbers * sizeof(scalar) + 2 * (size_t) most;
}

static void lay_out(const arm_search_job *job, scratch *space, char *next) {
  const int64_t wide = job->n_arm + 1, most = more_arms(job);
  pool *pools[] = {&space->all, &space->near};
  int i;
#define TAKE(where, type, size) \
  (where) = (type *) next;      \
  next += (size_t) (size) * sizeof(type)
  /* The widest first: each is aligned then. */
  for (i = 0; i < 2; ++i) {
    TAKE(pools[i]->arm, int64_t, most);
    TAKE(pools[i]->place, int64_t, most);
    TAKE(pools[i]->group, int64_t, most);
  }
  TAKE(space->closest, int64_t, job->lanes);
  TAKE(space->picked, int64_t, job->lanes);
  for (i = 0; i < 2; ++i) {
    TAKE(pools[i]->found, scalar, most * wide);
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

static int mapped(const arm_search_job *job, KERNEL(kernel, map_job), const scalar *in, int64_t wide,
                  scalar *out, int64_t wide_out, int64_t count) {
  const scalar *inputs[1];
  scalar *outputs[1];
  map_job map = {0};
  int code;
  inputs[0] = in;
  outputs[0] = out;
  map.inputs = inputs;
  map.input_steps = &wide;
  map.outputs = outputs;
  map.output_steps = &wide_out;
  map.count = count;
  map.slice = 1;
  (void) job;
  do code = CALL(kernel, &map);
  while (code == SLICE_OVER);
  return code;
}

/* Puts an arm into its bounds and the asked turn, that of a held joint where it is held; whether it
 * was within, as far as rounding goes. */
static int clamp_and_check(const arm_search_job *job, scalar *arm, const scalar *start) {
  int64_t j;
  for (j = 0; j < job->n_arm; ++j) {
    const scalar low = job->lower[j], high = job->upper[j];
    scalar x = arm[j];
    if (low >= high) {
      x += TURN * floor((low - x) / TURN + (scalar) 0.5);
    } else if (job->order == NEAR_START) {
      const scalar turned = x + TURN * floor((start[job->columns[j]] - x) / TURN + (scalar) 0.5);
      if (turned >= low && turned <= high) x = turned;
    }
    if (!(x - low >= job->allowed && high - x >= job->allowed)) return 0;
    arm[j] = x < low ? low : x > high ? high : x;
  }
  return 1;
}

static scalar rated(const arm_search_job *job, const scalar *arm, const scalar *start) {
  scalar value = job->order == NEAR_START ? 0 : INFINITY;
  int64_t j;
  for (j = 0; j < job->n_arm; ++j) {
    const scalar range = job->range[j];
    if (job->order == NEAR_START) {
      const scalar part = (arm[j] - start[job->columns[j]]) / range;
      value -= part * part;
    } else {
      const scalar below = arm[j] - job->low[j], above = job->low[j] + range - arm[j];
      const scalar part = (below < above ? below : above) / ((scalar) 0.5 * range);
      if (part < value) value = part;
    }
  }
  return value;
}

static void configuration(const arm_search_job *job, int64_t hand, const scalar *arm, scalar *q) {
  int64_t j;
  memcpy(q, job->q + hand * job->n_q, (size_t) job->n_q * sizeof(scalar));
  for (j = 0; j < job->n_arm; ++j) q[job->columns[j]] = arm[j];
}

static void add(const arm_search_job *job, int64_t hand, pool *to, int64_t arm, int64_t place,
                int64_t group) {
  const scalar *start = job->starts + hand * job->n_q;
  scalar *found = to->found + arm;
  const int64_t i = to->count;
  if (!clamp_and_check(job, found, start)) return;
  to->score[i] = rated(job, found, start);
  to->arm[i] = arm;
  to->place[i] = place;
  to->group[i] = group;
  to->used[i] = 0;
  ++to->count;
}

/* The arms of so many samples; those of one side only if it is not negative. */
static int look(const arm_search_job *job, scratch *space, int64_t hand, pool *to, int64_t count,
                int64_t side) {
  const int64_t wide = PALM + job->n_redundancy, size = job->n_rows * (job->n_arm + 1);
  const scalar *palm = job->palms + 16 * hand;
  int64_t i, k, s;
  int code;
  for (s = 0; s < count; ++s) {
    scalar *sample = space->samples + s * wide;
    for (i = 0; i < 3; ++i) {
      for (k = 0; k < 3; ++k) sample[3 * i + k] = palm[4 * i + k];
      sample[9 + i] = palm[4 * i + 3];
    }
  }
  to->count = 0;
  code = mapped(job, job->arms, space->samples, wide, to->found, size, count);
  if (code != DONE) return code;
  for (s = 0; s < count; ++s) {
    const scalar *slack = to->found + s * size + job->n_rows * job->n_arm;
    for (k = 0; k < job->n_rows; ++k) {
      if ((side < 0 || k == side) && slack[k] >= 0) {
        add(job, hand, to, s * size + k * job->n_arm, s, k);
      }
    }
  }
  return DONE;
}

static int measured(const arm_search_job *job, scratch *space, int64_t hand, pool *of) {
  int64_t i;
  if (job->order != MEASURED) return DONE;
  for (i = 0; i < of->count; ++i) {
    configuration(job, hand, of->found + of->arm[i], space->rows + i * job->n_q);
  }
  if (!of->count) return DONE;
  return mapped(job, job->measure, space->rows, job->n_q, of->score, 1, of->count);
}

/* The first in the asked order that is free, of a group, and better than what is there; or -1. */
static int pick(const arm_search_job *job, scratch *space, int64_t hand, pool *from, int64_t group,
                scalar *better, int64_t *chosen) {
  const int clearest = job->order == CLEAREST;
  clearance_job *clear = job->clear;
  const int64_t wanted = clear ? job->lanes : 1;
  *chosen = -1;
  for (;;) {
    const scalar least = clearest ? -INFINITY : *better;
    int64_t count = 0, i, n, *picked = space->picked;
    int code;
    for (i = 0; i < from->count; ++i) {
      const scalar value = from->score[i];
      if (from->used[i] || !(value > least)) continue;
      if (job->n_groups > 1 && from->group[i] != group) continue;
      if (count == wanted && !(value > from->score[picked[count - 1]])) continue;
      if (count < wanted) ++count;
      for (n = count - 1; n > 0 && value > from->score[picked[n - 1]]; --n) {
        picked[n] = picked[n - 1];
      }
      picked[n] = i;
    }
    if (!count) return DONE;
    for (n = 0; n < count; ++n) {
      from->used[picked[n]] = 1;
      configuration(job, hand, from->found + from->arm[picked[n]], space->rows + n * job->n_q);
    }
    if (!clear) {
      *chosen = space->picked[0];
      *better = from->score[*chosen];
      return DONE;
    }
    clear->q = space->rows;
    clear->poses = job->poses + hand * job->pose_step;
    clear->pose_step = 0;
    clear->most = clearest ? INFINITY : job->margin;
    clear->enough = clearest ? *better + job->margin : job->margin - job->rounding;
    clear->least = space->least;
    clear->closest = space->closest;
    clear->count = count;
    clear->next = 0;
    do code = CALL(job->check, clear);
    while (code == SLICE_OVER);
    if (code != DONE) return code;
    for (n = 0; n < count; ++n) {
      scalar room = space->least[n] - job->margin;
      /* Of arms with as much room as their hand has, the first in the order of limits. */
      if (clearest && room > job->caps[hand]) room = job->caps[hand];
      i = space->picked[n];
      if (clearest ? room > *better : room >= -job->rounding) {
        *chosen = i;
        *better = clearest ? room : from->score[i];
        if (!clearest) return DONE;
      }
    }
    if (clearest && *better >= job->caps[hand]) return DONE;
  }
}

/* Places about the one that an arm was found at, its branch only. */
static int refine(const arm_search_job *job, scratch *space, int64_t hand, const scalar *place,
                  int64_t group, scalar *better, scalar *arm) {
  int64_t i, chosen;
  int code;
  for (i = 0; i < job->n_closer; ++i) {
    scalar *redundancy = space->samples + i * (PALM + job->n_redundancy) + PALM;
    memcpy(redundancy, place, (size_t) job->n_redundancy * sizeof(scalar));
    redundancy[job->n_redundancy - 1] += job->closer[i];
  }
  code = look(job, space, hand, &space->near, job->n_closer, group);
  if (code == DONE) code = measured(job, space, hand, &space->near);
  if (code == DONE) code = pick(job, space, hand, &space->near, group, better, &chosen);
  if (code == DONE && chosen >= 0) {
    memcpy(arm, space->near.found + space->near.arm[chosen], (size_t) job->n_arm * sizeof(scalar));
  }
  return code;
}

static int search_level(const arm_search_job *job, scratch *space, int64_t hand, int level, int *any) {
  const int64_t count = job->n_places[level], wide = PALM + job->n_redundancy;
  const int64_t size = job->n_rows * (job->n_arm + 1);
  pool *all = &space->all;
  int64_t i, group, chosen;
  int code, most;
  for (i = 0; i < count; ++i) {
    memcpy(space->samples + i * wide + PALM, job->places[level] + i * job->n_redundancy,
           (size_t) job->n_redundancy * sizeof(scalar));
  }
  code = look(job, space, hand, all, count, -1);
  if (code != DONE) return code;
  if (!level) {
    scalar *own = all->found + count * size;
    for (i = 0; i < job->n_arm; ++i) own[i] = job->q[hand * job->n_q + job->columns[i]];
    add(job, hand, all, count * size, -1, job->n_groups - 1);
  }
  job->tried[hand] += all->count;
  code = measured(job, space, hand, all);
  if (code != DONE) return code;
  for (group = 0; group < job->n_groups; ++group) {
    scalar *score = job->score + hand * job->n_groups + group;
    scalar *arm = job->chosen + (hand * job->n_groups + group) * job->n_arm;
    code = pick(job, space, hand, all, group, score, &chosen);
    if (code != DONE) return code;
    if (chosen < 0) continue;
    most = job->order == CLEAREST && *score >= job->caps[hand];
    if (job->order != CLEAREST || most || *score >= -job->rounding) *any = 1;
    memcpy(arm, all->found + all->arm[chosen], (size_t) job->n_arm * sizeof(scalar));
    if (all->place[chosen] < 0 || !job->n_closer || most) continue;
    code = refine(job, space, hand, job->places[level] + all->place[chosen] * job->n_redundancy,
                  all->group[chosen], score, arm);
    if (code != DONE) return code;
  }
  return DONE;
}

EXPORT int casadi_ik_arm_search(arm_search_job *job) {
  scratch space;
  int64_t hand, i;
  char *block = ROOM(room(job));
  int done = 0, code = DONE;
  if (!block) return NO_MEMORY;
  lay_out(job, &space, block);
  for (hand = 0; hand < job->count && code == DONE; ++hand) {
    int level, any = 0;
    job->tried[hand] = 0;
    for (i = 0; i < job->n_groups; ++i) job->score[hand * job->n_groups + i] = -INFINITY;
    if (job->owner && hand && job->owner[hand] == job->owner[hand - 1] && done) continue;
    for (level = 0; level < LEVELS && !any && code == DONE; ++level) {
      if (job->n_places[level]) code = search_level(job, &space, hand, level, &any);
    }
    done = any;
  }
  GIVE_BACK(block);
  return code;
}
