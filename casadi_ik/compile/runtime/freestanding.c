/* Definitions of common.c without heap, locks and clock, for standalone solvers.
 *
 * The entry point of a driver has a second argument `memory`, large enough for every driver.
 */
#include <string.h>

#define FREESTANDING

enum { DONE = 0, SLICE_OVER = 1, ROWS_FULL = 2, CONTINUES = 3, FEW_LEFT = 4 };

/* Requires the macros NAMED and MEMORY: name and memory type of the driver. */
#define DRIVER(name, work) int NAMED(work *job, MEMORY *memory)
#define CLOCK_INTERVAL 16
#define monotonic() ((scalar) 0)

typedef struct {
  const real *arg[STEP_IN + 1];
  real *res[STEP_OUT + 1];
  real *extra;
} workspace;

#define set_up(space, size) ((void) (size), (space)->extra = memory->w, DONE)
#define give_back(space) ((void) (space))
