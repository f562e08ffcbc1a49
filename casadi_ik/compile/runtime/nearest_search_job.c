/* Job of the search for nearest configurations (nearest_search.c). */

/* Postures of fingers that share motors. Tables are stored in tiles of TILE rows. */
typedef struct {
  const int64_t *fingers;      /* (n_fingers) */
  const int64_t *motors;       /* (n_motors) indices in q */
  const float *features;       /* (n_rows / TILE, 13 n_fingers, TILE) */
  const float *postures;       /* (n_rows, n_motors) */
  int64_t n_fingers, n_motors, n_rows;
} finger_group;

typedef struct {
  const float *arm_features;   /* (n_samples regions / TILE, 16 n_palms, TILE) */
  const float *arm_postures;   /* (n_samples, regions, n_arm_motors) */
  const int64_t *arm_motors;   /* (n_arm_motors) indices in q */
  const int64_t *palm_of_finger;   /* (n_fingers) */
  const finger_group *groups;  /* (n_groups) */
  const scalar *home;          /* (n_motors) */
  const scalar *ranges;        /* (n_motors) lengths by which travel is divided */
  const scalar *rigid_points;  /* (count or 1, n_fingers, 3) mean contact points in the palm frame */
  const scalar *rigid_axes;    /* (count or 1, n_fingers, 3, 3) axes of the contact frames, in rows */
  const scalar *parameters;    /* (count, n_parameters) of the descent */
  const scalar *q0;            /* (count, n_motors) */
  const scalar *last_q;        /* (count, n_motors) ends of failed solves; NaN: none */
  scalar *states;              /* (count, n_starts, n_state) starts, and results of their descents */
  scalar *slot_memory;         /* (slots, n_state + n_parameters) */
  float *costs;                /* (n_samples regions + regions or more) costs of table rows */
  float *coefficients;         /* of the features of palms, or of a group of fingers */
  scalar *sorted_values;       /* (max_sorted) */
  int64_t *sorted;             /* (max_sorted) */
  int64_t *rows;               /* (max_sorted, 1 + n_groups) rows of the tables */
  int64_t *finalists;          /* (count, n_finalists) */
  scalar *q;                   /* (count, n_motors) result */
  scalar *distances;           /* (count) distances of the result */
  loop_job *loop;              /* its pointers, slot count and slice are set */
  int (*lane_loop)(loop_job *job);     /* NULL: none */
  int (*scalar_loop)(loop_job *job);
  int64_t n_motors, n_fingers, n_palms, n_groups, n_arm_motors, regions, n_samples;
  int64_t rigid_step;          /* 1: a rigid hand for each target; 0: one hand for all targets */
  int64_t n_state, n_parameters, state_q, state_damping, state_distance;
  int64_t points, normals, tangents, weights, lower, upper;    /* parameters; tangents -1: none */
  int64_t count;               /* number of targets */
  int64_t n_starts, n_candidates, n_finalists, race_steps, max_iterations;
  int64_t stage, last_stage;   /* current stage; the call ends after the last one */
  scalar length, damping, tie, duplicate_gap;
} nearest_search_job;
