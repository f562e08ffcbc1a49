/* Palms and hands whose fingertips touch an object, found by hashing oriented pairs of points.
 *
 * A pair of patches of the object and a pair of fingertips of the same cell give a palm in closed
 * form (B. Drost et al., Model globally, match locally, 2010); further fingers take any posture of
 * the table that touches, or one that is clear. Capsules keep clear of distances in grids: what is
 * given here is looked at exactly afterwards. Numbers are drawn from job->seed alone.
 */
#include <math.h>

enum { X, Y, Z, MOST_FINGERS = 8, MOST_WORDS = 32 };

/* Products of two sines below which two pads face along their line, and tell no turn about it. */
#define ACROSS 0.02
#define TURN 6.283185307179586

/* What a capsule advances by at least where it is near something [m]. */
#define LEAST_STEP 2e-3

static uint64_t drawn(touch_job *job) { /* S. Vigna's splitmix64 */
  uint64_t z = (uint64_t) (job->seed += (int64_t) 0x9E3779B97F4A7C15u);
  z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
  z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
  return z ^ (z >> 31);
}

static scalar chance(touch_job *job) { return (scalar) (drawn(job) >> 11) * 0x1p-53; }

static int64_t below(touch_job *job, int64_t count) {
  return (int64_t) (chance(job) * (scalar) count);
}

static scalar dot(const scalar *a, const scalar *b) {
  return a[X] * b[X] + a[Y] * b[Y] + a[Z] * b[Z];
}

static void cross(const scalar *a, const scalar *b, scalar *found) {
  found[X] = a[Y] * b[Z] - a[Z] * b[Y];
  found[Y] = a[Z] * b[X] - a[X] * b[Z];
  found[Z] = a[X] * b[Y] - a[Y] * b[X];
}

static void unit(scalar *a) {
  const scalar over = 1 / sqrt(dot(a, a) + 1e-300);
  int k;
  for (k = 0; k < 3; ++k) a[k] *= over;
}

/* A vector in the object's frame; the palm is its rotation row by row and its origin. */
static void turned(const scalar *palm, const scalar *a, scalar *found) {
  int k;
  for (k = 0; k < 3; ++k) found[k] = dot(palm + 3 * k, a);
}

static void placed(const scalar *palm, const scalar *a, scalar *found) {
  int k;
  for (k = 0; k < 3; ++k) found[k] = dot(palm + 3 * k, a) + palm[9 + k];
}

/* Cell of a point, -1 beyond the grid. */
static int64_t cell_of(const scalar *low, const int64_t *count, const scalar *p) {
  int64_t cell = 0;
  int k;
  for (k = 0; k < 3; ++k) {
    const scalar at = (p[k] - low[k]) / low[3];
    if (!(at >= 0 && at < (scalar) count[k])) return -1;
    cell = cell * count[k] + (int64_t) at;
  }
  return cell;
}

/* What is free about a point beyond a distance to what a grid tells of. Of points beyond the middles
 * of its outer cells it is their distance from these: what is farther away is not known. */
static scalar free_about(const scalar *low, const int64_t *count, const scalar *value,
                         const scalar *p, scalar distance) {
  int64_t cell[3];
  scalar part[3], lower, upper, beyond = -1;
  const scalar *v;
  int k;
  for (k = 0; k < 3; ++k) {
    const scalar at = (p[k] - low[k]) / low[3] - 0.5, over = at - (scalar) (count[k] - 1);
    beyond = -at > beyond ? -at : beyond;
    beyond = over > beyond ? over : beyond;
    cell[k] = (int64_t) at;
    part[k] = at - (scalar) cell[k];
  }
  if (beyond >= 0) return beyond * low[3];
  const int64_t row = count[Z], plane = count[Y] * row;
  v = value + cell[X] * plane + cell[Y] * row + cell[Z];
#define ALONG(i) (v[i] + part[Z] * (v[(i) + 1] - v[i]))
  lower = ALONG(0) + part[Y] * (ALONG(row) - ALONG(0));
  upper = ALONG(plane) + part[Y] * (ALONG(plane + row) - ALONG(plane));
#undef ALONG
  return lower + part[X] * (upper - lower) - distance;
}

