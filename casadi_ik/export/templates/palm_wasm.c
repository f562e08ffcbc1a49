
EXPORTED(touched) int touched(void);
EXPORTED(solve_palm) int solve_palm(int near);

/* Of the palm in palm, and the posture in posture. */
int touched(void) { return @PREFIX@_touched(&solver, palm, posture, points, normals); }
int solve_palm(int near) { return @PREFIX@_solve_palm(&solver, palm, posture, near ? q0 : 0); }
