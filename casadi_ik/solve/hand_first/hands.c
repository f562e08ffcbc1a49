/* The hands of a round that look like a target, for a body that the robot is a side of: sides.c. */
FIND_HANDS(search *job, const double *points, const double *normals, const double *here,
           int64_t nearest, int64_t round, double *postures) {
  int code;
  memcpy(job->points, points, sizeof job->points);
  memcpy(job->normals, normals, sizeof job->normals);
  memcpy(job->here, here, sizeof job->here);
  memcpy(job->terms + TERMS_LOWER, LOWER, sizeof LOWER);
  memcpy(job->terms + TERMS_UPPER, UPPER, sizeof UPPER);
  job->terms[TERMS_NEAREST] = (double) nearest;
  code = from_table(job, round);
  memcpy(postures, job->postures, N_CANDIDATES * N_HAND * sizeof(double));
  return code;
}
