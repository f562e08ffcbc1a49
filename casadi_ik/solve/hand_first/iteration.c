/* One iteration of hand-first: one step of the current stage, and the choice of the next stage.
 *
 * For each hand posture of a restart a solve computes the best palm pose (candidate), and fits
 * palm and hand to the contacts as if the hand were floating (hand fit). The arm is then placed in
 * closed form (arm placement, or arm choice if the preference is q0) or by damped steps (arm
 * steps). Where it cannot follow exactly, all motors move (refinement). Where a fit or a
 * refinement misses, it continues with errors within tolerance at no cost (tolerant hand fit,
 * tolerant refinement); then the largest relative error is minimised (balance). A stage that does
 * not lead to a solution is followed by the next posture, and after the last posture the incumbent
 * is returned.
 *
 * In a multi-arm robot the hands are fitted independently, one side after the other. Then all arms
 * are placed with the trunk where it is. If some cannot follow, trunk and arms move together with
 * the palms kept (trunk), and if that fails other trunk positions are tried.
 *
 * The capitalised functions are those of step.py: from state x and parameters p they compute state
 * y, the outputs of the stage and the record. The solves in all lanes are in the same stage
 * (loop.c), but continue independently. iteration.py defines the constants.
 */

#ifdef LANES
#define WIDTH LANES
#else
#define WIDTH 1
#endif

/* Data of one lane. */
typedef struct {
  double *x, *y, *said;
  const double *p, *own;       /* parameters; the same in a row, with the postures */
} solve;

/* Call the function of the current side; only multi-arm robots have several sides. */
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

#define X(field) s.x[STATE_##field * WIDTH]
#define Y(field) s.y[STATE_##field * WIDTH]
#define P(field) s.p[PARAMETERS_##field * WIDTH]
#define SAYS(what) (s.said[SAID_##what * WIDTH] > 0)
#define SAID(what) s.said[SAID_##what * WIDTH]
#define ENTRY(first, i) (&(first))[(i) * WIDTH]

static int goes_to(solve s, int stage) {
  Y(PHASE) = stage;
  return RUNNING_STATUS;
}

static void begin_fit(solve s) {
  Y(DAMPING) = FIT_DAMPING;
  Y(GROWTH) = FIT_GROWTH;
  Y(WAITED) = Y(SPENT) = 0;
}

/* Set the arm to the best one so far, clipped to its bounds. */
static void set_arm(solve s) {
  int i;
  for (i = 0; i < N_ARM; ++i) {
    const int k = ARM[i];
    const double low = ENTRY(P(LOWER), k), high = ENTRY(P(UPPER), k), at = ENTRY(Y(ARM), i);
    ENTRY(Y(Q), k) = at < low ? low : at > high ? high : at;
  }
}

#if N_SIDES
/* Continue with a hand posture of a side. */
static int to_side(solve s, int side, double candidate) {
  Y(SIDE) = side;
  Y(CANDIDATE) = candidate;
  return goes_to(s, CANDIDATE_STAGE + BY_SIDE * side);
}

static int to_next_candidate(solve s) {
  if (X(SIDE) < N_SIDES) return to_side(s, (int) X(SIDE), X(CANDIDATE) + 1);
  Y(FIRST) = Y(FARTHEST) = X(FARTHEST) + 1;
  return to_side(s, 0, Y(FIRST));
}

/* Return the low-discrepancy position of a motor for a trunk trial; in every second trial a
 * fraction AT_LIMITS of the range is mapped to the limits. */
static double spread(solve s, int motor, double step) {
  const double x = 0.5 + X(TRUNKS) * step, low = ENTRY(P(LOWER), motor);
  const int at_ends = (int) X(TRUNKS) % 2;
  double part = x - (double) (int64_t) x;
  if (at_ends) part = (part - 0.5) / (1 - AT_LIMITS) + 0.5;
  part = part < 0 ? 0 : part > 1 ? 1 : part;
  return low + part * (ENTRY(P(UPPER), motor) - low);
}

