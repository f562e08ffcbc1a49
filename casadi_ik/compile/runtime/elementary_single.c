/* Sines, cosines and arc functions in single precision, like elementary.c in double precision.
 *
 * Arithmetic without branches, within 2 (sines) and 4 (arcs) units in the last place; angles above 8192 rad go to the C
 * library. Reductions and coefficients are those of Moshier's Cephes library (sinf.c, atanf.c).
 */
#include <math.h>
#include <stdint.h>
#include <string.h>

#define QUALIFIERS static inline __attribute__((unused))
#define MASK(comparison) (-(int32_t) (comparison))
#define PICK(mask, yes, no) own_float(((mask) & own_bits(yes)) | (~(mask) & own_bits(no)))
/* The nearest whole number, as the last bits of a sum. */
#define SHIFT 12582912.0f

QUALIFIERS int32_t own_bits(float x) {
  int32_t bits;
  memcpy(&bits, &x, sizeof bits);
  return bits;
}

QUALIFIERS float own_float(int32_t bits) {
  float x;
  memcpy(&x, &bits, sizeof x);
  return x;
}

/* Sine of x and `quarters` quarters of a turn. */
QUALIFIERS float own_turned(float x, int32_t quarters) {
  const float k = x * 0.636619772367581343f + SHIFT, whole = k - SHIFT;
  const float r = ((x - whole * 1.5703125f) - whole * 4.837512969970703125e-4f)
                - whole * 7.54978995489188216e-8f;
  const float z = r * r;
  const float s = r + r * z * (-1.6666654611e-1f + z * (8.3321608736e-3f - z * 1.9515295891e-4f));
  const float c = (1.0f - 0.5f * z) + z * z * (4.166664568298827e-2f
      + z * (-1.388731625493765e-3f + z * 2.443315711809948e-5f));
  const int32_t quarter = own_bits(k) + quarters, odd = -(quarter & 1);
  const int32_t below = -((quarter >> 1) & 1);
  return own_float(own_bits(PICK(odd, c, s)) ^ (below & INT32_MIN));
}

QUALIFIERS float own_sin(float x) { return fabsf(x) < 8192.0f ? own_turned(x, 0) : sinf(x); }
QUALIFIERS float own_cos(float x) { return fabsf(x) < 8192.0f ? own_turned(x, 1) : cosf(x); }
QUALIFIERS float own_tan(float x) { return own_sin(x) / own_cos(x); }

/* Angle of (x, y): that of the smaller coordinate over the larger, which is at most 1, or by
 * tan(a - pi / 4) = (t - 1) / (t + 1) above tan(pi / 8); then by symmetry. */
QUALIFIERS float own_atan2(float y, float x) {
  const float wide = fabsf(x), high = fabsf(y);
  const int32_t steep = MASK(high > wide);
  const float large = PICK(steep, high, wide), small = PICK(steep, wide, high);
  const int32_t exceeds_limit = MASK(small > large * 0.41421356237f), none = MASK(large == 0.0f);
  const float above = PICK(exceeds_limit, small - large, small);
  const float below = PICK(exceeds_limit, small + large, PICK(none, 1.0f, large));
  const float t = above / below, z = t * t;
  const float rest = t * z * (-3.33329491539e-1f + z * (1.99777106478e-1f
      + z * (-1.38776856032e-1f + z * 8.05374449538e-2f)));
  /* The part of pi below the precision of a float is added with the small part. */
  float angle = own_float(exceeds_limit & own_bits(0.785398163397448310f)) + (t + rest);
  angle = PICK(steep, 1.57079632679489662f - (angle + 4.371139000186241e-8f), angle);
  angle = PICK(own_bits(x) >> 31, 3.14159265358979324f - (angle + 8.742278000372482e-8f), angle);
  return own_float(own_bits(angle) | (own_bits(y) & INT32_MIN));
}

QUALIFIERS float own_atan(float x) { return own_atan2(x, 1.0f); }
QUALIFIERS float own_asin(float x) { return own_atan2(x, sqrtf((1.0f - x) * (1.0f + x))); }
QUALIFIERS float own_acos(float x) { return own_atan2(sqrtf((1.0f - x) * (1.0f + x)), x); }

#define own_turns_1(x, sine, cosine) (*(sine) = own_sin(x), *(cosine) = own_cos(x))
#define own_arcs_1(y, x, angle) (*(angle) = own_atan2(y, x))

#undef QUALIFIERS
#undef MASK
#undef PICK
#undef SHIFT
