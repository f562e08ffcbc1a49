/* All rounds of hand-first for one target, as method.py and restarts.py make them for a batch.
 *
 * Calls the compiled kernels by the macros LOOK_UP, BEGIN, SOLVE, CONTACTS, VALLEY, EACH_FINGER (if
 * MENDS) and JUDGE, which take a pointer to a job of the drivers. The constants come from
 * rounds.py. Bit for bit the answers of a batch: what is computed here is computed in the same
 * order there.
 */

static const int64_t ALONE[] = {0, 0, 0, 0, 0, 0, 0, 0};

static int is_number(double x) { return x == x; }
static int is_finite(double x) { return x * 0.0 == 0.0; }

static double clipped(double x, double low, double high) {
  const double above = x > low ? x : low;
  return above < high ? above : high;
}

/* Entry of the i-th point, counted from 1, of an even spread. */
static double even(int64_t i, double step) {
  const double x = 0.5 + (double) i * step;
  return x - (double) (int64_t) x;
}

static double posture(int table, int64_t row, int motor) {
  const double spread = (even(row + 1, HAND_STEPS[motor]) - 0.5) / TABLE_SQUEEZE[table] + 0.5;
  return TABLE_LOWER[table][motor] + clipped(spread, 0.0, 1.0) * TABLE_RANGE[table][motor];
}

static int look_up(rounds *job, int table, int64_t wanted) {
  const double *inputs[2];
  lookup_job look = {0};
  inputs[0] = job->points;
  inputs[1] = job->normals;
  look.inputs = inputs;
  look.input_steps = ALONE;
  look.tiles = TILES(table);
  look.found = job->found;
  look.rows = TABLE_ROWS[table];
  look.wanted = wanted;
  look.count = 1;
  return LOOK_UP(&look);
}

static map_job mapping(int64_t count, const double **inputs, const int64_t *input_steps,
                       double **outputs, const int64_t *output_steps) {
  map_job map = {0};
  map.inputs = inputs;
  map.input_steps = input_steps;
  map.outputs = outputs;
  map.output_steps = output_steps;
  map.count = count;
  map.slice = SLICE;
  return map;
}

static double apart(const double *one, const double *other) {
  double sum = 0.0;
  int i;
  for (i = 0; i < N_HAND; ++i) sum += (one[i] - other[i]) * (one[i] - other[i]);
  return sum;
}

#if MENDS
/* Every finger of the pool's postures chosen by itself; those of which least is left come first. */
static int mend(rounds *job, int64_t pool) {
  static const int64_t in[] = {0, 0, N_HAND}, out[] = {N_HAND, 1};
  const double *inputs[3];
  double *outputs[2];
  map_job map = mapping(pool, inputs, in, outputs, out);
  int64_t i, place;
  int code;
  inputs[0] = job->points;
  inputs[1] = job->normals;
  inputs[2] = job->near;
  outputs[0] = job->mended;
  outputs[1] = job->left;
  do code = EACH_FINGER(&map);
  while (code == SLICE_OVER);
  if (code != DONE) return code;
  for (i = 0; i < pool; ++i) {
    for (place = i; place > 0 && job->left[i] < job->left[job->found[place - 1]]; --place) {
      job->found[place] = job->found[place - 1];
    }
    job->found[place] = i;
  }
  for (i = 0; i < pool; ++i) {
    memcpy(job->near + i * N_HAND, job->mended + job->found[i] * N_HAND, N_HAND * sizeof(double));
  }
  return DONE;
}
#endif

/* Of the pool of postures those that differ, best first, without the first of them. */
static void vary(rounds *job, int table, int64_t pool, int64_t count, int64_t first, double *into) {
  int64_t i, k, place, pick;
  for (i = 0; i < pool; ++i) {
    for (k = 0; k < N_HAND; ++k) {
      const double range = TABLE_RANGE[table][k];
      job->places[i * N_HAND + k] = job->near[i * N_HAND + k] / (range > 0 ? range : 1.0);
    }
    job->closest[i] = 1e300;
    job->taken[i] = 0;
  }
  for (place = 0; place < count; ++place) {
    int64_t least = 4;
    pick = 0;
    for (i = 0; i < pool; ++i) {
      const int64_t rank = 2 * job->taken[i] + (job->closest[i] < ALIKE);
      if (rank < least) {
        least = rank;
        pick = i;
      }
    }
    job->taken[pick] = 1;
    for (i = 0; i < pool; ++i) {
      const double off = apart(job->places + i * N_HAND, job->places + pick * N_HAND);
      if (off < job->closest[i]) job->closest[i] = off;
    }
    if (place < first) continue;
    memcpy(into + (place - first) * N_HAND, job->near + pick * N_HAND, N_HAND * sizeof(double));
  }
}

