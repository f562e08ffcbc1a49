/* Hand first: the search for one target, from the question to the verdict.
 *
 * A search makes rounds until a target is solved or none is left that may help. A round takes up to
 * N_CANDIDATES hand postures (seeds.c, of a body sides.c), one after the other. Of each it takes
 * the palm pose that suits it best (candidate), fits palm and hand to the contacts as if the hand
 * could fly (hand fit), has the arm carry the palm there in closed form (arm placement, or
 * arm choice if what is near q0 is wanted), moves all motors where the arm cannot follow exactly
 * (refinement), and brings the largest error down where contacts contradict each other (balance).
 * An iteration is one step of the stage that the solve is in, and the choice of the next stage:
 * iteration.c.
 *
 * The loop (compile/runtime/loop.c) makes the iterations, of many targets side by side or of one,
 * and asks `follow` whenever they end. A batch, one target, `fast`, a solve by steps and an
 * exported solver all come here.
 *
 * BEGIN, SOLVE and JUDGE call compiled kernels, as in seeds.c; the constants come from driver.py.
 */

/* Hand postures from anywhere, and all motors of the first of them: for what no table holds. */
static void from_anywhere(search *job, int64_t number, double *first) {
  int i, k;
  for (i = 0; i < N_CANDIDATES; ++i) {
    const int64_t place = number * N_CANDIDATES + i + 1;
    for (k = 0; k < N_HAND; ++k) {
      const int column = HAND[k];
      job->postures[i * N_HAND + k] =
          ANYWHERE_LOWER[column] + even(place, ALL_STEPS[column]) * ANYWHERE_RANGE[column];
    }
  }
  for (k = 0; k < N_MOTORS; ++k) {
    first[k] = ANYWHERE_LOWER[k]
             + even(number * N_CANDIDATES + 1, ALL_STEPS[k]) * ANYWHERE_RANGE[k];
  }
}

/* By turns, where the best so far nearly fits, hands on the line through it and the one that was it
 * before: contacts move little along it, and of its hands the arm may hold another. Whether it made
 * the round's; not of a body, whose sides find hands by themselves. */
static int from_line(search *job, int64_t number) {
  double *best = job->bests, *before = job->bests + N_HAND, longest = 0;
  int i, k, other = 0;
  if (N_SIDES || !number || !(job->last[STATE_BEST_COST] < NEARLY_FITS)) return 0;
  for (k = 0; k < N_HAND; ++k) other |= job->last[STATE_BEST_Q + HAND[k]] != best[k];
  if (other) {
    memcpy(before, best, N_HAND * sizeof(double));
    for (k = 0; k < N_HAND; ++k) best[k] = job->last[STATE_BEST_Q + HAND[k]];
    ++job->n_bests;
  }
  for (k = 0; k < N_HAND; ++k) {
    const double part = fabs(best[k] - before[k]) / ANYWHERE_RANGE[HAND[k]];
    if (part > longest) longest = part;
  }
  if (job->n_bests < 2 || number % 2 || !(longest > 0)) return 0;
  for (i = 0; i < N_CANDIDATES; ++i) {
    const double way = 2 * even(number * N_CANDIDATES + i + 1, ALL_STEPS[0]) - 1;
    for (k = 0; k < N_HAND; ++k) {
      const double step = ALONG_LINE * way / longest * (best[k] - before[k]);
      job->postures[i * N_HAND + k] = best[k] + step;
    }
  }
  return 1;
}

/* First state and parameters of the round, from its postures; what was found before stays. */
static int begin_round(search *job) {
  const int64_t number = job->round, later = number - ROUNDS;
  const double *inputs[5 + N_MORE];
  double *outputs[2], first[N_MOTORS];
  map_job map = mapping(1, inputs, ALONE, outputs, ALONE);
  int code = DONE, i, k;
  memcpy(job->last, job->state, sizeof job->last);
  if (later >= 0) from_anywhere(job, later, first);
  if (from_line(job, number)) code = DONE;
  else if (later < 0) code = from_table(job, number);
#if MENDS
  else code = from_spread(job, number);
#endif
  if (code != DONE) return code;
  inputs[0] = job->points;
  inputs[1] = job->normals;
  for (i = 0; i < N_MORE; ++i) inputs[2 + i] = job->more + 3 * N_FINGERS * i;
  inputs[2 + N_MORE] = job->here;
  inputs[3 + N_MORE] = job->terms;
  inputs[4 + N_MORE] = job->postures;
  outputs[0] = job->state;
  outputs[1] = job->parameters;
  code = BEGIN(&map);
  if (code != DONE) return code;
  if (!number) {
    for (i = 0; job->again && i < N_COUNTS; ++i) {
      job->state[STATE_COUNTS + i] = job->last[STATE_COUNTS + i];
    }
    return DONE;
  }
  job->state[STATE_PHASE] = CANDIDATE_PHASE;
  job->state[STATE_CANDIDATE] = 0.0;
  if (later >= 0) {
    /* The first begins as a whole: what stands in the way may be arm and hand together. By turns it
     * is the best so far, where that nearly fits: a refinement gives up in a flat valley. */
    const int goes_on = later % 2 && job->last[STATE_BEST_COST] < NEARLY_FITS;
    if (goes_on) memcpy(first, job->last + STATE_BEST_Q, sizeof first);
    for (k = 0; k < N_MOTORS; ++k) {
      job->state[STATE_Q + k] = clipped(first[k], job->parameters[PARAMETERS_LOWER + k],
                                        job->parameters[PARAMETERS_UPPER + k]);
    }
    job->state[STATE_PHASE] = REFINEMENT_PHASE;
    for (i = 0; i < N_FRESH; ++i) job->state[FRESH_PLACES[i]] = FRESH_VALUES[i];
  }
  for (i = 0; i < N_CARRIED; ++i) job->state[CARRIED[i]] = job->last[CARRIED[i]];
  job->state[STATE_EARLIER] = job->last[STATE_EARLIER] + N_CANDIDATES;
  return DONE;
}

