
/* Capacity of the scene, and the kinds of its solids. */
enum {
  @GUARD@_SCENE = @CAPACITY@,
@KINDS_C@
  @GUARD@_NOTHING = -1
};
enum { @GUARD@_COLLISION = 6 /* contacts and limits are met, but the robot is in collision */ };

/* Shapes of the robot: capsules, then boxes and cylinders. */
enum { @GUARD@_CAPSULES = @CAPSULES@, @GUARD@_OWN_SOLIDS = @OWN_SOLIDS@, @GUARD@_LINKS = @LINKS@ };
extern const char *const @PREFIX@_link_names[@GUARD@_LINKS];

typedef struct {
  int64_t kind;
  @REAL@ size[3], reach;
  int64_t first, planes;
} @PREFIX@_solid;

typedef struct {
  @REAL@ margin;
  @PREFIX@_solid solids[@SOLIDS@];
  @REAL@ poses[12 * @GUARD@_SCENE];
  int32_t grasped[@GUARD@_SCENE], pairs[2 * @MAX_PAIRS@];
  @REAL@ offsets[@MAX_PAIRS@];
  int64_t idle_pairs_begin, idle_pairs_end, n_pairs;
  /* State of the search for a collision-free answer. */
@ONE_ARM{@
  int64_t is_searching, preference_dropped, restart, candidate, n_hands, next_hand;
  int64_t iterations, restarts, has_new_hand, n_recorded_hands, n_free_hands;
@}@
@BODY{@
  int64_t group_ends[@PAIR_GROUPS@], has_pair_list;
  int64_t is_searching, preference_dropped, restart, candidate, trunk_stage, trunk_trial, task;
  int64_t has_new_hand, iterations, restarts;
@}@
  @REAL@ best_q[@GUARD@_MOTORS], best_surplus; /* answer of largest clearance; clearance - margin */
@BODY{@
  /* Collision-free hands of each side, and the poses of their palms. */
  int64_t n_hands[@SIDES@];
  @REAL@ hands[@SIDES@][@MAX_HANDS@][@GUARD@_MOTORS], palms[@SIDES@][@MAX_HANDS@][12];
@}@
@ONE_ARM{@
  /* Hands to try, sorted by rating; coordinates of all hand poses, and of collision-free ones. */
  @REAL@ hands[@N_CANDIDATES@ * @GUARD@_MOTORS], ratings[@N_CANDIDATES@];
  @REAL@ recorded_hands[@MAX_HANDS@ * @N_HAND_COORDINATES@];
  @REAL@ free_hands[@MAX_HANDS@ * @N_HAND_COORDINATES@];
@}@
} @PREFIX@_scene;
