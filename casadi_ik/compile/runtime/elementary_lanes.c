/* Definitions of elementary.c for vectors. */
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