/* Whether a segment keeps a distance to what a grid tells of: walked by what is free about it. */
static int keeps(const scalar *low, const int64_t *count, const scalar *value, const scalar *start,
                 const scalar *way, scalar length, scalar distance) {
  scalar t = 0;
  if (!(distance > -INFINITY)) return 1;
  for (;;) {
    const scalar part = length > 0 ? t / length : 0;
    const scalar p[3] = {start[X] + part * way[X], start[Y] + part * way[Y],
                         start[Z] + part * way[Z]};
    const scalar free = free_about(low, count, value, p, distance);
    if (free < 0) return 0;
    if (t >= length || t + free > length) return 1;
    t += free > LEAST_STEP ? free : LEAST_STEP;
    if (t > length) t = length;
  }
}

/* Whether capsules [from, to) keep clear of the object and of what stands about it. */
static int clear_of_all(const touch_job *job, const scalar *palm, const scalar *capsules,
                        int64_t from, int64_t to, int64_t shift, int touches) {
  int64_t i;
  for (i = from; i < to; ++i) {
    const int64_t number = i + shift;
    scalar start[3], way[3];
    placed(palm, capsules + 6 * i, start);
    turned(palm, capsules + 6 * i + 3, way);
    if (!(touches && job->pads[number])
        && !keeps(job->object_low, job->object_count, job->object_value, start, way,
                  job->lengths[number], job->off_object[number])) return 0;
    if (!keeps(job->scene_low, job->scene_count, job->scene_value, start, way,
               job->lengths[number], job->off_scene[number])) return 0;
  }
  return 1;
}

static int finger_clear(const touch_job *job, const scalar *palm, int64_t share, int64_t finger,
                        int64_t posture, int touches) {
  const scalar *capsules = job->capsules + 6 * job->n_capsules * (share * job->postures + posture);
  return clear_of_all(job, palm, capsules, job->first[finger], job->first[finger + 1], 0, touches);
}

static const scalar *pad(const touch_job *job, const scalar *from, int64_t share, int64_t finger,
                         int64_t posture) {
  return from + 3 * ((share * job->postures + posture) * job->n_fingers + finger);
}

static uint64_t *bits(const touch_job *job, int64_t share, int64_t one, int64_t other,
                      int64_t posture) {
  const int64_t row = (share * job->n_fingers + one) * job->n_fingers + other;
  return job->apart + (row * job->postures + posture) * job->words;
}

/* Axes whose last is along a line, the first across it. */
static void axes_about(const scalar *line, scalar *x, scalar *y) {
  const scalar size[3] = {fabs(line[X]), fabs(line[Y]), fabs(line[Z])};
  const int least = size[X] <= size[Y] ? (size[X] <= size[Z] ? X : Z) : (size[Y] <= size[Z] ? Y : Z);
  scalar other[3] = {0, 0, 0};
  other[least] = 1;
  cross(line, other, x);
  unit(x);
  cross(line, x, y);
}

/* The palm that brings two points with normals onto two others; the turn about their line is that
 * which brings the parts of both normals across it together, or any where pads face along it. */
