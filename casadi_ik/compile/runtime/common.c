/* Shared by the drivers; stands behind the code of one function.
 *
 * Expects the macros STEP(arg, res, wanted), which calls that function, and STEP_IN and STEP_OUT,
 * how many inputs and outputs it has. C99 with POSIX clocks.
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

/* The function of a driver, which Python calls. */
#define DRIVER(name, work) EXPORT int casadi_ik_##name(work *job)

/* What it returns. */
enum { DONE = 0, SLICE_OVER = 1, ROWS_FULL = 2, GOES_ON = 3, FEW_LEFT = 4, NO_MEMORY = -1 };

/* The clock is looked at once in so many evaluations: reading it costs about 25 ns. */
#define CLOCK_INTERVAL 16

static double monotonic(void) {
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return (double) now.tv_sec + 1e-9 * (double) now.tv_nsec;
}

/* Everything one call of a driver works on; each call has its own, so threads never share any. */
typedef struct {
  void *block;
  const real *arg[STEP_IN + 1];
  real *res[STEP_OUT + 1];
  real *extra;
} workspace;

/* Memory for numbers, aligned for vectors: malloc's alignment is less than they need. */
static int set_up(workspace *space, size_t extra) {
  char *block = malloc((extra + 2) * sizeof(real));
  space->block = block;
  if (!block) return NO_MEMORY;
  space->extra = (real *) (block + sizeof(real) - (uintptr_t) block % sizeof(real));
  return DONE;
}

static void give_back(workspace *space) { free(space->block); }
