/* Kinematics in double precision, for the test only. */
@KINEMATICS@
#include "judge.h"

int judge(const double *q, const double *points, const double *normals, double *position,
          double *angle, double *limit_excess) {
  const double *arg[] = {q, points, normals};
  double *res[] = {position, angle, limit_excess};
  STEP(arg, res, 0);
  return 0;
}
