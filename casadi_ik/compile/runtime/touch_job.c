/* What `casadi_ik_touch` and `casadi_ik_apart` work on. */

enum { BINS = 20 };

typedef struct {
  /* The hand, in the palm's frame: pads and capsules of each posture of each finger. */
  const scalar *points, *normals;  /* (shares, postures, fingers, 3) */
  const scalar *capsules;      /* (shares, postures, n_capsules, 6) one end, and the way to the other */
  const scalar *fixed;         /* (n_fixed, 6) capsules that move with the palm alone */
  const scalar *lengths;       /* (n_capsules + n_fixed) of their segments */
  const scalar *off_scene, *off_object; /* (n_capsules + n_fixed) what their middles keep away */
  const int64_t *first;        /* (fingers + 1) a finger's first capsule */
  const int64_t *pads;         /* (n_capsules) whether it may touch where its finger does */
  const scalar *radii, *cos_lean; /* (fingers) of pads */
  uint64_t *apart;             /* (shares, fingers, fingers, postures, words) bits of the postures of
                                  the second finger that are clear of one of the first */
  const int64_t *crossing;     /* (n_crossing, 4) fingers and their capsules that must not meet */
  const scalar *reach;         /* (n_crossing) how near they may come */
  const int64_t *pairs;        /* (n, 4) share, finger, posture of the thumb and of that finger */
  const scalar *depths;        /* (n) how far from the palm's frame these grasp, 0 to 1 */
  int64_t shares, postures, words, n_fingers, n_capsules, n_fixed, n_crossing, thumb;
  /* The object. */
  const scalar *samples, *outward; /* (m, 3) */
  const int64_t *inside;       /* (m) whether a pad fits */
  const int64_t *patches;      /* (n_patches, 4) two samples, first pair of the hand, how many */
  int64_t n_patches;
  /* Grids: lower corner, edge of a cell; numbers of cells; values in the middles of cells. */
  scalar near_low[4], object_low[4], scene_low[4];
  int64_t near_count[3], object_count[3], scene_count[3];
  const scalar *near_height;   /* of the surface, and the sample there */
  const int64_t *near_sample;
  const scalar *object_value, *scene_value;
  scalar up[3];                /* what points upwards, in the object's frame */
  /* How it is looked for. */
  scalar near, clear, least_often;
  int64_t fingers, tries, most;
  int64_t seed;
  /* How often what was tried was clear. */
  scalar depth_clear[BINS], depth_tried[BINS], way_clear[BINS], way_tried[BINS];
  /* What was found. */
  int64_t wanted, found, drawn, attempts, fit, free;
  scalar *palms;               /* (wanted, 12) rotation row by row, origin */
  int64_t *shared, *postured;  /* (wanted), (wanted, fingers) */
  int64_t *used;               /* (wanted, fingers) */
  scalar slice;
} touch_job;
