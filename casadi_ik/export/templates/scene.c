/* What stands about the robot: how far it is, and another arm for a hand where one touches. */
#include "@PREFIX@_parts.h"

#define FREESTANDING
#define EXPORT static
#define KERNEL(name, work) int (*name)(work *, @PREFIX@_memory *)
#define CALL(kernel, work) kernel(work, job->memory)
#define ROOM(bytes) ((bytes) <= sizeof job->memory->room ? (char *) job->memory->room : 0)
#define GIVE_BACK(room) ((void) (room))
#define OWN_MEMORY @PREFIX@_memory *memory;

enum { DONE = 0, SLICE_OVER = 1, NO_MEMORY = -1 };

@SCENE_CONSTANTS@
@ARM_SEARCH@
@BODY{@
enum { N_SIDES = @SIDES@ };

#if HAS_CLOSED_ARM
typedef struct {
  KERNEL(arms, map_job);
  int64_t n_arm, n_redundancy, n_rows, n_samples[LEVELS];
  const scalar *samples[LEVELS], *low, *range;
  const int64_t *columns;
} arm_of_side;

#endif
@ARMS_OF_SIDES@
@}@
void @PREFIX@_scene_init(@PREFIX@_solver *solver) {
  int i, k;
  for (i = 0; i < N_OWN; ++i) {
    @PREFIX@_solid *own = solver->scene.solids + i;
    own->kind = OWN_KIND[i];
    for (k = 0; k < 3; ++k) own->size[k] = OWN_SIZE[i][k];
    own->reach = OWN_REACH[i];
  }
  for (i = 0; i < @GUARD@_SCENE; ++i) solver->scene.solids[N_OWN + i].kind = @GUARD@_NOTHING;
@FIRST_MARGIN?@}

int @PREFIX@_set_solid(@PREFIX@_solver *solver, int place, int kind, const scalar *size,
                       const scalar *pose, int grasped) {
  @PREFIX@_solid *put;
  int k;
  if (place < 0 || place >= @GUARD@_SCENE) return @GUARD@_BAD_INPUT;
  if (kind < @GUARD@_NOTHING || kind >= N_KINDS) return @GUARD@_BAD_INPUT;
  put = solver->scene.solids + N_OWN + place;
  put->kind = kind;
  solver->scene.grasped[place] = grasped;
  if (kind == @GUARD@_NOTHING) return 0;
  memcpy(solver->scene.poses + 12 * place, pose, 12 * sizeof(scalar));
  put->reach = 0; /* at most: no shape reaches farther than all its sizes together */
  for (k = 0; k < 3; ++k) {
    put->size[k] = SIZE_FACTORS[kind][k] > 0 ? SIZE_FACTORS[kind][k] * size[k] : 0;
    put->reach += put->size[k];
  }
  return 0;
}

void @PREFIX@_set_margin(@PREFIX@_solver *solver, scalar margin) { solver->scene.margin = margin@MORE_MARGIN?@; }

void @PREFIX@_shapes(@PREFIX@_solver *solver, const scalar *q, scalar *places) {
  (void) @PREFIX@_place_kernel(q, places, &solver->memory);
}

static void add_pair(@PREFIX@_solver *solver, int i, int j, scalar offset) {
  const int64_t k = solver->scene.n_pairs++;
  solver->scene.pairs[2 * k] = i;
  solver->scene.pairs[2 * k + 1] = j;
  solver->scene.offsets[k] = offset;
}

@ONE_ARM{@
/* Of which pairs the distance is decided by what: hand and palm, without or with the fingers that
 * touch nothing, or the arm, too. */
enum { OF_HAND, OF_IDLE, OF_ARM };
@}@
@BODY{@
/* Of which pairs the distance is decided by what: a hand and its palm, without or with the fingers
 * that touch nothing, by side; then the trunk or several palms; then an arm, with those before it. */
enum {
  OF_HAND,
  OF_IDLE = N_SIDES,
  OF_TRUNK = 2 * N_SIDES,
  OF_ARM,
  N_PARTS_OF_PAIRS = OF_ARM + N_SIDES
};
@}@

@BODY{@
/* The part of a pair, if an idle finger is in it. */
static int part_of(int part, int idle) {
  return part < OF_IDLE && idle ? OF_IDLE + part : part;
}

@}@
static int link_of(int body) {
  if (body < N_CAPSULES) return LINK[body];
  body -= N_CAPSULES;
  return body < N_OWN ? OWN_LINK[body] : N_OWN - 1 - body;
}

