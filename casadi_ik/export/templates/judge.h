/* Computes the errors of the contacts [m, rad] and the largest excess of a motor or joint over its
 * limits [rad or m]. */
#define POSITION @POSITION_TOLERANCE@
#define ANGLE @ANGLE_TOLERANCE@
#define LIMITS @LIMIT_SLACK@

int judge(const double *q, const double *points, const double *normals, double *position,
          double *angle, double *limit_excess);
