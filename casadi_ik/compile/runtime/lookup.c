/* The rows of a table whose keys are nearest to that of each sample, in order.
 *
 * Expects the macros N_IN, N_KEY, TILE, STEPS, LARGEST and REGISTER_BYTES (of the machine's vectors,
 * 0: not known); the step is the function that makes a key.
 */
#include <math.h>

/* Twice a key of whole steps, for two entries of all rows of a tile. Entries that are not known
 * count nothing: `kept` is zero there, else all its bits are set. */
typedef struct {
  int16_t twice[2], kept[2];
} asked;

#define PAIRS ((N_KEY + 1) / 2)
#define FAR INT32_MAX

#define UNROLLED LOOPS static inline __attribute__((always_inline, unused))

static void ask(const scalar *key, asked *pairs) {
  int i;
  memset(pairs, 0, PAIRS * sizeof *pairs);
  for (i = 0; i < N_KEY; ++i) {
    if (key[i] != key[i]) continue;
    pairs[i / 2].twice[i % 2] = (int16_t) (2 * fmax(fmin(rint(key[i] * STEPS), LARGEST), -LARGEST));
    pairs[i / 2].kept[i % 2] = -1;
  }
}

/* |row - key|^2 over the known entries, without the part that all rows share. */
UNROLLED void measure(const lookup_job *job, const asked *pairs, int32_t *distance) {
  int64_t tile, tiles = (job->rows + TILE - 1) / TILE;
  int i, j;
  for (tile = 0; tile < tiles; ++tile, distance += TILE) {
    const int16_t *row = job->tiles + tile * PAIRS * TILE * 2;
    for (j = 0; j < TILE; ++j) distance[j] = 0;
    for (i = 0; i < PAIRS; ++i, row += TILE * 2) {
      for (j = 0; j < TILE; ++j) {
        distance[j] += row[2 * j] * ((row[2 * j] - pairs[i].twice[0]) & pairs[i].kept[0])
                     + row[2 * j + 1] * ((row[2 * j + 1] - pairs[i].twice[1]) & pairs[i].kept[1]);
      }
    }
  }
}

UNROLLED int32_t least(const int32_t *values, int64_t count) {
  int32_t found = FAR;
  int64_t j;
  for (j = 0; j < count; ++j) found = values[j] < found ? values[j] : found;
  return found;
}

/* The nearest one after the other, of equals the first: the tile it is in, then the row. */
UNROLLED void choose(const lookup_job *job, int32_t *distance, int32_t *nearest, int64_t *found) {
  const int64_t tiles = (job->rows + TILE - 1) / TILE;
  int64_t i, j, place;
  for (j = job->rows; j < tiles * TILE; ++j) distance[j] = FAR;
  for (i = 0; i < tiles; ++i) nearest[i] = least(distance + i * TILE, TILE);
  for (place = 0; place < job->wanted; ++place) {
    const int32_t best = least(nearest, tiles);
    int32_t *tile;
    for (i = 0; nearest[i] != best; ++i) {}
    tile = distance + i * TILE;
    for (j = 0; tile[j] != best; ++j) {}
    found[place] = i * TILE + j;
    tile[j] = FAR;
    nearest[i] = least(tile, TILE);
  }
}

#if defined(__x86_64__) && REGISTER_BYTES
#define PAIR_OF(numbers) \
  ((int32_t) ((uint32_t) (uint16_t) (numbers)[0] | (uint32_t) (uint16_t) (numbers)[1] << 16))

/* The instruction is named: the header of all of them takes longer to read than this file to
 * compile. */
#if REGISTER_BYTES == 64
#define TARGET "avx512f,avx512bw"
#define REGISTER "v"
#else
#define TARGET "avx2"
#define REGISTER "x"
#endif

typedef int32_t wide __attribute__((vector_size(REGISTER_BYTES)));
typedef int16_t halves __attribute__((vector_size(REGISTER_BYTES)));

LOOPS __attribute__((target(TARGET)))
static void measure_wide(const lookup_job *job, const asked *pairs, int32_t *distance) {
  wide twice[PAIRS], kept[PAIRS];
  const int64_t parts = TILE * 4 / REGISTER_BYTES;
  int64_t part, count = (job->rows + TILE - 1) / TILE * parts;
  int i;
  for (i = 0; i < PAIRS; ++i) {
    twice[i] = PAIR_OF(pairs[i].twice) + (wide) {0};
    kept[i] = PAIR_OF(pairs[i].kept) + (wide) {0};
  }
  for (part = 0; part < count; ++part) {
    const char *from = (const char *) job->tiles
                     + (part / parts * PAIRS * parts + part % parts) * REGISTER_BYTES;
    wide sum = {0};
    for (i = 0; i < PAIRS; ++i) {
      wide a, rest, both;
      memcpy(&a, from + i * parts * REGISTER_BYTES, REGISTER_BYTES);
      rest = (wide) ((halves) a - (halves) twice[i]) & kept[i];
      __asm__("vpmaddwd %2, %1, %0" : "=" REGISTER(both) : REGISTER(a), REGISTER(rest));
      sum += both;
    }
    memcpy(distance + part * (REGISTER_BYTES / 4), &sum, REGISTER_BYTES);
  }
}