static void match(touch_job *job, const scalar *a, const scalar *b, const scalar *na, const scalar *nb,
                  const scalar *p, const scalar *q, const scalar *np, const scalar *nq, scalar *palm) {
  scalar from[3][3], to[3][3], cosine, sine, over, mean[3], goal[3];
  int i, k;
  for (k = 0; k < 3; ++k) from[2][k] = b[k] - a[k];
  for (k = 0; k < 3; ++k) to[2][k] = q[k] - p[k];
  unit(from[2]);
  unit(to[2]);
  axes_about(from[2], from[0], from[1]);
  axes_about(to[2], to[0], to[1]);
  cosine = dot(from[0], na) * dot(to[0], np) + dot(from[1], na) * dot(to[1], np)
         + dot(from[0], nb) * dot(to[0], nq) + dot(from[1], nb) * dot(to[1], nq);
  sine = dot(from[0], na) * dot(to[1], np) - dot(from[1], na) * dot(to[0], np)
       + dot(from[0], nb) * dot(to[1], nq) - dot(from[1], nb) * dot(to[0], nq);
  over = sqrt(cosine * cosine + sine * sine);
  if (over > ACROSS) {
    cosine /= over;
    sine /= over;
  } else {
    const scalar turn = TURN * chance(job);
    cosine = cos(turn);
    sine = sin(turn);
  }
  for (k = 0; k < 3; ++k) {
    const scalar x = cosine * to[0][k] + sine * to[1][k], y = cosine * to[1][k] - sine * to[0][k];
    for (i = 0; i < 3; ++i) palm[3 * k + i] = x * from[0][i] + y * from[1][i] + to[2][k] * from[2][i];
    mean[k] = (a[k] + b[k]) / 2;
    goal[k] = (p[k] + q[k]) / 2;
  }
  turned(palm, mean, palm + 9);
  for (k = 0; k < 3; ++k) palm[9 + k] = goal[k] - palm[9 + k];
}

/* Whether to try what is as rarely clear as a bin tells. */
static int lucky(touch_job *job, const scalar *clear, const scalar *tried, int64_t bin) {
  scalar best = 0;
  int k;
  for (k = 0; k < BINS; ++k) best = clear[k] > best * tried[k] ? clear[k] / tried[k] : best;
  best = clear[bin] / tried[bin] / best;
  return chance(job) < (best > job->least_often ? best : job->least_often);
}

static int64_t bin_of(scalar value) {
  const int64_t bin = (int64_t) (value * BINS);
  return bin < 0 ? 0 : bin < BINS ? bin : BINS - 1;
}

/* How far a pad's middle at a tip is off the surface by how it leans there; false where it touches
 * nothing. */
static int rests(const touch_job *job, const scalar *palm, int64_t finger, const scalar *tip,
                 const scalar *normal, int64_t sample, const scalar *thumb, scalar *against) {
  const scalar *outward = job->outward + 3 * sample, *at = job->samples + 3 * sample;
  const scalar off[3] = {tip[X] - at[X], tip[Y] - at[Y], tip[Z] - at[Z]};
  scalar faces[3];
  if (!job->inside[sample] || fabs(dot(off, outward) - job->radii[finger]) >= job->near) return 0;
  turned(palm, normal, faces);
  *against = -dot(faces, thumb);
  return -dot(faces, outward) > job->cos_lean[finger];
}

/* A posture for a finger that touches if more are wanted, else one that is clear; -1: none. */
static int64_t posture_for(touch_job *job, const scalar *palm, int64_t share, int64_t finger,
                           const int64_t *postures, const int *there, const scalar *thumb,
                           int wanted, int needed, int64_t *used) {
  const int64_t count = job->postures, turn = below(job, count);
  uint64_t open[MOST_WORDS];
  int64_t candidate[MOST_WORDS * 64], idle[MOST_WORDS * 64], n = 0, n_idle = 0, i, k, w;
  scalar rank[MOST_WORDS * 64];
  for (w = 0; w < job->words; ++w) open[w] = ~(uint64_t) 0;
  for (k = 0; k < job->n_fingers; ++k) {
    const uint64_t *row = bits(job, share, k, finger, postures[k]);
    for (w = 0; there[k] && w < job->words; ++w) open[w] &= row[w];
  }
  for (k = 0; k < count; ++k) {
    const int64_t posture = k + turn < count ? k + turn : k + turn - count;
    scalar tip[3], height, against;
    int64_t cell;
    if (!(open[posture / 64] >> posture % 64 & 1)) continue;
    placed(palm, pad(job, job->points, share, finger, posture), tip);
    cell = cell_of(job->near_low, job->near_count, tip);
    height = cell < 0 ? INFINITY : job->near_height[cell] - job->radii[finger];
    if (height > job->clear) idle[n_idle++] = posture;
    if (!wanted || cell < 0 || fabs(height) > job->near + job->near_low[3]) continue;
    if (!rests(job, palm, finger, tip, pad(job, job->normals, share, finger, posture),
               job->near_sample[cell], thumb, &against)) continue;
    candidate[n] = posture;
    /* Rather one that pushes against the thumb. */
    rank[n++] = chance(job) + 2 * against;
  }
  for (k = 0; k < n && k < job->tries; ++k) {
    int64_t best = 0;
    for (i = 1; i < n; ++i) best = rank[i] > rank[best] ? i : best;
    if (finger_clear(job, palm, share, finger, candidate[best], 1)) {
      *used = 1;
      return candidate[best];
    }
    rank[best] = -INFINITY;
  }
  for (k = 0; !needed && k < n_idle && k < job->tries; ++k) {
    if (finger_clear(job, palm, share, finger, idle[k], 0)) return idle[k];
  }
  return -1;
}

