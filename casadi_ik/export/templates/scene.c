/* Clearance of the robot in its scene, and the search for collision-free hands and arms. */
#include "@PREFIX@_parts.h"

#define FREESTANDING
#define EXPORT static
#define KERNEL(name, work) int (*name)(work *, @PREFIX@_memory *)
#define CALL(kernel, work) kernel(work, job->memory)
#define ROOM(bytes) ((bytes) <= sizeof job->memory->scratch ? (char *) job->memory->scratch : 0)
#define GIVE_BACK(block) ((void) (block))
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
} side_arm;

#endif
@ARMS_OF_SIDES@
@}@
void @PREFIX@_scene_init(@PREFIX@_solver *solver) {
  int i, k;
  for (i = 0; i < N_OWN; ++i) {
    @PREFIX@_solid *solid = solver->scene.solids + i;
    solid->kind = OWN_KIND[i];
    for (k = 0; k < 3; ++k) solid->size[k] = OWN_SIZE[i][k];
    solid->reach = OWN_REACH[i];
  }
  for (i = 0; i < @GUARD@_SCENE; ++i) solver->scene.solids[N_OWN + i].kind = @GUARD@_NOTHING;
@FIRST_MARGIN?@}

int @PREFIX@_set_solid(@PREFIX@_solver *solver, int number, int kind, const scalar *size,
                       const scalar *pose, int grasped) {
  @PREFIX@_solid *solid;
  int k;
  if (number < 0 || number >= @GUARD@_SCENE) return @GUARD@_BAD_INPUT;
  if (kind < @GUARD@_NOTHING || kind >= N_KINDS) return @GUARD@_BAD_INPUT;
  solid = solver->scene.solids + N_OWN + number;
  solid->kind = kind;
  solver->scene.grasped[number] = grasped;
  if (kind == @GUARD@_NOTHING) return 0;
  memcpy(solver->scene.poses + 12 * number, pose, 12 * sizeof(scalar));
  solid->reach = 0; /* The sum of the sizes bounds the reach of every kind. */
  for (k = 0; k < 3; ++k) {
    solid->size[k] = SIZE_FACTORS[kind][k] > 0 ? SIZE_FACTORS[kind][k] * size[k] : 0;
    solid->reach += solid->size[k];
  }
  return 0;
}

void @PREFIX@_set_margin(@PREFIX@_solver *solver, scalar margin) { solver->scene.margin = margin@MORE_MARGIN?@; }

void @PREFIX@_shapes(@PREFIX@_solver *solver, const scalar *q, scalar *poses) {
  (void) @PREFIX@_place_kernel(q, poses, &solver->memory);
}

static void add_pair(@PREFIX@_solver *solver, int i, int j, scalar offset) {
  const int64_t k = solver->scene.n_pairs++;
  solver->scene.pairs[2 * k] = i;
  solver->scene.pairs[2 * k + 1] = j;
  solver->scene.offsets[k] = offset;
}

@ONE_ARM{@
/* Groups of pairs, by the motors that determine their distance: motors of fingers with a contact,
 * motors of idle fingers (fingers without a contact), motors of the arm. */
enum { HAND_PAIRS, IDLE_PAIRS, ARM_PAIRS };
@}@
@BODY{@
/* Groups of pairs, by the motors that determine their distance: a hand without its idle fingers
 * (fingers without a contact), by side; idle fingers, by side; trunk or several palms; an arm and the
 * arms of earlier sides, by side. */
enum {
  HAND_PAIRS,
  IDLE_PAIRS = N_SIDES,
  TRUNK_PAIRS = 2 * N_SIDES,
  ARM_PAIRS,
  N_PAIR_GROUPS = ARM_PAIRS + N_SIDES
};
@}@

@BODY{@
/* Returns the group of a pair, given the group without idle fingers. */
static int pair_group(int group, int has_idle_link) {
  return group < IDLE_PAIRS && has_idle_link ? IDLE_PAIRS + group : group;
}

@}@
/* Returns the link of a shape, or -1 - number of a solid in the scene. */
static int link_of(int shape) {
  if (shape < N_CAPSULES) return LINK[shape];
  shape -= N_CAPSULES;
  return shape < N_OWN ? OWN_LINK[shape] : N_OWN - 1 - shape;
}

/* Marks the motors of the hand that move no finger with a contact, and the links that they move. */
static void find_idle(@PREFIX@_solver *solver, const scalar *lower, const scalar *upper,
                      int *is_idle_motor, int *is_idle_link) {
  int k, f, i;
  memset(is_idle_link, 0, @GUARD@_LINKS * sizeof *is_idle_link);
  for (k = 0; k < N_HAND; ++k) {
    is_idle_motor[k] = lower[HAND[k]] < upper[HAND[k]];
    for (f = 0; f < @GUARD@_FINGERS; ++f) {
      is_idle_motor[k] &= !FINGER_MOVED[f][k] || solver->points[3 * f] != solver->points[3 * f];
    }
    for (i = 0; is_idle_motor[k] && i < @GUARD@_LINKS; ++i) is_idle_link[i] |= LINK_MOVED[i][k];
  }
}

