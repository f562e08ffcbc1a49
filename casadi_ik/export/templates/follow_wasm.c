
static @PREFIX@_follower follower;
static double rates[2 * @GUARD@_MOTORS];

EXPORTED(rates_at) double *rates_at(void);
EXPORTED(followed_at) double *followed_at(void);
EXPORTED(follow_from) int follow_from(int has_q0, double period, int has_velocity, int has_acceleration);
EXPORTED(follow) int follow(int has_palm);

/* Returns the array of velocity limits, then acceleration limits. */
double *rates_at(void) { return rates; }
/* Returns the array of q, velocity, position_error and angle_error. */
double *followed_at(void) { return follower.q; }
int follow_from(int has_q0, double period, int has_velocity, int has_acceleration) {
  return @PREFIX@_follow_from(&follower, has_q0 ? q0 : 0, period, has_velocity ? rates : 0,
                              has_acceleration ? rates + @GUARD@_MOTORS : 0);
}
int follow(int has_palm) { return @PREFIX@_follow(&follower, points, normals, has_palm ? palm : 0); }
