/* Hands whose fingertips touch an object, by geometric hashing of oriented point pairs.
 *
 * A pair of patches of the object and a pair of fingertips in the same cell of the hash table
 * determine the palm pose in closed form (B. Drost et al., Model globally, match locally, 2010).
 * Further fingers take a posture of the table that touches, or a collision-free one. Collisions are
 * checked with distance grids, so results require an exact check afterwards. All random numbers
 * follow from job->seed.
 */
#include <math.h>

enum { BINS = 20 };

typedef struct {
  /* The hand in the palm frame: pads and capsules of each posture of each finger. */
  const scalar *points, *normals;  /* (shares, postures, fingers, 3) */
  const scalar *capsules;      /* (shares, postures, n_capsules, 6) start of the axis, vector to its end */
  const scalar *palm_capsules; /* (n_palm_capsules, 6) capsules that are fixed to the palm */
  const scalar *lengths;       /* (n_capsules + n_palm_capsules) lengths of the axes */
  const scalar *scene_standoffs, *object_standoffs; /* (n_capsules + n_palm_capsules) minimum
                                                       distances of the axes from solids */
  const int64_t *first;        /* (fingers + 1) first capsule of each finger */
  const int64_t *may_touch;    /* (n_capsules) 1 for capsules that may touch if their finger does */
  const scalar *radii, *cos_lean; /* (fingers) radius and minimum cosine of the lean of each pad */
  uint64_t *separate;          /* (shares, fingers, fingers, postures, words) bit set of the postures of
                                  the second finger that do not collide with a posture of the first */
  const int64_t *crossing;     /* (n_crossing, 4) finger, capsule, finger, capsule of pairs to check */
  const scalar *min_distances; /* (n_crossing) minimum distances of the axes of these pairs */
  const int64_t *pairs;        /* (n, 4) share, finger, posture of the thumb, posture of the finger */
  const scalar *depths;        /* (n) pinch depths of the pairs, 0 to 1 */
  int64_t shares, postures, words, n_fingers, n_capsules, n_palm_capsules, n_crossing, thumb;
  /* The object. */
  const scalar *samples, *outward; /* (m, 3) points and outward normals of the surface */
  const int64_t *fits_pad;     /* (m) 1 for samples where a pad fits */
  const int64_t *patches;      /* (n_patches, 4) two samples, first pair of the hand, number of pairs */
  int64_t n_patches;
  /* Grids: lower corner and edge of a cell, numbers of cells, values at the centres of cells. */
  scalar surface_low[4], object_low[4], scene_low[4];
  int64_t surface_count[3], object_count[3], scene_count[3];
  const scalar *surface_height; /* signed distances from the surface */
  const int64_t *surface_sample; /* nearest samples */
  const scalar *object_value, *scene_value; /* distances */
  scalar up[3];                /* vertical direction in the object frame */
  /* Parameters of the search. */
  scalar max_height, idle_clearance, min_trial_probability;
  int64_t n_touching, max_posture_trials, max_attempts;
  int64_t seed;
  /* Numbers of collision-free trials and of all trials, by bin of palm depth and palm direction. */
  scalar depth_free[BINS], depth_trials[BINS], direction_free[BINS], direction_trials[BINS];
  /* Results. */
  int64_t n_requested, n_hands, n_draws, attempts, n_matched, n_free;
  scalar *palms;               /* (n_requested, 12) rotation row by row, origin; object frame */
  int64_t *hand_shares, *hand_postures; /* (n_requested), (n_requested, fingers) */
  int64_t *touches;            /* (n_requested, fingers) 1 for fingers that touch */
  scalar slice;
} touch_job;

enum { X, Y, Z, MAX_FINGERS = 8, MAX_WORDS = 32 };

/* Sum of products of sines below which both normals are parallel to the line between the pads, so
 * that they do not determine the rotation about it. */
#define MIN_SINES 0.02
#define FULL_TURN 6.283185307179586

/* Minimum step along the axis of a capsule in a distance check [m]. */
#define MIN_STEP 2e-3

static uint64_t random_bits(touch_job *job) { /* S. Vigna's splitmix64 */
  uint64_t z = (uint64_t) (job->seed += (int64_t) 0x9E3779B97F4A7C15u);
  z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
  z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
  return z ^ (z >> 31);
}