/* The other fingers, in any order. */
static int others_placed(touch_job *job, const scalar *palm, int64_t share, int64_t *postures,
                         int64_t *used, const scalar *thumb) {
  int there[MOST_FINGERS];
  int64_t order[MOST_FINGERS], left = 0, touching = 2, k;
  for (k = 0; k < job->n_fingers; ++k) {
    there[k] = (int) used[k];
    if (!there[k]) order[left++] = k;
  }
  while (left) {
    const int64_t place = below(job, left), finger = order[place];
    order[place] = order[--left];
    postures[finger] = posture_for(job, palm, share, finger, postures, there, thumb,
                                   touching < job->fingers, touching + left < job->fingers,
                                   used + finger);
    if (postures[finger] < 0) return 0;
    there[finger] = 1;
    touching += used[finger];
  }
  return touching == job->fingers;
}

/* One attempt; whether it came to a grasp, which is at the end of the others then. */
static int attempt(touch_job *job) {
  const int64_t *patch = job->patches + 4 * below(job, job->n_patches);
  const int64_t row = patch[2] + below(job, patch[3]), *cell = job->pairs + 4 * row;
  const int64_t share = cell[0], one = job->thumb, other = cell[1];
  const int64_t which[2] = {one, other}, at[2] = {cell[2], cell[3]};
  scalar *palm = job->palms + 12 * job->found, middle[2][3], inward[2][3], faces[3], thumb[3];
  int64_t *postures = job->postured + job->n_fingers * job->found;
  int64_t *used = job->used + job->n_fingers * job->found;
  int64_t depth = bin_of(job->depths[row]), way, k;
  const scalar *point[2], *normal[2];
  int side, clear;
  if (!lucky(job, job->depth_clear, job->depth_tried, depth)) return 0;
  ++job->attempts;
  for (side = 0; side < 2; ++side) {
    const scalar *outward = job->outward + 3 * patch[side];
    for (k = 0; k < 3; ++k) {
      inward[side][k] = -outward[k];
      middle[side][k] = job->samples[3 * patch[side] + k] + job->radii[which[side]] * outward[k];
    }
    point[side] = pad(job, job->points, share, which[side], at[side]);
    normal[side] = pad(job, job->normals, share, which[side], at[side]);
  }
  match(job, point[0], point[1], normal[0], normal[1], middle[0], middle[1], inward[0], inward[1], palm);
  turned(palm, normal[1], faces);
  turned(palm, normal[0], thumb);
  if (dot(thumb, inward[0]) <= job->cos_lean[one]) return 0;
  if (dot(faces, inward[1]) <= job->cos_lean[other]) return 0;
  /* Where the palm's z points, up or down. */
  way = bin_of(0.5 + 0.5 * (palm[2] * job->up[X] + palm[5] * job->up[Y] + palm[8] * job->up[Z]));
  if (!lucky(job, job->way_clear, job->way_tried, way)) return 0;
  ++job->fit;
  clear = clear_of_all(job, palm, job->fixed, 0, job->n_fixed, job->n_capsules, 0)
       && finger_clear(job, palm, share, one, at[0], 1)
       && finger_clear(job, palm, share, other, at[1], 1);
  job->depth_tried[depth] += 1;
  job->depth_clear[depth] += clear;
  job->way_tried[way] += 1;
  job->way_clear[way] += clear;
  if (!clear) return 0;
  ++job->free;
  for (k = 0; k < job->n_fingers; ++k) postures[k] = used[k] = 0;
  used[one] = used[other] = 1;
  postures[one] = at[0];
  postures[other] = at[1];
  job->shared[job->found] = share;
  return others_placed(job, palm, share, postures, used, thumb);
}