/* Appends the pairs of a group. is_idle marks the links of idle fingers; null: no finger is idle. */
static void add_pairs(@PREFIX@_solver *solver, const int *is_idle, int group) {
  int i, k, f;
  for (k = 0; k < @GUARD@_SCENE; ++k) {
    if (solver->scene.solids[N_OWN + k].kind == @GUARD@_NOTHING) continue;
    for (i = 0; i < N_CAPSULES; ++i) {
      int is_contact_link = 0;
      if (FIXED[i] || @CAPSULE_GROUP@ != group) continue;
      /* Links of fingertip pads with a contact may touch the grasped object. */
      for (f = 0; f < @GUARD@_FINGERS; ++f) {
        is_contact_link |= TOUCHES[f][i] && solver->points[3 * f] == solver->points[3 * f];
      }
      if (is_contact_link && solver->scene.grasped[k]) continue;
      add_pair(solver, i, N_CAPSULES + N_OWN + k, 0);
    }
  }
  for (k = 0; k < N_PAIRS; ++k) {
    const int first_link = link_of(PAIRS[k][0]), second_link = link_of(PAIRS[k][1]);
    if (@PAIR_GROUP@ == group) {
      add_pair(solver, PAIRS[k][0], PAIRS[k][1], OFFSETS[k]);
    }
  }
}

