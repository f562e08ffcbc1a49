/* The step's arithmetic on vectors whose entries belong to LANES solves, four or eight.
 *
 * Stands between the code as CasADi generated it and the same rewritten to call what is here
 * (`lanes.py`).
 * Every entry is computed as one double would be (no contraction, the same library functions), so
 * a solve's iterates are bit for bit those it has alone. Vectors are those of gcc and clang.
 */
#include <math.h>
#include <stdint.h>
#include <string.h>
#if defined(__x86_64__)
#include <immintrin.h>
#endif

typedef double lanes __attribute__((vector_size(LANES * sizeof(double))));
typedef int64_t lane_mask __attribute__((vector_size(LANES * sizeof(double))));

#if !defined(__x86_64__)
#define LANES_TARGET
#elif LANES == 8
#define LANES_TARGET __attribute__((target("avx512f,avx512dq,avx512vl")))
#else
#define LANES_TARGET __attribute__((target("avx2")))
#endif
#define LANES_INLINE static inline __attribute__((always_inline)) LANES_TARGET

#undef casadi_real
#define casadi_real lanes

#if LANES == 8
#define SPREAD(x) ((lanes) {(x), (x), (x), (x), (x), (x), (x), (x)})
#else
#define SPREAD(x) ((lanes) {(x), (x), (x), (x)})
#endif
#define TRUTH(mask) ((lanes) ((lane_mask) (mask) & (lane_mask) SPREAD(1.0)))
#define IS(x) ((lane_mask) ((x) != SPREAD(0.0)))
#define lanes_not(mask) (~(mask))
#define lanes_at(x, lane) ((x)[lane])

LANES_INLINE lanes lanes_select(lane_mask mask, lanes yes, lanes no) {
  return (lanes) ((mask & (lane_mask) yes) | (~mask & (lane_mask) no));
}

LANES_INLINE lanes lanes_if_else_zero(lanes condition, lanes value) {
  return (lanes) (IS(condition) & (lane_mask) value);
}

LANES_INLINE lanes lanes_sq(lanes x) { return x * x; }

LANES_INLINE lanes lanes_fabs(lanes x) { return (lanes) ((lane_mask) x & INT64_MAX); }

/* One lane after the other, each as it would be alone. */
#define LANES_ALONE(NAME)                                       \
  static __attribute__((noinline)) LANES_TARGET                 \
  lanes lanes_alone_##NAME(lanes x) {                           \
    lanes value;                                                \
    int i;                                                      \
    for (i = 0; i < LANES; ++i) value[i] = own_##NAME(x[i]);    \
    return value;                                               \
  }

LANES_ALONE(sin)
LANES_ALONE(cos)

#define LANES_OF_ONE(NAME)                               \
  LANES_INLINE lanes lanes_##NAME(lanes x) {             \
    lanes value;                                         \
    int i;                                               \
    for (i = 0; i < LANES; ++i) value[i] = NAME(x[i]);   \
    return value;                                        \
  }

#define LANES_OF_TWO(NAME)                                     \
  LANES_INLINE lanes lanes_##NAME(lanes x, lanes y) {          \
    lanes value;                                               \
    int i;                                                     \
    for (i = 0; i < LANES; ++i) value[i] = NAME(x[i], y[i]);   \
    return value;                                              \
  }

#if defined(__x86_64__) && LANES == 8
LANES_INLINE lanes lanes_sqrt(lanes x) { return _mm512_sqrt_pd(x); }
LANES_INLINE lanes lanes_floor(lanes x) { return _mm512_floor_pd(x); }
LANES_INLINE lanes lanes_ceil(lanes x) { return _mm512_ceil_pd(x); }
LANES_INLINE int lanes_all(lane_mask mask) { return _mm512_movepi64_mask((__m512i) mask) == 255; }
#elif defined(__x86_64__)
LANES_INLINE lanes lanes_sqrt(lanes x) { return _mm256_sqrt_pd(x); }
LANES_INLINE lanes lanes_floor(lanes x) { return _mm256_floor_pd(x); }
LANES_INLINE lanes lanes_ceil(lanes x) { return _mm256_ceil_pd(x); }
LANES_INLINE int lanes_all(lane_mask mask) { return _mm256_movemask_pd((__m256d) mask) == 15; }
#else
LANES_OF_ONE(sqrt)
LANES_OF_ONE(floor)
LANES_OF_ONE(ceil)

