/* One iteration of hand-first: one step of the current stage, and the choice of the next stage.
 *
 * For each hand posture of a restart a solve computes the best palm pose (candidate), and fits
 * palm and hand to the contacts as if the hand were floating (hand fit). The arm, or trunk and
 * arms, then carry the palm there (one_arm.c, multi_arm.c). Where they cannot follow exactly, all
 * motors move (refinement). Where a fit or a refinement misses, it continues with errors within
 * tolerance at no cost (tolerant hand fit, tolerant refinement); then the largest relative error is
 * minimised (balance). A stage that does not lead to a solution is followed by the next posture,
 * and after the last posture the incumbent is returned.
 *
 * The solves in all lanes are in the same stage (loop.c), but continue independently.
 */

/* Call the graph of the current side; only multi-arm robots have several sides. */
#if N_SIDES > 4
#error "OF_SIDE has cases for four sides"
#endif
#if N_SIDES > 1
#define OF_SIDE(function, ...) \
  do switch (side) { \
    case 0: function(__VA_ARGS__); break; \
    case 1: function##_1(__VA_ARGS__); break; \
    case 2: function##_2(__VA_ARGS__); break; \
    default: function##_3(__VA_ARGS__); \
  } while (0)
#else
#define OF_SIDE(function, ...) ((void) side, function(__VA_ARGS__))
#endif

static int after_start(solve s) {
  const double cost = RESULT(COST);
  if (cost < X(BEST_COST)) Y(BEST_COST) = cost;
  if (FLAG(IS_WITHIN)) return SOLVED_STATUS;
  if (HAS_ARM && cost > MAX_COST_OF_Q0) return to_next_candidate(s);
  return goes_to(s, REFINEMENT_STAGE);
}

/* Copy the hand posture of the candidate. */
static void before_candidate(solve s, double *hand) {
  const int last = N_CANDIDATES - 1;
  const int candidate = X(CANDIDATE) < last ? (int) X(CANDIDATE) : last;
  int i;
  for (i = 0; i < N_HAND; ++i) {
    hand[i * WIDTH] = s.all_p[PARAMETERS_POSTURES + candidate * N_HAND + i];
  }
}

static int after_hand_fit(solve s) {
  const int is_first = X(CANDIDATE) + X(CANDIDATES_BEFORE) <= 0 && X(STAGE_ITERATIONS) < 1;
  /* The hand of q0 is fitted only if its contacts roughly resemble the target. */
  if (N_CANDIDATES > 1 && P(NEAREST) > 0 && is_first && RESULT(COST) > MAX_COST_OF_Q0_HAND) {
    return to_next_candidate(s);
  }
  if (!FLAG(IS_SETTLED)) return goes_to(s, (int) X(PHASE));
  if (!FLAG(IS_WITHIN) && is_new_minimum(s, &Y(HAND_FIT_MINIMUM), X(HAND_FIT_MINIMUM))) {
    begin_fit(s);
    return goes_to(s, TOLERANT_HAND_FIT_STAGE + ((int) X(PHASE) - HAND_FIT_STAGE));
  }
  return after_hand(s);
}

static int after_tolerant_hand_fit(solve s) {
  if (!FLAG(IS_SETTLED)) return goes_to(s, (int) X(PHASE));
  /* Only a minimum near which no hand fits is skipped when another candidate leads to it. */
  if (FLAG(IS_WITHIN)) Y(HAND_FIT_MINIMUM) = 0;
  else update_smallest(s, &Y(HAND_FIT_MIN_EXCESS), X(HAND_FIT_MIN_EXCESS), Y(COST));
  return after_hand(s);
}

static int after_refinement(solve s) {
  update_incumbent(s, Y(COST));
  if (!FLAG(IS_SETTLED)) return goes_to(s, REFINEMENT_STAGE);
  if (FLAG(IS_WITHIN)) return SOLVED_STATUS;
  if (!is_new_minimum(s, &Y(REFINEMENT_MINIMUM), X(REFINEMENT_MINIMUM))) {
    return to_next_candidate(s);
  }
  begin_fit(s);
  return goes_to(s, TOLERANT_REFINEMENT_STAGE);
}

