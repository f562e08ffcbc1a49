#include "arm.h"
static arm_solver solver;
void many(int count, REAL position, REAL angle, const REAL *points, const REAL *normals,
          const REAL *q0, REAL *q, int *status) {
  int i, k;
  arm_init(&solver);
  arm_set_tolerance(&solver, -1, position, angle);
  for (i = 0; i < count; ++i) {
    status[i] = arm_solve(&solver, points + i * 3 * ARM_FINGERS, normals + i * 3 * ARM_FINGERS,
                          q0 ? q0 + i * ARM_MOTORS : 0);
    for (k = 0; k < ARM_MOTORS; ++k) q[i * ARM_MOTORS + k] = solver.q[k];
  }
}
