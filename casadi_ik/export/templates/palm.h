
/* Computes the contacts of a hand posture at a palm pose (rotation row by row, then the origin), as
 * targets of @PREFIX@_solve and others. posture has a number per motor; those of the arm are ignored.
 * Returns 0, or @GUARD@_BAD_INPUT if the pose is not a rigid motion or a motor exceeds its limits. */
int @PREFIX@_touched(@PREFIX@_solver *solver, const @REAL@ *palm, const @REAL@ *posture,
                     @REAL@ *points, @REAL@ *normals);

/* Solve for the arm, with the pose of the palm and the posture of the hand given; otherwise as
 * @PREFIX@_begin and @PREFIX@_solve. */
int @PREFIX@_begin_palm(@PREFIX@_solver *solver, const @REAL@ *palm, const @REAL@ *posture,
                        const @REAL@ *q0);
int @PREFIX@_solve_palm(@PREFIX@_solver *solver, const @REAL@ *palm, const @REAL@ *posture,
                        const @REAL@ *q0);
