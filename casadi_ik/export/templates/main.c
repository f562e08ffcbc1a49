/* @EXAMPLE_WHAT@ */
#include <stdio.h>

#include "@PREFIX@.h"

static @PREFIX@_solver solver;

int main(void) {
  static const @REAL@ points[] = @EXAMPLE_POINTS@;
  static const @REAL@ normals[] = @EXAMPLE_NORMALS@;
  int status, i;
  @PREFIX@_init(&solver);
  status = @PREFIX@_solve(&solver, points, normals, 0);
  printf("%s after %d iterations\n", status == @GUARD@_SOLVED ? "solved" : "not solved",
         (int) solver.iterations);
  for (i = 0; i < @GUARD@_MOTORS; ++i) {
    printf("  %-28s %10.6f\n", @PREFIX@_motor_names[i], @AS_DOUBLE?@solver.q[i]);
  }
  for (i = 0; i < @GUARD@_FINGERS; ++i) {
    printf("  %-28s %.2e m  %.2e rad\n", @PREFIX@_finger_names[i], @AS_DOUBLE?@solver.position_error[i],
           @AS_DOUBLE?@solver.angle_error[i]);
  }
  return status == @GUARD@_SOLVED ? 0 : 1;
}