/* Whether the round may help. One from a table does not where fits only come back to a minimum that
 * misses; one that not every target gets needs a target that ends elsewhere each time, and nearer
 * the longer it takes. */
static int may_help(const search *job) {
  const double returns = job->state[STATE_RETURNS], cost = job->state[STATE_BEST_COST];
  const int held = job->state[STATE_HELD] > 0;
  const double most = held ? SAME_MINIMUM_MANY : SAME_MINIMUM;
  const double near = held ? FAR_COST_MANY : FAR_COST;
  const int64_t rugged = job->round - FIRST_RUGGED;
  if (rugged >= 0) {
    return returns < most && cost < near && cost < FAR_COST_SHRINKS / (double) (rugged + 1);
  }
  return returns < most || cost < FLAT_COST || job->round < SURE_ROUNDS || job->round >= ROUNDS;
}

/* The next round that may help; 0 if there is none. A preference orders answers: where none was
 * found near `here`, all rounds follow without it. */
static int choose_round(search *job) {
#if N_SIDES
  if (job->state[STATE_HOPELESS] > 0) return 0;
#endif
  do ++job->round;
  while (job->round < job->most && !may_help(job));
  if (job->round < job->most) return 1;
  if (!job->most || !(job->terms[TERMS_NEAREST] > 0)) return 0;
  job->terms[TERMS_NEAREST] = 0.0;
  job->again = 1;
  job->round = 0;
  return 1;
}

/* The verdict, which has the last word on what is solved. */
static int judge(search *job) {
  const double slack = 1 + TOLERANCE_SLACK;
  const double *inputs[3];
  double *outputs[3];
  map_job map = mapping(1, inputs, ALONE, outputs, ALONE);
  int code, i, met = 1;
  inputs[0] = job->q;
  inputs[1] = job->points;
  inputs[2] = job->normals;
  outputs[0] = job->position_error;
  outputs[1] = job->angle_error;
  outputs[2] = &job->beyond;
  code = JUDGE(&map);
  if (code != DONE) return code;
  for (i = 0; i < N_FINGERS; ++i) {
    met &= job->position_error[i] <= job->terms[i] * slack || !is_number(job->points[3 * i]);
    met &= job->angle_error[i] <= job->terms[N_FINGERS + i] * slack
        || !is_number(job->normals[3 * i]);
  }
  if (ENFORCE_LIMITS) met &= job->beyond <= LIMIT_SLACK;
  if (met) job->status = SOLVED_STATUS;
  else if (job->status == SOLVED_STATUS) job->status = STALLED_STATUS;
  return DONE;
}

#if N_TURNING
/* A search begins within half a turn of zero where a motor has no limits: its bounds are no stops. */
static void take_turns(search *job) {
  int i;
  for (i = 0; i < N_TURNING; ++i) {
    const int k = TURNING[i];
    job->turns[i] = CONTINUOUS[i] ? TURN * floor(job->here[k] / TURN + 0.5) : 0.0;
    job->here[k] -= job->turns[i];
  }
}

/* Moves motors of the answer by full turns to be nearest to `here`: those without limits, and the
 * others within their bounds if that is preferred. A motor whose bounds are equal is held. */
static void nearest_turns(search *job) {
  int i;
  for (i = 0; i < N_TURNING; ++i) {
    const int k = TURNING[i];
    const double low = job->terms[TERMS_LOWER + k], high = job->terms[TERMS_UPPER + k];
    const double q = job->q[k], turns = floor((job->here[k] - q) / TURN + 0.5);
    if (CONTINUOUS[i] && low < high) {
      job->q[k] = q + TURN * turns + job->turns[i];
    } else if (job->terms[TERMS_NEAREST] > 0) {
      const double least = ceil((low - q) / TURN), most = floor((high - q) / TURN);
      job->q[k] = q + TURN * clipped(turns, least < 0 ? least : 0.0, most > 0 ? most : 0.0);
    }
  }
}
#endif

