/* How many solves this machine can make side by side, 0: vectors are of no use. */
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
