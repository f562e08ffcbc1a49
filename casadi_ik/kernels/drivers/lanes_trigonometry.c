/* Sines and cosines of four numbers at once, within 2 units in the last place for |x| < 1e5.
 *
 * For functions whose values need not be bit for bit those of the C library: with these a turn of a
 * robot's joints costs a tenth. The reduction is that of Cody and Waite (pi / 2 in three parts, the
 * first two short enough for exact products), the polynomials are those of Moshier's Cephes library.
 */

LANES_INLINE lanes quick_turned(lanes x, double quarters) {
  const lanes turns = lanes_floor(x * SPREAD(0.63661977236758134308) + SPREAD(0.5));
  const lanes r = ((x - turns * SPREAD(1.57079625129699707031))
                   - turns * SPREAD(7.54978941586159635335e-8))
                  - turns * SPREAD(5.39030285815811905290e-15);
  const lanes z = r * r;
  const lanes s = r + r * z * (SPREAD(-1.66666666666666307295e-1)
      + z * (SPREAD(8.33333333332211858878e-3) + z * (SPREAD(-1.98412698295895385996e-4)
      + z * (SPREAD(2.75573136213857245213e-6) + z * (SPREAD(-2.50507477628578072866e-8)
      + z * SPREAD(1.58962301576546568060e-10))))));
  const lanes c = SPREAD(1.0) - SPREAD(0.5) * z + z * z * (SPREAD(4.16666666666665929218e-2)
      + z * (SPREAD(-1.38888888888730564116e-3) + z * (SPREAD(2.48015872888517045348e-5)
      + z * (SPREAD(-2.75573141792967388112e-7) + z * (SPREAD(2.08757008419747316778e-9)
      + z * SPREAD(-1.13585365213876817300e-11))))));
  const lanes k = turns + SPREAD(quarters);
  const lanes quarter = k - SPREAD(4.0) * lanes_floor(k * SPREAD(0.25));
  const lane_mask odd = (lane_mask) (quarter == SPREAD(1.0)) | (lane_mask) (quarter == SPREAD(3.0));
  const lanes value = lanes_select(odd, c, s);
  return lanes_select((lane_mask) (quarter > SPREAD(1.5)), -value, value);
}

LANES_INLINE lanes quick_sin(lanes x) { return quick_turned(x, 0.0); }
LANES_INLINE lanes quick_cos(lanes x) { return quick_turned(x, 1.0); }

#define lanes_sin quick_sin
#define lanes_cos quick_cos
