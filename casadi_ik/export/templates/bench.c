/* Measures the time of a solve for contacts of random configurations: bench [SECONDS] [TARGETS].
 * cpu_mean is processor time, which other programs do not affect; all other figures are wall time. */
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "@PREFIX@.h"

enum { SAMPLE = 4096 };

static @PREFIX@_solver solver;
static uint64_t seed = 88172645463325252u;

static double random_part(void) {
  seed ^= seed << 13;
  seed ^= seed >> 7;
  seed ^= seed << 17;
  return (double) (seed >> 11) / 9007199254740992.0;
}

static double microseconds(clockid_t clock) {
  struct timespec t;
  clock_gettime(clock, &t);
  return (double) t.tv_sec * 1e6 + (double) t.tv_nsec * 1e-3;
}

static int compare(const void *a, const void *b) {
  const float x = *(const float *) a, y = *(const float *) b;
  return (x > y) - (x < y);
}

int main(int count, char **words) {
  const double seconds = count > 1 ? atof(words[1]) : 10.0, bench_start = microseconds(CLOCK_MONOTONIC);
  const long max_targets = count > 2 ? atol(words[2]) : 1000000;
  float *times = malloc((size_t) max_targets * sizeof *times);
  @REAL@ q[@GUARD@_MOTORS], points[3 * @GUARD@_FINGERS], normals[3 * @GUARD@_FINGERS]@AND_SUM@
  static @REAL@ contacts[SAMPLE][6 * @GUARD@_FINGERS];
  double cpu;
  long n, k, solved = 0;
  int i;
  if (!times) return 2;
  @PREFIX@_init(&solver);
  for (n = 0; n < max_targets && microseconds(CLOCK_MONOTONIC) - bench_start < seconds * 1e6; ++n) {
    double start;
    for (i = 0; i < @GUARD@_MOTORS; ++i) {
      q[i] = @PREFIX@_lower[i] + @TO_REAL?@random_part() * (@PREFIX@_upper[i] - @PREFIX@_lower[i]);
    }
    @PREFIX@_contacts(&solver, q, points, normals);
    start = microseconds(CLOCK_MONOTONIC);
    solved += @PREFIX@_solve(&solver, points, normals, 0) == @GUARD@_SOLVED;
    times[n] = (float) (microseconds(CLOCK_MONOTONIC) - start);
    sum += @AS_DOUBLE?@times[n];
    memcpy(contacts[n % SAMPLE], points, sizeof points);
    memcpy(contacts[n % SAMPLE] + 3 * @GUARD@_FINGERS, normals, sizeof normals);
  }
  if (!n) return 2;
  cpu = microseconds(CLOCK_PROCESS_CPUTIME_ID);
  for (k = 0; k < SAMPLE && k < n; ++k) {
    @PREFIX@_solve(&solver, contacts[k], contacts[k] + 3 * @GUARD@_FINGERS, 0);
  }
  cpu = (microseconds(CLOCK_PROCESS_CPUTIME_ID) - cpu) / (double) k;
  qsort(times, (size_t) n, sizeof *times, compare);
  printf("{\"targets\": %ld, \"solved\": %ld, \"cpu_mean\": %.3f, \"mean\": %.3f, \"median\": %.3f, \"p99\": %.3f, "
         "\"p99.9\": %.3f, \"max\": %.3f, \"unit\": \"us\", \"solver_bytes\": %ld}\n",
         n, solved, cpu, sum / (double) n, @AS_DOUBLE?@times[n / 2], @AS_DOUBLE?@times[n * 99 / 100], @AS_DOUBLE?@times[n * 999 / 1000],
         @AS_DOUBLE?@times[n - 1], (long) sizeof solver);
  free(times);
  return 0;
}