static scalar random_fraction(touch_job *job) { return (scalar) (random_bits(job) >> 11) * 0x1p-53; }

static int64_t random_index(touch_job *job, int64_t count) {
  return (int64_t) (random_fraction(job) * (scalar) count);
}

static scalar dot(const scalar *a, const scalar *b) {
  return a[X] * b[X] + a[Y] * b[Y] + a[Z] * b[Z];
}

static void cross(const scalar *a, const scalar *b, scalar *product) {
  product[X] = a[Y] * b[Z] - a[Z] * b[Y];
  product[Y] = a[Z] * b[X] - a[X] * b[Z];
  product[Z] = a[X] * b[Y] - a[Y] * b[X];
}

static void normalise(scalar *a) {
  const scalar inverse = 1 / sqrt(dot(a, a) + 1e-300);
  int k;
  for (k = 0; k < 3; ++k) a[k] *= inverse;
}

/* Rotate a vector from the palm frame to the object frame. `palm` is a rotation row by row and an
 * origin. */
static void rotate(const scalar *palm, const scalar *a, scalar *rotated) {
  int k;
  for (k = 0; k < 3; ++k) rotated[k] = dot(palm + 3 * k, a);
}

/* Transform a point from the palm frame to the object frame. */
static void transform(const scalar *palm, const scalar *a, scalar *transformed) {
  int k;
  for (k = 0; k < 3; ++k) transformed[k] = dot(palm + 3 * k, a) + palm[9 + k];
}

/* Return the index of the cell of a point, -1 outside the grid. */
static int64_t cell_of(const scalar *low, const int64_t *count, const scalar *p) {
  int64_t cell = 0;
  int k;
  for (k = 0; k < 3; ++k) {
    const scalar position = (p[k] - low[k]) / low[3];
    if (!(position >= 0 && position < (scalar) count[k])) return -1;
    cell = cell * count[k] + (int64_t) position;
  }
  return cell;
}

/* Return the clearance of a point beyond a required distance, by trilinear interpolation in a grid.
 * Outside the centres of the border cells, return the distance from these: solids may be anywhere
 * beyond the grid. */
static scalar clearance_at(const scalar *low, const int64_t *count, const scalar *value,
                         const scalar *p, scalar distance) {
  int64_t cell[3];
  scalar fraction[3], lower, upper, outside = -1;
  const scalar *v;
  int k;
  for (k = 0; k < 3; ++k) {
    const scalar position = (p[k] - low[k]) / low[3] - 0.5;
    const scalar excess = position - (scalar) (count[k] - 1);
    outside = -position > outside ? -position : outside;
    outside = excess > outside ? excess : outside;
    cell[k] = (int64_t) position;
    fraction[k] = position - (scalar) cell[k];
  }
  if (outside >= 0) return outside * low[3];
  const int64_t row = count[Z], plane = count[Y] * row;
  v = value + cell[X] * plane + cell[Y] * row + cell[Z];
#define ALONG_Z(i) (v[i] + fraction[Z] * (v[(i) + 1] - v[i]))
  lower = ALONG_Z(0) + fraction[Y] * (ALONG_Z(row) - ALONG_Z(0));
  upper = ALONG_Z(plane) + fraction[Y] * (ALONG_Z(plane + row) - ALONG_Z(plane));
#undef ALONG_Z
  return lower + fraction[X] * (upper - lower) - distance;
}

/* Return 1 if a segment keeps a distance from the solids of a grid: the check advances by the
 * clearance at each point. */
static int keeps_distance(const scalar *low, const int64_t *count, const scalar *value,
                          const scalar *start, const scalar *vector, scalar length, scalar distance) {
  scalar t = 0;
  if (!(distance > -INFINITY)) return 1;
  for (;;) {
    const scalar fraction = length > 0 ? t / length : 0;
    const scalar p[3] = {start[X] + fraction * vector[X], start[Y] + fraction * vector[Y],
                         start[Z] + fraction * vector[Z]};
    const scalar clearance = clearance_at(low, count, value, p, distance);
    if (clearance < 0) return 0;
    if (t >= length || t + clearance > length) return 1;
    t += clearance > MIN_STEP ? clearance : MIN_STEP;
    if (t > length) t = length;
  }
}

