
/* Puts solid `number` of @GUARD@_SCENE into the scene, or takes it out (@GUARD@_NOTHING). pose: rotation row by
 * row, then the origin (12 numbers). grasped: links whose pads are in contact may touch it. Being
@ONE_ARM{@
 * solved includes that nothing touches: the robot itself neither, also with nothing about it. Where
 * the answer touches, the arm's other ways to hold the hand are looked at, then up to @TRIED@ other hands
 * with theirs, which may take as long as so many solves; if none is free the status is
 * @GUARD@_COLLISION, and q the answer of largest clearance. */
@}@
@BODY{@
 * solved includes that nothing touches: the robot itself neither, also with nothing about it. Where
 * the answer touches, up to @MOST_TRUNKS@ other trunks and arms from anywhere are looked at for the same
 * hands, at each of them other arms, and in between up to @TRIED@ other hands, which may take as long as
 * so many solves; if none is free the status is @GUARD@_COLLISION, and q the answer of largest
 * clearance. */
@}@
int @PREFIX@_set_solid(@PREFIX@_solver *solver, int number, int kind, const @REAL@ *size,
                       const @REAL@ *pose, int grasped);

/* The distance to keep [m], 0 unless set. */
void @PREFIX@_set_margin(@PREFIX@_solver *solver, @REAL@ margin);

/* How far a configuration is from touching [m]; solver->nearest are the two. */
@REAL@ @PREFIX@_clearance(@PREFIX@_solver *solver, const @REAL@ *q);

/* Where the robot's shapes are: six numbers a capsule (middle of its segment, and from there to its
 * end), then twelve a solid (rotation row by row, origin). */
void @PREFIX@_shapes(@PREFIX@_solver *solver, const @REAL@ *q, @REAL@ *places);
