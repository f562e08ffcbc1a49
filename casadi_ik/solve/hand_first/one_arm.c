/* Choice of the next stage for one arm with a hand: hand postures and arms.
 *
 * A hand that fits is followed by a search for an arm that carries it: in closed form (arm
 * placement; arm choice if the preference is q0), or by damped steps (arm steps).
 */

static int to_next_candidate(solve s) {
  Y(CANDIDATE) = X(CANDIDATE) + 1;
  return goes_to(s, CANDIDATE_STAGE);
}

/* Return the stage that moves a hand without an arm. In later restarts every second posture is
 * fitted with errors within tolerance at no cost from the beginning, because the exact fits of all
 * postures may end in the same minima. */
static int stage_of_fixed_hand(solve s) {
  const int is_tolerant = X(CANDIDATES_BEFORE) > 0 && (int) X(CANDIDATE) % 2;
  return is_tolerant ? TOLERANT_REFINEMENT_STAGE : REFINEMENT_STAGE;
}

static int after_candidate(solve s) {
  if (X(CANDIDATE) >= N_CANDIDATES) return end_with_incumbent(s);
  return goes_to(s, HAS_ARM ? HAND_FIT_STAGE : stage_of_fixed_hand(s));
}

/* Return the stage that places the arm: in closed form if there is one, but by damped steps in
 * later restarts if the closed form may miss arms. */
static int arm_stage(solve s) {
  const int uses_steps = X(CANDIDATES_BEFORE) > 0 || (USES_STEPS_NEAR_Q0 && P(NEAREST) > 0);
  return IS_COMPLETE || (HAS_FAMILY && !uses_steps) ? ARM_PLACEMENT_STAGE : ARM_STEPS_STAGE;
}

/* Continue with the arm after a hand that fits, or after the last hand posture of a restart, from
 * which the refinement starts. */
static int after_hand(solve s) {
  const int is_last = X(CANDIDATE) + 1 >= N_CANDIDATES;
  if (!FLAG(IS_WITHIN) && !is_last) return to_next_candidate(s);
  goes_to(s, HAS_CHOICE && P(NEAREST) > 0 ? ARM_CHOICE_STAGE : arm_stage(s));
  if (P(HAND_ONLY) > 0) return FLAG(IS_WITHIN) ? SOLVED_STATUS : STALLED_STATUS;
  return RUNNING_STATUS;
}

static int after_placement(solve s) {
  const int max_trials = X(CANDIDATES_BEFORE) > 0 ? LATER_PLACEMENTS : PLACEMENTS;
  if (!FLAG(ARM_IS_ALLOWED) && Y(STAGE_ITERATIONS) < max_trials) {
    return goes_to(s, ARM_PLACEMENT_STAGE);
  }
  set_arm(s);
  Y(STAGE_ITERATIONS) = 0;
  goes_to(s, REFINEMENT_STAGE);
  return FLAG(ARM_IS_ALLOWED) && FLAG(ARM_IS_EXACT) && X(MEETS_CONTACTS) > 0 ? SOLVED_STATUS
                                                                       : RUNNING_STATUS;
}

static int after_choice(solve s) {
  if (!FLAG(ARM_IS_ALLOWED)) {
    if (Y(STAGE_ITERATIONS) < FAILED_CHOICES) return goes_to(s, ARM_CHOICE_STAGE);
    Y(ARM_MARGIN) = NO_MARGIN;
    Y(STAGE_ITERATIONS) = 0;
    return goes_to(s, arm_stage(s));
  }
  if (Y(STAGE_ITERATIONS) < CHOICES) return goes_to(s, ARM_CHOICE_STAGE);
  set_arm(s);
  Y(STAGE_ITERATIONS) = 0;
  goes_to(s, REFINEMENT_STAGE);
  return IS_EXACT && X(MEETS_CONTACTS) > 0 ? SOLVED_STATUS : RUNNING_STATUS;
}

#if N_STARTS
/* Start the arm steps at the entry of the start table whose palm is the next nearest to the palm
 * pose; after the farthest one, at the nearest again. If the preference is q0, the first start is
 * q0. */
static void before_arm_steps(solve s) {
  double distance[N_STARTS], next_distance = 1e300, min_distance = 1e300;
  int i, k, next = 0, nearest = 0;
  if (X(STAGE_ITERATIONS) >= 1 || X(ARM_FLIPPED_JOINT) > 0) return;
  if (P(NEAREST) > 0 && X(ARM_STARTS) < 1) return;
  for (i = 0; i < N_STARTS; ++i) distance[i] = 0;
  for (k = 0; k < 12; ++k) {
    const double target =
        k < 9 ? ENTRY(X(PALM_ROTATION), k) : ENTRY(X(PALM_ORIGIN), k - 9) / LENGTH;
    for (i = 0; i < N_STARTS; ++i) {
      distance[i] += (START_PALMS[k][i] - target) * (START_PALMS[k][i] - target);
    }
  }
  for (i = 0; i < N_STARTS; ++i) {
    if (distance[i] < min_distance) min_distance = distance[nearest = i];
    if (distance[i] > X(ARM_START_DISTANCE) && distance[i] < next_distance) {
      next_distance = distance[next = i];
    }
  }
  if (next_distance >= 1e300) next_distance = distance[next = nearest];
  for (i = 0; i < N_ARM; ++i) ENTRY(X(Q), ARM[i]) = START_ARMS[next][i];
  Y(ARM_START_DISTANCE) = X(ARM_START_DISTANCE) = next_distance;
}

static int after_arm_steps(solve s) {
  const int is_settled = FLAG(IS_SETTLED), is_exact = RESULT(COST) < EXACT_COST;
  const int is_first_restart = X(CANDIDATES_BEFORE) < 1;
  /* Solutions that the first restart missed may lie beyond the gap between the limits of a
   * joint. */
  const int flipped = is_settled && X(CANDIDATES_BEFORE) > 0 ? (int) RESULT(JOINT_TO_FLIP) : 0;
  if (flipped) {
    const int k = ARM[flipped - 1];
    ENTRY(Y(Q), k) = ENTRY(P(LOWER), k) + ENTRY(P(UPPER), k) - ENTRY(Y(Q), k);
  }
  if (is_settled) Y(ARM_FLIPPED_JOINT) = flipped;
  Y(ARM_STARTS) = X(ARM_STARTS) + (is_settled && !flipped);
  /* In the first restart the refinement reduces the remaining error of an arm with too few
   * motors. */
  if (!(is_exact || (is_settled && FLAG(ARM_IS_CLOSE) && is_first_restart)
        || Y(ARM_STARTS) >= MAX_STARTS)) {
    return goes_to(s, ARM_STEPS_STAGE);
  }
  set_arm(s);
  Y(ARM_FLIPPED_JOINT) = 0;
  goes_to(s, REFINEMENT_STAGE);
  return is_exact && X(MEETS_CONTACTS) > 0 ? SOLVED_STATUS : RUNNING_STATUS;
}
#endif

/* Choose what follows a stage that moves the arm only. */
static int after_arm_stage(solve s, int stage) {
#if N_STARTS
  if (stage == ARM_STEPS_STAGE) return after_arm_steps(s);
#endif
  return stage == ARM_CHOICE_STAGE ? after_choice(s) : after_placement(s);
}