#if MENDS
/* Mended postures that do not look like the target in particular, other ones in every round; late
 * ones by turns as they are. */
static int from_spread(rounds *job, int64_t number) {
  const int plain = number >= NARROW && number % 2;
  const int64_t count = plain ? N_CANDIDATES : number < NARROW ? SPREAD : NARROWER;
  int64_t i;
  int code, k;
  for (i = 0; i < count; ++i) {
    for (k = 0; k < N_HAND; ++k) job->near[i * N_HAND + k] = posture(1, number * SPREAD + i, k);
  }
  if (plain) {
    memcpy(job->postures, job->near, sizeof job->postures);
    return DONE;
  }
  code = mend(job, count);
  if (code == DONE) vary(job, 1, count, N_CANDIDATES, 0, job->postures);
  return code;
}
#endif

/* Nearest to where the robot is first; its own posture before them, instead of the last. */
static void order(rounds *job, int own) {
  double here[N_HAND], near[N_HAND], sorted[N_CANDIDATES * N_HAND], distance[N_CANDIDATES];
  const int first = own && HAS_ARM && N_CANDIDATES > 1;
  const int count = first ? N_CANDIDATES - 1 : N_CANDIDATES;
  int i, j, k;
  for (k = 0; k < N_HAND; ++k) {
    const int column = HAND[k];
    here[k] = clipped(job->here[column], job->terms[TERMS_LOWER + column],
                      job->terms[TERMS_UPPER + column]);
    near[k] = here[k] / ORDER_RANGES[k];
  }
  for (i = 0; i < count; ++i) {
    double place[N_HAND];
    for (k = 0; k < N_HAND; ++k) place[k] = job->postures[i * N_HAND + k] / ORDER_RANGES[k];
    distance[i] = apart(place, near);
  }
  for (i = 0; i < count; ++i) {
    int before = first;
    for (j = 0; j < count; ++j) {
      before += distance[j] < distance[i] || (distance[j] == distance[i] && j < i);
    }
    for (k = 0; k < N_HAND; ++k) sorted[before * N_HAND + k] = job->postures[i * N_HAND + k];
  }
  for (k = 0; first && k < N_HAND; ++k) sorted[k] = here[k];
  memcpy(job->postures, sorted, sizeof sorted);
}

/* Postures whose contacts look like the target. */
static int from_table(rounds *job, int64_t number) {
  const int table = !number ? 0 : !ENFORCE_LIMITS && number % 2 ? 2 : 1;
  const int64_t wanted = number ? number * N_CANDIDATES : N_CANDIDATES;
  const int64_t most = TABLE_ROWS[table];
  int64_t pool = number ? POOL * wanted : wanted;
  int code, i, k;
#if MENDS
  if (number >= VARIED) {
    code = from_spread(job, number);
    if (code == DONE && job->terms[TERMS_NEAREST] > 0) order(job, 0);
    return code;
  }
#endif
  if (pool > most) pool = most;
  code = look_up(job, table, pool);
  if (code != DONE) return code;
  for (i = 0; i < pool; ++i) {
    for (k = 0; k < N_HAND; ++k) job->near[i * N_HAND + k] = posture(table, job->found[i], k);
  }
  if (number) {
#if MENDS
    code = mend(job, pool);
    if (code != DONE) return code;
#endif
    vary(job, table, pool, wanted, wanted - N_CANDIDATES, job->postures);
  } else {
    memcpy(job->postures, job->near, sizeof job->postures);
  }
  if (job->terms[TERMS_NEAREST] > 0) order(job, !number);
  return DONE;
}

