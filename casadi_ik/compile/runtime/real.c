/* Definitions for emitted code (`emitter.py`) with scalars: `real` is a double, or a float if SINGLE
 * is defined. Requires the elementary functions of the same precision. */
#ifdef SINGLE
#include <tgmath.h>
typedef float real;
#else
#include <math.h>
typedef double real;
#endif

#ifndef CODE
#define CODE static __attribute__((noinline, unused))
#endif

typedef int mask;
typedef real scalar; /* number of one solve; `real` may be a vector (lanes.c) */

#define R(x) ((real) (x))
#define LESS(x, y) ((x) < (y))
#define AT_MOST(x, y) ((x) <= (y))
#define EQUAL(x, y) ((x) == (y))
#define UNEQUAL(x, y) ((x) != (y))
#define NOT(holds) (!(holds))
#define TRUTH(holds) ((real) (holds))
#define IF(holds, x) ((holds) ? (x) : R(0.0))

#define real_sq(x) ((x) * (x))
#define real_sign(x) ((x) < R(0.0) ? R(-1.0) : (x) > R(0.0) ? R(1.0) : (x))
/* For equal numbers the second, for a NaN the other number, like glibc but inline. */
#define real_fmax(x, y) ((y) != (y) ? (x) : (x) > (y) ? (x) : (y))
#define real_fmin(x, y) ((y) != (y) ? (x) : (x) < (y) ? (x) : (y))
#define real_fabs(x) fabs(x)
#define real_sqrt(x) sqrt(x)
#define real_floor(x) floor(x)
#define real_ceil(x) ceil(x)
#define real_exp(x) exp(x)
#define real_log(x) log(x)
#define real_log1p(x) log1p(x)
#define real_expm1(x) expm1(x)
#define real_erf(x) erf(x)
#define real_sinh(x) sinh(x)
#define real_cosh(x) cosh(x)
#define real_tanh(x) tanh(x)
#define real_asinh(x) asinh(x)
#define real_acosh(x) acosh(x)
#define real_atanh(x) atanh(x)
#define real_pow(x, y) pow(x, y)
#define real_fmod(x, y) fmod(x, y)
#define real_hypot(x, y) hypot(x, y)
#define real_copysign(x, y) copysign(x, y)
#define real_sin(x) own_sin(x)
#define real_cos(x) own_cos(x)
#define real_tan(x) own_tan(x)
#define real_asin(x) own_asin(x)
#define real_acos(x) own_acos(x)
#define real_atan(x) own_atan(x)
#define real_atan2(y, x) own_atan2(y, x)

/* Branch that an index selects: 0 ... last - 1, otherwise `last`. */
#define branch_of(index, last) ((index) > R(-1.0) && (index) < R(last) ? (int) (index) : (last))
