/* LOOPS marks functions whose loops gcc should vectorise. */
#ifndef LOOPS
#if defined(__GNUC__) && !defined(__clang__)
#define LOOPS __attribute__((optimize("O3")))
#else
#define LOOPS
#endif
#endif
