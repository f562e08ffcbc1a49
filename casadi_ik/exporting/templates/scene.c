/* What stands about the robot: how far it is, and another arm for the hand where one touches. */
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
@SWINGS@
static double length3(const double *v) { return sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); }

void @PREFIX@_scene_init(@PREFIX@_solver *solver) {
  int i;
  for (i = 0; i < N_OWN; ++i) {
    @PREFIX@_solid *own = solver->scene.solids + i;
    own->kind = OWN_KIND[i];
    memcpy(own->size, OWN_SIZE[i], sizeof own->size);
    own->reach = OWN_REACH[i];
  }
  for (i = 0; i < @GUARD@_SCENE; ++i) solver->scene.solids[N_OWN + i].kind = @GUARD@_NOTHING;
@FIRST_MARGIN@}

int @PREFIX@_set_solid(@PREFIX@_solver *solver, int number, int kind, const double *size,
                       const double *pose, int grasped) {
  @PREFIX@_solid *put;
  if (number < 0 || number >= @GUARD@_SCENE) return @GUARD@_BAD_INPUT;
  if (kind < @GUARD@_NOTHING || kind > @GUARD@_CYLINDER) return @GUARD@_BAD_INPUT;
  put = solver->scene.solids + N_OWN + number;
  put->kind = kind;
  solver->scene.grasped[number] = grasped;
  if (kind == @GUARD@_NOTHING) return 0;
  memcpy(solver->scene.poses + 12 * number, pose, 12 * sizeof(double));
  memset(put->size, 0, sizeof put->size);
  put->reach = 0;
  if (kind == @GUARD@_BOX) {
    int k;
    for (k = 0; k < 3; ++k) put->size[k] = size[k] / 2;
    put->reach = length3(put->size);
  } else if (kind != @GUARD@_HALF_SPACE) {
    put->size[0] = size[0];
    put->size[1] = size[1] / 2;
    put->reach = kind == @GUARD@_CAPSULE ? put->size[0] + put->size[1] : length3(put->size);
  }
  return 0;
}

void @PREFIX@_set_margin(@PREFIX@_solver *solver, double margin) { solver->scene.margin = margin@MORE_MARGIN@; }

void @PREFIX@_shapes(@PREFIX@_solver *solver, const double *q, double *places) {
  (void) @PREFIX@_place_kernel(q, places, &solver->memory);
}

static void add_pair(@PREFIX@_solver *solver, int i, int j, double offset) {
  const int64_t k = solver->scene.n_pairs++;
  solver->scene.pairs[2 * k] = i;
  solver->scene.pairs[2 * k + 1] = j;
  solver->scene.offsets[k] = offset;
}

/* Pairs that hand and palm decide, or those that the arm has a part in. */
static void add_pairs(@PREFIX@_solver *solver, int of_arm) {
  int i, k, f;
  for (k = 0; k < @GUARD@_SCENE; ++k) {
    if (solver->scene.solids[N_OWN + k].kind == @GUARD@_NOTHING) continue;
    for (i = 0; i < N_CAPSULES; ++i) {
      int may = 0;
      if (FIXED[i] || MOVING[i] != of_arm) continue;
      /* A finger may touch what it grasps with the link of its pad. */
      for (f = 0; f < @GUARD@_FINGERS; ++f) {
        may |= TOUCHES[f][i] && solver->points[3 * f] == solver->points[3 * f];
      }
      if (!(may && solver->scene.grasped[k])) add_pair(solver, i, N_CAPSULES + N_OWN + k, 0.0);
    }
  }
  for (k = 0; k < N_PAIRS; ++k) {
    if (PAIR_MOVING[k] == of_arm) add_pair(solver, PAIRS[k][0], PAIRS[k][1], OFFSETS[k]);
  }
}

static clearance_job about(@PREFIX@_solver *solver) {
  clearance_job job = {0};
  int i;
  solver->scene.n_pairs = 0;
  add_pairs(solver, 0);
  solver->scene.n_held = solver->scene.n_pairs;
  add_pairs(solver, 1);
  job.poses = solver->scene.poses;
  job.n_solids = @GUARD@_SCENE;
  job.solids = solver->scene.solids;
  job.radii = RADII;
  job.halves = HALVES;
  job.pairs = solver->scene.pairs;
  job.offsets = solver->scene.offsets;
  job.n_pairs = solver->scene.n_pairs;
  for (i = 0; i < RECENT; ++i) job.recent[i] = -1;
  job.most = INFINITY;
  job.enough = -INFINITY;
  job.count = 1;
  return job;
}

