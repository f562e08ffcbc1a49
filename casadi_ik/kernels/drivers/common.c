/* Shared by the drivers; appended to the code CasADi generated for one function.
 *
 * Expects the macros STEP, STEP_work, STEP_checkout, STEP_release and STEP_incref to name that
 * function's symbols. C99 with POSIX clocks and the __atomic builtins of gcc and clang.
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

/* What a driver returns to Python. */
enum {
  DONE = 0, SLICE_OVER = 1, ROWS_FULL = 2, GOES_ON = 3, FEW_LEFT = 4,
  NO_MEMORY = -1, NO_CHECKOUT = -2, STEP_FAILED = -3
};

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
  const casadi_real **arg;
  casadi_real **res;
  casadi_int *iw;
  casadi_real *w;
  casadi_real *extra;
  int mem;
} workspace;

/* CasADi's checkout of memory objects (only a few functions have any) is not atomic by itself. */
static char checkout_lock;
static int checkout_ready;

static int checkout(void) {
  int mem;
  while (__atomic_test_and_set(&checkout_lock, __ATOMIC_ACQUIRE)) {}
  if (!checkout_ready) {
    STEP_incref();
    checkout_ready = 1;
  }
  mem = STEP_checkout();
  __atomic_clear(&checkout_lock, __ATOMIC_RELEASE);
  return mem;
}

static void give_back(workspace *space) {
  while (__atomic_test_and_set(&checkout_lock, __ATOMIC_ACQUIRE)) {}
  STEP_release(space->mem);
  __atomic_clear(&checkout_lock, __ATOMIC_RELEASE);
  free(space->block);
}

/* One allocation for all arrays, numbers first so that everything is aligned: malloc's alignment
 * is less than vectors need. */
static int set_up(workspace *space, size_t extra) {
  casadi_int n_arg = 0, n_res = 0, n_iw = 0, n_w = 0;
  size_t doubles, bytes;
  char *block;
  STEP_work(&n_arg, &n_res, &n_iw, &n_w);
  doubles = (size_t) n_w + extra + 1;
  bytes = doubles * sizeof(casadi_real) + (size_t) n_iw * sizeof(casadi_int)
        + (size_t) n_arg * sizeof(casadi_real *) + (size_t) n_res * sizeof(casadi_real *);
  space->block = malloc(bytes + sizeof(casadi_real));
  if (!space->block) return NO_MEMORY;
  block = (char *) space->block;
  block += sizeof(casadi_real) - (uintptr_t) block % sizeof(casadi_real);
  space->w = (casadi_real *) block;
  space->extra = space->w + n_w;
  space->iw = (casadi_int *) (block + doubles * sizeof(casadi_real));
  space->arg = (const casadi_real **) (space->iw + n_iw);
  space->res = (casadi_real **) (space->arg + n_arg);
  space->mem = checkout();
  if (space->mem < 0) {
    free(space->block);
    return NO_CHECKOUT;
  }
  return DONE;
}
