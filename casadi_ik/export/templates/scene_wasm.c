
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
