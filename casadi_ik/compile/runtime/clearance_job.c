/* Arguments of `casadi_ik_clearance`. */

#ifndef OWN_SOLID
typedef struct {
  int64_t kind;
  scalar size[3];
  scalar reach;                /* radius of its bounding ball around the origin of its frame */
  int64_t first, planes;       /* first row and number of rows in the table of planes or points */
} solid;
#endif

enum { RECENT = 8 };

typedef struct {
  const scalar *q;             /* count rows of N_Q */
  const scalar *poses;         /* of the scene's solids: rotation (row-major), then origin */
  int64_t pose_step;           /* numbers from one configuration to the next, 0: the same for all */
  int64_t n_solids;            /* of the scene; in `solids` after those of the robot */
  const solid *solids;
  const scalar *planes;
  const scalar *radii, *halves;
  const int32_t *pairs;        /* a capsule, and a second one or N_CAPSULES + solid */
  const scalar *offsets;       /* subtracted from the distance of each pair */
  int64_t n_pairs;
  int64_t recent[RECENT];      /* recently critical pairs, which are checked first; -1: none */
  scalar max_distance;         /* larger distances are reported as this */
  scalar stop_below;           /* smaller distances are reported as any value below this */
  scalar *distances;           /* minimum over the pairs, for each configuration */
  int64_t *closest_pairs;      /* pair of the minimum; -1: none below `max_distance` */
  scalar *all_distances;       /* count rows of n_pairs, or NULL */
  int64_t count, next;
  scalar slice;
} clearance_job;