/* Motors of the hand that move no finger with a contact, and the links that they move. */
static void find_idle(@PREFIX@_solver *solver, const scalar *lower, const scalar *upper,
                      int *motors, int *links) {
  int k, f, i;
  memset(links, 0, @GUARD@_LINKS * sizeof *links);
  for (k = 0; k < N_HAND; ++k) {
    motors[k] = lower[HAND[k]] < upper[HAND[k]];
    for (f = 0; f < @GUARD@_FINGERS; ++f) {
      motors[k] &= !FINGER_MOVED[f][k] || solver->points[3 * f] != solver->points[3 * f];
    }
    for (i = 0; motors[k] && i < @GUARD@_LINKS; ++i) links[i] |= LINK_MOVED[i][k];
  }
}

/* Pairs of one part; idle: links of idle fingers, a null pointer: there are none. */
static void add_pairs(@PREFIX@_solver *solver, const int *idle, int part) {
  int i, k, f;
  for (k = 0; k < @GUARD@_SCENE; ++k) {
    if (solver->scene.solids[N_OWN + k].kind == @GUARD@_NOTHING) continue;
    for (i = 0; i < N_CAPSULES; ++i) {
      int may = 0;
      if (FIXED[i] || @CAPSULE_PART@ != part) continue;
      /* A finger may touch what it grasps with the link of its pad. */
      for (f = 0; f < @GUARD@_FINGERS; ++f) {
        may |= TOUCHES[f][i] && solver->points[3 * f] == solver->points[3 * f];
      }
      if (!(may && solver->scene.grasped[k])) add_pair(solver, i, N_CAPSULES + N_OWN + k, 0);
    }
  }
  for (k = 0; k < N_PAIRS; ++k) {
    const int first = link_of(PAIRS[k][0]), other = link_of(PAIRS[k][1]);
    if (@PAIR_PART@ == part) {
      add_pair(solver, PAIRS[k][0], PAIRS[k][1], OFFSETS[k]);
    }
  }
}

static clearance_job about(@PREFIX@_solver *solver, const int *idle) {
  clearance_job job = {0};
  int i;
@ONE_ARM{@
  solver->scene.n_pairs = 0;
  add_pairs(solver, idle, OF_HAND);
  solver->scene.n_busy = solver->scene.n_pairs;
  add_pairs(solver, idle, OF_IDLE);
  solver->scene.n_held = solver->scene.n_pairs;
  add_pairs(solver, idle, OF_ARM);
@}@
@BODY{@
  if (!solver->scene.listed) {
    solver->scene.n_pairs = 0;
    for (i = 0; i < N_PARTS_OF_PAIRS; ++i) {
      add_pairs(solver, idle, i);
      solver->scene.ends[i] = solver->scene.n_pairs;
    }
    solver->scene.n_busy = solver->scene.ends[OF_IDLE - 1];
    solver->scene.n_held = solver->scene.ends[OF_TRUNK - 1];
  }
@}@
  job.poses = solver->scene.poses;
  job.n_solids = @GUARD@_SCENE;
  job.solids = solver->scene.solids;
  job.radii = RADII;
  job.halves = HALVES;
  job.pairs = solver->scene.pairs;
  job.offsets = solver->scene.offsets;
  job.n_pairs = solver->scene.n_pairs;
  for (i = 0; i < RECENT; ++i) job.recent[i] = -1;
  job.max_distance = INFINITY;
  job.stop_below = -INFINITY;
  job.count = 1;
  return job;
}

static scalar room_at(@PREFIX@_solver *solver, clearance_job *job, const scalar *q,
                      int64_t *closest) {
  scalar least = INFINITY;
  job->q = q;
  job->distances = &least;
  job->closest_pairs = closest;
  job->next = 0;
  *closest = -1;
  (void) @PREFIX@_near_kernel(job, &solver->memory);
  return least - solver->scene.margin;
}

scalar @PREFIX@_clearance(@PREFIX@_solver *solver, const scalar *q) {
  clearance_job job = about(solver, 0);
  int64_t closest;
  const scalar room = room_at(solver, &job, q, &closest);
  if (closest >= 0) {
    solver->nearest[0] = link_of(solver->scene.pairs[2 * closest]);
    solver->nearest[1] = link_of(solver->scene.pairs[2 * closest + 1]);
  }
  return solver->clearance = room + solver->scene.margin;
}

