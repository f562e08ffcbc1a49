/* Write the seeds of a restart for a side of a multi-arm robot (sides.c). */
FIND_HANDS(search *job, const double *points, const double *normals, const double *q0,
           int64_t nearest, int64_t round, double *postures) {
  int code;
  memcpy(job->points, points, sizeof job->points);
  memcpy(job->normals, normals, sizeof job->normals);
  memcpy(job->q0, q0, sizeof job->q0);
  memcpy(job->settings + SETTINGS_LOWER, LOWER, sizeof LOWER);
  memcpy(job->settings + SETTINGS_UPPER, UPPER, sizeof UPPER);
  job->settings[SETTINGS_NEAREST] = (double) nearest;
  code = seed_from_tables(job, round);
  memcpy(postures, job->postures, N_CANDIDATES * N_HAND * sizeof(double));
  return code;
}
