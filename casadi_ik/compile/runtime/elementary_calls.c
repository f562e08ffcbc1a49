/* Sines and cosines, and angles, of several numbers in one call: what `emitter.py` writes. */
#define FEW_QUALIFIERS static __attribute__((noinline, unused))

#define own_turns_1(x, sines, cosines) own_turns(x, sines, cosines)

FEW_QUALIFIERS void own_turns_2(double x0, double x1, double *sines, double *cosines) {
  const own_reals_2 x = {x0, x1};
  own_reals_2 s, c;
  if (fabs(x0) < 5e8 && fabs(x1) < 5e8) {
    own_both_2(x, &s, &c);
    memcpy(sines, &s, sizeof s);
    memcpy(cosines, &c, sizeof c);
  } else {
    own_turns_1(x0, sines, cosines);
    own_turns_1(x1, sines + 1, cosines + 1);
  }
}

FEW_QUALIFIERS void own_turns_4(double x0, double x1, double x2, double x3,
                                double *sines, double *cosines) {
#ifdef __AVX2__
  const own_reals_4 x = {x0, x1, x2, x3};
  own_reals_4 s, c;
  if (fabs(x0) < 5e8 && fabs(x1) < 5e8 && fabs(x2) < 5e8 && fabs(x3) < 5e8) {
    own_both_4(x, &s, &c);
    memcpy(sines, &s, sizeof s);
    memcpy(cosines, &c, sizeof c);
    return;
  }
#endif
  own_turns_2(x0, x1, sines, cosines);
  own_turns_2(x2, x3, sines + 2, cosines + 2);
}

#define own_arcs_1(y, x, angles) (*(angles) = own_atan2(y, x))

FEW_QUALIFIERS void own_arcs_2(double y0, double y1, double x0, double x1, double *angles) {
  const own_reals_2 y = {y0, y1}, x = {x0, x1}, angle = own_atan2_2(y, x);
  memcpy(angles, &angle, sizeof angle);
}

FEW_QUALIFIERS void own_arcs_4(double y0, double y1, double y2, double y3,
                               double x0, double x1, double x2, double x3, double *angles) {
#ifdef __AVX2__
  const own_reals_4 y = {y0, y1, y2, y3}, x = {x0, x1, x2, x3}, angle = own_atan2_4(y, x);
  memcpy(angles, &angle, sizeof angle);
#else
  own_arcs_2(y0, y1, x0, x1, angles);
  own_arcs_2(y2, y3, x2, x3, angles + 2);
#endif
}