/* Place all arms again for the trunk of q. */
static int to_placement(solve s) {
  int i;
  for (i = 0; i < N_SIDES; ++i) ENTRY(Y(MARGIN), i) = NO_MARGIN;
  begin_fit(s);
  return goes_to(s, ARM_PLACEMENT_STAGE);
}

/* Store the palm pose of a side and continue with the next side, after the last one with all
 * arms. */
static int after_side(solve s, int skipped) {
  const int side = (int) X(SIDE);
  double away = 0;
  int i;
  for (i = 0; i < 12; ++i) {
    ENTRY(Y(PALM_ROTATION_0), 12 * side + i) = ENTRY(Y(PALM_ROTATION), i);
  }
  ENTRY(Y(FITTED), side) = Y(FITS);
  for (i = 0; i < 3; ++i) away += ENTRY(Y(PALM_ORIGIN), i) * ENTRY(Y(PALM_ORIGIN), i);
  /* No trunk position reaches palms beyond the stretched length of trunk and arm. */
  if (!skipped && away > SIDE_REACH[side] * SIDE_REACH[side]) return to_next_candidate(s);
  if (X(CANDIDATE) > X(FARTHEST)) Y(FARTHEST) = X(CANDIDATE);
  if (side + 1 < N_SIDES) return to_side(s, side + 1, X(FIRST));
  for (i = 0; i < N_SIDES; ++i) {
    if (!(ENTRY(Y(FITTED), i) > 0)) Y(FITS) = 0;
  }
  Y(SIDE) = N_SIDES;
  Y(TRIED) = 0;
  to_placement(s);
  /* If the preference is q0, trunk and arms start from q0. */
  if (P(NEAREST) > 0) goes_to(s, TRUNK_STAGE);
  return RUNNING_STATUS;
}

static int after_all_placements(solve s) {
  if (!SAYS(WITHIN) && X(AGAIN) > 0 && Y(SPENT) < AGAIN_TRIALS) {
    return goes_to(s, ARM_PLACEMENT_STAGE);
  }
  set_arm(s);
  begin_fit(s);
  if (!SAYS(NEAR)) return goes_to(s, TRUNK_STAGE);
  goes_to(s, REFINEMENT_STAGE);
  return X(FITS) > 0 ? SOLVED_STATUS : RUNNING_STATUS;
}

/* Return 1 if the target counts as out of reach. The larger the smallest cost of palms of hands
 * that fit, the fewer trunk trials are worthwhile; more are where contacts leave palms free, since
 * others may be near, and for one arm. Without a trunk the trials use low-discrepancy arms, which
 * say nothing about the reach. */
static int is_hopeless(solve s) {
  const double most = N_SIDES < 2 ? ONE_ARM_TRUNKS : P(LOOSE) > 0 ? LOOSE_TRUNKS : FAR_TRUNKS;
  if (!N_TRUNK || !(X(FITS) > 0)) return 0;
  Y(LOOKED) = X(LOOKED) + 1;
  if (!(X(LOOKED) > 0) || SAID(COST) < X(FAR)) Y(FAR) = SAID(COST);
  Y(HOPELESS) = Y(LOOKED) >= LEAST_TRUNKS && Y(LOOKED) * Y(FAR) > most;
  return Y(HOPELESS) > 0;
}

