
/* Computes the contacts of a hand posture at a palm pose; returns 0, or the status of bad input. */
int @PREFIX@_touched(@PREFIX@_solver *solver, const scalar *palm, const scalar *posture,
                     scalar *points, scalar *normals) {
  scalar q[N_MOTORS], rotation[9]; /* from the palm at home to the given palm pose */
  int i, k, m, is_valid = 1;
  memcpy(q, HOME, sizeof q);
  for (i = 0; i < N_MOTORS; ++i) {
    if (!OF_HAND[i]) continue;
    is_valid &= posture[i] >= LOWER[i] - POSTURE_ROUNDING && posture[i] <= UPPER[i] + POSTURE_ROUNDING;
    q[i] = clipped(posture[i], LOWER[i], UPPER[i]);
  }
  for (i = 0; i < 12; ++i) is_valid &= is_finite(palm[i]);
  for (i = 0; i < 3; ++i) {
    for (k = 0; k < 3; ++k) {
      const scalar *a = palm + 3 * i, *b = palm + 3 * k, *home = HOME_PALM + 3 * k;
      const scalar product = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] - (i == k);
      is_valid &= product < (scalar) 1e-6 && product > -(scalar) 1e-6;
      rotation[3 * i + k] = a[0] * home[0] + a[1] * home[1] + a[2] * home[2];
    }
  }
  is_valid &= palm[0] * (palm[4] * palm[8] - palm[5] * palm[7])
         - palm[1] * (palm[3] * palm[8] - palm[5] * palm[6])
         + palm[2] * (palm[3] * palm[7] - palm[4] * palm[6]) > 0;
  if (!is_valid) return @GUARD@_BAD_INPUT;
  @PREFIX@_contacts(solver, q, points, normals);
  for (i = 0; i < 3 * N_FINGERS; i += 3) {
    scalar point[3], normal[3];
    for (m = 0; m < 3; ++m) {
      point[m] = points[i + m] - HOME_PALM[9 + m];
      normal[m] = normals[i + m];
    }
    for (k = 0; k < 3; ++k) {
      const scalar *row = rotation + 3 * k;
      points[i + k] = palm[9 + k] + (row[0] * point[0] + row[1] * point[1] + row[2] * point[2]);
      normals[i + k] = row[0] * normal[0] + row[1] * normal[1] + row[2] * normal[2];
    }
  }
  return 0;
}

int @PREFIX@_begin_palm(@PREFIX@_solver *solver, const scalar *palm, const scalar *posture,
                        const scalar *q0) {
  scalar points[3 * N_FINGERS], normals[3 * N_FINGERS];
  int i;
  if (@PREFIX@_touched(solver, palm, posture, points, normals)) {
    solver->status = @GUARD@_BAD_INPUT;
    return @GUARD@_BAD_INPUT;
  }
  (void) @PREFIX@_begin(solver, points, normals, q0);
  for (i = 0; i < N_MOTORS; ++i) {
    if (!OF_HAND[i]) continue;
    solver->settings[SETTINGS_LOWER + i] = solver->settings[SETTINGS_UPPER + i] =
        clipped(posture[i], LOWER[i], UPPER[i]);
  }
  return (int) solver->status;
}

int @PREFIX@_solve_palm(@PREFIX@_solver *solver, const scalar *palm, const scalar *posture,
                        const scalar *q0) {
  int status = @PREFIX@_begin_palm(solver, palm, posture, q0);
  while (status == @GUARD@_RUNNING) status = @PREFIX@_run(solver, BUDGET);
  return status;
}
