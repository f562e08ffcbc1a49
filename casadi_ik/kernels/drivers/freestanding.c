/* What common.c is, without heap, locks and clock: for solvers that stand alone.
 *
 * A driver's function gets a second argument `memory`, room for the largest of them.
 */
#include <string.h>

#define FREESTANDING

enum { DONE = 0, SLICE_OVER = 1, ROWS_FULL = 2, GOES_ON = 3, FEW_LEFT = 4, STEP_FAILED = -3 };

#define EXPORT
#define CLOCK_INTERVAL 16
#define monotonic() 0.0

typedef struct {
  const casadi_real **arg;
  casadi_real **res;
  casadi_int *iw;
  casadi_real *w;
  casadi_real *extra;
  int mem;
} workspace;

#define set_up(space, extra) take(space, memory)
#define give_back(space) ((void) (space))
