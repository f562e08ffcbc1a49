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
@PALM_WASM?@@SCENE_WASM?@@FOLLOW_WASM?@