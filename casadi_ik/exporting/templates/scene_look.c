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
  if (!found && solver->terms[TERMS_NEAREST] > 0 && !look->again) {
    solver->terms[TERMS_NEAREST] = 0;
    memcpy(solver->here, HOME, sizeof solver->here);
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

/* Another arm for a hand that is free, and whether that is an answer. */
static int swung_free(@PREFIX@_solver *solver, const scalar *hand) {
  scalar q[N_MOTORS];
  memcpy(q, hand, sizeof q);
  return @PREFIX@_arm_is_free(solver, solver->terms + TERMS_LOWER, solver->terms + TERMS_UPPER,
                              solver->terms[TERMS_NEAREST] > 0, q)
      && answered(solver, q) && least_room(solver, q) >= -LOOK_ROUNDING;
}

/* Whether a hand is like none before it. */
static int is_new(const scalar *q, scalar *before, int64_t *count) {
  scalar *own = before + *count * N_HAND;
  int64_t i;
  int k;
  for (k = 0; k < N_HAND; ++k) own[k] = q[HAND[k]] / LOOK_RANGES[HAND[k]];
  for (i = 0; HAS_CLOSED_ARM && i < *count; ++i) {
    for (k = 0; k < N_HAND && fabs(own[k] - before[i * N_HAND + k]) < LOOK_ALIKE; ++k) continue;
    if (k == N_HAND) return 0;
  }
  ++*count;
  return 1;
}

/* What is preferred of hands, higher is better; of all motors where the arm goes with the hand. */
static scalar hand_rated(const @PREFIX@_solver *solver, const scalar *q) {
  const int near = solver->terms[TERMS_NEAREST] > 0, count = HAS_CLOSED_ARM ? N_HAND : N_MOTORS;
  scalar value = near ? 0 : INFINITY;
  int k;
  for (k = 0; k < count; ++k) {
    const int i = HAS_CLOSED_ARM ? HAND[k] : k;
    if (near) {
      const scalar part = (q[i] - solver->here[i]) / LOOK_RANGES[i];
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
  look->fresh |= is_new(q, look->known, &look->n_known);
  if (!fits || !is_new(q, look->swung, &look->n_swung)) return;
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
    code = from_table(job, look->round);
    job->terms[TERMS_NEAREST] = near;
  }
  if (code != DONE) return code;
  for (i = 0; i < N_CANDIDATES; ++i) {
    memcpy(job->near + i * N_HAND, job->postures + look->fit * N_HAND,
           N_HAND * sizeof(scalar));
  }
  for (i = 0; i < N_MOTORS; ++i) {
    here[i] = clipped(job->here[i], job->terms[TERMS_LOWER + i],
                      job->terms[TERMS_UPPER + i]);
  }
  inputs[0] = job->points;
  inputs[1] = job->normals;
  inputs[2] = here;
  inputs[3] = job->terms;
  inputs[4] = job->near;
  outputs[0] = job->state;
  outputs[1] = job->parameters;
  code = BEGIN(&map);
  job->state[STATE_PHASE] = CANDIDATE_PHASE;
  job->state[STATE_CANDIDATE] = N_CANDIDATES - 1;
  job->slot = -1;
  job->loop_status = RUNNING;
  return code;
}

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
