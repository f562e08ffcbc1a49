/* Solves the stored targets. Targets reported as solved must be met by kinematics in double
 * precision (judge.c), and at most 0.1 % of the targets that double precision solves may be
 * missed. Each target is solved once in one call, and once in calls of a few iterations
 * by a second solver; the solutions must be equal. */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "@PREFIX@.h"
#include "judge.h"
#include "targets.h"

static @PREFIX@_solver whole_solver, sliced_solver;

static void to_float(float *to, const double *from, int count) {
  while (count--) to[count] = (float) from[count];
}

/* Returns 1 if a solution meets its target in double precision. */
static int is_met(const @PREFIX@_solver *solver, const target *stored) {
  double q[@GUARD@_MOTORS], position[@GUARD@_FINGERS], angle[@GUARD@_FINGERS], limit_excess;
  int i, is_within = 1;
  for (i = 0; i < @GUARD@_MOTORS; ++i) q[i] = (double) solver->q[i];
  if (judge(q, stored->points, stored->normals, position, angle, &limit_excess)) return 0;
  for (i = 0; i < @GUARD@_FINGERS; ++i) is_within &= position[i] <= POSITION && angle[i] <= ANGLE;
@SCENE_TEST_SAME?@  return is_within && limit_excess <= LIMITS;
}

int main(void) {
  int i, wrong = 0, solved = 0, solvable = 0, missed = 0, is_refused = 0, calls = 0;
  float zeros[3 * @GUARD@_FINGERS] = {0};
  @PREFIX@_init(&whole_solver);
  @PREFIX@_init(&sliced_solver);
@SCENE_TEST_SET?@  for (i = 0; i < TARGETS; ++i) {
    const target *current = targets + i, *previous = targets + (i + TARGETS - 1) % TARGETS;
    float points[3 * @GUARD@_FINGERS], normals[3 * @GUARD@_FINGERS], start[@GUARD@_MOTORS];
    const float *q0 = current->prefers_q0 ? start : 0;
    to_float(start, current->q0, @GUARD@_MOTORS);
    to_float(points, previous->points, 3 * @GUARD@_FINGERS);
    to_float(normals, previous->normals, 3 * @GUARD@_FINGERS);
    @PREFIX@_solve(&whole_solver, points, normals, 0);
    to_float(points, current->points, 3 * @GUARD@_FINGERS);
    to_float(normals, current->normals, 3 * @GUARD@_FINGERS);
    @PREFIX@_begin(&sliced_solver, points, normals, q0);
    @PREFIX@_solve(&whole_solver, points, normals, q0);
    do ++calls;
    while (@PREFIX@_run(&sliced_solver, 3) == @GUARD@_RUNNING);
    wrong += whole_solver.status != sliced_solver.status || whole_solver.iterations != sliced_solver.iterations
          || memcmp(whole_solver.q, sliced_solver.q, sizeof whole_solver.q);
    wrong += whole_solver.status == @GUARD@_SOLVED && !is_met(&whole_solver, current);
    solvable += current->status == @GUARD@_SOLVED;
    solved += whole_solver.status == @GUARD@_SOLVED;
    missed += whole_solver.status != @GUARD@_SOLVED && current->status == @GUARD@_SOLVED;
  }
  /* Normals of length zero. */
  is_refused = @PREFIX@_solve(&whole_solver, zeros, zeros, 0) == @GUARD@_BAD_INPUT;
  printf("%d targets, %d solved of %d that are in double precision, %d missed, answers in %d calls of "
         "3 iterations; wrong: %d\n", TARGETS, solved, solvable, missed, calls, wrong);
  if (!is_refused) printf("a malformed target was accepted\n");
  return wrong || missed > (TARGETS + 999) / 1000 || !is_refused;
}
