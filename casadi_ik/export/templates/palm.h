
/* Computes the contacts of a hand posture at a palm pose (rotation row by row, then the origin), as
 * a target of @PREFIX@_solve and @PREFIX@_begin. posture has a number per motor; those of the arm are ignored.
 * Returns 0, or @GUARD@_BAD_INPUT if the pose is not a rigid motion or a motor exceeds its limits. */
int @PREFIX@_touched(@PREFIX@_solver *solver, const @REAL@ *palm, const @REAL@ *posture,
                     @REAL@ *points, @REAL@ *normals);

/* Solve for the arm at a palm pose with a hand posture; otherwise as @PREFIX@_begin and
 * @PREFIX@_solve. */
int @PREFIX@_begin_palm(@PREFIX@_solver *solver, const @REAL@ *palm, const @REAL@ *posture,
                        const @REAL@ *q0);
int @PREFIX@_solve_palm(@PREFIX@_solver *solver, const @REAL@ *palm, const @REAL@ *posture,
                        const @REAL@ *q0);
