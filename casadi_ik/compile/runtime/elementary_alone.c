/* Definitions of elementary.c for one number; emitted code calls these instead of the C library. */
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
