/* Conversion of doubles to the storage types of a record. Rows are packed, which requires memcpy.
 *
 * Defined for every double: f4 rounds to nearest and overflows to infinity (IEC 60559); the
 * integers drop the fraction and saturate, NaN becomes 0. `rows.py` does the same in numpy.
 */
static inline scalar clamped(scalar x, scalar low, scalar high) {
  return x >= high ? high : x > low ? x : x <= low ? low : 0;
}

static inline void store_f8(const scalar *from, unsigned char *to, int count) {
  memcpy(to, from, (size_t) count * sizeof(scalar));
}

#define DEFINE_STORE(NAME, TYPE, CONVERTED)                                          \
  static inline void store_##NAME(const scalar *from, unsigned char *to, int count) { \
    int i;                                                                           \
    for (i = 0; i < count; ++i) {                                                    \
      const scalar x = from[i];                                                      \
      const TYPE value = (TYPE) (CONVERTED);                                         \
      memcpy(to + (size_t) i * sizeof(TYPE), &value, sizeof(TYPE));                  \
    }                                                                                \
  }

DEFINE_STORE(f4, float, x)
DEFINE_STORE(u4, uint32_t, clamped(x, 0, 4294967295.0))
DEFINE_STORE(i4, int32_t, clamped(x, -2147483648.0, 2147483647.0))
DEFINE_STORE(u1, uint8_t, clamped(x, 0, 255))