DRIVER(touch, touch_job) {
  const scalar limit = monotonic() + job->slice;
  while (job->found < job->wanted && job->attempts < job->most) {
    if (++job->drawn % 1024 == 0 && monotonic() > limit) return SLICE_OVER;
    job->found += attempt(job);
  }
  return DONE;
}

/* Square of the least distance of two segments, each one end and the way to the other (C. Ericson,
 * Real-Time Collision Detection, section 5.1.9). */
static scalar squared(const scalar *one, const scalar *other) {
  const scalar *g = one + 3, *h = other + 3;
  const scalar r[3] = {one[X] - other[X], one[Y] - other[Y], one[Z] - other[Z]};
  const scalar a = dot(g, g), b = dot(h, h), both = dot(g, h), d = dot(g, r), f = dot(h, r);
  scalar s, t, off[3];
  int k;
#define WITHIN(x) fmin(fmax(x, 0), 1)
  t = WITHIN((both * f - b * d) / fmax(a * b - both * both, 1e-30));
  s = WITHIN((both * t + f) / fmax(b, 1e-30));
  t = WITHIN((both * s - d) / fmax(a, 1e-30));
#undef WITHIN
  for (k = 0; k < 3; ++k) off[k] = r[k] + t * g[k] - s * h[k];
  return dot(off, off);
}

/* Clears the bits of postures of two fingers that meet; `attempts` goes on through the postures. */
DRIVER(apart, touch_job) {
  const scalar limit = monotonic() + job->slice;
  for (; job->attempts < job->shares * job->postures; ++job->attempts) {
    const int64_t share = job->attempts / job->postures, i = job->attempts % job->postures;
    const scalar *here = job->capsules + 6 * job->n_capsules * job->attempts;
    int64_t j, k;
    if (monotonic() > limit) return SLICE_OVER;
    for (j = 0; j < job->postures; ++j) {
      const scalar *there = job->capsules + 6 * job->n_capsules * (share * job->postures + j);
      for (k = 0; k < job->n_crossing; ++k) {
        const int64_t *row = job->crossing + 4 * k;
        const scalar *one = here + 6 * row[1], *other = there + 6 * row[3], near = job->reach[k];
        uint64_t *theirs = bits(job, share, row[0], row[2], i) + j / 64;
        const scalar far = near + (job->lengths[row[1]] + job->lengths[row[3]]) / 2;
        const scalar r[3] = {one[X] - other[X] + (one[3] - other[3]) / 2,
                             one[Y] - other[Y] + (one[4] - other[4]) / 2,
                             one[Z] - other[Z] + (one[5] - other[5]) / 2};
        if (!(*theirs >> j % 64 & 1) || far <= 0 || dot(r, r) >= far * far) continue;
        if (near <= 0 || squared(one, other) >= near * near) continue;
        *theirs &= ~((uint64_t) 1 << j % 64);
        bits(job, share, row[2], row[0], j)[i / 64] &= ~((uint64_t) 1 << i % 64);
      }
    }
  }
  return DONE;
}

/* Loads: linear programs max s, W x + s d = 0, sum x + slack = 1, all at least 0, by the predictor and
 * corrector of S. Mehrotra (1992), SIDE of them side by side. They end in the middle of what is
 * optimal: where several edges of a cone would do, these share. */
enum { ROWS = 7, SIDE = 4 };

