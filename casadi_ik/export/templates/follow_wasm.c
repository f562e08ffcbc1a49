
static @PREFIX@_follower follower;
static double rates[2 * @GUARD@_MOTORS];

EXPORTED(rates_at) double *rates_at(void);
EXPORTED(followed_at) double *followed_at(void);
EXPORTED(follow_from) int follow_from(int near, double period, int fast, int accelerated);
EXPORTED(follow) int follow(int has_palm);

/* Velocities, then accelerations. */
double *rates_at(void) { return rates; }
/* q, velocity, position_error, angle_error. */
double *followed_at(void) { return follower.q; }
int follow_from(int near, double period, int fast, int accelerated) {
  return @PREFIX@_follow_from(&follower, near ? q0 : 0, period, fast ? rates : 0,
                              accelerated ? rates + @GUARD@_MOTORS : 0);
}
int follow(int has_palm) { return @PREFIX@_follow(&follower, points, normals, has_palm ? palm : 0); }
