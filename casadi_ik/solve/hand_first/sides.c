/* Where the rounds of a body begin: with hands that the tables of its sides hold (seeds.c).
 *
 * Expects the macro HANDS, which has a side find hands: from its points and normals, its place of
 * the robot, whether what is near is wanted and the round, into the postures.
 */

/* Postures of every hand whose contacts look like its part of the target. */
static int from_table(search *job, int64_t number) {
  double here[N_MOTORS], hands[N_CANDIDATES * N_HAND + 1];
  int side, i, k, finger = 0, first = 0;
  for (side = 0; side < N_SIDES; ++side) {
    const int fingers = SIDE_FINGERS[side], count = SIDE_HANDS[side];
    int asked = 0, code;
    for (i = 0; i < fingers; ++i) asked |= is_number(job->points[3 * (finger + i)]);
    for (i = 0; i < SIDE_MOTORS[side]; ++i) here[i] = job->here[SIDE_PLACES[side][i]];
    if (asked) {
      code = HANDS(side, job->points + 3 * finger, job->normals + 3 * finger, here,
                   job->terms[TERMS_NEAREST] > 0, number, hands);
      if (code != DONE) return code;
    }
    for (i = 0; i < N_CANDIDATES; ++i) {
      for (k = 0; k < count; ++k) {
        job->postures[i * N_HAND + first + k] =
            asked ? hands[i * count + k] : job->here[HAND[first + k]];
      }
    }
    finger += fingers;
    first += count;
  }
  return DONE;
}
