#define LOOK_ROUNDING @ROUNDING@
@LOOK_CONSTANTS@

const char *const @PREFIX@_link_names[] = {@LINK_NAMES@};

static scalar least_room(@PREFIX@_solver *solver, const scalar *q) {
  return @PREFIX@_clearance(solver, q) - solver->scene.margin;
}

/* Makes a configuration the answer, if it is one; else the status is another. */
static int answered(@PREFIX@_solver *solver, const scalar *q) {
  memmove(solver->q, q, sizeof solver->q);
  solver->status = STALLED_STATUS;
  return judge(solver) == DONE && solver->status == SOLVED_STATUS;
}

/* Ends the search: with a free answer, or the one of largest clearance. A preference orders answers,
 * it does not decide whether there is one: where what was wanted is near, all is looked at once more
 * as if nothing were preferred. */
static void end_look(@PREFIX@_solver *solver, int found) {
  @PREFIX@_scene *look = &solver->scene;
  look->looking = 0;
@BODY{@
  look->listed = 0;
@}@
  if (!found && solver->terms[TERMS_NEAREST] > 0 && !look->again) {
    solver->terms[TERMS_NEAREST] = 0;
    memcpy(solver->q0, HOME, sizeof solver->q0);
    look->again = 1;
    solver->slot = -1;
    solver->loop_status = UNBEGUN;
    solver->iterations = 0;
    solver->status = RUNNING;
    return;
  }
  if (!found) (void) answered(solver, look->q);
  (void) least_room(solver, solver->q);
  solver->status = found ? SOLVED_STATUS : @GUARD@_COLLISION;
  solver->iterations = look->iterations;
  solver->restarts = look->restarts;
}