/* Lists the pairs by group, and returns a job that checks all of them. */
static clearance_job new_clearance_job(@PREFIX@_solver *solver, const int *is_idle) {
  clearance_job job = {0};
  int i;
@ONE_ARM{@
  solver->scene.n_pairs = 0;
  add_pairs(solver, is_idle, HAND_PAIRS);
  solver->scene.idle_pairs_begin = solver->scene.n_pairs;
  add_pairs(solver, is_idle, IDLE_PAIRS);
  solver->scene.idle_pairs_end = solver->scene.n_pairs;
  add_pairs(solver, is_idle, ARM_PAIRS);
@}@
@BODY{@
  if (!solver->scene.has_pair_list) {
    solver->scene.n_pairs = 0;
    for (i = 0; i < N_PAIR_GROUPS; ++i) {
      add_pairs(solver, is_idle, i);
      solver->scene.group_ends[i] = solver->scene.n_pairs;
    }
    solver->scene.idle_pairs_begin = solver->scene.group_ends[IDLE_PAIRS - 1];
    solver->scene.idle_pairs_end = solver->scene.group_ends[TRUNK_PAIRS - 1];
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

/* Returns the clearance beyond the margin [m], and the closest pair of the job; -1: none. */
static scalar surplus_at(@PREFIX@_solver *solver, clearance_job *job, const scalar *q,
                         int64_t *closest) {
  scalar distance = INFINITY;
  job->q = q;
  job->distances = &distance;
  job->closest_pairs = closest;
  job->next = 0;
  *closest = -1;
  (void) @PREFIX@_near_kernel(job, &solver->memory);
  return distance - solver->scene.margin;
}

scalar @PREFIX@_clearance(@PREFIX@_solver *solver, const scalar *q) {
  clearance_job job = new_clearance_job(solver, 0);
  int64_t closest;
  const scalar surplus = surplus_at(solver, &job, q, &closest);
  if (closest >= 0) {
    solver->nearest[0] = link_of(solver->scene.pairs[2 * closest]);
    solver->nearest[1] = link_of(solver->scene.pairs[2 * closest + 1]);
  }
  return solver->clearance = surplus + solver->scene.margin;
}

@ONE_ARM{@
#if HAS_CLOSED_ARM
/* Replaces the arm in q by the preferred collision-free arm at the same palm pose; returns 0 if there
 * is none. */
static int choose_arm(@PREFIX@_solver *solver, const scalar *lower, const scalar *upper,
                      int prefer_q0, scalar *q) {
  clearance_job clearance = new_clearance_job(solver, 0);
  static const int64_t columns[] = ARM_COLUMNS;
  arm_search_job job = {0};
  map_job map = {0};
  const scalar *inputs[1];
  scalar *outputs[1], palm[16], arm_lower[N_ARM], arm_upper[N_ARM], arm[N_ARM], score = 0;
  const int64_t step = 0;
  int64_t n_arms = 0;
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
    arm_lower[i] = lower[columns[i]];
    arm_upper[i] = upper[columns[i]];
  }
  clearance.pairs += 2 * solver->scene.idle_pairs_end;
  clearance.offsets += solver->scene.idle_pairs_end;
  clearance.n_pairs -= solver->scene.idle_pairs_end;
  job.arms = @PREFIX@_arms_kernel;
  job.check = @PREFIX@_near_kernel;
  job.clearance = &clearance;
  job.lanes = 1;
  job.order = prefer_q0 ? NEAR_START : FAR_FROM_LIMITS;
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
  job.lower = arm_lower;
  job.upper = arm_upper;
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
  job.best_arms = arm;
  job.score = &score;
  job.arms_tried = &n_arms;
  job.memory = &solver->memory;
  if (casadi_ik_arm_search(&job) != DONE || !(score > -INFINITY)) return 0;
  for (i = 0; i < N_ARM; ++i) q[columns[i]] = arm[i];
  return 1;
}
#endif
@}@
@BODY{@
/* Returns a job that checks the pairs from one group to another. */
static clearance_job group_clearance_job(@PREFIX@_solver *solver, int first, int last) {
  clearance_job job = new_clearance_job(solver, 0);
  const int64_t begin = first ? solver->scene.group_ends[first - 1] : 0;
  job.pairs += 2 * begin;
  job.offsets += begin;
  job.n_pairs = solver->scene.group_ends[last] - begin;
  return job;
}

static int groups_are_free(@PREFIX@_solver *solver, int first, int last, const scalar *q) {
  clearance_job job = group_clearance_job(solver, first, last);
  int64_t closest;
  job.max_distance = solver->scene.margin;
  job.stop_below = solver->scene.margin - ROUNDING;
  return surplus_at(solver, &job, q, &closest) >= -ROUNDING;
}

#if HAS_CLOSED_ARM
/* Replaces the arms of this side and of later sides in q by collision-free arms at the same palm poses;
 * returns 0 if there are none. For every side but the last, the preferred arm of each branch is
 * combined with the arms of later sides. */
static int choose_arms(@PREFIX@_solver *solver, const scalar *lower, const scalar *upper,
                       int prefer_q0, int side, const scalar *palms, scalar *q) {
  const side_arm *arm = ARMS + side;
  const int last = side + 1 == N_SIDES;
  clearance_job clearance = group_clearance_job(solver, ARM_PAIRS + side, ARM_PAIRS + side);
  arm_search_job job = {0};
  scalar arm_lower[MAX_ARM], arm_upper[MAX_ARM];
  scalar arms[(MAX_ROWS + 1) * MAX_ARM], score[MAX_ROWS + 1];
  int64_t n_arms = 0;
  int i, k;
  for (i = 0; i < arm->n_arm; ++i) {
    arm_lower[i] = lower[arm->columns[i]];
    arm_upper[i] = upper[arm->columns[i]];
  }
  job.arms = arm->arms;
  job.check = @PREFIX@_near_kernel;
  job.clearance = &clearance;
  job.lanes = 1;
  job.order = prefer_q0 ? NEAR_START : FAR_FROM_LIMITS;
  job.n_q = @GUARD@_MOTORS;
  job.n_arm = arm->n_arm;
  job.n_redundancy = arm->n_redundancy;
  job.n_rows = arm->n_rows;
  job.n_groups = last ? 1 : arm->n_rows + 1;
  for (i = 0; i < LEVELS; ++i) {
    job.n_samples[i] = arm->n_samples[i];
    job.samples[i] = arm->samples[i];
  }
  job.columns = arm->columns;
  job.lower = arm_lower;
  job.upper = arm_upper;
  job.low = arm->low;
  job.range = arm->range;
  job.q = q;
  job.palms = palms + 16 * side;
  job.starts = solver->q0;
  job.poses = solver->scene.poses;
  job.margin = solver->scene.margin;
  job.rounding = ROUNDING;
  job.min_limit_margin = MIN_LIMIT_MARGIN;
  job.count = 1;
  job.best_arms = arms;
  job.score = score;
  job.arms_tried = &n_arms;
  job.memory = &solver->memory;
  if (casadi_ik_arm_search(&job) != DONE) return 0;
  for (k = 0; k < job.n_groups; ++k) {
    scalar candidate[@GUARD@_MOTORS];
    if (!(score[k] > -INFINITY)) continue;
    memcpy(candidate, q, sizeof candidate);
    for (i = 0; i < arm->n_arm; ++i) candidate[arm->columns[i]] = arms[k * arm->n_arm + i];
    if (!last && !choose_arms(solver, lower, upper, prefer_q0, side + 1, palms, candidate)) continue;
    memcpy(q, candidate, sizeof candidate);
    return 1;
  }
  return 0;
}
#endif
@}@

/* If only idle fingers collide, moves them to the posture of largest clearance. Returns the clearance
 * of hand and palm beyond the margin [m]. */
static scalar move_idle_fingers(@PREFIX@_solver *solver, const scalar *lower, const scalar *upper,
                                scalar *q) {
  int is_idle_motor[N_HAND + 1], is_idle_link[@GUARD@_LINKS], k, stage;
  scalar best_surplus, radius = 0, candidate[@GUARD@_MOTORS], best_q[@GUARD@_MOTORS];
  int64_t closest, sample;
  clearance_job job;
  find_idle(solver, lower, upper, is_idle_motor, is_idle_link);
  job = new_clearance_job(solver, is_idle_link);
  job.n_pairs = solver->scene.idle_pairs_begin;
  best_surplus = surplus_at(solver, &job, q, &closest);
  job.pairs += 2 * solver->scene.idle_pairs_begin;
  job.offsets += solver->scene.idle_pairs_begin;
  job.n_pairs = solver->scene.idle_pairs_end - solver->scene.idle_pairs_begin;
  if (best_surplus < -ROUNDING || !job.n_pairs) return best_surplus;
  best_surplus = surplus_at(solver, &job, q, &closest);
  memcpy(best_q, q, sizeof best_q);
  /* The first stage samples the whole range, later ones smaller neighbourhoods of the best posture. */
  for (stage = 0; stage <= N_IDLE_RADII && best_surplus < -ROUNDING; ++stage) {
    if (stage && !(best_surplus > -IDLE_MAX_GAIN)) break;
    if (stage) radius = IDLE_RADII[stage - 1];
    for (sample = 0; sample < (stage ? N_IDLE_LOCAL : N_IDLE); ++sample) {
      scalar surplus;
      memcpy(candidate, q, sizeof candidate);
      for (k = 0; k < N_HAND; ++k) {
        const int column = HAND[k];
        const scalar x = (scalar) 0.5 + (scalar) sample * HAND_SPREAD[k];
        const scalar fraction = x - (scalar) (int64_t) x;
        scalar position = HAND_LOWER[k] + fraction * HAND_RANGE[k];
        if (!is_idle_motor[k]) continue;
        if (stage) position = q[column] + radius * ((fraction - (scalar) 0.5) * HAND_RANGE[k]);
        position = position > lower[column] ? position : lower[column];
        candidate[column] = position < upper[column] ? position : upper[column];
      }
      surplus = surplus_at(solver, &job, candidate, &closest);
      if (!(surplus > best_surplus)) continue;
      best_surplus = surplus;
      memcpy(best_q, candidate, sizeof best_q);
    }
    memcpy(q, best_q, sizeof best_q);
  }
  job = new_clearance_job(solver, is_idle_link);
  job.n_pairs = solver->scene.idle_pairs_end;
  return surplus_at(solver, &job, q, &closest);
}

int @PREFIX@_hand_is_free(@PREFIX@_solver *solver, const scalar *lower, const scalar *upper,
                          scalar *q) {
  return move_idle_fingers(solver, lower, upper, q) >= -ROUNDING;
}

@ONE_ARM{@
int @PREFIX@_arm_is_free(@PREFIX@_solver *solver, const scalar *lower, const scalar *upper,
                         int prefer_q0, scalar *q) {
#if HAS_CLOSED_ARM
  return choose_arm(solver, lower, upper, prefer_q0, q);
#else
  (void) lower, (void) upper, (void) prefer_q0;
  return @PREFIX@_clearance(solver, q) - solver->scene.margin >= -ROUNDING;
#endif
}
@}@
@BODY{@
void @PREFIX@_list_pairs(@PREFIX@_solver *solver, const scalar *lower, const scalar *upper) {
  int is_idle_motor[N_HAND + 1], is_idle_link[@GUARD@_LINKS];
  find_idle(solver, lower, upper, is_idle_motor, is_idle_link);
  solver->scene.has_pair_list = 0;
  (void) new_clearance_job(solver, is_idle_link);
  solver->scene.has_pair_list = 1;
}

int @PREFIX@_side_is_free(@PREFIX@_solver *solver, int side, const scalar *q) {
  return groups_are_free(solver, HAND_PAIRS + side, HAND_PAIRS + side, q)
      && groups_are_free(solver, IDLE_PAIRS + side, IDLE_PAIRS + side, q);
}

int @PREFIX@_arms_are_free(@PREFIX@_solver *solver, const scalar *lower, const scalar *upper,
                           int prefer_q0, const scalar *palms, scalar *q) {
#if HAS_CLOSED_ARM
  return groups_are_free(solver, HAND_PAIRS, TRUNK_PAIRS, q)
      && choose_arms(solver, lower, upper, prefer_q0, 0, palms, q);
#else
  (void) lower, (void) upper, (void) prefer_q0, (void) palms;
  return 0;
#endif
}
@}@
