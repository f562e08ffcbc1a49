
/* Where the fingertips are if the hand has a posture and its palm a pose (rotation row by row, then
 * the origin): targets for @PREFIX@_solve and others. posture has a number for each motor; those of
 * the arm are not looked at. Returns 0, or @GUARD@_BAD_INPUT for no rigid motion and for motors beyond
 * their limits. */
int @PREFIX@_touched(@PREFIX@_solver *solver, const @REAL@ *palm, const @REAL@ *posture,
                     @REAL@ *points, @REAL@ *normals);

/* As @PREFIX@_begin and @PREFIX@_solve, for a palm that is given with the posture of the hand: only the
 * arm is unknown. */
int @PREFIX@_begin_palm(@PREFIX@_solver *solver, const @REAL@ *palm, const @REAL@ *posture,
                        const @REAL@ *q0);
int @PREFIX@_solve_palm(@PREFIX@_solver *solver, const @REAL@ *palm, const @REAL@ *posture,
                        const @REAL@ *q0);