/* Return 1 if capsules [from, to) are free of collision with the object and the scene. `shift` is
 * added to their indices in job->lengths; with `touches`, pads may touch the object. */
static int capsules_are_free(const touch_job *job, const scalar *palm, const scalar *capsules,
                             int64_t from, int64_t to, int64_t shift, int touches) {
  int64_t i;
  for (i = from; i < to; ++i) {
    const int64_t index = i + shift;
    scalar start[3], vector[3];
    transform(palm, capsules + 6 * i, start);
    rotate(palm, capsules + 6 * i + 3, vector);
    if (!(touches && job->may_touch[index])
        && !keeps_distance(job->object_low, job->object_count, job->object_value, start, vector,
                           job->lengths[index], job->object_standoffs[index])) return 0;
    if (!keeps_distance(job->scene_low, job->scene_count, job->scene_value, start, vector,
                        job->lengths[index], job->scene_standoffs[index])) return 0;
  }
  return 1;
}

static int finger_is_free(const touch_job *job, const scalar *palm, int64_t share, int64_t finger,
                        int64_t posture, int touches) {
  const scalar *capsules = job->capsules + 6 * job->n_capsules * (share * job->postures + posture);
  return capsules_are_free(job, palm, capsules, job->first[finger], job->first[finger + 1], 0, touches);
}

/* Return the vector of a pad in `vectors`, which is job->points or job->normals. */
static const scalar *pad(const touch_job *job, const scalar *vectors, int64_t share, int64_t finger,
                         int64_t posture) {
  return vectors + 3 * ((share * job->postures + posture) * job->n_fingers + finger);
}

/* Return the bit set of the postures of the second finger that do not collide with a posture of the
 * first. */
static uint64_t *separate_postures(const touch_job *job, int64_t share, int64_t first, int64_t second,
                                   int64_t posture) {
  const int64_t row = (share * job->n_fingers + first) * job->n_fingers + second;
  return job->separate + (row * job->postures + posture) * job->words;
}

/* Complete a unit vector along a line to a right-handed frame (x, y, line). */
static void axes_about(const scalar *line, scalar *x, scalar *y) {
  const scalar size[3] = {fabs(line[X]), fabs(line[Y]), fabs(line[Z])};
  const int smallest = size[X] <= size[Y] ? (size[X] <= size[Z] ? X : Z) : (size[Y] <= size[Z] ? Y : Z);
  scalar axis[3] = {0, 0, 0};
  axis[smallest] = 1;
  cross(line, axis, x);
  normalise(x);
  cross(line, x, y);
}

/* Compute the palm pose that aligns points a, b with normals na, nb to points p, q with normals np,
 * nq. The rotation about the line through the points aligns the components of the normals orthogonal
 * to the line; it is random if the normals are parallel to the line. */
static void match(touch_job *job, const scalar *a, const scalar *b, const scalar *na, const scalar *nb,
                  const scalar *p, const scalar *q, const scalar *np, const scalar *nq, scalar *palm) {
  scalar from[3][3], to[3][3], cosine, sine, norm, mean[3], goal[3];
  int i, k;
  for (k = 0; k < 3; ++k) from[2][k] = b[k] - a[k];
  for (k = 0; k < 3; ++k) to[2][k] = q[k] - p[k];
  normalise(from[2]);
  normalise(to[2]);
  axes_about(from[2], from[0], from[1]);
  axes_about(to[2], to[0], to[1]);
  cosine = dot(from[0], na) * dot(to[0], np) + dot(from[1], na) * dot(to[1], np)
         + dot(from[0], nb) * dot(to[0], nq) + dot(from[1], nb) * dot(to[1], nq);
  sine = dot(from[0], na) * dot(to[1], np) - dot(from[1], na) * dot(to[0], np)
       + dot(from[0], nb) * dot(to[1], nq) - dot(from[1], nb) * dot(to[0], nq);
  norm = sqrt(cosine * cosine + sine * sine);
  if (norm > MIN_SINES) {
    cosine /= norm;
    sine /= norm;
  } else {
    const scalar angle = FULL_TURN * random_fraction(job);
    cosine = cos(angle);
    sine = sin(angle);
  }
  for (k = 0; k < 3; ++k) {
    const scalar x = cosine * to[0][k] + sine * to[1][k], y = cosine * to[1][k] - sine * to[0][k];
    for (i = 0; i < 3; ++i) palm[3 * k + i] = x * from[0][i] + y * from[1][i] + to[2][k] * from[2][i];
    mean[k] = (a[k] + b[k]) / 2;
    goal[k] = (p[k] + q[k]) / 2;
  }
  rotate(palm, mean, palm + 9);
  for (k = 0; k < 3; ++k) palm[9 + k] = goal[k] - palm[9 + k];
}