/* A number of each, and for which of them something holds. */
typedef scalar few __attribute__((vector_size(SIDE * sizeof(scalar)), aligned(16)));
typedef int64_t few_of __attribute__((vector_size(SIDE * sizeof(scalar)), aligned(16)));

#define SMALLEST 1e-14 /* of variables and dual slacks */

/* A share more of the normal matrix's diagonal, for rows that depend on each other, as of contacts on a
 * line; each step is solved so often, for what that leaves. */
#define MORE 1e-14
#define PASSES 2

/* A column of the matrix, its variable and dual slack with their inverses, and the step of both. */
typedef struct {
  few at[ROWS], x, z, over_x, over_z, dual, dx, dz;
} column;

typedef struct {
  const scalar *wrenches;      /* (count / each, 6, edges) W */
  const scalar *directions;    /* (count, 6) d */
  scalar *solved;              /* (count, edges + 2) x, s and slack */
  scalar *work;                /* (edges + 2) columns */
  scalar enough;               /* a mean of x z that is followed by the last step */
  int64_t edges, each, steps, count, next;
  scalar slice;
} load_job;

static few most_of(few a, few b) {
  const few_of first = a > b;
  return (few) ((first & (few_of) a) | (~first & (few_of) b));
}

/* Divides by the matrix of a factor, in place. */
static void divided(few factor[ROWS][ROWS], few *y) {
  int i, k;
  for (i = 0; i < ROWS; ++i) {
    for (k = 0; k < i; ++k) y[i] -= factor[i][k] * y[k];
    y[i] *= factor[i][i];
  }
  for (i = ROWS - 1; i >= 0; --i) {
    for (k = i + 1; k < ROWS; ++k) y[i] -= factor[k][i] * y[k];
    y[i] *= factor[i][i];
  }
}

static few along(const column *c, const few *y) {
  few sum = c->at[0] * y[0];
  int i;
  for (i = 1; i < ROWS; ++i) sum += c->at[i] * y[i];
  return sum;
}

/* Newton's step to where x z is `goal` less dx dz of the step before. */
static void newton(column *all, int64_t n, few factor[ROWS][ROWS], const few *off, few goal, few *y) {
  few rest[ROWS];
  int64_t j;
  int i, pass;
  for (j = 0; j < n; ++j) {
    column *c = all + j;
    c->dz = goal - c->dx * c->dz;
    c->dx = c->dual + c->z - c->dz * c->over_x;
  }
  memset(y, 0, ROWS * sizeof(few));
  for (pass = 0; pass < PASSES; ++pass) {
    for (i = 0; i < ROWS; ++i) rest[i] = off[i];
    for (j = 0; j < n; ++j) {
      const column *c = all + j;
      const few part = c->x * c->over_z * (c->dx - along(c, y));
      for (i = 0; i < ROWS; ++i) rest[i] += c->at[i] * part;
    }
    divided(factor, rest);
    for (i = 0; i < ROWS; ++i) y[i] += rest[i];
  }
  for (j = 0; j < n; ++j) {
    column *c = all + j;
    c->dx = c->x * c->over_z * (along(c, y) - c->dx);
    c->dz = (c->dz - c->z * c->dx) * c->over_x - c->z;
  }
}

/* How far to go, at most once, so that all x and all z stay positive. */
static void longest(const column *all, int64_t n, few *x, few *z) {
  int64_t j;
  *x = *z = (few) {0} + 1;
  for (j = 0; j < n; ++j) {
    *x = most_of(*x, -all[j].dx * all[j].over_x);
    *z = most_of(*z, -all[j].dz * all[j].over_z);
  }
  *x = 1 / *x;
  *z = 1 / *z;
}

