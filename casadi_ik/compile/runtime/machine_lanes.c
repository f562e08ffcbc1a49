/* Width of the vector registers, read with cpuid: not every compiler provides the library that
 * __builtin_cpu_supports requires. */
#if defined(__x86_64__)
#include <cpuid.h>

/* Register states that the operating system saves for a thread. */
static unsigned saved_registers(void) {
  unsigned low, high;
  __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
  return low;
}

/* Return 512 with AVX-512 F, DQ, BW and VL, 256 with AVX2, otherwise 128. */
static int register_bits(void) {
  const unsigned wide = 1u << 16 | 1u << 17 | 1u << 30 | 1u << 31;
  unsigned a, b, c, d, saved;
  if (!__get_cpuid(1, &a, &b, &c, &d) || !(c & 1u << 27) || !(c & 1u << 28)) return 128;
  saved = saved_registers();
  if ((saved & 0x6) != 0x6 || !__get_cpuid_count(7, 0, &a, &b, &c, &d)) return 128;
  if ((b & wide) == wide && (saved & 0xe6) == 0xe6) return 512;
  return b & 1u << 5 ? 256 : 128;
}
#endif

/* Return the number of lanes of this machine; 0: no useful vectors. */
#if defined(_WIN32)
__declspec(dllexport)
#else
__attribute__((visibility("default")))
#endif
int casadi_ik_machine_lanes(void) {
#if defined(_WIN32) && !defined(__clang__)
  return 0; /* gcc does not align vectors on the stack there */
#elif defined(__x86_64__)
  const int bits = register_bits();
  return bits == 512 ? 8 : bits == 256 ? 4 : 0;
#else
  return 4;
#endif
}