/* What follows when the loop has come to an end of the target's iterations, or it is new: the next
 * round (GOES_ON), or the answer (DONE); SLICE_OVER where this call may not begin one. */
static int follow(void *method, int64_t slot, int64_t solve, int32_t *status) {
  search *job = method;
  int code = DONE, goes_on = *status == UNBEGUN;
  (void) slot, (void) solve;
  if (*status != SOLVED_STATUS) {
    if (!job->may_begin) return SLICE_OVER;
#if N_TURNING
    if (goes_on) take_turns(job);
#endif
    if (goes_on) job->round = job->again = job->n_bests = 0;
    else goes_on = choose_round(job);
  }
  if (goes_on) {
    --job->may_begin;
    code = begin_round(job);
    return code == DONE ? GOES_ON : code;
  }
  job->status = *status == RUNNING ? ITERATION_LIMIT_STATUS
              : *status == REPEATED ? STALLED_STATUS
              : *status < 0 ? INVALID_STATUS : *status;
  if (job->again) job->terms[TERMS_NEAREST] = 1.0;
  memcpy(job->q, job->state + STATE_Q, sizeof job->q);
#if N_TURNING
  nearest_turns(job);
#endif
  job->restarts = (int64_t) job->state[STATE_EARLIER]
                + (int64_t) clipped((double) (int64_t) job->state[STATE_CANDIDATE], 0.0,
                                    N_CANDIDATES - 1);
  if (!N_MORE && job->judged) code = judge(job);
  *status = (int32_t) job->status;
  return code;
}

/* So many steps of what is in `state`; `next` says what follows. SLICE_OVER: there is more. */
static int iterate(search *job, int64_t steps,
                   int (*next)(void *, int64_t, int64_t, int32_t *)) {
  int32_t status = (int32_t) job->loop_status;
  double seconds = 0;
  loop_job loop = {0};
  int code;
  loop.states = job->state;
  loop.parameters = job->parameters;
  loop.iterations = &job->iterations;
  loop.status = &status;
  loop.seconds = &seconds;
  loop.slots = &job->slot;
  loop.begun = &job->begun;
  loop.mark = job->mark;
  loop.slot_count = 1;
  loop.count = 1;
  loop.solve = job->slot < 0 ? 0 : 1;
  loop.max_iterations = BUDGET;
  loop.left = steps;
  loop.slice = SLICE;
  loop.follow = next;
  loop.method = job;
  code = SOLVE(&loop);
  job->loop_status = status;
  return code;
}

static double length_of(const double *vector) {
  return sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2]);
}

/* Whether a vector is free, or a direction: that gets length one as `unit_vectors` makes it. */
static int made_unit(double *vector) {
  double length;
  int i;
  if (vector[0] != vector[0]) return vector[1] != vector[1] && vector[2] != vector[2];
  if (!(is_finite(vector[0]) && is_finite(vector[1]) && is_finite(vector[2]))) return 0;
  length = length_of(vector);
  if (!(length >= SMALL_LENGTH && length <= LARGE_LENGTH)) {
    /* By powers of two, which change no digit; in two halves, as one may be out of range. */
    double most = 0;
    int power, half;
    for (i = 0; i < 3; ++i) most = fabs(vector[i]) > most ? fabs(vector[i]) : most;
    (void) frexp(most, &power);
    half = (-power - (power & 1)) / 2;
    for (i = 0; i < 3; ++i) vector[i] = ldexp(ldexp(vector[i], half), -power - half);
    length = length_of(vector);
  }
  if (length == 0) return 0;
  if (length - 1 < UNIT && 1 - length < UNIT) return 1;
  for (i = 0; i < 3; ++i) vector[i] /= length;
  return 1;
}

/* Takes up the question that stands in the job; 0 if it is malformed. */
static int search_begin(search *job) {
  int i, asked = 0, sound = 1;
  for (i = 0; i < N_FINGERS; ++i) {
    double *point = job->points + 3 * i, *normal = job->normals + 3 * i;
    const int placed = is_finite(point[0]) && is_finite(point[1]) && is_finite(point[2]);
    const int placeless = !is_number(point[0]) && !is_number(point[1]) && !is_number(point[2]);
    sound &= placed || (placeless && !is_number(normal[0]));
    sound &= made_unit(normal);
    asked |= placed;
  }
  for (i = 0; i < N_MOTORS; ++i) sound &= is_finite(job->here[i]);
  job->slot = -1;
  job->loop_status = UNBEGUN;
  job->iterations = 0;
  job->restarts = 0;
  job->judged = 1;
  job->status = RUNNING;
  return sound && asked;
}

/* Goes on for so many iterations, and begins so many rounds at most; `status` says whether the
 * search is over. */
static int search_run(search *job, int64_t steps, int64_t rounds) {
  int code;
  if (job->status != RUNNING || steps <= 0) return DONE;
  job->may_begin = rounds;
  code = iterate(job, steps, follow);
  return code == SLICE_OVER ? DONE : code;
}