LANES_INLINE int lanes_all(lane_mask mask) {
  int i, all = 1;
  for (i = 0; i < LANES; ++i) all &= mask[i] != 0;
  return all;
}
#endif
LANES_OF_ONE(exp)
LANES_OF_ONE(log)
LANES_OF_ONE(tanh)
LANES_OF_TWO(fmod)
LANES_OF_TWO(hypot)
LANES_OF_TWO(pow)

/* As in extremes.c. */
LANES_INLINE lanes lanes_fmax(lanes x, lanes y) {
  return lanes_select((lane_mask) (y != y), x, lanes_select((lane_mask) (x > y), x, y));
}

LANES_INLINE lanes lanes_fmin(lanes x, lanes y) {
  return lanes_select((lane_mask) (y != y), x, lanes_select((lane_mask) (x < y), x, y));
}

static inline void lanes_copy(const lanes *from, casadi_int count, lanes *to) {
  if (!to) return;
  if (from) memcpy(to, from, (size_t) count * sizeof(lanes));
  else memset(to, 0, (size_t) count * sizeof(lanes));
}

static inline void lanes_clear(lanes *to, casadi_int count) {
  if (to) memset(to, 0, (size_t) count * sizeof(lanes));
}

/* Which branch each lane takes, `last` for all numbers that are not 0 ... last - 1: converted as
 * casadi_to_int does it; of two branches everything but 0 takes the last. */
static void lanes_branch(const lanes *index, int last, int *branch) {
  int i;
  for (i = 0; i < LANES; ++i) {
    const casadi_int k = index ? (casadi_int) ((const double *) index)[i] : 0;
    branch[i] = k >= 0 && k < last ? (int) k : last;
  }
}

/* A bit for each lane that takes branch b. */
static int lanes_in(const int *branch, int b) {
  int i, bits = 0;
  for (i = 0; i < LANES; ++i) bits |= (branch[i] == b) << i;
  return bits;
}

static void lanes_keep(int mine, const lanes *own, int count, lanes *result) {
  int i, k;
  if (!result) return;
  for (i = 0; i < LANES; ++i) {
    if (!(mine >> i & 1)) continue;
    for (k = 0; k < count; ++k) {
      ((double *) result)[k * LANES + i] = ((const double *) own)[k * LANES + i];
    }
  }
}

/* A function of plain doubles and memory for a call of it. */
typedef struct {
  int (*function)(const double **, double **, casadi_int *, double *, int);
  int n_in, n_out;
  const int *sizes;            /* numbers of each input, then of each output */
  double *numbers;             /* their sum */
  const double **arg;
  double **res;
} lanes_alone;

static int lanes_one_by_one(const lanes_alone *alone, const lanes **arg, lanes **res,
                            casadi_int *iw, double *w, int wanted) {
  int lane, i, k;
  for (lane = 0; lane < LANES; ++lane) {
    double *number = alone->numbers;
    const int *size = alone->sizes;
    if (!(wanted >> lane & 1)) continue;
    for (i = 0; i < alone->n_in; ++i, number += *size++) {
      alone->arg[i] = arg[i] ? number : NULL;
      for (k = 0; arg[i] && k < *size; ++k) number[k] = ((const double *) arg[i])[k * LANES + lane];
    }
    for (i = 0; i < alone->n_out; ++i, number += *size++) alone->res[i] = res[i] ? number : NULL;
    if (alone->function(alone->arg, alone->res, iw, w, 0)) return 1;
    size = alone->sizes + alone->n_in;
    for (i = 0; i < alone->n_out; ++i, ++size) {
      for (k = 0; res[i] && k < *size; ++k) {
        ((double *) res[i])[k * LANES + lane] = alone->res[i][k];
      }
    }
  }
  return 0;
}