/* How the contacts move with palm and hand. */
static int find_slopes(rounds *job, const double *q) {
  const double *inputs[1];
  double *outputs[2];
  static const int64_t in[] = {N_MOTORS}, out[] = {3 * N_FINGERS, 3 * N_FINGERS};
  const double *base[2];
  map_job map = mapping(N_HAND + 1, inputs, in, outputs, out);
  int code, kind, i, k, m;
  for (k = 0; k <= N_HAND; ++k) {
    memcpy(job->moved + k * N_MOTORS, q, N_MOTORS * sizeof(double));
    if (k) job->moved[k * N_MOTORS + HAND[k - 1]] += NUDGE * SIZE[k - 1];
  }
  inputs[0] = job->moved;
  outputs[0] = job->moved_points;
  outputs[1] = job->moved_normals;
  code = CONTACTS(&map);
  if (code != DONE) return code;
  for (i = 0; i < (N_HAND + 1) * 3 * N_FINGERS; ++i) job->moved_points[i] /= LENGTH;
  base[0] = job->moved_points;
  base[1] = job->moved_normals;
  memset(job->rigid, 0, sizeof job->rigid);
  for (kind = 0; kind < 2; ++kind) {
    const double *target = kind ? job->normals : job->points;
    for (i = 0; i < 3 * N_FINGERS; ++i) {
      const int place = kind * 3 * N_FINGERS + i;
      const double counts = is_number(target[i - i % 3]) ? 1.0 : 0.0;
      for (k = 0; k < N_HAND; ++k) {
        const double there = base[kind][(k + 1) * 3 * N_FINGERS + i];
        job->slopes[k * 6 * N_FINGERS + place] = (there - base[kind][i]) / NUDGE * counts;
      }
      if (!HAS_ARM) continue;
      if (!kind) job->rigid[i % 3 * 6 * N_FINGERS + place] = counts;
      for (m = 0; m < 3; ++m) {
        /* The m-th axis times the vector. */
        const double *vector = base[kind] + i - i % 3;
        const int axis = i % 3;
        double turn = 0.0;
        if (axis == (m + 1) % 3) turn = -vector[(m + 2) % 3];
        if (axis == (m + 2) % 3) turn = vector[(m + 1) % 3];
        job->rigid[(3 + m) * 6 * N_FINGERS + place] = turn * counts;
      }
    }
  }
  return DONE;
}

/* Postures to either side of a fit that came to rest. */
static int along_valley(rounds *job, int64_t which) {
  const double *q = job->last + STATE_BEST_Q;
  const double *inputs[3];
  double *outputs[1];
  map_job map = mapping(1, inputs, ALONE, outputs, ALONE);
  int code = find_slopes(job, q), i, k;
  if (code != DONE) return code;
  for (k = 0; k < N_HAND; ++k) {
    const double at = q[HAND[k]], below = at - LOWER[HAND[k]], above = UPPER[HAND[k]] - at;
    const double end = below < above ? below : above;
    job->held[k] = which % 2 == 0 && end < AT_END ? HELD : 0.0;
  }
  inputs[0] = job->rigid;
  inputs[1] = job->slopes;
  inputs[2] = job->held;
  outputs[0] = job->motion;
  code = VALLEY(&map);
  if (code != DONE) return code;
  for (i = 0; i < N_CANDIDATES; ++i) {
    for (k = 0; k < N_HAND; ++k) {
      const double step = job->motion[k] * SIZE[k];
      job->postures[i * N_HAND + k] = q[HAND[k]] + STRIDES[which * N_CANDIDATES + i] * step;
    }
  }
  return DONE;
}

