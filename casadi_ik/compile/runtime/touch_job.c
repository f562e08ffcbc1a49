/* Job of the drivers `casadi_ik_touch` and `casadi_ik_apart`. */

enum { BINS = 20 };

typedef struct {
  /* The hand in the palm frame: pads and capsules of each posture of each finger. */
  const scalar *points, *normals;  /* (shares, postures, fingers, 3) */
  const scalar *capsules;      /* (shares, postures, n_capsules, 6) start of the axis, vector to its end */
  const scalar *palm_capsules; /* (n_palm_capsules, 6) capsules that are fixed to the palm */
  const scalar *lengths;       /* (n_capsules + n_palm_capsules) lengths of the axes */
  const scalar *scene_standoffs, *object_standoffs; /* (n_capsules + n_palm_capsules) minimum
                                                       distances of the axes from solids */
  const int64_t *first;        /* (fingers + 1) first capsule of each finger */
  const int64_t *may_touch;    /* (n_capsules) 1 for capsules that may touch if their finger does */
  const scalar *radii, *cos_lean; /* (fingers) radius and minimum cosine of the lean of each pad */
  uint64_t *separate;          /* (shares, fingers, fingers, postures, words) bit set of the postures of
                                  the second finger that do not collide with a posture of the first */
  const int64_t *crossing;     /* (n_crossing, 4) finger, capsule, finger, capsule of pairs to check */
  const scalar *min_distances; /* (n_crossing) minimum distances of the axes of these pairs */
  const int64_t *pairs;        /* (n, 4) share, finger, posture of the thumb, posture of the finger */
  const scalar *depths;        /* (n) pinch depths of the pairs, 0 to 1 */
  int64_t shares, postures, words, n_fingers, n_capsules, n_palm_capsules, n_crossing, thumb;
  /* The object. */
  const scalar *samples, *outward; /* (m, 3) points and outward normals of the surface */
  const int64_t *fits_pad;     /* (m) 1 for samples where a pad fits */
  const int64_t *patches;      /* (n_patches, 4) two samples, first pair of the hand, number of pairs */
  int64_t n_patches;
  /* Grids: lower corner and edge of a cell, numbers of cells, values at the centres of cells. */
  scalar surface_low[4], object_low[4], scene_low[4];
  int64_t surface_count[3], object_count[3], scene_count[3];
  const scalar *surface_height; /* signed distances from the surface */
  const int64_t *surface_sample; /* nearest samples */
  const scalar *object_value, *scene_value; /* distances */
  scalar up[3];                /* vertical direction in the object frame */
  /* Parameters of the search. */
  scalar max_height, idle_clearance, min_trial_probability;
  int64_t n_touching, max_posture_trials, max_attempts;
  int64_t seed;
  /* Numbers of collision-free trials and of all trials, by bin of palm depth and palm direction. */
  scalar depth_free[BINS], depth_trials[BINS], direction_free[BINS], direction_trials[BINS];
  /* Results. */
  int64_t n_requested, n_hands, n_draws, attempts, n_matched, n_free;
  scalar *palms;               /* (n_requested, 12) rotation row by row, origin; object frame */
  int64_t *hand_shares, *hand_postures; /* (n_requested), (n_requested, fingers) */
  int64_t *touches;            /* (n_requested, fingers) 1 for fingers that touch */
  scalar slice;
} touch_job;
