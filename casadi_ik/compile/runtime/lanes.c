/* Definitions for emitted code (`emitter.py`) in vectors whose entries belong to LANES solves, four
 * or eight. Every entry is computed like a single double (no contraction, the same elementary
 * functions), so that the iterates of a solve do not depend on the other lanes. Requires vector
 * extensions of gcc or clang, and the elementary functions for one number.
 */
#include <math.h>
#include <stdint.h>
#include <string.h>

typedef double lanes __attribute__((vector_size(LANES * sizeof(double))));
typedef int64_t lane_mask __attribute__((vector_size(LANES * sizeof(double))));
typedef lanes real;
typedef lane_mask mask;
typedef double scalar; /* number of one solve */

#if !defined(__x86_64__)
#define LANES_TARGET
#elif LANES == 8
#define LANES_TARGET __attribute__((target("avx512f,avx512dq,avx512vl")))
#else
#define LANES_TARGET __attribute__((target("avx2")))
#endif
#define LANES_INLINE static inline __attribute__((always_inline, unused)) LANES_TARGET
#define CODE static __attribute__((noinline, unused)) LANES_TARGET

#if LANES == 8
#define SPREAD(x) ((lanes) {(x), (x), (x), (x), (x), (x), (x), (x)})
#else
#define SPREAD(x) ((lanes) {(x), (x), (x), (x)})
#endif
#define lanes_not(mask) (~(mask))
#define lanes_at(x, lane) ((x)[lane])

#define R(x) SPREAD(x)
#define LESS(x, y) ((mask) ((x) < (y)))
#define AT_MOST(x, y) ((mask) ((x) <= (y)))
#define EQUAL(x, y) ((mask) ((x) == (y)))
#define UNEQUAL(x, y) ((mask) ((x) != (y)))
#define NOT(holds) (~(holds))
#define TRUTH(holds) ((lanes) ((holds) & (mask) SPREAD(1.0)))
#define IF(holds, x) ((lanes) ((holds) & (mask) (x)))

LANES_INLINE lanes lanes_select(lane_mask mask, lanes yes, lanes no) {
  return (lanes) ((mask & (lane_mask) yes) | (~mask & (lane_mask) no));
}

LANES_INLINE lanes lanes_sq(lanes x) { return x * x; }
LANES_INLINE lanes lanes_fabs(lanes x) { return (lanes) ((lane_mask) x & INT64_MAX); }
LANES_INLINE lanes lanes_sign(lanes x) {
  return lanes_select(x < SPREAD(0.0), SPREAD(-1.0), lanes_select(x > SPREAD(0.0), SPREAD(1.0), x));
}

/* As in real.c. */
LANES_INLINE lanes lanes_fmax(lanes x, lanes y) {
  return lanes_select((lane_mask) (y != y), x, lanes_select((lane_mask) (x > y), x, y));
}

LANES_INLINE lanes lanes_fmin(lanes x, lanes y) {
  return lanes_select((lane_mask) (y != y), x, lanes_select((lane_mask) (x < y), x, y));
}

/* One lane after the other, each as it would be alone. */
#define LANES_OF_ONE(NAME, ALONE)                              \
  static __attribute__((noinline, unused)) LANES_TARGET        \
  lanes lanes_##NAME(lanes x) {                                \
    lanes value;                                               \
    int i;                                                     \
    for (i = 0; i < LANES; ++i) value[i] = ALONE(x[i]);        \
    return value;                                              \
  }

#define LANES_OF_TWO(NAME)                                     \
  static __attribute__((noinline, unused)) LANES_TARGET        \
  lanes lanes_##NAME(lanes x, lanes y) {                       \
    lanes value;                                               \
    int i;                                                     \
    for (i = 0; i < LANES; ++i) value[i] = NAME(x[i], y[i]);   \
    return value;                                              \
  }

/* Single instructions by name: the header of all of them takes longer to read than a small kernel to
 * compile. */
#define LANES_INSTRUCTION(NAME, CODE, REGISTER)      \
  LANES_INLINE lanes lanes_##NAME(lanes x) {         \
    lanes value;                                     \
    __asm__(CODE : "=" REGISTER(value) : REGISTER(x)); \
    return value;                                    \
  }

#if defined(__x86_64__) && LANES == 8
LANES_INSTRUCTION(sqrt, "vsqrtpd %1, %0", "v")
LANES_INSTRUCTION(floor, "vrndscalepd $9, %1, %0", "v")
LANES_INSTRUCTION(ceil, "vrndscalepd $10, %1, %0", "v")