/* Hand postures from anywhere, and all motors of the first of them. */
static void from_anywhere(rounds *job, int64_t number, double *first) {
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

static int begin_round(rounds *job, int64_t number) {
  const double *inputs[5 + N_MORE];
  double *outputs[2], first[N_MOTORS];
  map_job map = mapping(1, inputs, ALONE, outputs, ALONE);
  const int64_t later = number - TABLE_ROUNDS;
  int code = DONE, goes_on, i, k;
  memcpy(job->last, job->state, sizeof job->last);
  goes_on = later >= VALLEYS && (later - VALLEYS) % 2 == 0 && job->last[STATE_BEST_COST] < SURE;
  if (later < 0 || !number) code = from_table(job, number);
  else if (later < VALLEYS) code = along_valley(job, later);
  else if (goes_on) code = along_valley(job, VALLEYS + (later - VALLEYS) / 2);
  else from_anywhere(job, later - VALLEYS, first);
#if MENDS
  if (later >= VALLEYS && !goes_on) code = from_spread(job, number);
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
  if (later >= VALLEYS) {
    /* The first begins as a whole: what stands in the way may be arm and hand together. */
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

static int is_hopeful(const rounds *job, int64_t number) {
  const double returns = job->state[STATE_RETURNS], cost = job->state[STATE_BEST_COST];
  const int held = job->state[STATE_HELD] > 0;
  const double most = held ? RETURNS_OF_HELD : RETURNS, near = held ? NEAR_OF_HELD : NEAR_COST;
  const int64_t rugged = number - FIRST_RUGGED;
  if (rugged >= 0) {
    return returns < most && cost < near && cost < NEAR_SHRINKS / (double) (rugged + 1);
  }
  return returns < most || cost < SURE || number < VARIED || number >= TABLE_ROUNDS;
}

/* The verdict, which has the last word on what is solved. */
static int finish(rounds *job) {
  const double slack = 1 + TOLERANCE_SLACK, tried = job->state[STATE_CANDIDATE];
  const double *inputs[3];
  double *outputs[3];
  map_job map = mapping(1, inputs, ALONE, outputs, ALONE);
  int code, i, met = 1;
  if (job->again) job->terms[TERMS_NEAREST] = 1.0;
  memcpy(job->q, job->state + STATE_Q, sizeof job->q);
  job->restarts = (int64_t) job->state[STATE_EARLIER]
                + (int64_t) clipped((double) (int64_t) tried, 0.0, N_CANDIDATES - 1);
  if (N_MORE) return DONE;
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
static int rounds_begin(rounds *job) {
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
  job->round = 0;
  job->under_way = 0;
  job->iterations = 0;
  job->restarts = 0;
  job->again = 0;
  job->status = RUNNING;
  return sound && asked;
}

/* A preference orders answers: where none was found near `here`, all rounds follow without it. 0 if
 * they have been made, and if a first round alone is wanted. */
static int search_again(rounds *job) {
  if (!job->rounds || !(job->terms[TERMS_NEAREST] > 0)) return 0;
  job->terms[TERMS_NEAREST] = 0.0;
  job->again = 1;
  job->round = 0;
  return 1;
}

/* Goes on with what is under way for at most so many iterations. */
static int iterate(rounds *job, int64_t most, int32_t *status) {
  const int64_t before = job->in_round;
  double seconds = 0;
  loop_job loop = {0};
  int code;
  loop.states = job->state;
  loop.parameters = job->parameters;
  loop.iterations = &job->in_round;
  loop.status = status;
  loop.seconds = &seconds;
  loop.mark = job->mark;
  loop.count = 1;
  loop.max_iterations = before + most < BUDGET ? before + most : BUDGET;
  loop.slice = SLICE;
  code = SOLVE(&loop);
  job->iterations += job->in_round - before;
  return code;
}

/* Goes on for so many iterations, and begins one round at most; `status` says whether it is over.
 *
 * Returns DONE, SLICE_OVER if it has to be called again, or what went wrong.
 */
static int rounds_run(rounds *job, int64_t most) {
  int begun = 0, code;
  while (job->status == RUNNING) {
    const int64_t before = job->iterations;
    int32_t status = RUNNING;
    if (!job->under_way) {
      if (begun++ || most <= 0) return DONE;
      code = begin_round(job, job->round);
      if (code != DONE) return code;
      job->under_way = 1;
      job->in_round = 0;
    }
    code = iterate(job, most, &status);
    most -= job->iterations - before;
    if (code != DONE) return code;
    if (status == RUNNING && job->in_round < BUDGET) return DONE;
    job->under_way = 0;
    if (status == SOLVED_STATUS) {
      job->status = SOLVED_STATUS;
      return finish(job);
    }
    do ++job->round;
    while (job->round < job->rounds && !is_hopeful(job, job->round));
    if (job->round < job->rounds || search_again(job)) continue;
    job->status = status == RUNNING ? LIMIT_STATUS
                : status == REPEATED ? STALLED_STATUS
                : status < 0 ? INVALID_STATUS : status;
    return finish(job);
  }
  return DONE;
}
