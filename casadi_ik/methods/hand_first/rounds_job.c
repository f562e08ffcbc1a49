/* State of a solver; everything is in it, and nothing points into it between two calls. */
typedef struct {
  /* The question. */
  double points[3 * N_FINGERS], normals[3 * N_FINGERS];  /* base frame, NaN = free */
  double more[3 * N_FINGERS * N_MORE + 1];  /* contacts' other vectors, which get no verdict here */
  double here[N_MOTORS];
  double terms[N_TERMS];        /* tolerances [m], [rad]; lower, upper bounds; 1 = nearest wanted */
  /* The answer. */
  double q[N_MOTORS];
  double position_error[N_FINGERS], angle_error[N_FINGERS], beyond;
  int64_t iterations, restarts;
  int64_t status;
  /* On its way. */
  int64_t round, under_way, in_round;
  int64_t rounds;               /* of a search, at most; 0: its first alone, no other */
  int64_t again;                /* 1 = near `here` there was none: the search without preference */
  double state[N_STATE], last[N_STATE], parameters[N_PARAMETERS], mark[N_STATE];
  double postures[N_CANDIDATES * N_HAND];
  double near[N_POOL * N_HAND], mended[N_MENDED * N_HAND], left[N_MENDED];
  double places[N_POOL * N_HAND], closest[N_POOL];
  int64_t found[N_POOL];
  int64_t taken[N_POOL];
  double moved[(N_HAND + 1) * N_MOTORS];
  double moved_points[(N_HAND + 1) * 3 * N_FINGERS], moved_normals[(N_HAND + 1) * 3 * N_FINGERS];
  double rigid[36 * N_FINGERS], slopes[6 * N_FINGERS * N_HAND], held[N_HAND], motion[N_HAND];
  OWN_FIELDS
} rounds;

