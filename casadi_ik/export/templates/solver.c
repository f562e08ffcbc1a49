/* Search for a solution of a target. */
#include "@PREFIX@_parts.h"

enum { DONE = 0, SLICE_OVER = 1, CONTINUES = 3 };

typedef @PREFIX@_solver search;

@CALLS@
@SIZES@
@CONSTANTS@
@SEEDS@
@SEARCH@
@SETTINGS@
@LIMITS@
const char *const @PREFIX@_finger_names[] = {@FINGER_NAMES@};
const char *const @PREFIX@_motor_names[] = {@MOTOR_NAMES@};

@SCENE_SEARCH@
void @PREFIX@_init(@PREFIX@_solver *solver) {
  memset(solver, 0, sizeof *solver);
  memcpy(solver->settings, SETTINGS, sizeof SETTINGS);
  memcpy(solver->ranges, SETTINGS + SETTINGS_LOWER, sizeof solver->ranges);
  solver->max_restarts = ALL_ROUNDS;
  solver->status = @GUARD@_BAD_INPUT;
@SCENE_INIT?@}

void @PREFIX@_set_tolerance(@PREFIX@_solver *solver, int finger, scalar position, scalar angle) {
  int i;
  for (i = 0; i < N_FINGERS; ++i) {
    if (finger >= 0 && i != finger) continue;
    solver->settings[i] = position@LESS_POSITION?@;
    solver->settings[N_FINGERS + i] = angle@LESS_ANGLE?@;
  }
}

void @PREFIX@_set_range(@PREFIX@_solver *solver, int motor, scalar lower, scalar upper) {
  solver->ranges[motor] = lower;
  solver->ranges[N_MOTORS + motor] = upper;
}

int @PREFIX@_begin(@PREFIX@_solver *solver, const scalar *points, const scalar *normals,
                   const scalar *q0) {
  memcpy(solver->points, points, sizeof solver->points);
  memcpy(solver->normals, normals, sizeof solver->normals);
  memcpy(solver->q0, q0 ? q0 : HOME, sizeof solver->q0);
  memcpy(solver->settings + SETTINGS_LOWER, solver->ranges, sizeof solver->ranges);
  solver->settings[SETTINGS_NEAREST] = q0 ? 1 : 0;
@SCENE_BEGIN?@  if (!search_begin(solver)) solver->status = @GUARD@_BAD_INPUT;
  return (int) solver->status;
}

int @PREFIX@_run(@PREFIX@_solver *solver, int64_t iterations) {
  if (solver->status == @GUARD@_RUNNING && continue_search(solver, iterations) != DONE) {
    solver->status = @GUARD@_INVALID;
  }
  return (int) solver->status;
}

int @PREFIX@_solve(@PREFIX@_solver *solver, const scalar *points, const scalar *normals,
                   const scalar *q0) {
  int status = @PREFIX@_begin(solver, points, normals, q0);
  while (status == @GUARD@_RUNNING) status = @PREFIX@_run(solver, BUDGET);
  return status;
}

void @PREFIX@_contacts(@PREFIX@_solver *solver, const scalar *q, scalar *points, scalar *normals) {
  const scalar *inputs[1];
  scalar *outputs[2];
  map_job map = mapping(1, inputs, ALONE, outputs, ALONE);
  inputs[0] = q;
  outputs[0] = points;
  outputs[1] = normals;
  (void) @PREFIX@_contacts_kernel(&map, &solver->memory);
}
@PALM?@