@ONE_ARM{@
#if HAS_CLOSED_ARM
/* The preferred arm that touches nothing, for the hand of an answer; 0 if there is none. */
static int choose_arm(@PREFIX@_solver *solver, const scalar *lower, const scalar *upper, int near,
                     scalar *q) {
  clearance_job clear = about(solver, 0);
  static const int64_t columns[] = ARM_COLUMNS;
  arm_search_job job = {0};
  map_job map = {0};
  const scalar *inputs[1];
  scalar *outputs[1], palm[16], low[N_ARM], high[N_ARM], arm[N_ARM], score = 0;
  const int64_t step = 0;
  int64_t tried = 0;
  int i;
  inputs[0] = q;
  outputs[0] = palm;
  map.inputs = inputs;
  map.input_steps = &step;
  map.outputs = outputs;
  map.output_steps = &step;
  map.count = 1;
  if (@PREFIX@_palm_kernel(&map, &solver->memory) != DONE) return 0;
  for (i = 0; i < N_ARM; ++i) {
    low[i] = lower[columns[i]];
    high[i] = upper[columns[i]];
  }
  clear.pairs += 2 * solver->scene.n_held;
  clear.offsets += solver->scene.n_held;
  clear.n_pairs -= solver->scene.n_held;
  job.arms = @PREFIX@_arms_kernel;
  job.check = @PREFIX@_near_kernel;
  job.clearance = &clear;
  job.lanes = 1;
  job.order = near ? NEAR_START : FAR_FROM_LIMITS;
  job.n_q = @GUARD@_MOTORS;
  job.n_arm = N_ARM;
  job.n_redundancy = N_REDUNDANCY;
  job.n_rows = N_ROWS;
  job.n_groups = 1;
  job.n_samples[0] = N_SAMPLES;
  job.n_samples[1] = N_MORE_SAMPLES;
  job.n_offsets = N_SAMPLE_OFFSETS;
  job.samples[0] = SAMPLES;
  job.samples[1] = MORE_SAMPLES;
  job.offsets = SAMPLE_OFFSETS;
  job.columns = columns;
  job.lower = low;
  job.upper = high;
  job.low = ARM_LOW;
  job.range = ARM_RANGE;
  job.q = q;
  job.palms = palm;
  job.starts = solver->q0;
  job.poses = solver->scene.poses;
  job.margin = solver->scene.margin;
  job.rounding = ROUNDING;
  job.min_limit_margin = MIN_LIMIT_MARGIN;
  job.count = 1;
  job.chosen = arm;
  job.score = &score;
  job.tried = &tried;
  job.memory = &solver->memory;
  if (casadi_ik_arm_search(&job) != DONE || !(score > -INFINITY)) return 0;
  for (i = 0; i < N_ARM; ++i) q[columns[i]] = arm[i];
  return 1;
}
#endif
@}@
@BODY{@
/* Only the pairs from one part to another. */
static clearance_job of_parts(@PREFIX@_solver *solver, int first, int last) {
  clearance_job job = about(solver, 0);
  const int64_t begin = first ? solver->scene.ends[first - 1] : 0;
  job.pairs += 2 * begin;
  job.offsets += begin;
  job.n_pairs = solver->scene.ends[last] - begin;
  return job;
}

static int part_is_free(@PREFIX@_solver *solver, int first, int last, const scalar *q) {
  clearance_job job = of_parts(solver, first, last);
  int64_t closest;
  job.max_distance = solver->scene.margin;
  job.stop_below = solver->scene.margin - ROUNDING;
  return room_at(solver, &job, q, &closest) >= -ROUNDING;
}

#if HAS_CLOSED_ARM
/* Arms that touch nothing for the palms of a side and of those behind it; 0 if there are none. Of
 * every arm but the last the preferred one of each branch is taken up. */
static int choose_arms(@PREFIX@_solver *solver, const scalar *lower, const scalar *upper, int near,
                       int side, const scalar *palms, scalar *q) {
  const arm_of_side *own = ARMS + side;
  const int last = side + 1 == N_SIDES;
  clearance_job clear = of_parts(solver, OF_ARM + side, OF_ARM + side);
  arm_search_job job = {0};
  scalar low[MOST_ARM], high[MOST_ARM], arms[(MOST_ROWS + 1) * MOST_ARM], score[MOST_ROWS + 1];
  int64_t tried = 0;
  int i, k;
  for (i = 0; i < own->n_arm; ++i) {
    low[i] = lower[own->columns[i]];
    high[i] = upper[own->columns[i]];
  }
  job.arms = own->arms;
  job.check = @PREFIX@_near_kernel;
  job.clearance = &clear;
  job.lanes = 1;
  job.order = near ? NEAR_START : FAR_FROM_LIMITS;
  job.n_q = @GUARD@_MOTORS;
  job.n_arm = own->n_arm;
  job.n_redundancy = own->n_redundancy;
  job.n_rows = own->n_rows;
  job.n_groups = last ? 1 : own->n_rows + 1;
  for (i = 0; i < LEVELS; ++i) {
    job.n_samples[i] = own->n_samples[i];
    job.samples[i] = own->samples[i];
  }
  job.columns = own->columns;
  job.lower = low;
  job.upper = high;
  job.low = own->low;
  job.range = own->range;
  job.q = q;
  job.palms = palms + 16 * side;
  job.starts = solver->q0;
  job.poses = solver->scene.poses;
  job.margin = solver->scene.margin;
  job.rounding = ROUNDING;
  job.min_limit_margin = MIN_LIMIT_MARGIN;
  job.count = 1;
  job.chosen = arms;
  job.score = score;
  job.tried = &tried;
  job.memory = &solver->memory;
  if (casadi_ik_arm_search(&job) != DONE) return 0;
  for (k = 0; k < job.n_groups; ++k) {
    scalar next[@GUARD@_MOTORS];
    if (!(score[k] > -INFINITY)) continue;
    memcpy(next, q, sizeof next);
    for (i = 0; i < own->n_arm; ++i) next[own->columns[i]] = arms[k * own->n_arm + i];
    if (!last && !choose_arms(solver, lower, upper, near, side + 1, palms, next)) continue;
    memcpy(q, next, sizeof next);
    return 1;
  }
  return 0;
}
#endif
@}@

