
/* Status of a cycle of a follower. */
enum {
  @GUARD@_HOLDING = 0,   /* invalid frame: the motors decelerate to rest and wait */
  @GUARD@_FOLLOWING = 1, /* all contacts are within tolerance */
  @GUARD@_LATE = 2,      /* velocity and acceleration limits delay the motors */
  @GUARD@_MISSED = 3     /* no configuration on this branch meets the contacts */
};

/* Recovery of a follower that is stuck: a trail of postures that it has passed, and a line to one. */
typedef struct {
  double trail[@FOLLOW_TRAIL@][@GUARD@_MOTORS], start[@GUARD@_MOTORS], line[@GUARD@_MOTORS];
  double least_since, least_ratio, longest_step, done, line_step, next_step, line_max_step, line_change;
  int64_t count, cycles_to_check, check_cycles, patience, comparisons, cycles_stuck, candidate, destination;
  int64_t is_returning, has_line, has_met;
} @PREFIX@_recovery;

/* A robot that follows moving contacts. Its results are q (positions of the motors at the end of the
 * cycle), velocity, the errors and status. The other members are private. */
typedef struct {
  double q[@GUARD@_MOTORS], velocity[@GUARD@_MOTORS];
  double position_error[@GUARD@_FINGERS], angle_error[@GUARD@_FINGERS]; /* of q; 0 where free */
  int64_t status;
  double period, max_change[@GUARD@_MOTORS];
  double state[@FOLLOW_STATE@], new_state[@FOLLOW_STATE@];
  double parameters[@FOLLOW_PARAMETERS@], record[@FOLLOW_RECORD@];
  @PREFIX@_recovery recovery;
} @PREFIX@_follower;

/* Starts at rest at q0, or at home if that is a null pointer. period is the time between two cycles
 * [s]. velocity and acceleration are limits of the motors; null pointers select the velocities of the
 * robot's description, and accelerations that reach them from rest in a quarter of a second. Returns
 * 0, or @GUARD@_BAD_INPUT if a value is not finite or not positive; the follower is unusable then. */
int @PREFIX@_follow_from(@PREFIX@_follower *follower, const double *q0, double period,
                         const double *velocity, const double *acceleration);

/* Computes one cycle. Positions, velocities and accelerations of the motors stay within limits for all
 * targets. points and normals are as in @PREFIX@_begin. palm is a pose of the palm (rotation row by row,
 * then the origin) that is used as far as the contacts leave the palm free; it may be a null pointer.
 * An invalid frame is not an error; its status is @GUARD@_HOLDING. Collisions are not checked. */
int @PREFIX@_follow(@PREFIX@_follower *follower, const double *points, const double *normals,
                    const double *palm);
