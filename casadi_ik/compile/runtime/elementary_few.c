/* Definitions of elementary.c for FEW numbers of one solve, two or four. */
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
