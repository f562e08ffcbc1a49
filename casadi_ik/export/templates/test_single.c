/* Solves the stored targets. Answers that are reported as solved must be solved by kinematics in
 * double precision (judge.c), and at most one in a thousand of the targets that double precision
 * solves may be missed. Each target is solved once in one call, and once in calls of a few iterations
 * by a second solver; the answers must be equal. */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "@PREFIX@.h"
#include "judge.h"
#include "targets.h"

static @PREFIX@_solver one, other;

static void copied(float *to, const double *from, int count) {
  while (count--) to[count] = (float) from[count];
}

/* Returns 1 if an answer meets its target in double precision. */
static int is_met(const @PREFIX@_solver *solver, const target *stored) {
  double q[@GUARD@_MOTORS], position[@GUARD@_FINGERS], angle[@GUARD@_FINGERS], beyond;
  int i, met = 1;
  for (i = 0; i < @GUARD@_MOTORS; ++i) q[i] = (double) solver->q[i];
  if (judge(q, stored->points, stored->normals, position, angle, &beyond)) return 0;
  for (i = 0; i < @GUARD@_FINGERS; ++i) met &= position[i] <= POSITION && angle[i] <= ANGLE;
@SCENE_TEST_SAME?@  return met && beyond <= LIMITS;
}

int main(void) {
  int i, wrong = 0, solved = 0, wanted = 0, missed = 0, malformed = 0, calls = 0;
  float nothing[3 * @GUARD@_FINGERS] = {0};
  @PREFIX@_init(&one);
  @PREFIX@_init(&other);
@SCENE_TEST_SET?@  for (i = 0; i < TARGETS; ++i) {
    const target *now = targets + i, *before = targets + (i + TARGETS - 1) % TARGETS;
    float points[3 * @GUARD@_FINGERS], normals[3 * @GUARD@_FINGERS], here[@GUARD@_MOTORS];
    const float *q0 = now->near ? here : 0;
    copied(here, now->q0, @GUARD@_MOTORS);
    copied(points, before->points, 3 * @GUARD@_FINGERS);
    copied(normals, before->normals, 3 * @GUARD@_FINGERS);
    @PREFIX@_solve(&one, points, normals, 0);
    copied(points, now->points, 3 * @GUARD@_FINGERS);
    copied(normals, now->normals, 3 * @GUARD@_FINGERS);
    @PREFIX@_begin(&other, points, normals, q0);
    @PREFIX@_solve(&one, points, normals, q0);
    do ++calls;
    while (@PREFIX@_run(&other, 3) == @GUARD@_RUNNING);
    wrong += one.status != other.status || one.iterations != other.iterations
          || memcmp(one.q, other.q, sizeof one.q);
    wrong += one.status == @GUARD@_SOLVED && !is_met(&one, now);
    wanted += now->status == @GUARD@_SOLVED;
    solved += one.status == @GUARD@_SOLVED;
    missed += one.status != @GUARD@_SOLVED && now->status == @GUARD@_SOLVED;
  }
  /* Normals of length zero. */
  malformed = @PREFIX@_solve(&one, nothing, nothing, 0) == @GUARD@_BAD_INPUT;
  printf("%d targets, %d solved of %d that are in double precision, %d missed, answers in %d calls of "
         "3 iterations; wrong: %d\n", TARGETS, solved, wanted, missed, calls, wrong);
  if (!malformed) printf("a malformed target was accepted\n");
  return wrong || missed > (TARGETS + 999) / 1000 || !malformed;
}
