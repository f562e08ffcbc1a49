/* Sines, cosines and arc functions for scalars and vectors.
 *
 * The C library computes one number per call, which took a quarter of the time of four or eight
 * solves in lanes. These functions use the same arithmetic for scalars and vectors: the iterates of a
 * solve are the same bit for bit with both, and do not depend on the C library of the machine. Errors
 * are within 2 units in the last place of normal numbers; angles above 5e8 rad are passed to the C
 * library. Reductions and coefficients are those of the Cephes library of Moshier (sin.c, atan.c).
 *
 * The file is included once per form, with FEW or LANES defined for two of them. The macros of a form
 * are NAME(f), QUALIFIERS, INNER (qualifiers of inlined functions), REAL and INTEGER, BITS(real) and
 * REAL_OF(integer), which reinterpret bits, MASK(comparison) with all bits of a true entry set, ROOT,
 * SMALL(real), which is true if all entries can be reduced here, and LIBRARY(f, x) for other entries;
 * without LIBRARY only functions that do not use it are defined.
 */
#if defined(FEW)

/* FEW numbers of one solve, two or four. */
#ifndef FEW_NAMED
#define FEW_JOINED(f, count) own_##f##_##count
#define FEW_NAMED(f, count) FEW_JOINED(f, count)
#endif

typedef double FEW_NAMED(reals, FEW) __attribute__((vector_size(FEW * 8)));
typedef int64_t FEW_NAMED(whole, FEW) __attribute__((vector_size(FEW * 8)));

/* No function has a vector argument, because calling conventions for vectors differ by machine. */
#define NAME(f) FEW_NAMED(f, FEW)
#define QUALIFIERS static inline __attribute__((always_inline, unused))
#define INNER QUALIFIERS
#define REAL FEW_NAMED(reals, FEW)
#define INTEGER FEW_NAMED(whole, FEW)
#define BITS(x) ((INTEGER) (x))
#define REAL_OF(bits) ((REAL) (bits))
#define MASK(comparison) ((INTEGER) (comparison))

#elif defined(LANES)

/* A number of each solve in lanes (lanes.c). */
#define NAME(f) lanes_##f
#define QUALIFIERS static __attribute__((unused, noinline)) LANES_TARGET
#define INNER static inline __attribute__((always_inline, unused)) LANES_TARGET
#define REAL lanes
#define INTEGER lane_mask
#define BITS(x) ((lane_mask) (x))
#define REAL_OF(bits) ((lanes) (bits))
#define MASK(comparison) ((lane_mask) (comparison))
#define ROOT(x) lanes_sqrt(x)
#define SMALL(x) lanes_all((lane_mask) (lanes_fabs(x) < SPREAD(5e8)))
#define LIBRARY(f, x) lanes_alone_##f(x)

#else

/* One number; emitted code calls these functions instead of the C library. */
#include <math.h>
#include <stdint.h>
#include <string.h>

static inline int64_t own_bits(double x) {
  int64_t bits;
  memcpy(&bits, &x, sizeof bits);
  return bits;
}

static inline double own_double(int64_t bits) {
  double x;
  memcpy(&x, &bits, sizeof x);
  return x;
}

#define NAME(f) own_##f
#define QUALIFIERS static __attribute__((unused))
#define INNER static inline __attribute__((always_inline, unused))
#define REAL double
#define INTEGER int64_t
#define BITS(x) own_bits(x)
#define REAL_OF(bits) own_double(bits)
#define MASK(comparison) (-(int64_t) (comparison))
#define ROOT(x) sqrt(x)
#define SMALL(x) (fabs(x) < 5e8)
#define LIBRARY(f, x) f(x)

#endif

#define ALL(number) ((REAL) {0} + (number))
#define PICK(mask, yes, no) REAL_OF(((mask) & BITS(yes)) | (~(mask) & BITS(no)))

/* Adding this number leaves the nearest integer in the last bits of the sum, without a call. */
#define SHIFT 6755399441055744.0
#define SIGN ((INTEGER) {0} + INT64_MIN)

/* Sine and cosine of the difference between x and the nearest multiple of a quarter turn, whose
 * number is in the last bits of `quarters`. */
INNER REAL NAME(reduce)(REAL x, REAL *cosine, INTEGER *quarters) {
  const REAL k = x * 0.63661977236758134308 + SHIFT, whole = k - SHIFT;
  const REAL r = ((x - whole * 1.57079625129699707031) - whole * 7.54978941586159635335e-8)
               - whole * 5.39030285815811905290e-15;
  const REAL z = r * r;
  *cosine = (1.0 - 0.5 * z) + z * z * (4.16666666666665929218e-2
      + z * (-1.38888888888730564116e-3 + z * (2.48015872888517045348e-5
      + z * (-2.75573141792967388112e-7 + z * (2.08757008419747316778e-9
      + z * -1.13585365213876817300e-11)))));
  *quarters = BITS(k);
  return r + r * z * (-1.66666666666666307295e-1
      + z * (8.33333333332211858878e-3 + z * (-1.98412698295885395996e-4
      + z * (2.75573136213857245213e-6 + z * (-2.50507477628578072866e-8
      + z * 1.58962301576546568060e-10)))));
}