static int after_trunk(solve s) {
  const int later = X(EARLIER) > 0;
  int i, most = X(FIRST) > 0 ? OTHER_TRUNKS : later ? LATER_TRUNKS : FIRST_TRUNKS;
  if (SAID(COST) < EXACT_COST) {
    begin_fit(s);
    goes_to(s, REFINEMENT_STAGE);
    return X(FITS) > 0 ? SOLVED_STATUS : RUNNING_STATUS;
  }
  if (!SAYS(SETTLED)) return goes_to(s, TRUNK_STAGE);
  if (!(X(AGAIN) > 0) && SAID(COST) < NEARLY) {
    /* Arms that are placed again at this trunk may be on other branches. */
    Y(AGAIN) = 1;
    return to_placement(s);
  }
  Y(AGAIN) = 0;
  Y(TRIED) = X(TRIED) + 1;
  if (!(X(TRIED) > 0) || SAID(COST) < X(PALMS_LEAST)) {
    Y(PALMS_LEAST) = SAID(COST);
    for (i = 0; i < N_MOTORS; ++i) ENTRY(Y(PALMS_BEST), i) = ENTRY(Y(Q), i);
  }
  if (is_hopeless(s)) {
    Y(FARTHEST) = N_CANDIDATES - 1;
    most = 0;
  }
  if (Y(TRIED) >= most) {
    /* Palms out of reach may still be within tolerance. */
    for (i = 0; i < N_MOTORS; ++i) ENTRY(Y(Q), i) = ENTRY(Y(PALMS_BEST), i);
    begin_fit(s);
    return goes_to(s, REFINEMENT_STAGE);
  }
  Y(TRUNKS) = X(TRUNKS) + 1;
  for (i = 0; i < N_TRUNK; ++i) {
    const int k = TRUNK_MOTORS[i];
    const double anywhere = spread(s, k, TRUNK_STEPS[i]);
    ENTRY(Y(Q), k) = anywhere;
    if ((int) Y(TRIED) % CLOSER_EVERY == CLOSER_EVERY - 1) {
      /* Sample around the best trunk, with a radius that shrinks with the number of trials. */
      const double best = ENTRY(Y(PALMS_BEST), k);
      ENTRY(Y(Q), k) = best + (anywhere - best) * BOX / (BOX + Y(TRIED));
    }
  }
  for (i = 0; i < N_ARM; ++i) {
    ENTRY(Y(ARM), i) = ENTRY(Y(Q), ARM[i]) = spread(s, ARM[i], BODY_ARM_STEPS[i]);
  }
  for (i = 0; i < N_SIDES; ++i) ENTRY(Y(SWIVEL), i) = ENTRY(Y(ARM), i);
  to_placement(s);
  /* Alternate between arms over the whole redundancy, arms around one value of it, and arms from
   * low-discrepancy configurations. */
  if ((int) Y(TRIED) % (later ? LATER_ANYWHERE : FROM_ANYWHERE) == 0) return goes_to(s, TRUNK_STAGE);
  if ((int) Y(TRIED) % 2) Y(SPENT) = AROUND;
  return RUNNING_STATUS;
}
#else
static int to_next_candidate(solve s) {
  Y(CANDIDATE) = X(CANDIDATE) + 1;
  return goes_to(s, CANDIDATE_STAGE);
}
#endif

/* Return 1 if the tolerances may hold near the minimum of the exact fit that a solve has come to,
 * and it is not the minimum that missed before. Near misses at that minimum are counted. */
static int is_new_miss(solve s, double *missed, double before) {
  const double cost = Y(COST), difference = cost - before;
  if (SAID(MISS) > NEAR_MISS) return 0;
  if ((difference < 0 ? -difference : difference) <= SAME_COST * before) {
    Y(RETURNS) = X(RETURNS) + 1;
    return 0;
  }
  *missed = cost;
  return SAID(MISS) <= PROMISING;
}

/* Count a fit that ends no closer than one before; `least` is what the closest one left. */
static void count_return(solve s, double *least, double before, double value) {
  Y(RETURNS) = X(RETURNS) + (value > CLOSER * before);
  if (value < before) *least = value;
}

static void keep_best(solve s, double cost) {
  int i;
  if (!(cost < X(BEST_COST))) return;
  Y(BEST_COST) = cost;
  for (i = 0; i < N_MOTORS; ++i) ENTRY(Y(BEST_Q), i) = ENTRY(Y(Q), i);
}

static int after_start(solve s) {
  const double cost = SAID(COST);
  if (cost < X(BEST_COST)) Y(BEST_COST) = cost;
  if (SAYS(WITHIN)) return SOLVED_STATUS;
  if (HAS_ARM && cost > WHOLE) return to_next_candidate(s);
  return goes_to(s, REFINEMENT_STAGE);
}