static int after_tolerant_refinement(solve s) {
  if (!FLAG(IS_SETTLED)) return goes_to(s, TOLERANT_REFINEMENT_STAGE);
  if (FLAG(IS_WITHIN)) return SOLVED_STATUS;
  begin_fit(s);
  return goes_to(s, BALANCE_STAGE);
}

static int after_balance(solve s) {
  if (FLAG(IS_WITHIN)) return SOLVED_STATUS;
  if (!FLAG(IS_SETTLED)) return goes_to(s, BALANCE_STAGE);
  begin_fit(s);
  Y(POWER) = 0;
  update_smallest(s, &Y(BALANCE_MIN_RATIO), X(BALANCE_MIN_RATIO), RESULT(MAX_RATIO));
  return to_next_candidate(s);
}

static solve solve_of_lane(int lane, real *x, const real *p, const double *all_p, real *y,
                           real *results) {
  solve s;
  s.x = (double *) x + lane;
  s.p = (const double *) p + lane;
  s.all_p = all_p;
  s.y = (double *) y + lane;
  s.results = (double *) results + lane;
  return s;
}

/* Run one iteration; `active_lanes` has a bit for each lane with a solve, and is used by the macros
 * of the graphs. */
CODE void iterate(real *x, const real *p, const double *const *all_p, real *y, real *record,
                  real *status, int active_lanes) {
  real results[N_RESULTS], hand[N_HAND + 1];
  int lane = 0, stage, side;
  while (!(active_lanes >> lane & 1)) ++lane;
  stage = (int) solve_of_lane(lane, x, p, all_p[lane], y, results).x[STATE_PHASE * WIDTH];
  side = stage / SIDE_OFFSET;
  stage %= SIDE_OFFSET;
#define EACH_LANE for (lane = 0; lane < WIDTH; ++lane) if (active_lanes >> lane & 1)
#define SOLVE solve_of_lane(lane, x, p, all_p[lane], y, results)
  if (stage == CANDIDATE_STAGE) EACH_LANE before_candidate(SOLVE, (double *) hand + lane);
#if N_STARTS
  if (stage == ARM_STEPS_STAGE) EACH_LANE before_arm_steps(SOLVE);
#endif
  switch (stage) {
    case START_STAGE: START(x, p, y, results, record); break;
    case CANDIDATE_STAGE: OF_SIDE(CANDIDATE, x, p, hand, y, results, record); break;
    case HAND_FIT_STAGE: OF_SIDE(HAND_FIT, x, p, y, results, record); break;
    case TOLERANT_HAND_FIT_STAGE: OF_SIDE(TOLERANT_HAND_FIT, x, p, y, results, record); break;
    case TOLERANT_REFINEMENT_STAGE: TOLERANT_REFINEMENT(x, p, y, results, record); break;
    case ARM_PLACEMENT_STAGE: ARM_PLACEMENT(x, p, y, results, record); break;
    case ARM_STEPS_STAGE: ARM_STEPS(x, p, y, results, record); break;
    case ARM_CHOICE_STAGE: ARM_CHOICE(x, p, y, results, record); break;
    case BALANCE_STAGE: BALANCE(x, p, y, results, record); break;
    case TRUNK_STAGE: TRUNK(x, p, y, results, record); break;
    default: REFINEMENT(x, p, y, results, record);
  }
  EACH_LANE {
    const solve s = SOLVE;
    int code;
    switch (stage) {
      case START_STAGE: code = after_start(s); break;
      case CANDIDATE_STAGE: code = after_candidate(s); break;
      case HAND_FIT_STAGE: code = after_hand_fit(s); break;
      case TOLERANT_HAND_FIT_STAGE: code = after_tolerant_hand_fit(s); break;
      case REFINEMENT_STAGE: code = after_refinement(s); break;
      case TOLERANT_REFINEMENT_STAGE: code = after_tolerant_refinement(s); break;
      case BALANCE_STAGE: code = after_balance(s); break;
      default: code = after_arm_stage(s, stage);
    }
    ENTRY(Y(COUNTS), COUNTER_OF_STAGE[stage]) = ENTRY(X(COUNTS), COUNTER_OF_STAGE[stage]) + 1;
    ((double *) status)[lane] = code;
    if (record) ((double *) record)[RECORD_STATUS * WIDTH + lane] = code;
  }
}
