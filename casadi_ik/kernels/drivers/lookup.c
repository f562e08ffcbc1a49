/* The rows of a table whose keys are nearest to that of each sample, in order.
 *
 * Expects the macros N_IN, N_KEY, TILE, STEPS and LARGEST; the step is the function that makes a key.
 */
#include <math.h>

/* Twice a key of whole steps, for two entries of all rows of a tile. Entries that are not known
 * count nothing: `kept` is zero there, else all its bits are set. */
typedef struct {
  int16_t twice[2], kept[2];
} asked;

#define PAIRS ((N_KEY + 1) / 2)
#define FAR INT32_MAX

/* Only gcc needs to be told that loops over a tile are one instruction. */
#if defined(__clang__)
#define UNROLLED static inline __attribute__((always_inline, unused))
#else
#define UNROLLED static inline __attribute__((always_inline, unused, optimize("O3")))
#endif

static void ask(const double *key, asked *pairs) {
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

typedef void look_up(const lookup_job *, const asked *, int32_t *, int32_t *, int64_t *);

#if defined(__clang__)
#define FORM static
#else
#define FORM static __attribute__((optimize("O3")))
#endif

#if defined(__x86_64__) && !defined(FREESTANDING)
#include <immintrin.h>

#define PAIR_OF(numbers) \
  ((int32_t) ((uint32_t) (uint16_t) (numbers)[0] | (uint32_t) (uint16_t) (numbers)[1] << 16))

__attribute__((target("avx2")))
static void measure_avx2(const lookup_job *job, const asked *pairs, int32_t *distance) {
  __m256i twice[PAIRS], kept[PAIRS];
  const __m256i *row = (const __m256i *) job->tiles;
  int64_t half, halves = (job->rows + TILE - 1) / TILE * 2;
  int i;
  for (i = 0; i < PAIRS; ++i) {
    twice[i] = _mm256_set1_epi32(PAIR_OF(pairs[i].twice));
    kept[i] = _mm256_set1_epi32(PAIR_OF(pairs[i].kept));
  }
  for (half = 0; half < halves; ++half) {
    const __m256i *from = row + half / 2 * PAIRS * 2 + half % 2;
    __m256i sum = _mm256_setzero_si256();
    for (i = 0; i < PAIRS; ++i) {
      const __m256i a = _mm256_loadu_si256(from + 2 * i);
      const __m256i rest = _mm256_and_si256(_mm256_sub_epi16(a, twice[i]), kept[i]);
      sum = _mm256_add_epi32(sum, _mm256_madd_epi16(a, rest));
    }
    _mm256_storeu_si256((__m256i *) (distance + half * TILE / 2), sum);
  }
}

__attribute__((target("avx2"))) FORM void with_avx2(
    const lookup_job *job, const asked *pairs, int32_t *distance, int32_t *nearest, int64_t *found) {
  measure_avx2(job, pairs, distance);
  choose(job, distance, nearest, found);
}

__attribute__((target("avx512f,avx512bw")))
static void measure_avx512(const lookup_job *job, const asked *pairs, int32_t *distance) {
  __m512i twice[PAIRS], kept[PAIRS];
  const __m512i *row = (const __m512i *) job->tiles;
  int64_t tile, tiles = (job->rows + TILE - 1) / TILE;
  int i;
  for (i = 0; i < PAIRS; ++i) {
    twice[i] = _mm512_set1_epi32(PAIR_OF(pairs[i].twice));
    kept[i] = _mm512_set1_epi32(PAIR_OF(pairs[i].kept));
  }
  for (tile = 0; tile < tiles; ++tile) {
    __m512i sum = _mm512_setzero_si512();
    for (i = 0; i < PAIRS; ++i) {
      const __m512i a = _mm512_loadu_si512(row++);
      const __m512i rest = _mm512_and_si512(_mm512_sub_epi16(a, twice[i]), kept[i]);
      sum = _mm512_add_epi32(sum, _mm512_madd_epi16(a, rest));
    }
    _mm512_storeu_si512(distance + tile * TILE, sum);
  }
}

__attribute__((target("avx512f,avx512bw"))) FORM void with_avx512(
    const lookup_job *job, const asked *pairs, int32_t *distance, int32_t *nearest, int64_t *found) {
  measure_avx512(job, pairs, distance);
  choose(job, distance, nearest, found);
}
#endif

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

FORM void with_eight(
    const lookup_job *job, const asked *pairs, int32_t *distance, int32_t *nearest, int64_t *found) {
  measure_eight(job, pairs, distance);
  choose(job, distance, nearest, found);
}
#define PLAIN with_eight
#else
FORM void anywhere(
    const lookup_job *job, const asked *pairs, int32_t *distance, int32_t *nearest, int64_t *found) {
  measure(job, pairs, distance);
  choose(job, distance, nearest, found);
}
#define PLAIN anywhere
#endif

/* Asked once: in a virtual machine the question takes longer than a lookup. Threads that ask at the
 * same time get the same answer. */
static look_up *best_form(void) {
#if defined(__x86_64__) && !defined(FREESTANDING)
  static int known;
  int bits = __atomic_load_n(&known, __ATOMIC_RELAXED);
  if (!bits) {
    bits = register_bits();
    __atomic_store_n(&known, bits, __ATOMIC_RELAXED);
  }
  if (bits == 512) return with_avx512;
  if (bits == 256) return with_avx2;
#endif
  return PLAIN;
}

EXPORT int casadi_ik_lookup(lookup_job *job) {
  workspace space;
  int outcome = set_up(&space, N_KEY + 2 * (job->rows + TILE));
  int64_t ticks = 0;
  double limit = 0;
  int i;
  asked pairs[PAIRS];
  int32_t *distance, *nearest;
  look_up *find = best_form();
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
