/* Choice of the next stage for a multi-arm robot: hand postures, arms and trunk.
 *
 * The hands are fitted independently, one side after the other. Then the arms of all sides are
 * placed with the trunk where it is. If some arm cannot follow, trunk and arms move together
 * towards the palm poses (trunk), and if that fails other trunk positions are tried. A solve that
 * only carries palms (PALMS_ONLY) has given palm poses, and tries a single trunk position.
 */

/* Continue with a hand posture of a side. */
static int to_side(solve s, int side, double candidate) {
  Y(SIDE) = side;
  Y(CANDIDATE) = candidate;
  return goes_to(s, CANDIDATE_STAGE + SIDE_OFFSET * side);
}

static int to_next_candidate(solve s) {
  if (P(PALMS_ONLY) > 0) return end_with_incumbent(s);
  if (X(SIDE) < N_SIDES) return to_side(s, (int) X(SIDE), X(CANDIDATE) + 1);
  Y(FIRST_CANDIDATE) = Y(LAST_CANDIDATE) = X(LAST_CANDIDATE) + 1;
  return to_side(s, 0, Y(FIRST_CANDIDATE));
}

/* Place all arms again, for the trunk of q. */
static int to_placement(solve s) {
  int i;
  for (i = 0; i < N_SIDES; ++i) ENTRY(Y(ARM_MARGIN), i) = NO_MARGIN;
  begin_fit(s);
  return goes_to(s, ARM_PLACEMENT_STAGE);
}

/* Return 1 if the palm is beyond the stretched length of trunk and arm of a side. */
static int is_beyond_reach(solve s, int side) {
  double squared_distance = 0;
  int i;
  for (i = 0; i < 3; ++i) {
    squared_distance += ENTRY(Y(PALM_ORIGIN), i) * ENTRY(Y(PALM_ORIGIN), i);
  }
  return squared_distance > SIDE_REACH[side] * SIDE_REACH[side];
}

/* Store the palm pose of a side, and continue with the next side, or after the last one with all
 * arms. */
static int after_side(solve s, int is_idle) {
  const int side = (int) X(SIDE);
  int i;
  for (i = 0; i < 12; ++i) {
    ENTRY(Y(PALM_ROTATION_0), 12 * side + i) = ENTRY(Y(PALM_ROTATION), i);
  }
  ENTRY(Y(SIDE_FITS), side) = Y(MEETS_CONTACTS);
  if (!is_idle && is_beyond_reach(s, side)) return to_next_candidate(s);
  if (X(CANDIDATE) > X(LAST_CANDIDATE)) Y(LAST_CANDIDATE) = X(CANDIDATE);
  if (side + 1 < N_SIDES) return to_side(s, side + 1, X(FIRST_CANDIDATE));
  for (i = 0; i < N_SIDES; ++i) {
    if (!(ENTRY(Y(SIDE_FITS), i) > 0)) Y(MEETS_CONTACTS) = 0;
  }
  Y(SIDE) = N_SIDES;
  Y(TRUNK_TRIALS) = 0;
  to_placement(s);
  /* If the preference is q0, trunk and arms start from q0. */
  if (P(NEAREST) > 0) goes_to(s, TRUNK_STAGE);
  return RUNNING_STATUS;
}

static int after_candidate(solve s) {
  if (!(X(CANDIDATE) < N_CANDIDATES)) return end_with_incumbent(s);
  if (FLAG(IS_IDLE)) {
    Y(MEETS_CONTACTS) = 1;
    return after_side(s, 1);
  }
  return goes_to(s, HAND_FIT_STAGE + SIDE_OFFSET * (int) X(SIDE));
}

/* Continue after a hand that fits, or after the last hand posture of a restart, from which the
 * refinement starts. */
static int after_hand(solve s) {
  const int is_last = X(CANDIDATE) + 1 >= N_CANDIDATES;
  return FLAG(IS_WITHIN) || is_last ? after_side(s, 0) : to_next_candidate(s);
}

static int after_placement(solve s) {
  const int max_trials = X(TRUNK_ARMS_PLACED_AGAIN) > 0 ? REPLACEMENT_TRIALS : 1;
  if (!FLAG(ARM_IS_EXACT) && Y(STAGE_ITERATIONS) < max_trials) {
    return goes_to(s, ARM_PLACEMENT_STAGE);
  }
  if (!FLAG(ARM_IS_EXACT) && P(PALMS_ONLY) > 0) return end_with_incumbent(s);
  set_arm(s);
  begin_fit(s);
  if (!FLAG(ARM_IS_EXACT)) return goes_to(s, TRUNK_STAGE);
  goes_to(s, REFINEMENT_STAGE);
  return X(MEETS_CONTACTS) > 0 ? SOLVED_STATUS : RUNNING_STATUS;
}

/* Return 1 if the target counts as out of reach after this trial. The larger the smallest cost of
 * trials with hands that fit, the fewer trials are worthwhile; more are where contacts leave palms
 * free, since other palm poses may be near, and for one arm. Without a trunk the trials use
 * low-discrepancy arms, whose cost is unrelated to the reach. */
