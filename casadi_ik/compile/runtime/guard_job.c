/* What `casadi_ik_keep_away` and `casadi_ik_stop_in_time` work on. */

typedef struct {
  scalar *at;                  /* where all pairs were looked at last; NaN: nowhere yet */
  scalar horizon;              /* how far apart pairs were there at least that are not listed */
  int64_t n_near, n_close;
  int64_t spent;               /* pairs that came into question since */
  int64_t *near;               /* the pairs that were nearer */
  scalar *known;               /* their distances there */
  int64_t *close;              /* those of them that come into question now */
  scalar *limits;              /* what these have to be apart on a way */
} surroundings;

typedef struct {
  clearance_job *about;        /* pairs and solids */
  const scalar *levers;        /* n_pairs rows of ROW: `collision.distances.levers` */
  const scalar *hand;          /* N_Q: 1 of motors beyond a palm */
  const scalar *side;          /* N_Q: number of the side; -1: all palms are moved by it */
  const scalar *widest;        /* N_Q: the longest of all pairs */
  scalar spare;                /* how far motors may move things until all pairs are looked at */
  surroundings *by_goal, *by_way;

  const scalar *goal;
  scalar minded;               /* distance below which the goal keeps away */
  scalar nudge;                /* of a motor, for slopes */
  scalar *rooms, *slopes;      /* of the OBSTACLES nearest pairs: what they lack, 0: nothing; rows of N_Q */

  const scalar *q, *last;      /* where motors are, and their last step */
  const scalar *wanted;        /* their next */
  const scalar *change;        /* how much a step may differ from the last */
  scalar enough;               /* distance that is kept */
  const scalar *shares;        /* of the wanted step, beside braking, that are tried one by one */
  int64_t n_shares;
  scalar *part;                /* the share of each motor; 0: it brakes */
  scalar *step, *rest;         /* the step made, and where it can end */
} guard_job;