/* Puts idle fingers where they have most room, if the hand touches something by them alone; the room
 * that hand and palm have [m]. */
static scalar put_aside(@PREFIX@_solver *solver, const scalar *lower, const scalar *upper,
                        scalar *q) {
  int motors[N_HAND + 1], links[@GUARD@_LINKS], k, closer;
  scalar most, part = 0, tried[@GUARD@_MOTORS], best[@GUARD@_MOTORS];
  int64_t closest, place;
  clearance_job job;
  find_idle(solver, lower, upper, motors, links);
  job = about(solver, links);
  job.n_pairs = solver->scene.n_busy;
  most = room_at(solver, &job, q, &closest);
  job.pairs += 2 * solver->scene.n_busy;
  job.offsets += solver->scene.n_busy;
  job.n_pairs = solver->scene.n_held - solver->scene.n_busy;
  if (most < -ROUNDING || !job.n_pairs) return most;
  most = room_at(solver, &job, q, &closest);
  memcpy(best, q, sizeof best);
  /* All over their range first, then ever closer about the best. */
  for (closer = 0; closer <= N_IDLE_RADII && most < -ROUNDING; ++closer) {
    if (closer && !(most > -IDLE_MAX_GAIN)) break;
    if (closer) part = IDLE_RADII[closer - 1];
    for (place = 0; place < (closer ? N_IDLE_LOCAL : N_IDLE); ++place) {
      scalar room;
      memcpy(tried, q, sizeof tried);
      for (k = 0; k < N_HAND; ++k) {
        const int column = HAND[k];
        const scalar x = (scalar) 0.5 + (scalar) place * HAND_SPREAD[k], step = x - (scalar) (int64_t) x;
        scalar to = HAND_LOWER[k] + step * HAND_RANGE[k];
        if (!motors[k]) continue;
        if (closer) to = q[column] + part * ((step - (scalar) 0.5) * HAND_RANGE[k]);
        to = to > lower[column] ? to : lower[column];
        tried[column] = to < upper[column] ? to : upper[column];
      }
      room = room_at(solver, &job, tried, &closest);
      if (!(room > most)) continue;
      most = room;
      memcpy(best, tried, sizeof best);
    }
    memcpy(q, best, sizeof best);
  }
  job = about(solver, links);
  job.n_pairs = solver->scene.n_held;
  return room_at(solver, &job, q, &closest);
}

int @PREFIX@_hand_is_free(@PREFIX@_solver *solver, const scalar *lower, const scalar *upper,
                          scalar *q) {
  return put_aside(solver, lower, upper, q) >= -ROUNDING;
}

@ONE_ARM{@
int @PREFIX@_arm_is_free(@PREFIX@_solver *solver, const scalar *lower, const scalar *upper, int near,
                         scalar *q) {
#if HAS_CLOSED_ARM
  return choose_arm(solver, lower, upper, near, q);
#else
  (void) lower, (void) upper, (void) near;
  return @PREFIX@_clearance(solver, q) - solver->scene.margin >= -ROUNDING;
#endif
}
@}@
@BODY{@
void @PREFIX@_list_pairs(@PREFIX@_solver *solver, const scalar *lower, const scalar *upper) {
  int motors[N_HAND + 1], links[@GUARD@_LINKS];
  find_idle(solver, lower, upper, motors, links);
  solver->scene.listed = 0;
  (void) about(solver, links);
  solver->scene.listed = 1;
}

int @PREFIX@_side_is_free(@PREFIX@_solver *solver, int side, const scalar *q) {
  return part_is_free(solver, OF_HAND + side, OF_HAND + side, q)
      && part_is_free(solver, OF_IDLE + side, OF_IDLE + side, q);
}

int @PREFIX@_arms_are_free(@PREFIX@_solver *solver, const scalar *lower, const scalar *upper, int near,
                           const scalar *palms, scalar *q) {
#if HAS_CLOSED_ARM
  return part_is_free(solver, OF_HAND, OF_TRUNK, q)
      && choose_arms(solver, lower, upper, near, 0, palms, q);
#else
  (void) lower, (void) upper, (void) near, (void) palms;
  return 0;
#endif
}
@}@
