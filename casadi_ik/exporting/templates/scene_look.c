#define LOOK_ROUNDING @ROUNDING@

const char *const @PREFIX@_link_names[] = {@LINK_NAMES@};

/* An answer that touches something is exchanged for one that does not, if there is an arm for it. */
static void look_about(@PREFIX@_solver *solver) {
  double q[N_MOTORS];
  memcpy(q, solver->q, sizeof q);
  if (@PREFIX@_free(solver, solver->terms + TERMS_LOWER, solver->terms + TERMS_UPPER,
                    solver->terms[TERMS_NEAREST] > 0, solver->q)) {
    if (!memcmp(q, solver->q, sizeof q)) return;
    memcpy(solver->state + STATE_Q, solver->q, sizeof q);
    if (finish(solver) == DONE && solver->status == @GUARD@_SOLVED
        && @PREFIX@_clearance(solver, solver->q) >= solver->scene.margin - LOOK_ROUNDING) return;
    memcpy(solver->state + STATE_Q, q, sizeof q);
    solver->status = @GUARD@_SOLVED;
    (void) finish(solver);
    (void) @PREFIX@_clearance(solver, q);
  }
  solver->status = @GUARD@_COLLISION;
}
