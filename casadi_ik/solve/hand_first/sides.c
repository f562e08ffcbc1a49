/* Seeds of the restarts of a multi-arm robot: hand postures from the tables of its sides
 * (seeds.c).
 *
 * The macro HANDS calls the search of a side: it takes the side's points and normals, its part of
 * q0, whether the preference is q0, and the number of the restart, and writes the postures.
 */

/* Seed every hand with the postures whose contacts resemble its part of the target most. */
static int seed_from_tables(search *job, int64_t number) {
  double q0_of_side[N_MOTORS], hands[N_CANDIDATES * N_HAND + 1];
  int side, i, k, finger = 0, first = 0;
  for (side = 0; side < N_SIDES; ++side) {
    const int fingers = SIDE_FINGERS[side], count = SIDE_HANDS[side];
    int has_point = 0, code;
    for (i = 0; i < fingers; ++i) has_point |= is_number(job->points[3 * (finger + i)]);
    for (i = 0; i < SIDE_MOTORS[side]; ++i) q0_of_side[i] = job->q0[SIDE_COLUMNS[side][i]];
    if (has_point) {
      code = HANDS(side, job->points + 3 * finger, job->normals + 3 * finger, q0_of_side,
                   job->settings[SETTINGS_NEAREST] > 0, number, hands);
      if (code != DONE) return code;
    }
    for (i = 0; i < N_CANDIDATES; ++i) {
      for (k = 0; k < count; ++k) {
        job->postures[i * N_HAND + first + k] =
            has_point ? hands[i * count + k] : job->q0[HAND[first + k]];
      }
    }
    finger += fingers;
    first += count;
  }
  return DONE;
}