/* Factor of A diag(x / z) A', whose diagonal is inverted. */
static void factorised(const column *all, int64_t n, few a[ROWS][ROWS]) {
  int64_t j;
  int i, k, l;
  memset(a, 0, ROWS * ROWS * sizeof(few));
  for (j = 0; j < n; ++j) {
    const few ratio = all[j].x * all[j].over_z;
    for (i = 0; i < ROWS; ++i) {
      const few part = ratio * all[j].at[i];
      for (k = 0; k <= i; ++k) a[i][k] += part * all[j].at[k];
    }
  }
  for (k = 0; k < ROWS; ++k) {
    const few more = MORE * a[k][k] + 1e-300;
    a[k][k] += more;
    for (l = 0; l < k; ++l) a[k][k] -= a[k][l] * a[k][l];
    a[k][k] = most_of(a[k][k], more);
    for (i = 0; i < SIDE; ++i) a[k][k][i] = 1 / sqrt(a[k][k][i]);
    for (i = k + 1; i < ROWS; ++i) {
      for (l = 0; l < k; ++l) a[i][k] -= a[i][l] * a[k][l];
      a[i][k] *= a[k][k];
    }
  }
}

/* One iteration; returns the mean of x z before. */
static few load_step(column *all, int64_t n, few *y) {
  const few nothing = {0};
  few factor[ROWS][ROWS], off[ROWS], dy[ROWS], gap = nothing, after = nothing, x, z;
  int64_t j;
  int i;
  memset(off, 0, sizeof off);
  off[ROWS - 1] += 1;
  for (j = 0; j < n; ++j) {
    column *c = all + j;
    c->over_x = 1 / c->x;
    c->over_z = 1 / c->z;
    c->dx = c->dz = nothing;
    c->dual = -c->z - (j == n - 2);
    for (i = 0; i < ROWS; ++i) {
      off[i] -= c->at[i] * c->x;
      c->dual -= c->at[i] * y[i];
    }
    gap += c->x * c->z;
  }
  factorised(all, n, factor);
  newton(all, n, factor, off, nothing, dy);
  longest(all, n, &x, &z);
  for (j = 0; j < n; ++j) after += (all[j].x + x * all[j].dx) * (all[j].z + z * all[j].dz);
  gap /= (scalar) n;
  after /= gap * (scalar) n;
  newton(all, n, factor, off, after * after * after * gap, dy);
  longest(all, n, &x, &z);
  for (j = 0; j < n; ++j) {
    all[j].x = most_of(all[j].x + 0.99 * x * all[j].dx, nothing + SMALLEST);
    all[j].z = most_of(all[j].z + 0.99 * z * all[j].dz, nothing + SMALLEST);
  }
  for (i = 0; i < ROWS; ++i) y[i] += 0.99 * z * dy[i];
  return gap;
}

DRIVER(loads, load_job) {
  const scalar limit = monotonic() + job->slice;
  const int64_t n = job->edges + 2;
  column *all = (column *) job->work;
  for (; job->next < job->count; job->next += SIDE) {
    const int64_t here = job->count - job->next < SIDE ? job->count - job->next : SIDE;
    int64_t step, j, l, left = here;
    int done[SIDE] = {0}, i;
    few y[ROWS];
    if (monotonic() > limit) return SLICE_OVER;
    memset(y, 0, sizeof y);
    memset(all, 0, (size_t) n * sizeof(column));
    for (l = 0; l < SIDE; ++l) { /* where there are less, the last several times */
      const int64_t number = job->next + (l < here ? l : here - 1);
      const scalar *wrench = job->wrenches + number / job->each * 6 * job->edges;
      for (j = 0; j < n; ++j) {
        for (i = 0; i < 6 && j < job->edges; ++i) all[j].at[i][l] = wrench[i * job->edges + j];
        all[j].at[6][l] = j != job->edges;
        all[j].x[l] = 1 / (scalar) n;
        all[j].z[l] = 1;
      }
      for (i = 0; i < 6; ++i) all[job->edges].at[i][l] = job->directions[6 * number + i];
    }
    for (step = 1; step <= job->steps && left; ++step) {
      const few gap = load_step(all, n, y);
      for (l = 0; l < here; ++l) {
        if (done[l] || (gap[l] >= job->enough && step < job->steps)) continue;
        for (j = 0; j < n; ++j) job->solved[n * (job->next + l) + j] = all[j].x[l];
        done[l] = 1;
        --left;
      }
    }
  }
  return DONE;
}