LANES_INLINE int lanes_all(lane_mask mask) {
  int bits;
  __asm__("vpmovq2m %1, %%k1\n\tkmovb %%k1, %0" : "=r"(bits) : "v"(mask) : "k1");
  return bits == 255;
}
#elif defined(__x86_64__)
LANES_INSTRUCTION(sqrt, "vsqrtpd %1, %0", "x")
LANES_INSTRUCTION(floor, "vroundpd $9, %1, %0", "x")
LANES_INSTRUCTION(ceil, "vroundpd $10, %1, %0", "x")

LANES_INLINE int lanes_all(lane_mask mask) {
  int bits;
  __asm__("vmovmskpd %1, %0" : "=r"(bits) : "x"(mask));
  return bits == 15;
}
#else
LANES_OF_ONE(sqrt, sqrt)
LANES_OF_ONE(floor, floor)
LANES_OF_ONE(ceil, ceil)

LANES_INLINE int lanes_all(lane_mask mask) {
  int i, all = 1;
  for (i = 0; i < LANES; ++i) all &= mask[i] != 0;
  return all;
}
#endif
LANES_OF_ONE(alone_sin, own_sin)
LANES_OF_ONE(alone_cos, own_cos)
LANES_OF_ONE(exp, exp)
LANES_OF_ONE(log, log)
LANES_OF_ONE(log1p, log1p)
LANES_OF_ONE(expm1, expm1)
LANES_OF_ONE(erf, erf)
LANES_OF_ONE(sinh, sinh)
LANES_OF_ONE(cosh, cosh)
LANES_OF_ONE(tanh, tanh)
LANES_OF_ONE(asinh, asinh)
LANES_OF_ONE(acosh, acosh)
LANES_OF_ONE(atanh, atanh)
LANES_OF_TWO(fmod)
LANES_OF_TWO(hypot)
LANES_OF_TWO(pow)
LANES_OF_TWO(copysign)

/* The names of the emitter. */
#define real_sq(x) lanes_sq(x)
#define real_sign(x) lanes_sign(x)
#define real_fmax(x, y) lanes_fmax(x, y)
#define real_fmin(x, y) lanes_fmin(x, y)
#define real_fabs(x) lanes_fabs(x)
#define real_sqrt(x) lanes_sqrt(x)
#define real_floor(x) lanes_floor(x)
#define real_ceil(x) lanes_ceil(x)
#define real_exp(x) lanes_exp(x)
#define real_log(x) lanes_log(x)
#define real_log1p(x) lanes_log1p(x)
#define real_expm1(x) lanes_expm1(x)
#define real_erf(x) lanes_erf(x)
#define real_sinh(x) lanes_sinh(x)
#define real_cosh(x) lanes_cosh(x)
#define real_tanh(x) lanes_tanh(x)
#define real_asinh(x) lanes_asinh(x)
#define real_acosh(x) lanes_acosh(x)
#define real_atanh(x) lanes_atanh(x)
#define real_pow(x, y) lanes_pow(x, y)
#define real_fmod(x, y) lanes_fmod(x, y)
#define real_hypot(x, y) lanes_hypot(x, y)
#define real_copysign(x, y) lanes_copysign(x, y)
#define real_sin(x) lanes_sin(x)
#define real_cos(x) lanes_cos(x)
#define real_tan(x) lanes_tan(x)
#define real_asin(x) lanes_asin(x)
#define real_acos(x) lanes_acos(x)
#define real_atan(x) lanes_atan(x)
#define real_atan2(y, x) lanes_atan2(y, x)
#define own_turns_1(x, sine, cosine) lanes_turns(x, sine, cosine)
#define own_arcs_1(y, x, angle) (*(angle) = lanes_atan2(y, x))

/* Which branch each lane takes, `last` for all numbers that are not 0 ... last - 1. */
LANES_INLINE void lanes_branches(lanes index, int last, int *branch) {
  int i;
  for (i = 0; i < LANES; ++i) {
    branch[i] = index[i] > -1.0 && index[i] < last ? (int) index[i] : last;
  }
}

/* A bit for each lane that takes branch b. */
static __attribute__((unused)) int lanes_in(const int *branch, int b) {
  int i, bits = 0;
  for (i = 0; i < LANES; ++i) bits |= (branch[i] == b) << i;
  return bits;
}

static __attribute__((unused)) void lanes_keep(int branch_lanes, const lanes *own, int count, lanes *result) {
  int i, k;
  if (!result) return;
  for (i = 0; i < LANES; ++i) {
    if (!(branch_lanes >> i & 1)) continue;
    for (k = 0; k < count; ++k) {
      ((double *) result)[k * LANES + i] = ((const double *) own)[k * LANES + i];
    }
  }
}
