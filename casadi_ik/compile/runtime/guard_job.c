/* Data of `casadi_ik_keep_away` and `casadi_ik_stop_in_time`. */

/* Pairs near a configuration. */
typedef struct {
  scalar *q_listed;            /* N_Q: configuration at which all pairs were compared; NaN: none yet */
  scalar horizon;              /* pairs that are not listed were at least this far apart there */
  int64_t n_listed, n_candidates;
  int64_t n_checked;           /* pairs that were checked since */
  int64_t *listed;             /* pairs nearer than the horizon */
  scalar *distance_bounds;     /* lower bounds of their distances at q_listed */
  int64_t *candidates;         /* listed pairs that may violate their distance on the present path */
  scalar *required;            /* distances that the candidates must keep on the path */
} nearby_pairs;

typedef struct {
  clearance_job *scene;        /* pairs and solids */
  const scalar *levers;        /* n_pairs rows of ROW: `collision.distances.levers` */
  const scalar *hand;          /* N_Q: 1 for motors beyond a palm */
  const scalar *side;          /* N_Q: number of the side; -1 for motors that move all palms */
  const scalar *max_levers;    /* N_Q: largest lever of each motor over all pairs */
  scalar relist_motion;        /* motion of shapes after which all pairs are compared again */
  nearby_pairs *near_goal, *near_path;

  const scalar *goal;
  scalar avoided_distance;     /* distance below which the goal avoids a pair */
  scalar nudge;                /* step of the finite differences */
  scalar *lacking, *slopes;    /* lacking clearances of the OBSTACLES nearest pairs, 0: none; rows of N_Q */

  const scalar *q, *last_step; /* positions of the motors, and their last step */
  const scalar *wanted_step;   /* next step without obstacles */
  const scalar *change;        /* largest change of a step from cycle to cycle */
  scalar required_distance;    /* distance that every pair must keep */
  const scalar *shares;        /* shares of the requested step that are tried successively before braking */
  int64_t n_shares;
  scalar *share;               /* share of each motor; 0: the motor brakes */
  scalar *step, *q_rest;       /* the step, and the positions at rest after it */
} guard_job;