/* Sine of an angle with sine s and cosine c, increased by quarter turns. */
INNER REAL NAME(shift)(REAL s, REAL c, INTEGER quarters) {
  const INTEGER odd = -(quarters & 1), below = -((quarters >> 1) & 1);
  return REAL_OF(BITS(PICK(odd, c, s)) ^ (below & SIGN));
}

/* Sine of x, increased by quarter turns. */
QUALIFIERS REAL NAME(turned)(REAL x, int64_t quarters) {
  REAL c;
  INTEGER k;
  const REAL s = NAME(reduce)(x, &c, &k);
  return NAME(shift)(s, c, k + quarters);
}

/* Sine and cosine of x, if it can be reduced here. */
INNER void NAME(both)(REAL x, REAL *sine, REAL *cosine) {
  REAL c;
  INTEGER k;
  const REAL s = NAME(reduce)(x, &c, &k);
  *sine = NAME(shift)(s, c, k);
  *cosine = NAME(shift)(s, c, k + 1);
}

#ifdef LIBRARY
QUALIFIERS REAL NAME(sin)(REAL x) { return SMALL(x) ? NAME(turned)(x, 0) : LIBRARY(sin, x); }
QUALIFIERS REAL NAME(cos)(REAL x) { return SMALL(x) ? NAME(turned)(x, 1) : LIBRARY(cos, x); }
QUALIFIERS REAL NAME(tan)(REAL x) { return NAME(sin)(x) / NAME(cos)(x); }
QUALIFIERS void NAME(turns)(REAL x, REAL *sine, REAL *cosine) {
  if (SMALL(x)) {
    NAME(both)(x, sine, cosine);
  } else {
    *sine = LIBRARY(sin, x);
    *cosine = LIBRARY(cos, x);
  }
}
#endif

/* Angle of (x, y): the arctangent of the smaller coordinate over the larger, which is at most 1; above
 * 0.66 with tan(a - pi / 4) = (t - 1) / (t + 1); then by symmetry. */
QUALIFIERS REAL NAME(atan2)(REAL y, REAL x) {
  const REAL wide = REAL_OF(BITS(x) & ~SIGN), high = REAL_OF(BITS(y) & ~SIGN);
  const INTEGER steep = MASK(high > wide);
  const REAL large = PICK(steep, high, wide), small = PICK(steep, wide, high);
  const INTEGER exceeds_limit = MASK(small > large * 0.66), none = MASK(large == 0.0);
  const REAL above = PICK(exceeds_limit, small - large, small);
  const REAL below = PICK(exceeds_limit, small + large, PICK(none, ALL(1.0), large));
  const REAL t = above / below, z = t * t;
  const REAL p = (((-8.750608600031904122785e-1 * z - 1.615753718733365076637e1) * z
      - 7.500855792314704667340e1) * z - 1.228866684490136173410e2) * z - 6.485021904942025371773e1;
  const REAL q = ((((z + 2.485846490142306297962e1) * z + 1.650270098316988542046e2) * z
      + 4.328810604912902668951e2) * z + 4.853903996359136964868e2) * z + 1.945506571482613964425e2;
  /* The part of pi below the precision of a double is added with the small part. */
  const REAL rest = t * (z * p / q) + REAL_OF(exceeds_limit & BITS(ALL(3.0616169978683830e-17)));
  REAL angle = REAL_OF(exceeds_limit & BITS(ALL(0.78539816339744830962))) + (t + rest);
  angle = PICK(steep, 1.57079632679489661923 - (angle - 6.123233995736766e-17), angle);
  angle = PICK(BITS(x) >> 63, 3.14159265358979323846 - (angle - 1.2246467991473532e-16), angle);
  return REAL_OF(BITS(angle) | (BITS(y) & SIGN));
}

QUALIFIERS REAL NAME(atan)(REAL x) { return NAME(atan2)(x, ALL(1.0)); }
#ifdef LIBRARY
QUALIFIERS REAL NAME(asin)(REAL x) { return NAME(atan2)(x, ROOT((1.0 - x) * (1.0 + x))); }
QUALIFIERS REAL NAME(acos)(REAL x) { return NAME(atan2)(ROOT((1.0 - x) * (1.0 + x)), x); }
#endif

#undef ALL
#undef PICK
#undef SHIFT
#undef SIGN
#undef NAME
#undef QUALIFIERS
#undef INNER
#undef REAL
#undef INTEGER
#undef BITS
#undef REAL_OF
#undef MASK
#undef ROOT
#undef SMALL
#undef LIBRARY