LOOPS __attribute__((target(TARGET)))
static void find(const lookup_job *job, const asked *pairs, int32_t *distance, int32_t *nearest,
                 int64_t *found) {
  measure_wide(job, pairs, distance);
  choose(job, distance, nearest, found);
}
#else
#if defined(FREESTANDING) && (defined(__SSE2__) || defined(__wasm_simd128__))
#if defined(__SSE2__)
#include <emmintrin.h>
typedef __m128i eight;
#define LOADED(from) _mm_loadu_si128((const __m128i *) (const void *) (from))
#define STORED(to, x) _mm_storeu_si128((__m128i *) (void *) (to), x)
#define TWICE(x) _mm_set1_epi32(x)
#define REST(a, twice, kept) _mm_and_si128(_mm_sub_epi16(a, twice), kept)
#define SUM(sum, a, rest) _mm_add_epi32(sum, _mm_madd_epi16(a, rest))
#else
#include <wasm_simd128.h>
typedef v128_t eight;
#define LOADED(from) wasm_v128_load(from)
#define STORED(to, x) wasm_v128_store(to, x)
#define TWICE(x) wasm_i32x4_splat(x)
#define REST(a, twice, kept) wasm_v128_and(wasm_i16x8_sub(a, twice), kept)
#define SUM(sum, a, rest) wasm_i32x4_add(sum, wasm_i32x4_dot_i16x8(a, rest))
#endif

#define PAIR_OF(numbers) \
  ((int32_t) ((uint32_t) (uint16_t) (numbers)[0] | (uint32_t) (uint16_t) (numbers)[1] << 16))

/* What every machine of the kind has. */
static void measure_eight(const lookup_job *job, const asked *pairs, int32_t *distance) {
  eight twice[PAIRS], kept[PAIRS];
  int64_t tile, tiles = (job->rows + TILE - 1) / TILE;
  int i, part;
  for (i = 0; i < PAIRS; ++i) {
    twice[i] = TWICE(PAIR_OF(pairs[i].twice));
    kept[i] = TWICE(PAIR_OF(pairs[i].kept));
  }
  for (tile = 0; tile < tiles; ++tile) {
    const int16_t *row = job->tiles + tile * PAIRS * TILE * 2;
    for (part = 0; part < TILE / 4; ++part) {
      eight sum = TWICE(0);
      for (i = 0; i < PAIRS; ++i) {
        const eight a = LOADED(row + (i * TILE + part * 4) * 2);
        sum = SUM(sum, a, REST(a, twice[i], kept[i]));
      }
      STORED(distance + tile * TILE + part * 4, sum);
    }
  }
}

#define measure measure_eight
#endif

LOOPS static void find(const lookup_job *job, const asked *pairs, int32_t *distance,
                       int32_t *nearest, int64_t *found) {
  measure(job, pairs, distance);
  choose(job, distance, nearest, found);
}
#endif

DRIVER(lookup, lookup_job) {
  workspace space;
  int outcome = set_up(&space, N_KEY + 2 * (job->rows + TILE));
  int64_t ticks = 0;
  scalar limit = 0;
  int i;
  asked pairs[PAIRS];
  int32_t *distance, *nearest;
  if (outcome != DONE) return outcome;
  distance = (int32_t *) (space.extra + N_KEY);
  nearest = distance + job->rows + TILE;
  if (job->count - job->next > CLOCK_INTERVAL) limit = monotonic() + job->slice;
  for (; job->next < job->count; ++job->next) {
    if (++ticks % CLOCK_INTERVAL == 0 && monotonic() > limit) {
      outcome = SLICE_OVER;
      break;
    }
    for (i = 0; i < N_IN; ++i) space.arg[i] = job->inputs[i] + job->next * job->input_steps[i];
    space.res[0] = space.extra;
    STEP(space.arg, space.res, 0);
    ask(space.extra, pairs);
    find(job, pairs, distance, nearest, job->found + job->next * job->wanted);
  }
  give_back(&space);
  return outcome;
}