/* Return 1 with a probability proportional to the success rate of a bin: its share of
 * collision-free trials, relative to the best bin. */
static int accept_bin(touch_job *job, const scalar *n_free, const scalar *n_trials, int64_t bin) {
  scalar best = 0, probability;
  int k;
  for (k = 0; k < BINS; ++k) {
    best = n_free[k] > best * n_trials[k] ? n_free[k] / n_trials[k] : best;
  }
  probability = n_free[bin] / n_trials[bin] / best;
  if (probability < job->min_trial_probability) probability = job->min_trial_probability;
  return random_fraction(job) < probability;
}

static int64_t bin_of(scalar value) {
  const int64_t bin = (int64_t) (value * BINS);
  return bin < 0 ? 0 : bin < BINS ? bin : BINS - 1;
}

/* Return 1 if a pad touches the surface at a sample within the limits of height and lean.
 * `opposition` becomes the cosine between its normal and the reversed normal of the thumb. */
static int pad_touches(const touch_job *job, const scalar *palm, int64_t finger, const scalar *tip,
                       const scalar *normal, int64_t sample, const scalar *thumb_normal,
                       scalar *opposition) {
  const scalar *outward = job->outward + 3 * sample, *point = job->samples + 3 * sample;
  const scalar offset[3] = {tip[X] - point[X], tip[Y] - point[Y], tip[Z] - point[Z]};
  scalar pad_normal[3];
  if (!job->fits_pad[sample]) return 0;
  if (fabs(dot(offset, outward) - job->radii[finger]) >= job->max_height) return 0;
  rotate(palm, normal, pad_normal);
  *opposition = -dot(pad_normal, thumb_normal);
  return -dot(pad_normal, outward) > job->cos_lean[finger];
}

/* Return a posture of a finger that touches the object or, unless `must_touch`, a collision-free
 * one; -1 if there is none. Sets `touches` to 1 if the finger touches. `is_placed` marks the fingers
 * with a posture. */
static int64_t choose_posture(touch_job *job, const scalar *palm, int64_t share, int64_t finger,
                              const int64_t *postures, const int *is_placed,
                              const scalar *thumb_normal, int may_touch, int must_touch,
                              int64_t *touches) {
  const int64_t count = job->postures, shift = random_index(job, count);
  uint64_t permitted[MAX_WORDS];
  int64_t candidate[MAX_WORDS * 64], idle[MAX_WORDS * 64], n = 0, n_idle = 0, i, k, w;
  scalar score[MAX_WORDS * 64];
  for (w = 0; w < job->words; ++w) permitted[w] = ~(uint64_t) 0;
  for (k = 0; k < job->n_fingers; ++k) {
    const uint64_t *row = separate_postures(job, share, k, finger, postures[k]);
    for (w = 0; is_placed[k] && w < job->words; ++w) permitted[w] &= row[w];
  }
  for (k = 0; k < count; ++k) {
    const int64_t posture = k + shift < count ? k + shift : k + shift - count;
    scalar tip[3], height, opposition;
    int64_t cell;
    if (!(permitted[posture / 64] >> posture % 64 & 1)) continue;
    transform(palm, pad(job, job->points, share, finger, posture), tip);
    cell = cell_of(job->surface_low, job->surface_count, tip);
    height = cell < 0 ? INFINITY : job->surface_height[cell] - job->radii[finger];
    if (height > job->idle_clearance) idle[n_idle++] = posture;
    if (!may_touch || cell < 0 || fabs(height) > job->max_height + job->surface_low[3]) continue;
    if (!pad_touches(job, palm, finger, tip, pad(job, job->normals, share, finger, posture),
                     job->surface_sample[cell], thumb_normal, &opposition)) continue;
    candidate[n] = posture;
    /* Postures that push against the thumb are preferred. */
    score[n++] = random_fraction(job) + 2 * opposition;
  }
  for (k = 0; k < n && k < job->max_posture_trials; ++k) {
    int64_t best = 0;
    for (i = 1; i < n; ++i) best = score[i] > score[best] ? i : best;
    if (finger_is_free(job, palm, share, finger, candidate[best], 1)) {
      *touches = 1;
      return candidate[best];
    }
    score[best] = -INFINITY;
  }
  for (k = 0; !must_touch && k < n_idle && k < job->max_posture_trials; ++k) {
    if (finger_is_free(job, palm, share, finger, idle[k], 0)) return idle[k];
  }
  return -1;
}

