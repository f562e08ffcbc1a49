/* Access to the data of one lane, and helpers of all stages of hand-first.
 *
 * The capitalised functions of the stages are the graphs of step.py and multi_arm.py: from state x
 * and parameters p they compute the next state y, the results of the stage and the record.
 * iteration.py defines them and the constants.
 */

#ifdef LANES
#define WIDTH LANES
#else
#define WIDTH 1
#endif

/* Data of one lane. */
typedef struct {
  double *x, *y, *results;     /* state, next state, results of the stage; WIDTH doubles apart */
  const double *p;             /* parameters without the postures, WIDTH doubles apart */
  const double *all_p;         /* all parameters, contiguous */
} solve;

#define X(field) s.x[STATE_##field * WIDTH]
#define Y(field) s.y[STATE_##field * WIDTH]
#define P(field) s.p[PARAMETERS_##field * WIDTH]
#define RESULT(field) s.results[RESULT_##field * WIDTH]
#define FLAG(field) (RESULT(field) > 0)
#define ENTRY(first, i) (&(first))[(i) * WIDTH]

static int goes_to(solve s, int stage) {
  Y(PHASE) = stage;
  return RUNNING_STATUS;
}

static void begin_fit(solve s) {
  Y(DAMPING) = FIT_DAMPING;
  Y(GROWTH) = FIT_GROWTH;
  Y(SLOW_STEPS) = Y(STAGE_ITERATIONS) = 0;
}

/* Set the arm in q to the best arm, clipped to its bounds. */
static void set_arm(solve s) {
  int i;
  for (i = 0; i < N_ARM; ++i) {
    const int k = ARM[i];
    const double low = ENTRY(P(LOWER), k), high = ENTRY(P(UPPER), k), q = ENTRY(Y(ARM_BEST), i);
    ENTRY(Y(Q), k) = q < low ? low : q > high ? high : q;
  }
}

/* Update the incumbent with the configuration of this cost. */
static void update_incumbent(solve s, double cost) {
  int i;
  if (!(cost < X(BEST_COST))) return;
  Y(BEST_COST) = cost;
  for (i = 0; i < N_MOTORS; ++i) ENTRY(Y(BEST_Q), i) = ENTRY(Y(Q), i);
}

/* End the solve with the incumbent. */
static int end_with_incumbent(solve s) {
  int i;
  for (i = 0; i < N_MOTORS; ++i) ENTRY(Y(Q), i) = ENTRY(Y(BEST_Q), i);
  return STALLED_STATUS;
}

/* Return 1 if tolerances may hold near the minimum of this exact fit, and `minimum`, the cost of
 * the last such minimum, is another one; then update it. Otherwise count a repeated minimum. */
static int is_new_minimum(solve s, double *minimum, double last_minimum) {
  const double cost = Y(COST), difference = cost - last_minimum;
  if (RESULT(RMS_RATIO) > NEAR_MISS_RATIO) return 0;
  if ((difference < 0 ? -difference : difference) <= SAME_COST * last_minimum) {
    Y(REPEATED_MINIMA) = X(REPEATED_MINIMA) + 1;
    return 0;
  }
  *minimum = cost;
  return RESULT(RMS_RATIO) <= MAX_START_RATIO;
}

/* Update the smallest result of a fit, or count a repeated minimum if this one is no smaller. */
static void update_smallest(solve s, double *smallest, double last_smallest, double value) {
  Y(REPEATED_MINIMA) = X(REPEATED_MINIMA) + (value > IMPROVEMENT_RATIO * last_smallest);
  if (value < last_smallest) *smallest = value;
}