static void before_candidate(solve s, double *hand) {
  const int last = N_CANDIDATES - 1, at = X(CANDIDATE) < last ? (int) X(CANDIDATE) : last;
  int i;
  for (i = 0; i < N_HAND; ++i) hand[i * WIDTH] = s.own[PARAMETERS_POSTURES + at * N_HAND + i];
}

static int after_candidate(solve s) {
  int i;
#if N_SIDES
  if (X(CANDIDATE) < N_CANDIDATES && SAYS(WITHIN)) {
    Y(FITS) = 1;
    return after_side(s, 1);
  }
  if (X(CANDIDATE) < N_CANDIDATES) return goes_to(s, HAND_FIT_STAGE + BY_SIDE * (int) X(SIDE));
#endif
  if (X(CANDIDATE) < N_CANDIDATES) return goes_to(s, HAS_ARM ? HAND_FIT_STAGE : REFINEMENT_STAGE);
  for (i = 0; i < N_MOTORS; ++i) ENTRY(Y(Q), i) = ENTRY(X(BEST_Q), i);
  return STALLED_STATUS;
}

/* Return the stage that places the arm: closed forms first, damped steps in later restarts. */
static int placement(solve s) {
  const int searched = NEAR_IS_SEARCHED && P(NEAREST) > 0;
  if (IS_COMPLETE || (HAS_FAMILY && !(X(EARLIER) > 0) && !searched)) return ARM_PLACEMENT_STAGE;
  return ARM_STEPS_STAGE;
}

/* The arm follows a hand that fits. It also follows the last hand posture of a restart, so that the
 * refinement starts from it. */
static int after_fitted_hand(solve s) {
  const int is_last = X(CANDIDATE) + 1 >= N_CANDIDATES, alone = P(ALONE) > 0;
  if (!SAYS(WITHIN) && !is_last) return to_next_candidate(s);
#if N_SIDES
  return after_side(s, 0);
#endif
  goes_to(s, HAS_CHOICE && P(NEAREST) > 0 ? ARM_CHOICE_STAGE : placement(s));
  return !alone ? RUNNING_STATUS : SAYS(WITHIN) ? SOLVED_STATUS : STALLED_STATUS;
}

static int after_tolerant_hand_fit(solve s) {
  if (!SAYS(SETTLED)) return goes_to(s, (int) X(PHASE));
  /* Only a minimum near which no hand fits is skipped when another candidate leads to it. */
  if (SAYS(WITHIN)) Y(NEAR) = 0;
  else count_return(s, &Y(LEAST_EXCESS), X(LEAST_EXCESS), Y(COST));
  return after_fitted_hand(s);
}

static int after_hand_fit(solve s) {
  const int first = X(CANDIDATE) + X(EARLIER) <= 0 && X(SPENT) < 1;
  /* The hand of q0 is fitted only if its contacts roughly resemble the target. */
  if (N_CANDIDATES > 1 && P(NEAREST) > 0 && first && SAID(COST) > OWN_HAND) {
    return to_next_candidate(s);
  }
  if (!SAYS(SETTLED)) return goes_to(s, (int) X(PHASE));
  if (!SAYS(WITHIN) && is_new_miss(s, &Y(NEAR), X(NEAR))) {
    begin_fit(s);
    return goes_to(s, TOLERANT_HAND_FIT_STAGE + ((int) X(PHASE) - HAND_FIT_STAGE));
  }
  return after_fitted_hand(s);
}

#if !N_SIDES
static int after_placement(solve s) {
  const int over = Y(SPENT) >= (X(EARLIER) > 0 ? ALL_PLACEMENTS : PLACEMENTS);
  if (!SAYS(WITHIN) && !over) return goes_to(s, ARM_PLACEMENT_STAGE);
  set_arm(s);
  Y(SPENT) = 0;
  goes_to(s, REFINEMENT_STAGE);
  return SAYS(WITHIN) && SAYS(NEAR) && X(FITS) > 0 ? SOLVED_STATUS : RUNNING_STATUS;
}
#endif

