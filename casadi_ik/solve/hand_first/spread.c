/* Shared helpers: tests of numbers, low-discrepancy sequences, and calls of kernels for one
 * sample. */

static const int64_t ALONE[] = {0, 0, 0, 0, 0, 0, 0, 0};

static inline int is_number(double x) { return x == x; }
static inline int is_finite(double x) { return x * 0.0 == 0.0; }

static double clipped(double x, double low, double high) {
  const double above = x > low ? x : low;
  return above < high ? above : high;
}

/* Return a coordinate of point i (from 1) of an additive low-discrepancy sequence. */
static double even(int64_t i, double step) {
  const double x = 0.5 + (double) i * step;
  return x - (double) (int64_t) x;
}

static inline map_job mapping(int64_t count, const double **inputs, const int64_t *input_steps,
                              double **outputs, const int64_t *output_steps) {
  map_job map = {0};
  map.inputs = inputs;
  map.input_steps = input_steps;
  map.outputs = outputs;
  map.output_steps = output_steps;
  map.count = count;
  map.slice = SLICE;
  return map;
}
