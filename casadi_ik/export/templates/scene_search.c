#define CLEARANCE_ROUNDING @ROUNDING@
@SCENE_SEARCH_CONSTANTS@

const char *const @PREFIX@_link_names[] = {@LINK_NAMES@};

/* Returns the clearance beyond the margin [m]; negative in collision. */
static scalar surplus_of(@PREFIX@_solver *solver, const scalar *q) {
  return @PREFIX@_clearance(solver, q) - solver->scene.margin;
}

/* Makes a configuration the answer; returns 1 if it meets contacts and limits. */
static int set_answer(@PREFIX@_solver *solver, const scalar *q) {
  memmove(solver->q, q, sizeof solver->q);
  solver->status = STALLED_STATUS;
  return judge(solver) == DONE && solver->status == SOLVED_STATUS;
}

/* Ends the search with a collision-free answer, or with the answer of largest clearance. If solutions
 * near q0 are preferred and all of them collide, the search starts again without the preference,
 * because a preference must not decide whether a target is solved. */
static void end_scene_search(@PREFIX@_solver *solver, int is_free) {
  @PREFIX@_scene *scene = &solver->scene;
  scene->is_searching = 0;
@BODY{@
  scene->has_pair_list = 0;
@}@
  if (!is_free && solver->settings[SETTINGS_NEAREST] > 0 && !scene->preference_dropped) {
    solver->settings[SETTINGS_NEAREST] = 0;
    memcpy(solver->q0, HOME, sizeof solver->q0);
    scene->preference_dropped = 1;
    solver->slot = -1;
    solver->loop_status = UNBEGUN;
    solver->iterations = 0;
    solver->status = RUNNING;
    return;
  }
  if (!is_free) (void) set_answer(solver, scene->best_q);
  (void) surplus_of(solver, solver->q);
  solver->status = is_free ? SOLVED_STATUS : @GUARD@_COLLISION;
  solver->iterations = scene->iterations;
  solver->restarts = scene->restarts;
}