@ONE_ARM{@
/* Another arm for a hand that is free, and whether that is an answer. */
static int swung_free(@PREFIX@_solver *solver, const scalar *hand) {
  scalar q[N_MOTORS];
  memcpy(q, hand, sizeof q);
  return @PREFIX@_arm_is_free(solver, solver->terms + TERMS_LOWER, solver->terms + TERMS_UPPER,
                              solver->terms[TERMS_NEAREST] > 0, q)
      && answered(solver, q) && least_room(solver, q) >= -LOOK_ROUNDING;
}

#if HAS_CLOSED_ARM
/* Appends the numbers that distinguish a hand pose (motors of the hand divided by their ranges, then
 * the pose of the palm) to those of earlier hand poses; returns 0 if they equal earlier ones. */
static int is_new(search *job, const scalar *q, scalar *before, int64_t *count) {
  scalar *parts = before + *count * N_HAND_PARTS, palm[16];
  const scalar *inputs[1];
  scalar *outputs[1];
  map_job map = mapping(1, inputs, ALONE, outputs, ALONE);
  int64_t i;
  int k;
  inputs[0] = q;
  outputs[0] = palm;
  if (PALM(&map) != DONE) return 0;
  for (k = 0; k < N_HAND; ++k) parts[k] = q[HAND[k]] / LOOK_RANGES[HAND[k]];
  for (i = 0; i < 12; ++i, ++k) parts[k] = palm[i] * (i % 4 < 3 ? PALM_TURN : PALM_SHIFT);
  for (i = 0; i < *count; ++i) {
    const scalar *other = before + i * N_HAND_PARTS;
    for (k = 0; k < N_HAND_PARTS && fabs(parts[k] - other[k]) < LOOK_ALIKE; ++k) continue;
    if (k == N_HAND_PARTS) return 0;
  }
  ++*count;
  return 1;
}
#else
/* Without an arm in closed form every hand pose is tried. */
#define is_new(job, q, before, count) 1
#endif

/* What is preferred of hands, higher is better; of all motors where the arm goes with the hand. */
static scalar hand_rated(const @PREFIX@_solver *solver, const scalar *q) {
  const int near = solver->terms[TERMS_NEAREST] > 0, count = HAS_CLOSED_ARM ? N_HAND : N_MOTORS;
  scalar value = near ? 0 : INFINITY;
  int k;
  for (k = 0; k < count; ++k) {
    const int i = HAS_CLOSED_ARM ? HAND[k] : k;
    if (near) {
      const scalar part = (q[i] - solver->q0[i]) / LOOK_RANGES[i];
      value -= part * part;
    } else {
      const scalar below = q[i] - LOWER[i], above = UPPER[i] - q[i];
      const scalar part = (below < above ? below : above) / ((UPPER[i] - LOWER[i]) / 2);
      if (part < value) value = part;
    }
  }
  return value;
}

/* Takes a hand that meets the contacts in: where its idle fingers touch something they are put
 * elsewhere, and where it still does it is none. */
static void take_hand(@PREFIX@_solver *solver, scalar *q) {
  @PREFIX@_scene *look = &solver->scene;
  const scalar room = least_room(solver, q);
  scalar rated;
  int64_t place;
  int fits;
  if (room > look->room) {
    look->room = room;
    memcpy(look->q, q, sizeof look->q);
  }
  fits = @PREFIX@_hand_is_free(solver, solver->terms + TERMS_LOWER, solver->terms + TERMS_UPPER, q);
  look->fresh |= is_new(solver, q, look->known, &look->n_known);
  if (!fits || !is_new(solver, q, look->swung, &look->n_swung)) return;
  /* Into the order in which they are looked at. */
  rated = hand_rated(solver, q);
  for (place = look->n_met++; place > 0; --place) {
    const scalar before = look->rated[place - 1];
    if (HAS_CLOSED_ARM ? !(rated > before) : !(rated >= before)) break;
    look->rated[place] = before;
    memcpy(look->met + place * N_MOTORS, look->met + (place - 1) * N_MOTORS, sizeof look->q);
  }
  look->rated[place] = rated;
  memcpy(look->met + place * N_MOTORS, q, sizeof look->q);
}

/* An answer that touches something is exchanged for one that does not: first for the same hand with
 * another arm, then (`look_on`) for other hands. */
static void look_about(@PREFIX@_solver *solver) {
  @PREFIX@_scene *look = &solver->scene;
  scalar q[N_MOTORS];
  const scalar room = least_room(solver, solver->q);
  if (!look->again) {
    look->iterations = solver->iterations;
    look->restarts = solver->restarts;
    look->room = -INFINITY;
  }
  if (room >= -LOOK_ROUNDING) {
    end_look(solver, 1);
    return;
  }
  look->looking = 1;
  look->round = look->fit = look->next = look->n_met = look->n_known = look->n_swung = 0;
  memcpy(q, solver->q, sizeof q);
  take_hand(solver, q);
  if (look->n_met && swung_free(solver, look->met)) {
    end_look(solver, 1);
    return;
  }
  look->n_met = 0;
  look->fresh = 1;
  solver->status = RUNNING;
}

@}@
/* Begins the fit of the next hand of the round. */
static int begin_hand(search *job) {
  @PREFIX@_scene *look = &job->scene;
  const scalar *inputs[5], near = job->terms[TERMS_NEAREST];
  scalar *outputs[2], here[N_MOTORS];
  map_job map = mapping(1, inputs, ALONE, outputs, ALONE);
  int code = DONE, i;
  if (!look->fit) {
    look->fresh = 0;
    /* The order does not matter here, and where the robot is has been looked at. */
    job->terms[TERMS_NEAREST] = 0;
    code = seed_from_tables(job, look->round);
    job->terms[TERMS_NEAREST] = near;
  }
  if (code != DONE) return code;
  for (i = 0; i < N_CANDIDATES; ++i) {
    memcpy(job->seed_pool + i * N_HAND, job->postures + look->fit * N_HAND,
           N_HAND * sizeof(scalar));
  }
  for (i = 0; i < N_MOTORS; ++i) {
    here[i] = clipped(job->q0[i], job->terms[TERMS_LOWER + i],
                      job->terms[TERMS_UPPER + i]);
  }
  inputs[0] = job->points;
  inputs[1] = job->normals;
  inputs[2] = here;
  inputs[3] = job->terms;
  inputs[4] = job->seed_pool;
  outputs[0] = job->state;
  outputs[1] = job->parameters;
  code = BEGIN(&map);
  job->state[STATE_PHASE] = CANDIDATE_PHASE;
  job->state[STATE_CANDIDATE] = N_CANDIDATES - 1;
  /* A different palm for each posture, where contacts leave the palm free. */
  job->state[STATE_PALM_NUMBER] = (scalar) (look->round * N_CANDIDATES + look->fit);
@BODY{@
  job->state[STATE_FIRST_CANDIDATE] = N_CANDIDATES - 1;
@}@
  job->slot = -1;
  job->loop_status = RUNNING;
  return code;
}

