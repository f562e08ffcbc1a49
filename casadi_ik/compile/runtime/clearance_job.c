/* What `casadi_ik_clearance` works on. */

#ifndef OWN_SOLID
typedef struct {
  int64_t kind;
  scalar size[3];
  scalar reach;                /* of the ball about its origin that holds it */
  int64_t first, planes;       /* rows of the table of planes, or points */
} solid;
#endif

enum { RECENT = 8 };

typedef struct {
  const scalar *q;             /* count rows of N_Q */
  const scalar *poses;         /* of the scene's solids: rotation row by row, then the origin */
  int64_t pose_step;           /* numbers from one configuration to the next, 0: the same for all */
  int64_t n_solids;            /* of the scene; they come behind the robot's own */
  const solid *solids;
  const scalar *planes;
  const scalar *radii, *halves;
  const int32_t *pairs;        /* capsule; another, or N_CAPSULES + solid */
  const scalar *offsets;       /* taken off each pair's distance */
  int64_t n_pairs;
  int64_t recent[RECENT];      /* pairs that are looked at first, those that were enough; -1: none */
  scalar most;                 /* distances above this are not told apart */
  scalar enough;               /* nor those below this */
  scalar *least;
  int64_t *closest;            /* pair of the least; -1: none below `most` */
  scalar *every;               /* count rows of n_pairs, or NULL */
  int64_t count, next;
  scalar slice;
} clearance_job;