@ONE_ARM{@
/* Chooses a collision-free arm for the palm pose of a configuration; returns 1 if it is an answer. */
static int choose_free_arm(@PREFIX@_solver *solver, const scalar *q_hand) {
  scalar q[N_MOTORS];
  memcpy(q, q_hand, sizeof q);
  return @PREFIX@_arm_is_free(solver, solver->settings + SETTINGS_LOWER,
                              solver->settings + SETTINGS_UPPER,
                              solver->settings[SETTINGS_NEAREST] > 0, q)
      && set_answer(solver, q) && surplus_of(solver, q) >= -CLEARANCE_ROUNDING;
}

#if HAS_CLOSED_ARM
/* Appends the coordinates of a hand pose (motors of the hand divided by their ranges, then the pose of
 * the palm) to those of earlier hand poses; returns 0 if they equal earlier ones. */
static int add_if_new(search *job, const scalar *q, scalar *hand_poses, int64_t *count) {
  scalar *coordinates = hand_poses + *count * N_HAND_COORDINATES, palm[16];
  const scalar *inputs[1];
  scalar *outputs[1];
  map_job map = mapping(1, inputs, ALONE, outputs, ALONE);
  int64_t i;
  int k;
  inputs[0] = q;
  outputs[0] = palm;
  if (PALM(&map) != DONE) return 0;
  for (k = 0; k < N_HAND; ++k) coordinates[k] = q[HAND[k]] / MOTOR_RANGES[HAND[k]];
  for (i = 0; i < 12; ++i, ++k) {
    coordinates[k] = palm[i] * (i % 4 < 3 ? PALM_ROTATION_SCALE : PALM_TRANSLATION_SCALE);
  }
  for (i = 0; i < *count; ++i) {
    const scalar *earlier = hand_poses + i * N_HAND_COORDINATES;
    for (k = 0; k < N_HAND_COORDINATES; ++k) {
      if (!(fabs(coordinates[k] - earlier[k]) < MIN_HAND_DIFFERENCE)) break;
    }
    if (k == N_HAND_COORDINATES) return 0;
  }
  ++*count;
  return 1;
}
#else
/* Without an arm in closed form every hand pose is tried. */
#define add_if_new(job, q, hand_poses, count) 1
#endif

/* Returns the preference score of a hand, higher is better. Without an arm in closed form the motors
 * of the arm count too. */
static scalar hand_rating(const @PREFIX@_solver *solver, const scalar *q) {
  const int prefer_q0 = solver->settings[SETTINGS_NEAREST] > 0;
  const int count = HAS_CLOSED_ARM ? N_HAND : N_MOTORS;
  scalar rating = prefer_q0 ? 0 : INFINITY;
  int k;
  for (k = 0; k < count; ++k) {
    const int i = HAS_CLOSED_ARM ? HAND[k] : k;
    if (prefer_q0) {
      const scalar change = (q[i] - solver->q0[i]) / MOTOR_RANGES[i];
      rating -= change * change;
    } else {
      const scalar below = q[i] - LOWER[i], above = UPPER[i] - q[i];
      const scalar margin = (below < above ? below : above) / ((UPPER[i] - LOWER[i]) / 2);
      if (margin < rating) rating = margin;
    }
  }
  return rating;
}

/* Inserts a hand that meets the contacts into the list of hands, sorted by rating, unless it collides
 * or equals an earlier one. Idle fingers that collide are moved first. */
static void record_hand(@PREFIX@_solver *solver, scalar *q) {
  @PREFIX@_scene *scene = &solver->scene;
  const scalar surplus = surplus_of(solver, q);
  scalar rating;
  int64_t row;
  int is_free;
  if (surplus > scene->best_surplus) {
    scene->best_surplus = surplus;
    memcpy(scene->best_q, q, sizeof scene->best_q);
  }
  is_free = @PREFIX@_hand_is_free(solver, solver->settings + SETTINGS_LOWER,
                                  solver->settings + SETTINGS_UPPER, q);
  scene->has_new_hand |= add_if_new(solver, q, scene->recorded_hands, &scene->n_recorded_hands);
  if (!is_free || !add_if_new(solver, q, scene->free_hands, &scene->n_free_hands)) return;
  rating = hand_rating(solver, q);
  for (row = scene->n_hands++; row > 0; --row) {
    const scalar previous = scene->ratings[row - 1];
    if (HAS_CLOSED_ARM ? !(rating > previous) : !(rating >= previous)) break;
    scene->ratings[row] = previous;
    memcpy(scene->hands + row * N_MOTORS, scene->hands + (row - 1) * N_MOTORS,
           sizeof scene->best_q);
  }
  scene->ratings[row] = rating;
  memcpy(scene->hands + row * N_MOTORS, q, sizeof scene->best_q);
}

/* If the answer collides, starts the search for a collision-free one: with other arms for the same
 * hand pose, then (`continue_scene_search`) with other hand poses. */
static void begin_scene_search(@PREFIX@_solver *solver) {
  @PREFIX@_scene *scene = &solver->scene;
  scalar q[N_MOTORS];
  const scalar surplus = surplus_of(solver, solver->q);
  if (!scene->preference_dropped) {
    scene->iterations = solver->iterations;
    scene->restarts = solver->restarts;
    scene->best_surplus = -INFINITY;
  }
  if (surplus >= -CLEARANCE_ROUNDING) {
    end_scene_search(solver, 1);
    return;
  }
  scene->is_searching = 1;
  scene->restart = scene->candidate = scene->next_hand = 0;
  scene->n_hands = scene->n_recorded_hands = scene->n_free_hands = 0;
  memcpy(q, solver->q, sizeof q);
  record_hand(solver, q);
  if (scene->n_hands && choose_free_arm(solver, scene->hands)) {
    end_scene_search(solver, 1);
    return;
  }
  scene->n_hands = 0;
  scene->has_new_hand = 1;
  solver->status = RUNNING;
}

@}@
/* Starts the fit of the next hand of this restart. */
static int begin_hand(search *job) {
  @PREFIX@_scene *scene = &job->scene;
  const scalar *inputs[5], preference = job->settings[SETTINGS_NEAREST];
  scalar *outputs[2], start[N_MOTORS];
  map_job map = mapping(1, inputs, ALONE, outputs, ALONE);
  int code = DONE, i;
  if (!scene->candidate) {
    scene->has_new_hand = 0;
    /* All candidates are fitted, so that their order is irrelevant, and the search has started from
     * q0 before. */
    job->settings[SETTINGS_NEAREST] = 0;
    code = seed_from_tables(job, scene->restart);
    job->settings[SETTINGS_NEAREST] = preference;
  }
  if (code != DONE) return code;
  for (i = 0; i < N_CANDIDATES; ++i) {
    memcpy(job->seed_pool + i * N_HAND, job->postures + scene->candidate * N_HAND,
           N_HAND * sizeof(scalar));
  }
  for (i = 0; i < N_MOTORS; ++i) {
    start[i] = clipped(job->q0[i], job->settings[SETTINGS_LOWER + i],
                      job->settings[SETTINGS_UPPER + i]);
  }
  inputs[0] = job->points;
  inputs[1] = job->normals;
  inputs[2] = start;
  inputs[3] = job->settings;
  inputs[4] = job->seed_pool;
  outputs[0] = job->state;
  outputs[1] = job->parameters;
  code = BEGIN(&map);
  job->state[STATE_PHASE] = CANDIDATE_STAGE;
  job->state[STATE_CANDIDATE] = N_CANDIDATES - 1;
  /* A different palm for each posture, where contacts leave the palm free. */
  job->state[STATE_PALM_NUMBER] = (scalar) (scene->restart * N_CANDIDATES + scene->candidate);
@BODY{@
  job->state[STATE_FIRST_CANDIDATE] = N_CANDIDATES - 1;
@}@
  job->slot = -1;
  job->loop_status = RUNNING;
  return code;
}

