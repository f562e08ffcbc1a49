/* Lookup of the rows of a table with the nearest keys, in the order of their distance.
 *
 * Requires the macros N_IN, N_KEY, TILE, STEPS and LARGEST, and outside of standalone solvers
 * REGISTER_BYTES (size of the machine's vector registers; 0: unknown). The step graph computes a key.
 */
#include <math.h>

/* Two entries of a quantized key, doubled. `mask` is zero for unknown entries, which do not count,
 * and has all bits set otherwise. */
typedef struct {
  int16_t twice[2], mask[2];
} key_pair;

#define PAIRS ((N_KEY + 1) / 2)
#define MAX_DISTANCE INT32_MAX

#define UNROLLED LOOPS static inline __attribute__((always_inline, unused))

static void quantize_key(const scalar *key, key_pair *pairs) {
  int i;
  memset(pairs, 0, PAIRS * sizeof *pairs);
  for (i = 0; i < N_KEY; ++i) {
    if (key[i] != key[i]) continue;
    pairs[i / 2].twice[i % 2] = (int16_t) (2 * fmax(fmin(rint(key[i] * STEPS), LARGEST), -LARGEST));
    pairs[i / 2].mask[i % 2] = -1;
  }
}

/* |row - key|^2 over the known entries, without the term that all rows share. */
UNROLLED void measure(const lookup_job *job, const key_pair *pairs, int32_t *distance) {
  int64_t tile, tiles = (job->rows + TILE - 1) / TILE;
  int i, j;
  for (tile = 0; tile < tiles; ++tile, distance += TILE) {
    const int16_t *row = job->tiles + tile * PAIRS * TILE * 2;
    for (j = 0; j < TILE; ++j) distance[j] = 0;
    for (i = 0; i < PAIRS; ++i, row += TILE * 2) {
      for (j = 0; j < TILE; ++j) {
        distance[j] += row[2 * j] * ((row[2 * j] - pairs[i].twice[0]) & pairs[i].mask[0])
                     + row[2 * j + 1] * ((row[2 * j + 1] - pairs[i].twice[1]) & pairs[i].mask[1]);
      }
    }
  }
}

UNROLLED int32_t min_of(const int32_t *values, int64_t count) {
  int32_t minimum = MAX_DISTANCE;
  int64_t j;
  for (j = 0; j < count; ++j) minimum = values[j] < minimum ? values[j] : minimum;
  return minimum;
}

/* Select the nearest rows in order, the first among equals: first the tile, then the row. */
UNROLLED void select_nearest(const lookup_job *job, int32_t *distance, int32_t *nearest,
                             int64_t *nearest_rows) {
  const int64_t tiles = (job->rows + TILE - 1) / TILE;
  int64_t i, j, rank;
  for (j = job->rows; j < tiles * TILE; ++j) distance[j] = MAX_DISTANCE;
  for (i = 0; i < tiles; ++i) nearest[i] = min_of(distance + i * TILE, TILE);
  for (rank = 0; rank < job->n_nearest; ++rank) {
    const int32_t best = min_of(nearest, tiles);
    int32_t *tile;
    for (i = 0; nearest[i] != best; ++i) {}
    tile = distance + i * TILE;
    for (j = 0; tile[j] != best; ++j) {}
    nearest_rows[rank] = i * TILE + j;
    tile[j] = MAX_DISTANCE;
    nearest[i] = min_of(tile, TILE);
  }
}

/* PRODUCTS multiplies the 16-bit numbers of two vectors of REGISTER_BYTES bytes, and adds the products
 * of each pair. Standalone solvers use the vectors that every machine of the architecture has. Inline
 * assembly, since the header of the intrinsics takes longer to parse than this file takes to compile.
 */
