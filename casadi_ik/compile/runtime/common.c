/* Definitions shared by the drivers, placed after the code of one function.
 *
 * Requires the macros STEP(arg, res, active_lanes), which calls that function, and STEP_IN and
 * STEP_OUT, its numbers of inputs and outputs. C99 with POSIX clocks.
 */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

/* Entry point of a driver, which Python calls. */
#define DRIVER(name, work) EXPORT int casadi_ik_##name(work *job)

/* Result of a driver. */
enum { DONE = 0, SLICE_OVER = 1, ROWS_FULL = 2, CONTINUES = 3, FEW_LEFT = 4, NO_MEMORY = -1 };

/* Number of evaluations between readings of the clock, which take about 25 ns. */
#define CLOCK_INTERVAL 16

static double monotonic(void) {
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return (double) now.tv_sec + 1e-9 * (double) now.tv_nsec;
}

/* Memory of one call of a driver; threads share no workspace. */
typedef struct {
  void *block;
  const real *arg[STEP_IN + 1];
  real *res[STEP_OUT + 1];
  real *extra;
} workspace;

/* Allocate `extra` numbers, aligned for vectors, for which the alignment of malloc is too small. */
static int set_up(workspace *space, size_t extra) {
  char *block = malloc((extra + 2) * sizeof(real));
  space->block = block;
  if (!block) return NO_MEMORY;
  space->extra = (real *) (block + sizeof(real) - (uintptr_t) block % sizeof(real));
  return DONE;
}

static void give_back(workspace *space) { free(space->block); }
