/* Kinematics in double precision: for the test alone, no part of the solver. */
@KINEMATICS@
#include "judge.h"

int judge(const double *q, const double *points, const double *normals, double *position,
          double *angle, double *beyond) {
  static double w[@JUDGE_W@];
  static long long int iw[@JUDGE_IW@];
  const double *arg[@JUDGE_ARG@];
  double *res[@JUDGE_RES@];
  arg[0] = q;
  arg[1] = points;
  arg[2] = normals;
  res[0] = position;
  res[1] = angle;
  res[2] = beyond;
  return STEP(arg, res, iw, w, 0);
}