@ONE_ARM{@
/* Continues with at most max_iterations of one fit, or with the arms of one hand pose. */
static int continue_scene_search(@PREFIX@_solver *solver, int64_t max_iterations) {
  @PREFIX@_scene *scene = &solver->scene;
  int code;
  if (scene->candidate == N_CANDIDATES) {
    if (scene->next_hand < scene->n_hands) {
      const scalar *q_hand = scene->hands + scene->next_hand++ * N_MOTORS;
      if (choose_free_arm(solver, q_hand)) end_scene_search(solver, 1);
      else solver->status = RUNNING;
      return DONE;
    }
    /* Later restarts find new hands only if this one has found any. */
    if (++scene->restart == SCENE_RESTARTS || !scene->has_new_hand) {
      end_scene_search(solver, 0);
      return DONE;
    }
    scene->candidate = scene->next_hand = scene->n_hands = 0;
  }
  if (max_iterations <= 0) return DONE;
  if (solver->slot < 0) {
    code = begin_hand(solver);
    if (code != DONE) return code;
  }
  code = iterate(solver, max_iterations, NULL);
  if (code != DONE) return code == SLICE_OVER ? DONE : code;
  ++scene->candidate;
  memcpy(solver->q, solver->state + STATE_Q, sizeof solver->q);
  if (set_answer(solver, solver->q)) {
    scalar q[N_MOTORS];
    memcpy(q, solver->q, sizeof q);
    record_hand(solver, q);
  }
  solver->status = RUNNING;
  return DONE;
}

@}@
@BODY{@
/* Computes the palm poses of all sides: in the base frame, twelve numbers per side, and in the frame at
 * the end of the trunk, sixteen numbers per side. */
static int compute_palms(search *job, const scalar *q, scalar *palms, scalar *trunk_palms) {
  const scalar *inputs[1];
  scalar *outputs[2];
  map_job map = mapping(1, inputs, ALONE, outputs, ALONE);
  inputs[0] = q;
  outputs[0] = palms;
  outputs[1] = trunk_palms;
  return PALM(&map);
}

/* Returns 1 if the hand posture or palm pose of a side differs from all recorded ones. */
static int is_new_hand(const @PREFIX@_scene *scene, int side, int first, const scalar *q,
                  const scalar *palm) {
  int64_t n;
  int i;
  for (n = 0; n < scene->n_hands[side]; ++n) {
    const scalar *hand = scene->hands[side][n], *recorded_palm = scene->palms[side][n];
    int is_equal = 1;
    for (i = first; i < first + SIDE_HANDS[side]; ++i) {
      is_equal &= fabs(q[HAND[i]] - hand[HAND[i]]) < MIN_HAND_DIFFERENCE * MOTOR_RANGES[HAND[i]];
    }
    for (i = 0; i < 12; ++i) {
      const scalar scale = i < 9 ? PALM_ROTATION_SCALE : PALM_TRANSLATION_SCALE;
      is_equal &= scale * fabs(palm[i] - recorded_palm[i]) < MIN_HAND_DIFFERENCE;
    }
    if (is_equal) return 0;
  }
  return 1;
}

/* Records the collision-free hands of a configuration that meets the contacts, by side. Idle fingers
 * that collide are moved first. Returns 1 if the whole robot is collision-free. */
static int record_hands(search *job, scalar *q) {
  @PREFIX@_scene *scene = &job->scene;
  scalar palms[12 * N_SIDES], trunk_palms[16 * N_SIDES], surplus;
  int side, first = 0;
  (void) @PREFIX@_hand_is_free(job, job->settings + SETTINGS_LOWER,
                               job->settings + SETTINGS_UPPER, q);
  surplus = surplus_of(job, q);
  if (surplus > scene->best_surplus) {
    scene->best_surplus = surplus;
    memcpy(scene->best_q, q, sizeof scene->best_q);
  }
  if (surplus >= -CLEARANCE_ROUNDING) return set_answer(job, q);
  if (compute_palms(job, q, palms, trunk_palms) != DONE) return 0;
  for (side = 0; side < N_SIDES; first += SIDE_HANDS[side++]) {
    const int64_t n = scene->n_hands[side];
    const scalar *palm = palms + 12 * side;
    if (!@PREFIX@_side_is_free(job, side, q)) continue;
    if (!is_new_hand(scene, side, first, q, palm)) continue;
    memcpy(scene->hands[side][n], q, sizeof scene->hands[side][n]);
    memcpy(scene->palms[side][n], palm, sizeof scene->palms[side][n]);
    ++scene->n_hands[side];
    scene->has_new_hand = 1;
  }
  return 0;
}

/* Tasks of the loop: to fit other hands, to place trunk and arms, and to refine arms that a search at
 * a trunk posture has found. */
enum { NO_TASK, HAND_TASK, TRUNK_TASK, ARMS_TASK };

/* If the answer collides, starts the search for a collision-free one (`continue_scene_search`): with
 * other trunk postures and arms for the same hands, then with other hands. */
static void begin_scene_search(@PREFIX@_solver *solver) {
  @PREFIX@_scene *scene = &solver->scene;
  scalar q[N_MOTORS];
  if (!scene->preference_dropped) {
    scene->iterations = solver->iterations;
    scene->restarts = solver->restarts;
    scene->best_surplus = -INFINITY;
  }
  memcpy(q, solver->q, sizeof q);
  if (surplus_of(solver, q) >= -CLEARANCE_ROUNDING) {
    end_scene_search(solver, 1);
    return;
  }
  @PREFIX@_list_pairs(solver, solver->settings + SETTINGS_LOWER, solver->settings + SETTINGS_UPPER);
  scene->is_searching = 1;
  scene->restart = scene->trunk_stage = scene->trunk_trial = scene->task = 0;
  scene->candidate = N_CANDIDATES;
  scene->has_new_hand = 1;
  memset(scene->n_hands, 0, sizeof scene->n_hands);
  if (record_hands(solver, q)) end_scene_search(solver, 1);
  else solver->status = RUNNING;
}

/* Starts the search for trunk and arms that carry the palms, from a configuration whose hands stay. */
static int begin_carrying(search *job, const scalar *q, const scalar *palms, int phase) {
  const scalar *inputs[5];
  scalar *outputs[2];
  map_job map = mapping(1, inputs, ALONE, outputs, ALONE);
  int code, i, k;
  for (i = 0; i < N_CANDIDATES; ++i) {
    for (k = 0; k < N_HAND; ++k) job->seed_pool[i * N_HAND + k] = q[HAND[k]];
  }
  inputs[0] = job->points;
  inputs[1] = job->normals;
  inputs[2] = q;
  inputs[3] = job->settings;
  inputs[4] = job->seed_pool;
  outputs[0] = job->state;
  outputs[1] = job->parameters;
  code = BEGIN(&map);
  memcpy(job->state + STATE_Q, q, N_MOTORS * sizeof(scalar));
  memcpy(job->state + STATE_BEST_Q, q, N_MOTORS * sizeof(scalar));
  memcpy(job->state + STATE_PALMS, palms, 12 * N_SIDES * sizeof(scalar));
  for (i = 0; i < N_SIDES; ++i) job->state[STATE_ARM_MARGIN + i] = NO_MARGIN;
  job->state[STATE_MEETS_CONTACTS] = 1.0;
  job->parameters[PARAMETERS_PALMS_ONLY] = 1.0;
  job->state[STATE_PHASE] = phase;
  job->slot = -1;
  job->loop_status = RUNNING;
  return code;
}

/* Starts the next trial of the stage, at a low-discrepancy posture of trunk and arms; on every second
 * trial part of the range is clamped to the limits. Combinations of recorded hands alternate. */
static int begin_trunk(search *job) {
  @PREFIX@_scene *scene = &job->scene;
  scalar q[N_MOTORS], palms[12 * N_SIDES];
  int64_t combinations = 1, earlier_trials = 0, number;
  int i, k, side, first = 0;
  for (side = 0; side < N_SIDES; ++side) {
    if (scene->n_hands[side] > combinations) combinations = scene->n_hands[side];
  }
  for (i = 0; i < scene->trunk_stage; ++i) earlier_trials += TRUNK_STAGES[i][0];
  if (combinations > TRUNK_STAGES[scene->trunk_stage][1]) {
    combinations = TRUNK_STAGES[scene->trunk_stage][1];
  }
  number = earlier_trials + scene->trunk_trial / combinations;
  for (side = 0; side < N_SIDES; first += SIDE_HANDS[side++]) {
    const int64_t n = scene->trunk_trial % combinations % scene->n_hands[side];
    if (!side) memcpy(q, scene->hands[side][n], sizeof q);
    for (k = first; k < first + SIDE_HANDS[side]; ++k) q[HAND[k]] = scene->hands[side][n][HAND[k]];
    memcpy(palms + 12 * side, scene->palms[side][n], sizeof scene->palms[side][n]);
  }
  for (i = 0; i < N_TRUNK_AND_ARMS; ++i) {
    const int column = TRUNK_AND_ARMS[i];
    const scalar low = job->settings[SETTINGS_LOWER + column];
    const scalar high = job->settings[SETTINGS_UPPER + column];
    scalar fraction = even(number + 1, TRUNK_AND_ARM_STEPS[i]);
    if (number % 2) fraction = clipped((fraction - 0.5) * TRUNK_STRETCH + 0.5, 0.0, 1.0);
    q[column] = low + fraction * (high - low);
  }
  return begin_carrying(job, q, palms, number % 4 != 3 ? ARM_PLACEMENT_STAGE : TRUNK_STAGE);
}

/* Starts the next task; returns 0 if there is none. */
static int begin_next_task(search *job, int *code) {
  @PREFIX@_scene *scene = &job->scene;
  int side, all_have_hands = 1;
  for (side = 0; side < N_SIDES; ++side) all_have_hands &= scene->n_hands[side] > 0;
  while (scene->candidate == N_CANDIDATES) {
    if (scene->trunk_stage == N_TRUNK_STAGES) return 0;
    if (all_have_hands && scene->trunk_trial < TRUNK_STAGES[scene->trunk_stage][0]) {
      scene->task = TRUNK_TASK;
      *code = begin_trunk(job);
      return 1;
    }
    ++scene->trunk_stage;
    scene->trunk_trial = 0;
    /* Later restarts find new hands only if this one has found any. */
    if (scene->restart < SCENE_RESTARTS && scene->has_new_hand) scene->candidate = 0;
  }
  scene->task = HAND_TASK;
  *code = begin_hand(job);
  return 1;
}

/* Continues with at most max_iterations of one fit, or of one trunk posture. */
static int continue_scene_search(@PREFIX@_solver *solver, int64_t max_iterations) {
  @PREFIX@_scene *scene = &solver->scene;
  scalar q[N_MOTORS], palms[12 * N_SIDES], trunk_palms[16 * N_SIDES];
  int code = DONE, task, is_answer, is_free = 0;
  if (max_iterations <= 0) return DONE;
  if (scene->task == NO_TASK && !begin_next_task(solver, &code)) {
    end_scene_search(solver, 0);
    return DONE;
  }
  if (code == DONE) code = iterate(solver, max_iterations, NULL);
  if (code != DONE) return code == SLICE_OVER ? DONE : code;
  task = (int) scene->task;
  scene->task = NO_TASK;
  memcpy(q, solver->state + STATE_Q, sizeof q);
  is_answer = set_answer(solver, q);
  if (task == HAND_TASK) {
    scene->restart += ++scene->candidate == N_CANDIDATES;
    is_free = is_answer && record_hands(solver, q);
  } else {
    scene->trunk_trial += task == TRUNK_TASK;
    is_free = is_answer && surplus_of(solver, q) >= -CLEARANCE_ROUNDING;
  }
  solver->status = RUNNING;
  if (is_free) {
    end_scene_search(solver, 1);
  } else if (task == TRUNK_TASK && is_answer) {
    code = compute_palms(solver, q, palms, trunk_palms);
    if (code == DONE
        && @PREFIX@_arms_are_free(solver, solver->settings + SETTINGS_LOWER,
                                  solver->settings + SETTINGS_UPPER,
                                  solver->settings[SETTINGS_NEAREST] > 0, trunk_palms, q)) {
      scene->task = ARMS_TASK;
      code = begin_carrying(solver, q, palms, TRUNK_STAGE);
    }
  }
  return code;
}

@}@
/* Continues the search for a solution, or for a collision-free one. */
static int continue_search(@PREFIX@_solver *solver, int64_t max_iterations) {
  int code;
  if (solver->scene.is_searching) return continue_scene_search(solver, max_iterations);
  code = search_run(solver, max_iterations, 1);
  if (code != DONE || solver->status == RUNNING) return code;
  if (solver->status == SOLVED_STATUS) begin_scene_search(solver);
  else if (solver->scene.preference_dropped) end_scene_search(solver, 0);
  return DONE;
}
