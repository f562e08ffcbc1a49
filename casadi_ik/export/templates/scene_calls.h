
/* Places solid `number` (0 to @GUARD@_SCENE - 1) in the scene, or removes it (kind @GUARD@_NOTHING). pose is
 * the rotation row by row, then the origin (12 numbers). A grasped solid may be touched by the links
 * of fingertip pads that have a contact.
 *
 * A target is solved only if the robot collides neither with a solid nor with itself; self-collision
@ONE_ARM{@
 * is checked in an empty scene too. If an answer collides, the solver examines other arm
 * configurations for the same hand pose, and then up to @MAX_HAND_FITS@ other hand poses with theirs, which may
 * take as long as that many solves. If all of them collide, the status is @GUARD@_COLLISION, and q is
 * the answer of largest clearance. */
@}@
@BODY{@
 * is checked in an empty scene too. If an answer collides, the solver examines up to @MAX_TRUNK_TRIALS@
 * other trunk and arm configurations for the same hand poses, with other arms at each of them, and in
 * between up to @MAX_HAND_FITS@ other hand poses, which may take as long as that many solves. If all of them
 * collide, the status is @GUARD@_COLLISION, and q is the answer of largest clearance. */
@}@
int @PREFIX@_set_solid(@PREFIX@_solver *solver, int number, int kind, const @REAL@ *size,
                       const @REAL@ *pose, int grasped);

/* Sets the required clearance [m]; default: 0. */
void @PREFIX@_set_margin(@PREFIX@_solver *solver, @REAL@ margin);

/* Returns the clearance of a configuration [m], and stores the nearest pair in solver->nearest. */
@REAL@ @PREFIX@_clearance(@PREFIX@_solver *solver, const @REAL@ *q);

/* Computes the poses of the robot's shapes: six numbers per capsule (middle of its segment, and the
 * vector from there to its end), then twelve per solid (rotation row by row, origin). */
void @PREFIX@_shapes(@PREFIX@_solver *solver, const @REAL@ *q, @REAL@ *poses);