static int is_out_of_reach(solve s) {
  const double max_weighted = N_SIDES < 2 ? MAX_WEIGHTED_TRIALS_ONE_ARM
                            : P(PALMS_ARE_FREE) > 0 ? MAX_WEIGHTED_TRIALS_FREE_PALMS
                            : MAX_WEIGHTED_TRIALS;
  if (!N_TRUNK || !(X(MEETS_CONTACTS) > 0)) return 0;
  Y(TRUNK_FITTING_TRIALS) = X(TRUNK_FITTING_TRIALS) + 1;
  if (!(X(TRUNK_FITTING_TRIALS) > 0) || RESULT(COST) < X(TRUNK_FITTING_MIN_COST)) {
    Y(TRUNK_FITTING_MIN_COST) = RESULT(COST);
  }
  Y(IS_OUT_OF_REACH) = Y(TRUNK_FITTING_TRIALS) >= MIN_FITTING_TRIALS
                    && Y(TRUNK_FITTING_TRIALS) * Y(TRUNK_FITTING_MIN_COST) > max_weighted;
  return Y(IS_OUT_OF_REACH) > 0;
}

/* Return the low-discrepancy position of a motor for a trunk trial; in every second trial a
 * fraction TRUNK_LIMIT_FRACTION of the range is mapped to the limits. */
static double trial_position(solve s, int motor, double step) {
  const double x = 0.5 + X(TRUNK_TOTAL_TRIALS) * step, low = ENTRY(P(LOWER), motor);
  const int at_limits = (int) X(TRUNK_TOTAL_TRIALS) % 2;
  double fraction = x - (double) (int64_t) x;
  if (at_limits) fraction = (fraction - 0.5) / (1 - TRUNK_LIMIT_FRACTION) + 0.5;
  fraction = fraction < 0 ? 0 : fraction > 1 ? 1 : fraction;
  return low + fraction * (ENTRY(P(UPPER), motor) - low);
}

/* Start the next trunk trial: sample the trunk and the arms. */
static int to_next_trunk(solve s) {
  const int trial = (int) Y(TRUNK_TRIALS);
  const int is_local = trial % LOCAL_TRUNK_PERIOD == LOCAL_TRUNK_PERIOD - 1;
  const int free_arms_period = X(CANDIDATES_BEFORE) > 0 ? LATER_FREE_ARMS_PERIOD : FREE_ARMS_PERIOD;
  int i;
  Y(TRUNK_TOTAL_TRIALS) = X(TRUNK_TOTAL_TRIALS) + 1;
  for (i = 0; i < N_TRUNK; ++i) {
    const int k = TRUNK_MOTORS[i];
    const double sample = trial_position(s, k, TRUNK_STEPS[i]), best = ENTRY(Y(TRUNK_BEST_Q), k);
    /* The radius around the best trunk shrinks with the number of trials. */
    ENTRY(Y(Q), k) = is_local
        ? best + (sample - best) * RADIUS_TRIALS / (RADIUS_TRIALS + Y(TRUNK_TRIALS)) : sample;
  }
  for (i = 0; i < N_ARM; ++i) {
    ENTRY(Y(ARM_BEST), i) = ENTRY(Y(Q), ARM[i]) = trial_position(s, ARM[i], ARM_STEPS_OF_TRIAL[i]);
  }
  for (i = 0; i < N_SIDES; ++i) ENTRY(Y(ARM_REDUNDANCY), i) = ENTRY(Y(ARM_BEST), i);
  to_placement(s);
  /* Alternate between arms over the whole redundancy, arms around one value of it, and arms from
   * low-discrepancy configurations. */
  if (trial % free_arms_period == 0) return goes_to(s, TRUNK_STAGE);
  if (trial % 2) Y(STAGE_ITERATIONS) = LOCAL_ARM_TRIAL;
  return RUNNING_STATUS;
}

static int after_trunk(solve s) {
  int max_trials = P(PALMS_ONLY) > 0 ? 1
                 : X(FIRST_CANDIDATE) > 0 ? OTHER_TRUNK_TRIALS
                 : X(CANDIDATES_BEFORE) > 0 ? LATER_TRUNK_TRIALS : FIRST_TRUNK_TRIALS;
  int i;
  if (RESULT(COST) < EXACT_COST) {
    begin_fit(s);
    goes_to(s, REFINEMENT_STAGE);
    return X(MEETS_CONTACTS) > 0 ? SOLVED_STATUS : RUNNING_STATUS;
  }
  if (!FLAG(IS_SETTLED)) return goes_to(s, TRUNK_STAGE);
  if (!(X(TRUNK_ARMS_PLACED_AGAIN) > 0) && !(P(PALMS_ONLY) > 0)
      && RESULT(COST) < REPLACEMENT_COST) {
    /* Arms that are placed again at this trunk may be on other branches. */
    Y(TRUNK_ARMS_PLACED_AGAIN) = 1;
    return to_placement(s);
  }
  Y(TRUNK_ARMS_PLACED_AGAIN) = 0;
  Y(TRUNK_TRIALS) = X(TRUNK_TRIALS) + 1;
  if (!(X(TRUNK_TRIALS) > 0) || RESULT(COST) < X(TRUNK_MIN_COST)) {
    Y(TRUNK_MIN_COST) = RESULT(COST);
    for (i = 0; i < N_MOTORS; ++i) ENTRY(Y(TRUNK_BEST_Q), i) = ENTRY(Y(Q), i);
  }
  if (is_out_of_reach(s)) {
    Y(LAST_CANDIDATE) = N_CANDIDATES - 1;
    max_trials = 0;
  }
  if (Y(TRUNK_TRIALS) < max_trials) return to_next_trunk(s);
  /* Contacts of palms out of reach may still be within tolerance. */
  for (i = 0; i < N_MOTORS; ++i) ENTRY(Y(Q), i) = ENTRY(Y(TRUNK_BEST_Q), i);
  begin_fit(s);
  return goes_to(s, REFINEMENT_STAGE);
}

/* Choose what follows a stage that moves trunk and arms only. */
static int after_arm_stage(solve s, int stage) {
  return stage == TRUNK_STAGE ? after_trunk(s) : after_placement(s);
}