static double room_at(@PREFIX@_solver *solver, clearance_job *job, const double *q,
                      int64_t *closest) {
  double least = INFINITY;
  job->q = q;
  job->least = &least;
  job->closest = closest;
  job->next = 0;
  *closest = -1;
  (void) @PREFIX@_near_kernel(job, &solver->memory);
  return least - solver->scene.margin;
}

static int link_of(int number) {
  if (number < N_CAPSULES) return LINK[number];
  number -= N_CAPSULES;
  return number < N_OWN ? OWN_LINK[number] : N_OWN - 1 - number;
}

double @PREFIX@_clearance(@PREFIX@_solver *solver, const double *q) {
  clearance_job job = about(solver);
  int64_t closest;
  const double room = room_at(solver, &job, q, &closest);
  if (closest >= 0) {
    solver->nearest[0] = link_of(solver->scene.pairs[2 * closest]);
    solver->nearest[1] = link_of(solver->scene.pairs[2 * closest + 1]);
  }
  return solver->clearance = room + solver->scene.margin;
}

#if HAS_CLOSED_ARM
/* The preferred arm that touches nothing, for the hand of an answer; 0 if there is none. */
static int swing_arm(@PREFIX@_solver *solver, clearance_job *clear, const double *lower,
                     const double *upper, int near, double *q) {
  static const int64_t columns[] = ARM_COLUMNS;
  swings_job job = {0};
  map_job map = {0};
  const double *inputs[1];
  double *outputs[1], palm[16], low[N_ARM], high[N_ARM], arm[N_ARM], score = 0;
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
  clear->pairs += 2 * solver->scene.n_held;
  clear->offsets += solver->scene.n_held;
  clear->n_pairs -= solver->scene.n_held;
  job.arms = @PREFIX@_arms_kernel;
  job.check = @PREFIX@_near_kernel;
  job.clear = clear;
  job.lanes = 1;
  job.order = near ? NEAR_START : FAR_FROM_LIMITS;
  job.n_q = @GUARD@_MOTORS;
  job.n_arm = N_ARM;
  job.n_free = N_FREE;
  job.n_sides = N_SIDES;
  job.n_groups = 1;
  job.n_places[0] = N_PLACES;
  job.n_places[1] = N_MORE_PLACES;
  job.n_closer = N_CLOSER;
  job.places[0] = PLACES;
  job.places[1] = MORE_PLACES;
  job.closer = CLOSER;
  job.columns = columns;
  job.lower = low;
  job.upper = high;
  job.low = ARM_LOW;
  job.range = ARM_RANGE;
  job.q = q;
  job.palms = palm;
  job.starts = solver->here;
  job.poses = solver->scene.poses;
  job.margin = solver->scene.margin;
  job.rounding = ROUNDING;
  job.allowed = ALLOWED;
  job.count = 1;
  job.chosen = arm;
  job.score = &score;
  job.tried = &tried;
  job.memory = &solver->memory;
  if (casadi_ik_swings(&job) != DONE || !(score > -INFINITY)) return 0;
  for (i = 0; i < N_ARM; ++i) q[columns[i]] = arm[i];
  return 1;
}
#endif

int @PREFIX@_free(@PREFIX@_solver *solver, const double *lower, const double *upper, int near,
                  double *q) {
  int found = @PREFIX@_clearance(solver, q) - solver->scene.margin >= -ROUNDING;
#if HAS_CLOSED_ARM
  if (!found) {
    clearance_job job = about(solver);
    int64_t closest;
    job.n_pairs = solver->scene.n_held;
    if (room_at(solver, &job, q, &closest) < -ROUNDING) return 0;
    job = about(solver);
    found = swing_arm(solver, &job, lower, upper, near, q);
  }
#else
  (void) lower, (void) upper, (void) near;
#endif
  return found;
}
