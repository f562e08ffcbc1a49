/* Four solves side by side: the step's arithmetic on vectors whose entries belong to four solves.
 *
 * Stands before the code CasADi generated, which `lanes.py` has rewritten to call what is here.
 * Every entry is computed as one double would be (no contraction, the same library functions), so
 * a solve's iterates are bit for bit those it has alone. Vectors are those of gcc and clang.
 */
#include <math.h>
#include <stdint.h>
#include <string.h>

#define LANES 4
typedef double lanes __attribute__((vector_size(LANES * sizeof(double))));
typedef int64_t lane_mask __attribute__((vector_size(LANES * sizeof(double))));

#if defined(__x86_64__)
#define LANES_TARGET __attribute__((target("avx2")))
#else
#define LANES_TARGET
#endif
#define LANES_INLINE static inline __attribute__((always_inline)) LANES_TARGET

#define casadi_real lanes
#define casadi_int long long int

#define SPREAD(x) ((lanes) {(x), (x), (x), (x)})
#define TRUTH(mask) ((lanes) ((lane_mask) (mask) & (lane_mask) SPREAD(1.0)))
#define IS(x) ((lane_mask) ((x) != SPREAD(0.0)))

LANES_INLINE lanes lanes_select(lane_mask mask, lanes yes, lanes no) {
  return (lanes) ((mask & (lane_mask) yes) | (~mask & (lane_mask) no));
}

LANES_INLINE lanes lanes_if_else_zero(lanes condition, lanes value) {
  return (lanes) (IS(condition) & (lane_mask) value);
}

LANES_INLINE lanes lanes_sq(lanes x) { return x * x; }

LANES_INLINE lanes lanes_fabs(lanes x) { return (lanes) ((lane_mask) x & INT64_MAX); }

/* Of equal numbers the second, of a NaN the other: as the C library of x86 does it. */
LANES_INLINE lanes lanes_fmax(lanes x, lanes y) {
  return lanes_select((lane_mask) (y != y), x, lanes_select((lane_mask) (x > y), x, y));
}

LANES_INLINE lanes lanes_fmin(lanes x, lanes y) {
  return lanes_select((lane_mask) (y != y), x, lanes_select((lane_mask) (x < y), x, y));
}

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

#if defined(__x86_64__)
LANES_INLINE lanes lanes_sqrt(lanes x) { return __builtin_ia32_sqrtpd256(x); }
LANES_INLINE lanes lanes_floor(lanes x) { return __builtin_ia32_roundpd256(x, 9); }
LANES_INLINE lanes lanes_ceil(lanes x) { return __builtin_ia32_roundpd256(x, 10); }
#else
LANES_OF_ONE(sqrt)
LANES_OF_ONE(floor)
LANES_OF_ONE(ceil)
#endif
LANES_OF_ONE(sin)
LANES_OF_ONE(cos)
LANES_OF_ONE(tan)
LANES_OF_ONE(asin)
LANES_OF_ONE(acos)
LANES_OF_ONE(atan)
LANES_OF_ONE(exp)
LANES_OF_ONE(log)
LANES_OF_ONE(tanh)
LANES_OF_TWO(atan2)
LANES_OF_TWO(fmod)
LANES_OF_TWO(hypot)
LANES_OF_TWO(pow)

static inline void lanes_copy(const lanes *from, casadi_int count, lanes *to) {
  if (!to) return;
  if (from) memcpy(to, from, (size_t) count * sizeof(lanes));
  else memset(to, 0, (size_t) count * sizeof(lanes));
}

static inline void lanes_clear(lanes *to, casadi_int count) {
  if (to) memset(to, 0, (size_t) count * sizeof(lanes));
}

/* Branches: which one each lane takes, `last` for all numbers that are not 0 ... last - 1.
 * As CasADi's casadi_to_int the fraction is dropped; of a choice, everything but 0 is the last. */
LANES_INLINE lane_mask lanes_branch(const lanes *index, int64_t last) {
  lane_mask branch = {0};
  int i;
  for (i = 0; index && i < LANES; ++i) {
    const double x = (*index)[i];
    branch[i] = x > -1 && x < (double) last ? (int64_t) x : last;
  }
  return branch;
}

LANES_INLINE int lanes_any(lane_mask mask) {
  return (mask[0] | mask[1] | mask[2] | mask[3]) != 0;
}

LANES_INLINE int lanes_all(lane_mask mask) {
  return (mask[0] & mask[1] & mask[2] & mask[3]) != 0;
}

LANES_INLINE void lanes_keep(lane_mask mine, const lanes *own, int count, lanes *result) {
  int k;
  for (k = 0; result && k < count; ++k) result[k] = lanes_select(mine, own[k], result[k]);
}
