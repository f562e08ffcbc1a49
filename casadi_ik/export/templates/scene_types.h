
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
  int32_t grasped[@GUARD@_SCENE], pairs[2 * @MOST_PAIRS@];
  @REAL@ offsets[@MOST_PAIRS@];
  int64_t n_busy, n_held, n_pairs;
  /* State of the search for a collision-free answer. */
@ONE_ARM{@
  int64_t looking, again, round, fit, n_met, next, iterations, restarts, fresh, n_known, n_swung;
@}@
@BODY{@
  int64_t ends[@PARTS_OF_PAIRS@], listed;
  int64_t looking, again, round, fit, lot, tried, under_way, fresh, iterations, restarts;
@}@
  @REAL@ q[@GUARD@_MOTORS], room; /* the answer of largest clearance */
@BODY{@
  /* Collision-free hands of each side, and the poses of their palms. */
  int64_t n_hands[@SIDES@];
  @REAL@ hands[@SIDES@][@N_LOOKED@][@GUARD@_MOTORS], palms[@SIDES@][@N_LOOKED@][12];
@}@
@ONE_ARM{@
  @REAL@ met[@N_CANDIDATES@ * @GUARD@_MOTORS], rated[@N_CANDIDATES@];
  @REAL@ known[@N_LOOKED@ * @N_HAND_PARTS@], swung[@N_LOOKED@ * @N_HAND_PARTS@];
@}@
} @PREFIX@_scene;
