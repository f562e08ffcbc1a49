
EXPORTED(palm_contacts) int palm_contacts(void);
EXPORTED(solve_palm) int solve_palm(int prefer_q0);

/* Computes the contacts of the posture at the palm pose. */
int palm_contacts(void) { return @PREFIX@_touched(&solver, palm, posture, points, normals); }
int solve_palm(int prefer_q0) {
  return @PREFIX@_solve_palm(&solver, palm, posture, prefer_q0 ? q0 : 0);
}
