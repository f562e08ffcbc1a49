/* Solves the stored targets and compares the solutions with those of Python bit for bit. Each target is
 * solved in one call, and by a second solver in calls of a few iterations, while the first solver
 * solves another target. */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "@PREFIX@.h"
#include "targets.h"

static @PREFIX@_solver whole_solver, sliced_solver;

static int is_as_stored(const @PREFIX@_solver *solver, const target *stored) {
@SCENE_TEST_FREED?@  return solver->status == stored->status && solver->iterations == stored->iterations
      && solver->restarts == stored->restarts
@SCENE_TEST_SAME?@      && (@SCENE_TEST_OR?@!memcmp(solver->q, stored->q, sizeof stored->q));
}

@FOLLOW{@
/* Counts the frames at which the results of the follower differ from those of Python. */
static int count_wrong_frames(void) {
  static @PREFIX@_follower follower;
  int i, wrong = @PREFIX@_follow_from(&follower, 0, PERIOD, 0, 0) != 0;
  for (i = 0; i < FRAMES; ++i) {
    const frame *current = frames + i;
    wrong += @PREFIX@_follow(&follower, current->points, current->normals, 0) != current->status
          || memcmp(follower.q, current->q, sizeof current->q);
  }
  return wrong;
}

@}@
int main(void) {
  int i, wrong = 0, solved = 0, is_refused = 0, calls = 0;
  double zeros[3 * @GUARD@_FINGERS] = {0};
  @PREFIX@_init(&whole_solver);
  @PREFIX@_init(&sliced_solver);
@SCENE_TEST_SET?@  for (i = 0; i < TARGETS; ++i) {
    const target *current = targets + i, *previous = targets + (i + TARGETS - 1) % TARGETS;
    const double *q0 = current->prefers_q0 ? current->q0 : 0;
    solved += @PREFIX@_solve(&whole_solver, current->points, current->normals, q0) == @GUARD@_SOLVED;
    wrong += !is_as_stored(&whole_solver, current);
    @PREFIX@_begin(&sliced_solver, current->points, current->normals, q0);
    @PREFIX@_solve(&whole_solver, previous->points, previous->normals, 0);
    do ++calls;
    while (@PREFIX@_run(&sliced_solver, 3) == @GUARD@_RUNNING);
    wrong += !is_as_stored(&sliced_solver, current);
  }
  /* Normals of length zero. */
  is_refused = @PREFIX@_solve(&whole_solver, zeros, zeros, 0) == @GUARD@_BAD_INPUT;
  printf("%d targets, %d solved, %d answers in %d calls of 3 iterations; wrong: %d\n", TARGETS,
         solved, TARGETS, calls, wrong);
@FOLLOW{@
  i = count_wrong_frames();
  printf("%d frames of moving contacts; wrong: %d\n", FRAMES, i);
  wrong += i;
@}@
  if (!is_refused) printf("a malformed target was accepted\n");
  return wrong || !is_refused;
}