static int after_choice(solve s) {
  if (!SAYS(WITHIN)) {
    if (Y(SPENT) < CHOICE_PATIENCE) return goes_to(s, ARM_CHOICE_STAGE);
    Y(MARGIN) = NO_MARGIN;
    Y(SPENT) = 0;
    return goes_to(s, placement(s));
  }
  if (Y(SPENT) < CHOICES) return goes_to(s, ARM_CHOICE_STAGE);
  set_arm(s);
  Y(SPENT) = 0;
  goes_to(s, REFINEMENT_STAGE);
  return IS_EXACT && X(FITS) > 0 ? SOLVED_STATUS : RUNNING_STATUS;
}

#if N_STARTS
/* Start the arm at the next row of the table: the nearest to the palm pose that is farther than
 * the previous start; after the last row, the nearest of all. If the preference is q0, the first
 * start is q0. */
LOOPS static void before_arm_steps(solve s) {
  double distance[N_STARTS], nearest = 1e300, again = 1e300;
  int i, k, found = 0, first = 0;
  if (X(SPENT) >= 1 || X(TURNED) > 0 || (P(NEAREST) > 0 && X(STARTS) < 1)) return;
  for (i = 0; i < N_STARTS; ++i) distance[i] = 0;
  for (k = 0; k < 12; ++k) {
    const double wanted = k < 9 ? ENTRY(X(PALM_ROTATION), k) : ENTRY(X(PALM_ORIGIN), k - 9) / LENGTH;
    for (i = 0; i < N_STARTS; ++i) {
      distance[i] += (START_PALMS[k][i] - wanted) * (START_PALMS[k][i] - wanted);
    }
  }
  for (i = 0; i < N_STARTS; ++i) {
    if (distance[i] < again) again = distance[first = i];
    if (distance[i] > X(PASSED) && distance[i] < nearest) nearest = distance[found = i];
  }
  if (nearest >= 1e300) nearest = distance[found = first];
  for (i = 0; i < N_ARM; ++i) ENTRY(X(Q), ARM[i]) = START_ARMS[found][i];
  Y(PASSED) = X(PASSED) = nearest;
}

static int after_arm_steps(solve s) {
  const int settled = SAYS(SETTLED), exact = SAID(COST) < EXACT_COST;
  /* Solutions that the first restart missed may lie beyond the gap between the limits of a
   * joint. */
  const int sent = settled && X(EARLIER) > 0 ? (int) SAID(AT_END) : 0;
  if (sent) {
    const int k = ARM[sent - 1];
    ENTRY(Y(Q), k) = ENTRY(P(LOWER), k) + ENTRY(P(UPPER), k) - ENTRY(Y(Q), k);
  }
  if (settled) Y(TURNED) = sent;
  Y(STARTS) = X(STARTS) + (settled && !sent);
  /* In the first restart the refinement reduces the remaining error of an arm with too few
   * motors. */
  if (!(exact || (settled && SAYS(NEAR) && X(EARLIER) < 1) || Y(STARTS) >= MOST_STARTS)) {
    return goes_to(s, ARM_STEPS_STAGE);
  }
  set_arm(s);
  Y(TURNED) = 0;
  goes_to(s, REFINEMENT_STAGE);
  return exact && X(FITS) > 0 ? SOLVED_STATUS : RUNNING_STATUS;
}
#endif

static int after_refinement(solve s) {
  keep_best(s, Y(COST));
  if (!SAYS(SETTLED)) return goes_to(s, REFINEMENT_STAGE);
  if (SAYS(WITHIN)) return SOLVED_STATUS;
  if (!is_new_miss(s, &Y(BALANCED), X(BALANCED))) return to_next_candidate(s);
  begin_fit(s);
  return goes_to(s, TOLERANT_REFINEMENT_STAGE);
}

static int after_tolerant_refinement(solve s) {
  if (!SAYS(SETTLED)) return goes_to(s, TOLERANT_REFINEMENT_STAGE);
  if (SAYS(WITHIN)) return SOLVED_STATUS;
  begin_fit(s);
  return goes_to(s, BALANCE_STAGE);
}

