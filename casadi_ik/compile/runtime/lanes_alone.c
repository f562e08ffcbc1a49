/* Definitions of lanes.c for one solve in standard C, for standalone solvers. */
#define LANES 1
#define LANES_TARGET
#define LANES_INLINE static inline
#define SPREAD(x) ((lanes) (x))
#define lanes_select(mask, yes, no) ((mask) ? (yes) : (no))
#define lanes_all(mask) (mask)
#define lanes_not(mask) (!(mask))
#define lanes_at(x, lane) ((void) (lane), (x))
#define lanes_fabs(x) fabs(x)
#define lanes_sqrt(x) sqrt(x)

typedef scalar lanes;
typedef int lane_mask;
