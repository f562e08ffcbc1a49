/* What common.c is, without heap, locks and clock: for solvers that stand alone.
 *
 * A driver's function gets a second argument `memory`, room for the largest of them.
 */
#include <string.h>

#define FREESTANDING

enum { DONE = 0, SLICE_OVER = 1, ROWS_FULL = 2, GOES_ON = 3, FEW_LEFT = 4 };

/* Expects the macros NAMED and MEMORY: the driver's name and the type of its memory. */
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
