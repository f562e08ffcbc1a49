/* What `casadi_ik_clearance` works on. */

typedef struct {
  int64_t kind;
  double size[3];
  double reach;                /* of the ball about its origin that holds it */
  int64_t first, planes;       /* rows of the table of planes, or points */
} solid;

enum { RECENT = 8 };

typedef struct {
  const double *q;             /* count rows of N_Q */
  const double *poses;         /* of the scene's solids: rotation row by row, then the origin */
  int64_t pose_step;           /* doubles from one configuration to the next, 0: the same for all */
  int64_t n_solids;            /* of the scene; they come behind the robot's own */
  const solid *solids;
  const double *planes;
  const double *radii, *halves;
  const int32_t *pairs;        /* capsule; another, or N_CAPSULES + solid */
  const double *offsets;       /* taken off each pair's distance */
  int64_t n_pairs;
  int64_t recent[RECENT];      /* pairs that are looked at first, those that were enough; -1: none */
  double most;                 /* distances above this are not told apart */
  double enough;               /* nor those below this */
  double *least;
  int64_t *closest;            /* pair of the least; -1: none below `most` */
  double *every;               /* count rows of n_pairs, or NULL */
  int64_t count, next;
  double slice;
} clearance_job;