#if defined(__x86_64__) && REGISTER_BYTES == 64
#define TARGET __attribute__((target("avx512f,avx512bw")))
#define PRODUCTS(sums, a, b) __asm__("vpmaddwd %2, %1, %0" : "=v"(sums) : "v"(a), "v"(b))
#elif defined(__x86_64__) && REGISTER_BYTES
#define TARGET __attribute__((target("avx2")))
#define PRODUCTS(sums, a, b) __asm__("vpmaddwd %2, %1, %0" : "=x"(sums) : "x"(a), "x"(b))
#elif defined(FREESTANDING) && defined(__GNUC__) && defined(__SSE2__)
#define REGISTER_BYTES 16
#define TARGET
#define PRODUCTS(sums, a, b) \
  sums = a; \
  __asm__("pmaddwd %1, %0" : "+x"(sums) : "x"(b))
#elif defined(FREESTANDING) && defined(__wasm_simd128__)
#include <wasm_simd128.h>
#define REGISTER_BYTES 16
#define TARGET
#define PRODUCTS(sums, a, b) sums = (wide) wasm_i32x4_dot_i16x8((v128_t) a, (v128_t) b)
#endif

#ifdef PRODUCTS
#define PAIR_OF(numbers) \
  ((int32_t) ((uint32_t) (uint16_t) (numbers)[0] | (uint32_t) (uint16_t) (numbers)[1] << 16))

typedef int32_t wide __attribute__((vector_size(REGISTER_BYTES)));
typedef int16_t halves __attribute__((vector_size(REGISTER_BYTES)));

LOOPS TARGET static void measure_wide(const lookup_job *job, const key_pair *pairs,
                                      int32_t *distance) {
  wide twice[PAIRS], mask[PAIRS];
  const int64_t parts = TILE * 4 / REGISTER_BYTES;
  int64_t part, count = (job->rows + TILE - 1) / TILE * parts;
  int i;
  for (i = 0; i < PAIRS; ++i) {
    twice[i] = PAIR_OF(pairs[i].twice) + (wide) {0};
    mask[i] = PAIR_OF(pairs[i].mask) + (wide) {0};
  }
  for (part = 0; part < count; ++part) {
    const char *from = (const char *) job->tiles
                     + (part / parts * PAIRS * parts + part % parts) * REGISTER_BYTES;
    wide sum = {0};
    for (i = 0; i < PAIRS; ++i) {
      wide a, difference, products;
      memcpy(&a, from + i * parts * REGISTER_BYTES, REGISTER_BYTES);
      difference = (wide) ((halves) a - (halves) twice[i]) & mask[i];
      PRODUCTS(products, a, difference);
      sum += products;
    }
    memcpy(distance + part * (REGISTER_BYTES / 4), &sum, REGISTER_BYTES);
  }
}
#else
#define TARGET
#define measure_wide measure
#endif

LOOPS TARGET static void find(const lookup_job *job, const key_pair *pairs, int32_t *distance,
                              int32_t *nearest, int64_t *nearest_rows) {
  measure_wide(job, pairs, distance);
  select_nearest(job, distance, nearest, nearest_rows);
}

DRIVER(lookup, lookup_job) {
  workspace space;
  int outcome = set_up(&space, N_KEY + 2 * (job->rows + TILE));
  int64_t ticks = 0;
  scalar deadline = 0;
  int i;
  key_pair pairs[PAIRS];
  int32_t *distance, *nearest;
  if (outcome != DONE) return outcome;
  distance = (int32_t *) (space.extra + N_KEY);
  nearest = distance + job->rows + TILE;
  if (job->count - job->next > CLOCK_INTERVAL) deadline = monotonic() + job->slice;
  for (; job->next < job->count; ++job->next) {
    if (++ticks % CLOCK_INTERVAL == 0 && monotonic() > deadline) {
      outcome = SLICE_OVER;
      break;
    }
    for (i = 0; i < N_IN; ++i) space.arg[i] = job->inputs[i] + job->next * job->input_steps[i];
    space.res[0] = space.extra;
    STEP(space.arg, space.res, 0);
    quantize_key(space.extra, pairs);
    find(job, pairs, distance, nearest, job->nearest_rows + job->next * job->n_nearest);
  }
  give_back(&space);
  return outcome;
}