static int after_balance(solve s) {
  if (SAYS(WITHIN)) return SOLVED_STATUS;
  if (!SAYS(SETTLED)) return goes_to(s, BALANCE_STAGE);
  begin_fit(s);
  Y(POWER) = 0;
  count_return(s, &Y(LEAST), X(LEAST), SAID(COST));
  return to_next_candidate(s);
}

static solve solve_in(int lane, real *x, const real *p, const double *own, real *y, real *said) {
  solve s;
  s.x = (double *) x + lane;
  s.p = (const double *) p + lane;
  s.own = own;
  s.y = (double *) y + lane;
  s.said = (double *) said + lane;
  return s;
}

/* The iteration; `wanted` has a bit for each lane in which there is a solve. */
CODE void iterate(real *x, const real *p, const double *const *own, real *y, real *record, real *status,
                  int wanted) {
  real said[N_SAID], hand[N_HAND + 1];
  int lane = 0, stage, side;
  while (!(wanted >> lane & 1)) ++lane;
  stage = (int) solve_in(lane, x, p, own[lane], y, said).x[STATE_PHASE * WIDTH];
  side = stage / BY_SIDE;
  stage %= BY_SIDE;
#define EACH for (lane = 0; lane < WIDTH; ++lane) if (wanted >> lane & 1)
#define SOLVE solve_in(lane, x, p, own[lane], y, said)
  if (stage == CANDIDATE_STAGE) EACH before_candidate(SOLVE, (double *) hand + lane);
#if N_STARTS
  if (stage == ARM_STEPS_STAGE) EACH before_arm_steps(SOLVE);
#endif
  switch (stage) {
    case START_STAGE: START(x, p, y, said, record); break;
    case CANDIDATE_STAGE: OF_SIDE(CANDIDATE, x, p, hand, y, said, record); break;
    case HAND_FIT_STAGE: OF_SIDE(HAND_FIT, x, p, y, said, record); break;
    case TOLERANT_HAND_FIT_STAGE: OF_SIDE(TOLERANT_HAND_FIT, x, p, y, said, record); break;
    case TOLERANT_REFINEMENT_STAGE: TOLERANT_REFINEMENT(x, p, y, said, record); break;
    case ARM_PLACEMENT_STAGE: ARM_PLACEMENT(x, p, y, said, record); break;
    case ARM_STEPS_STAGE: ARM_STEPS(x, p, y, said, record); break;
    case ARM_CHOICE_STAGE: ARM_CHOICE(x, p, y, said, record); break;
    case BALANCE_STAGE: BALANCE(x, p, y, said, record); break;
    case TRUNK_STAGE: TRUNK(x, p, y, said, record); break;
    default: REFINEMENT(x, p, y, said, record);
  }
  EACH {
    const solve s = SOLVE;
    int code;
    switch (stage) {
      case START_STAGE: code = after_start(s); break;
      case CANDIDATE_STAGE: code = after_candidate(s); break;
      case HAND_FIT_STAGE: code = after_hand_fit(s); break;
      case TOLERANT_HAND_FIT_STAGE: code = after_tolerant_hand_fit(s); break;
      case TOLERANT_REFINEMENT_STAGE: code = after_tolerant_refinement(s); break;
#if N_SIDES
      case ARM_PLACEMENT_STAGE: code = after_all_placements(s); break;
      case TRUNK_STAGE: code = after_trunk(s); break;
#else
      case ARM_PLACEMENT_STAGE: code = after_placement(s); break;
#endif
#if N_STARTS
      case ARM_STEPS_STAGE: code = after_arm_steps(s); break;
#endif
      case ARM_CHOICE_STAGE: code = after_choice(s); break;
      case BALANCE_STAGE: code = after_balance(s); break;
      default: code = after_refinement(s);
    }
    ENTRY(Y(COUNTS), PLACE_OF_STAGE[stage]) = ENTRY(X(COUNTS), PLACE_OF_STAGE[stage]) + 1;
    ((double *) status)[lane] = code;
    if (record) ((double *) record)[RECORD_STATUS * WIDTH + lane] = code;
  }
}
