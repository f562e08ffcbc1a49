/* Solves the stored targets and compares the answers with those of Python bit for bit. Each target is
 * solved in one call, and by a second solver in calls of a few iterations, while the first one solves
 * another target. */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "@PREFIX@.h"
#include "targets.h"

static @PREFIX@_solver one, other;

static int is_as_stored(const @PREFIX@_solver *solver, const target *stored) {
@SCENE_TEST_FREED?@  return solver->status == stored->status && solver->iterations == stored->iterations
      && solver->restarts == stored->restarts
@SCENE_TEST_SAME?@      && (@SCENE_TEST_OR?@!memcmp(solver->q, stored->q, sizeof stored->q));
}

@FOLLOW{@
/* Counts the frames at which the follower answers otherwise than Python. */
static int count_wrong_frames(void) {
  static @PREFIX@_follower follower;
  int i, wrong = @PREFIX@_follow_from(&follower, 0, PERIOD, 0, 0) != 0;
  for (i = 0; i < FRAMES; ++i) {
    const frame *now = frames + i;
    wrong += @PREFIX@_follow(&follower, now->points, now->normals, 0) != now->status
          || memcmp(follower.q, now->q, sizeof now->q);
  }
  return wrong;
}

@}@
int main(void) {
  int i, wrong = 0, solved = 0, malformed = 0, calls = 0;
  double nothing[3 * @GUARD@_FINGERS] = {0};
  @PREFIX@_init(&one);
  @PREFIX@_init(&other);
@SCENE_TEST_SET?@  for (i = 0; i < TARGETS; ++i) {
    const target *now = targets + i, *before = targets + (i + TARGETS - 1) % TARGETS;
    const double *q0 = now->near ? now->q0 : 0;
    solved += @PREFIX@_solve(&one, now->points, now->normals, q0) == @GUARD@_SOLVED;
    wrong += !is_as_stored(&one, now);
    @PREFIX@_begin(&other, now->points, now->normals, q0);
    @PREFIX@_solve(&one, before->points, before->normals, 0);
    do ++calls;
    while (@PREFIX@_run(&other, 3) == @GUARD@_RUNNING);
    wrong += !is_as_stored(&other, now);
  }
  /* Normals of length zero. */
  malformed = @PREFIX@_solve(&one, nothing, nothing, 0) == @GUARD@_BAD_INPUT;
  printf("%d targets, %d solved, %d answers in %d calls of 3 iterations; wrong: %d\n", TARGETS,
         solved, TARGETS, calls, wrong);
@FOLLOW{@
  i = count_wrong_frames();
  printf("%d frames of moving contacts; wrong: %d\n", FRAMES, i);
  wrong += i;
@}@
  if (!malformed) printf("a malformed target was accepted\n");
  return wrong || !malformed;
}
