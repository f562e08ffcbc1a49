/* How far fingertips are from their targets [m], [rad], and motors and joints beyond their limits. */
#define POSITION @POSITION_TOLERANCE@
#define ANGLE @ANGLE_TOLERANCE@
#define LIMITS @LIMIT_SLACK@

int judge(const double *q, const double *points, const double *normals, double *position,
          double *angle, double *beyond);