@ONE_ARM{@
/* Goes on with the search: at most so many iterations of one fit, or the arms of one hand. */
static int look_on(@PREFIX@_solver *solver, int64_t most) {
  @PREFIX@_scene *look = &solver->scene;
  int code;
  if (look->fit == N_CANDIDATES) {
    if (look->next < look->n_met) {
      if (swung_free(solver, look->met + look->next++ * N_MOTORS)) end_look(solver, 1);
      else solver->status = RUNNING;
      return DONE;
    }
    /* Where a round has brought no other hand, the next will not either. */
    if (++look->round == LOOK_ROUNDS || !look->fresh) {
      end_look(solver, 0);
      return DONE;
    }
    look->fit = look->next = look->n_met = 0;
  }
  if (most <= 0) return DONE;
  if (solver->slot < 0) {
    code = begin_hand(solver);
    if (code != DONE) return code;
  }
  code = iterate(solver, most, NULL);
  if (code != DONE) return code == SLICE_OVER ? DONE : code;
  ++look->fit;
  memcpy(solver->q, solver->state + STATE_Q, sizeof solver->q);
  if (answered(solver, solver->q)) {
    scalar q[N_MOTORS];
    memcpy(q, solver->q, sizeof q);
    take_hand(solver, q);
  }
  solver->status = RUNNING;
  return DONE;
}

@}@
@BODY{@
/* Where the palms are, twelve numbers a side, and as the trunk's end sees them, sixteen. */
static int find_palms(search *job, const scalar *q, scalar *palms, scalar *seen) {
  const scalar *inputs[1];
  scalar *outputs[2];
  map_job map = mapping(1, inputs, ALONE, outputs, ALONE);
  inputs[0] = q;
  outputs[0] = palms;
  outputs[1] = seen;
  return PALM(&map);
}

/* Whether a hand of a side and its palm are like none before. */
static int is_new(const @PREFIX@_scene *look, int side, int first, const scalar *q,
                  const scalar *palm) {
  int64_t n;
  int i;
  for (n = 0; n < look->n_hands[side]; ++n) {
    const scalar *hand = look->hands[side][n], *before = look->palms[side][n];
    int alike = 1;
    for (i = first; i < first + SIDE_HANDS[side]; ++i) {
      alike &= fabs(q[HAND[i]] - hand[HAND[i]]) < LOOK_ALIKE * LOOK_RANGES[HAND[i]];
    }
    for (i = 0; i < 12; ++i) {
      alike &= (i < 9 ? PALM_TURN : PALM_SHIFT) * fabs(palm[i] - before[i]) < LOOK_ALIKE;
    }
    if (alike) return 0;
  }
  return 1;
}

/* Takes an answer in, its idle fingers put elsewhere where they touch something: hands that touch
 * nothing by themselves are kept by side. Whether it is free as a whole. */
static int take_answer(search *job, scalar *q) {
  @PREFIX@_scene *look = &job->scene;
  scalar palms[12 * N_SIDES], seen[16 * N_SIDES], room;
  int side, first = 0;
  (void) @PREFIX@_hand_is_free(job, job->terms + TERMS_LOWER, job->terms + TERMS_UPPER, q);
  room = least_room(job, q);
  if (room > look->room) {
    look->room = room;
    memcpy(look->q, q, sizeof look->q);
  }
  if (room >= -LOOK_ROUNDING) return answered(job, q);
  if (find_palms(job, q, palms, seen) != DONE) return 0;
  for (side = 0; side < N_SIDES; first += SIDE_HANDS[side++]) {
    const int64_t n = look->n_hands[side];
    const scalar *palm = palms + 12 * side;
    if (!@PREFIX@_side_is_free(job, side, q) || !is_new(look, side, first, q, palm)) continue;
    memcpy(look->hands[side][n], q, sizeof look->hands[side][n]);
    memcpy(look->palms[side][n], palm, sizeof look->palms[side][n]);
    ++look->n_hands[side];
    look->fresh = 1;
  }
  return 0;
}

/* What the loop is at: the fit of another hand, another trunk, or arms that were found at one. */
enum { AT_NOTHING, AT_HAND, AT_TRUNK, AT_ARMS };

/* An answer that touches something is exchanged for one that does not (`look_on`): with other trunks
 * and arms for the same hands, then with other hands. */
static void look_about(@PREFIX@_solver *solver) {
  @PREFIX@_scene *look = &solver->scene;
  scalar q[N_MOTORS];
  if (!look->again) {
    look->iterations = solver->iterations;
    look->restarts = solver->restarts;
    look->room = -INFINITY;
  }
  memcpy(q, solver->q, sizeof q);
  if (least_room(solver, q) >= -LOOK_ROUNDING) {
    end_look(solver, 1);
    return;
  }
  @PREFIX@_list_pairs(solver, solver->terms + TERMS_LOWER, solver->terms + TERMS_UPPER);
  look->looking = 1;
  look->round = look->lot = look->tried = look->under_way = 0;
  look->fit = N_CANDIDATES;
  look->fresh = 1;
  memset(look->n_hands, 0, sizeof look->n_hands);
  if (take_answer(solver, q)) end_look(solver, 1);
  else solver->status = RUNNING;
}

/* Trunk and arms, from a configuration on, are to carry palms; its hands stay. */
static int begin_carry(search *job, const scalar *q, const scalar *palms, int phase) {
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
  inputs[3] = job->terms;
  inputs[4] = job->seed_pool;
  outputs[0] = job->state;
  outputs[1] = job->parameters;
  code = BEGIN(&map);
  memcpy(job->state + STATE_Q, q, N_MOTORS * sizeof(scalar));
  memcpy(job->state + STATE_BEST_Q, q, N_MOTORS * sizeof(scalar));
  memcpy(job->state + STATE_PALMS, palms, 12 * N_SIDES * sizeof(scalar));
  for (i = 0; i < N_CARRY; ++i) job->state[CARRY_PLACES[i]] = CARRY_VALUES[i];
  job->state[STATE_PHASE] = phase;
  job->slot = -1;
  job->loop_status = RUNNING;
  return code;
}

/* The next trunk of the lot, evenly spread as all arms are, every second one up to the limits; ways
 * to combine hands of the sides share them. */
static int begin_trunk(search *job) {
  @PREFIX@_scene *look = &job->scene;
  scalar q[N_MOTORS], palms[12 * N_SIDES];
  int64_t ways = 1, before = 0, number;
  int i, k, side, first = 0;
  for (side = 0; side < N_SIDES; ++side) {
    if (look->n_hands[side] > ways) ways = look->n_hands[side];
  }
  for (i = 0; i < look->lot; ++i) before += LOTS[i][0];
  if (ways > LOTS[look->lot][1]) ways = LOTS[look->lot][1];
  number = before + look->tried / ways;
  for (side = 0; side < N_SIDES; first += SIDE_HANDS[side++]) {
    const int64_t n = look->tried % ways % look->n_hands[side];
    if (!side) memcpy(q, look->hands[side][n], sizeof q);
    for (k = first; k < first + SIDE_HANDS[side]; ++k) q[HAND[k]] = look->hands[side][n][HAND[k]];
    memcpy(palms + 12 * side, look->palms[side][n], sizeof look->palms[side][n]);
  }
  for (i = 0; i < N_CARRYING; ++i) {
    const int column = CARRYING[i];
    const scalar low = job->terms[TERMS_LOWER + column], high = job->terms[TERMS_UPPER + column];
    scalar part = even(number + 1, CARRYING_STEPS[i]);
    if (number % 2) part = clipped((part - 0.5) * TRUNK_AT_ENDS + 0.5, 0.0, 1.0);
    q[column] = low + part * (high - low);
  }
  return begin_carry(job, q, palms, number % 4 != 3 ? ARM_PLACEMENT_PHASE : TRUNK_PHASE);
}

/* Begins what comes next; 0: the search is over. */
static int look_next(search *job, int *code) {
  @PREFIX@_scene *look = &job->scene;
  int side, known = 1;
  for (side = 0; side < N_SIDES; ++side) known &= look->n_hands[side] > 0;
  while (look->fit == N_CANDIDATES) {
    if (look->lot == N_LOTS) return 0;
    if (known && look->tried < LOTS[look->lot][0]) {
      look->under_way = AT_TRUNK;
      *code = begin_trunk(job);
      return 1;
    }
    ++look->lot;
    look->tried = 0;
    /* Where a round has brought no other hand, the next will not either. */
    if (look->round < LOOK_ROUNDS && look->fresh) look->fit = 0;
  }
  look->under_way = AT_HAND;
  *code = begin_hand(job);
  return 1;
}

/* Goes on with the search: at most so many iterations of one fit, or of one trunk. */
static int look_on(@PREFIX@_solver *solver, int64_t most) {
  @PREFIX@_scene *look = &solver->scene;
  scalar q[N_MOTORS], palms[12 * N_SIDES], seen[16 * N_SIDES];
  int code = DONE, met, at, found = 0;
  if (most <= 0) return DONE;
  if (look->under_way == AT_NOTHING && !look_next(solver, &code)) {
    end_look(solver, 0);
    return DONE;
  }
  if (code == DONE) code = iterate(solver, most, NULL);
  if (code != DONE) return code == SLICE_OVER ? DONE : code;
  at = (int) look->under_way;
  look->under_way = AT_NOTHING;
  memcpy(q, solver->state + STATE_Q, sizeof q);
  met = answered(solver, q);
  if (at == AT_HAND) {
    look->round += ++look->fit == N_CANDIDATES;
    found = met && take_answer(solver, q);
  } else {
    look->tried += at == AT_TRUNK;
    found = met && least_room(solver, q) >= -LOOK_ROUNDING;
  }
  solver->status = RUNNING;
  if (found) {
    end_look(solver, 1);
  } else if (at == AT_TRUNK && met) {
    code = find_palms(solver, q, palms, seen);
    if (code == DONE
        && @PREFIX@_arms_are_free(solver, solver->terms + TERMS_LOWER, solver->terms + TERMS_UPPER,
                                  solver->terms[TERMS_NEAREST] > 0, seen, q)) {
      look->under_way = AT_ARMS;
      code = begin_carry(solver, q, palms, TRUNK_PHASE);
    }
  }
  return code;
}

@}@
/* Goes on with what is under way. */
static int run_on(@PREFIX@_solver *solver, int64_t most) {
  int code;
  if (solver->scene.looking) return look_on(solver, most);
  code = search_run(solver, most, 1);
  if (code != DONE || solver->status == RUNNING) return code;
  if (solver->status == SOLVED_STATUS) look_about(solver);
  else if (solver->scene.again) end_look(solver, 0);
  return DONE;
}
