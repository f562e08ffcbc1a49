
/* How a cycle of a follower ended. */
enum {
  @GUARD@_HOLDING = 0,   /* the frame was none: the motors come to rest and wait */
  @GUARD@_FOLLOWING = 1, /* every contact is within tolerance */
  @GUARD@_LATE = 2,      /* the motors are under way: velocities and accelerations permit no more */
  @GUARD@_MISSED = 3     /* no posture on this branch meets the contacts */
};

/* A robot that follows moving contacts. Read q (where the motors are to be at the end of the cycle),
 * velocity, the errors and status. Leave the rest. */
typedef struct {
  double q[@GUARD@_MOTORS], velocity[@GUARD@_MOTORS];
  double position_error[@GUARD@_FINGERS], angle_error[@GUARD@_FINGERS]; /* of q; 0 where free */
  int64_t status;
  double period, change[@GUARD@_MOTORS];
  double state[@FOLLOW_STATE@], after[@FOLLOW_STATE@];
  double asked[@FOLLOW_ASKED@], record[@FOLLOW_RECORD@];
} @PREFIX@_follower;

/* Begins at rest: at q0, or at home if that is a null pointer. period: time from cycle to cycle [s].
 * velocity and acceleration: limits of the motors; null pointers: the description's, and from rest to
 * the velocity limit in a quarter of a second. Returns 0, or @GUARD@_BAD_INPUT for what is no number
 * or not positive: the follower is none then. */
int @PREFIX@_follow_from(@PREFIX@_follower *follower, const double *q0, double period,
                         const double *velocity, const double *acceleration);

/* One cycle: positions, velocities and accelerations of the motors stay within limits, whatever the
 * targets do. points and normals as in @PREFIX@_begin. palm: a pose of the palm (rotation row by row,
 * then the origin) that counts as far as the contacts leave it free; a null pointer: anywhere. What is
 * malformed is no error of a stream (@GUARD@_HOLDING). Collisions are not looked at. */
int @PREFIX@_follow(@PREFIX@_follower *follower, const double *points, const double *normals,
                    const double *palm);