/* Choose postures of the remaining fingers in random order; return 1 if enough fingers touch. */
static int place_remaining_fingers(touch_job *job, const scalar *palm, int64_t share,
                                   int64_t *postures, int64_t *touches,
                                   const scalar *thumb_normal) {
  int is_placed[MAX_FINGERS];
  int64_t order[MAX_FINGERS], n_remaining = 0, n_touching = 2, k;
  for (k = 0; k < job->n_fingers; ++k) {
    is_placed[k] = (int) touches[k];
    if (!is_placed[k]) order[n_remaining++] = k;
  }
  while (n_remaining) {
    const int64_t index = random_index(job, n_remaining), finger = order[index];
    order[index] = order[--n_remaining];
    postures[finger] = choose_posture(job, palm, share, finger, postures, is_placed, thumb_normal,
                                      n_touching < job->n_touching,
                                      n_touching + n_remaining < job->n_touching,
                                      touches + finger);
    if (postures[finger] < 0) return 0;
    is_placed[finger] = 1;
    n_touching += touches[finger];
  }
  return n_touching == job->n_touching;
}

/* Make one attempt; return 1 if it gave a hand, which is stored behind the previous ones. */
static int attempt(touch_job *job) {
  const int64_t *patch = job->patches + 4 * random_index(job, job->n_patches);
  const int64_t row = patch[2] + random_index(job, patch[3]), *cell = job->pairs + 4 * row;
  const int64_t share = cell[0], thumb = job->thumb, finger = cell[1];
  const int64_t fingers[2] = {thumb, finger}, pair_postures[2] = {cell[2], cell[3]};
  scalar *palm = job->palms + 12 * job->n_hands, goals[2][3], inward[2][3];
  scalar finger_normal[3], thumb_normal[3];
  int64_t *postures = job->hand_postures + job->n_fingers * job->n_hands;
  int64_t *touches = job->touches + job->n_fingers * job->n_hands;
  int64_t depth = bin_of(job->depths[row]), direction, k;
  const scalar *point[2], *normal[2];
  int side, is_free;
  if (!accept_bin(job, job->depth_free, job->depth_trials, depth)) return 0;
  ++job->attempts;
  for (side = 0; side < 2; ++side) {
    const scalar *outward = job->outward + 3 * patch[side];
    for (k = 0; k < 3; ++k) {
      inward[side][k] = -outward[k];
      goals[side][k] = job->samples[3 * patch[side] + k] + job->radii[fingers[side]] * outward[k];
    }
    point[side] = pad(job, job->points, share, fingers[side], pair_postures[side]);
    normal[side] = pad(job, job->normals, share, fingers[side], pair_postures[side]);
  }
  match(job, point[0], point[1], normal[0], normal[1], goals[0], goals[1], inward[0], inward[1], palm);
  rotate(palm, normal[1], finger_normal);
  rotate(palm, normal[0], thumb_normal);
  if (dot(thumb_normal, inward[0]) <= job->cos_lean[thumb]) return 0;
  if (dot(finger_normal, inward[1]) <= job->cos_lean[finger]) return 0;
  /* The bin of the palm direction follows from the vertical component of its z axis. */
  direction = bin_of(0.5 + 0.5 * (palm[2] * job->up[X] + palm[5] * job->up[Y] + palm[8] * job->up[Z]));
  if (!accept_bin(job, job->direction_free, job->direction_trials, direction)) return 0;
  ++job->n_matched;
  is_free = capsules_are_free(job, palm, job->palm_capsules, 0, job->n_palm_capsules,
                              job->n_capsules, 0)
         && finger_is_free(job, palm, share, thumb, pair_postures[0], 1)
         && finger_is_free(job, palm, share, finger, pair_postures[1], 1);
  job->depth_trials[depth] += 1;
  job->depth_free[depth] += is_free;
  job->direction_trials[direction] += 1;
  job->direction_free[direction] += is_free;
  if (!is_free) return 0;
  ++job->n_free;
  for (k = 0; k < job->n_fingers; ++k) postures[k] = touches[k] = 0;
  touches[thumb] = touches[finger] = 1;
  postures[thumb] = pair_postures[0];
  postures[finger] = pair_postures[1];
  job->hand_shares[job->n_hands] = share;
  return place_remaining_fingers(job, palm, share, postures, touches, thumb_normal);
}

