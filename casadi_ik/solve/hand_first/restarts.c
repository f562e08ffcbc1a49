/* Restart policy of hand-first: seeds and first stage of each restart, and the end of the search.
 *
 * Restarts are numbered from 0. The first ROUNDS restarts are table restarts, whose seeds resemble
 * the target. The others are global restarts, which begin with a refinement of all motors, because
 * arm and hand together may be the obstacle; their seeds are low-discrepancy postures. Restarts
 * from FIRST_RUGGED on are extra restarts, for targets that still improve.
 */

/* Tables of hand postures. */
enum { TABLE_OF_FIRST_SEEDS = 0, TABLE_OF_LATER_SEEDS = 1, TABLE_BEYOND_LIMITS = 2 };

static inline int is_odd(int64_t number) { return (int) (number % 2); }

static inline int is_global_restart(int64_t number) { return number >= ROUNDS; }

/* Return the table of a table restart. If limits are ignored, every second restart uses the table
 * of postures beyond the limits. */
static inline int table_of_restart(int64_t number) {
  if (!number) return TABLE_OF_FIRST_SEEDS;
  return !ENFORCE_LIMITS && is_odd(number) ? TABLE_BEYOND_LIMITS : TABLE_OF_LATER_SEEDS;
}

/* Return 1 if seeds are repaired finger by finger; every second late restart omits the repair. */
static inline int repairs_seeds(int64_t number) { return number < LATE_ROUND || !is_odd(number); }

/* Return 1 if the incumbent of the previous restarts nearly meets the contacts. */
static inline int incumbent_nearly_fits(const search *job) {
  return job->previous_state[STATE_BEST_COST] < NEARLY_FITS;
}

/* Return 1 if the incumbents before a restart define a line for its seeds. Multi-arm robots have
 * none, because their sides are seeded independently. */
static inline int tracks_incumbents(const search *job, int64_t number) {
  return !N_SIDES && number > 0 && incumbent_nearly_fits(job);
}

/* Return 1 if a restart has seeds on the line through the last two incumbents: every second one. */
static inline int seeds_along_line(const search *job, int64_t number) {
  return tracks_incumbents(job, number) && job->incumbent_count > 1 && !is_odd(number);
}

/* Return 1 if the refinement of a global restart starts from the incumbent instead of a
 * low-discrepancy configuration: every second one, because a refinement stalls in flat valleys. */
static inline int starts_at_incumbent(const search *job, int64_t number) {
  return incumbent_nearly_fits(job) && is_odd(number - ROUNDS);
}

/* Return 1 if a contact has a wide angle tolerance. Configurations within such a tolerance are
 * often far from the minima of exact fits. */
static inline int has_wide_tolerance(const search *job) {
  int i, is_wide = 0;
  for (i = 0; i < N_FINGERS; ++i) {
    is_wide |= job->settings[N_FINGERS + i] > WIDE_ANGLE && is_number(job->normals[3 * i]);
  }
  return is_wide;
}

/* Return 1 if a global restart begins with a tolerant refinement: every second one if a tolerance
 * is wide. */
static inline int starts_tolerant(const search *job, int64_t number) {
  return has_wide_tolerance(job) && is_odd(number - ROUNDS) && !starts_at_incumbent(job, number);
}

/* Return 1 if another restart is worthwhile. Table seeds are not once most fits have converged to
 * the same infeasible minimum. Extra restarts require that minima keep changing and that the best
 * cost shrinks with the number of restarts; if a tolerance is wide, their number is fixed. */
static inline int restart_is_worthwhile(const search *job) {
  const double repeated = job->state[STATE_REPEATED_MINIMA], cost = job->state[STATE_BEST_COST];
  const int is_underactuated = job->state[STATE_IS_UNDERACTUATED] > 0;
  const double max_repeated = is_underactuated ? SAME_MINIMUM_MANY : SAME_MINIMUM;
  const double max_cost = is_underactuated ? FAR_COST_MANY : FAR_COST;
  const int64_t extra = job->round - FIRST_RUGGED;
  if (has_wide_tolerance(job)) return extra < WIDE_ROUNDS;
  if (extra >= 0) {
    return repeated < max_repeated && cost < max_cost
        && cost < FAR_COST_SHRINKS / (double) (extra + 1);
  }
  return repeated < max_repeated || cost < FLAT_COST || job->round < SURE_ROUNDS
      || is_global_restart(job->round);
}

/* Advance to the next worthwhile restart; return 0 if there is none. A preference only ranks
 * answers: if no answer near q0 exists, all restarts are repeated without the preference. */
static inline int next_restart(search *job) {
#if N_SIDES
  if (job->state[STATE_IS_OUT_OF_REACH] > 0) return 0;
#endif
  do ++job->round;
  while (job->round < job->max_restarts && !restart_is_worthwhile(job));
  if (job->round < job->max_restarts) return 1;
  if (!job->max_restarts || !(job->settings[SETTINGS_NEAREST] > 0)) return 0;
  job->settings[SETTINGS_NEAREST] = 0.0;
  job->preference_dropped = 1;
  job->round = 0;
  return 1;
}
