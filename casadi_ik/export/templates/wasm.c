/* Functions that JavaScript calls: a solver, and the addresses of its arrays. */
#include "@PREFIX@.h"

#define EXPORTED(name) __attribute__((export_name(#name)))

static @PREFIX@_solver solver;
static double points[3 * @GUARD@_FINGERS], normals[3 * @GUARD@_FINGERS], q0[@GUARD@_MOTORS];
static double palm[12], posture[@GUARD@_MOTORS];

EXPORTED(init) void init(void);
EXPORTED(points_at) double *points_at(void);
EXPORTED(normals_at) double *normals_at(void);
EXPORTED(q0_at) double *q0_at(void);
EXPORTED(palm_at) double *palm_at(void);
EXPORTED(posture_at) double *posture_at(void);
EXPORTED(q_at) double *q_at(void);
EXPORTED(position_error_at) double *position_error_at(void);
EXPORTED(angle_error_at) double *angle_error_at(void);
EXPORTED(iterations) int iterations(void);
EXPORTED(restarts) int restarts(void);
EXPORTED(begin) int begin(int prefer_q0);
EXPORTED(run) int run(int max_iterations);
EXPORTED(solve) int solve(int prefer_q0);
EXPORTED(contacts) void contacts(void);
EXPORTED(set_tolerance) void set_tolerance(int finger, double position, double angle);
EXPORTED(set_range) void set_range(int motor, double lower, double upper);

void init(void) { @PREFIX@_init(&solver); }
double *points_at(void) { return points; }
double *normals_at(void) { return normals; }
double *q0_at(void) { return q0; }
double *palm_at(void) { return palm; }
double *posture_at(void) { return posture; }
double *q_at(void) { return solver.q; }
double *position_error_at(void) { return solver.position_error; }
double *angle_error_at(void) { return solver.angle_error; }
int iterations(void) { return (int) solver.iterations; }
int restarts(void) { return (int) solver.restarts; }
int begin(int prefer_q0) { return @PREFIX@_begin(&solver, points, normals, prefer_q0 ? q0 : 0); }
int run(int max_iterations) { return @PREFIX@_run(&solver, max_iterations); }
int solve(int prefer_q0) { return @PREFIX@_solve(&solver, points, normals, prefer_q0 ? q0 : 0); }
/* Computes the contacts of the configuration in q0. */
void contacts(void) { @PREFIX@_contacts(&solver, q0, points, normals); }
void set_tolerance(int finger, double position, double angle) {
  @PREFIX@_set_tolerance(&solver, finger, position, angle);
}
void set_range(int motor, double lower, double upper) {
  @PREFIX@_set_range(&solver, motor, lower, upper);
}
@PALM{@

EXPORTED(palm_contacts) int palm_contacts(void);
EXPORTED(solve_palm) int solve_palm(int prefer_q0);

/* Computes the contacts of the posture at the palm pose. */
int palm_contacts(void) { return @PREFIX@_touched(&solver, palm, posture, points, normals); }
int solve_palm(int prefer_q0) {
  return @PREFIX@_solve_palm(&solver, palm, posture, prefer_q0 ? q0 : 0);
}
@}@
@SCENE{@

static double shape_poses[@SHAPE_POSES@ + 1], size[3], pose[12];

EXPORTED(places_at) double *places_at(void);
EXPORTED(size_at) double *size_at(void);
EXPORTED(pose_at) double *pose_at(void);
EXPORTED(shapes) void shapes(void);
EXPORTED(clearance) double clearance(void);
EXPORTED(last_clearance) double last_clearance(void);
EXPORTED(closest) int closest(int index);
EXPORTED(set_solid) int set_solid(int number, int kind, int grasped);
EXPORTED(set_margin) void set_margin(double margin);

double *places_at(void) { return shape_poses; }
double *size_at(void) { return size; }
double *pose_at(void) { return pose; }
/* Computes the poses of shapes at the configuration in q0. */
void shapes(void) { @PREFIX@_shapes(&solver, q0, shape_poses); }
/* Returns the clearance of the configuration in q0. */
double clearance(void) { return @PREFIX@_clearance(&solver, q0); }
/* Returns the clearance of the last answer or configuration. */
double last_clearance(void) { return solver.clearance; }
/* Returns a link of the nearest pair, or -1 - number of a solid. */
int closest(int index) { return (int) solver.nearest[index]; }
int set_solid(int number, int kind, int grasped) {
  return @PREFIX@_set_solid(&solver, number, kind, size, pose, grasped);
}
void set_margin(double margin) { @PREFIX@_set_margin(&solver, margin); }
@}@
@FOLLOW{@

static @PREFIX@_follower follower;
static double rates[2 * @GUARD@_MOTORS];

EXPORTED(rates_at) double *rates_at(void);
EXPORTED(followed_at) double *followed_at(void);
EXPORTED(follow_from) int follow_from(int has_q0, double period, int has_velocity, int has_acceleration);
EXPORTED(follow) int follow(int has_palm);
EXPORTED(pause) void pause(void);
EXPORTED(resume) int resume(int has_q);
EXPORTED(follow_posture) int follow_posture(void);

/* Returns the array of velocity limits, then acceleration limits. */
double *rates_at(void) { return rates; }
/* Returns the array of q, velocity, position_error and angle_error. */
double *followed_at(void) { return follower.q; }
int follow_from(int has_q0, double period, int has_velocity, int has_acceleration) {
  return @PREFIX@_follow_from(&follower, has_q0 ? q0 : 0, period, has_velocity ? rates : 0,
                              has_acceleration ? rates + @GUARD@_MOTORS : 0);
}
int follow(int has_palm) { return @PREFIX@_follow(&follower, points, normals, has_palm ? palm : 0); }
void pause(void) { @PREFIX@_pause(&follower); }
int resume(int has_q) { return @PREFIX@_resume(&follower, has_q ? q0 : 0); }
int follow_posture(void) { return @PREFIX@_follow_posture(&follower, q0); }
@}@