DRIVER(touch, touch_job) {
  const scalar limit = monotonic() + job->slice;
  while (job->n_hands < job->n_requested && job->attempts < job->max_attempts) {
    if (++job->n_draws % 1024 == 0 && monotonic() > limit) return SLICE_OVER;
    job->n_hands += attempt(job);
  }
  return DONE;
}

/* Return the squared distance between two segments, each a start and a vector to its end
 * (C. Ericson, Real-Time Collision Detection, section 5.1.9). */
static scalar squared_distance(const scalar *first, const scalar *second) {
  const scalar *g = first + 3, *h = second + 3;
  const scalar r[3] = {first[X] - second[X], first[Y] - second[Y], first[Z] - second[Z]};
  const scalar a = dot(g, g), b = dot(h, h), c = dot(g, h), d = dot(g, r), f = dot(h, r);
  scalar s, t, offset[3];
  int k;
#define CLAMP(x) fmin(fmax(x, 0), 1)
  t = CLAMP((c * f - b * d) / fmax(a * b - c * c, 1e-30));
  s = CLAMP((c * t + f) / fmax(b, 1e-30));
  t = CLAMP((c * s - d) / fmax(a, 1e-30));
#undef CLAMP
  for (k = 0; k < 3; ++k) offset[k] = r[k] + t * g[k] - s * h[k];
  return dot(offset, offset);
}

/* Clear the bits of pairs of postures that collide; `attempts` counts the postures of the first
 * finger. */
DRIVER(apart, touch_job) {
  const scalar limit = monotonic() + job->slice;
  for (; job->attempts < job->shares * job->postures; ++job->attempts) {
    const int64_t share = job->attempts / job->postures, i = job->attempts % job->postures;
    const scalar *first = job->capsules + 6 * job->n_capsules * job->attempts;
    int64_t j, k;
    if (monotonic() > limit) return SLICE_OVER;
    for (j = 0; j < job->postures; ++j) {
      const scalar *second = job->capsules + 6 * job->n_capsules * (share * job->postures + j);
      for (k = 0; k < job->n_crossing; ++k) {
        const int64_t *row = job->crossing + 4 * k;
        const scalar *a = first + 6 * row[1], *b = second + 6 * row[3];
        const scalar min_distance = job->min_distances[k];
        uint64_t *word = separate_postures(job, share, row[0], row[2], i) + j / 64;
        /* Segments whose bounding balls are farther apart do not collide. */
        const scalar bound = min_distance + (job->lengths[row[1]] + job->lengths[row[3]]) / 2;
        const scalar r[3] = {a[X] - b[X] + (a[3] - b[3]) / 2,
                             a[Y] - b[Y] + (a[4] - b[4]) / 2,
                             a[Z] - b[Z] + (a[5] - b[5]) / 2};
        if (!(*word >> j % 64 & 1) || bound <= 0 || dot(r, r) >= bound * bound) continue;
        if (min_distance <= 0 || squared_distance(a, b) >= min_distance * min_distance) continue;
        *word &= ~((uint64_t) 1 << j % 64);
        separate_postures(job, share, row[2], row[0], j)[i / 64] &= ~((uint64_t) 1 << i % 64);
      }
    }
  }
  return DONE;
}
