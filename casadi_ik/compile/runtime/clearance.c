/* Distances of the robot's capsules from each other and from solids, for LANES configurations at a
 * time. The step graph maps q to the centers and half-axes of the capsules' segments, and to the
 * poses of the robot's own solids.
 *
 * The distance of two capsules is exact. The distance of a capsule and a convex solid is a lower
 * bound: the signed distance is convex along the capsule's segment, and its minimum is bounded by
 * the intersection of two tangents. The distance from a point cloud is exact.
 *
 * Requires the macros N_Q, N_CAPSULES, N_OWN (number of the robot's solids), and the kinds of
 * solids.
 */
#ifndef LANES
/* The vocabulary of lanes.c for one solve in standard C, for standalone solvers. */
#define LANES 1
#define LANES_TARGET
#define LANES_INLINE static inline
#define SPREAD(x) ((lanes) (x))
#define lanes_select(mask, yes, no) ((mask) ? (yes) : (no))
#define lanes_all(mask) (mask)
#define lanes_not(mask) (!(mask))
#define lanes_at(x, lane) ((void) (lane), (x))
#define lanes_fabs(x) fabs(x)
#define lanes_sqrt(x) sqrt(x)

typedef scalar lanes;
typedef int lane_mask;
#endif

enum { MAX_CUTS = 40 };

/* Number of planes, spread over all directions, by which a distant convex solid is skipped. */
enum { FIRST_PLANES = 64 };

/* Number of points of a cloud per bounding ball; the ball is the row before its points. */
enum { GROUP = 32 };

/* Tolerance between the tangents' bound and the function's value [m]. */
#define CONVERGED (scalar) 1e-7
#define TINY (scalar) 1e-30

typedef struct { lanes x, y, z; } vector;
typedef struct { lanes value, slope; } along;

LANES_INLINE lanes smaller(lanes a, lanes b) { return lanes_select(a < b, a, b); }
LANES_INLINE lanes larger(lanes a, lanes b) { return lanes_select(a > b, a, b); }
LANES_INLINE lanes within(lanes t) { return larger(smaller(t, SPREAD(1.0)), SPREAD(-1.0)); }
LANES_INLINE lanes dot(vector a, vector b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
LANES_INLINE vector minus(vector a, vector b) {
  return (vector) {a.x - b.x, a.y - b.y, a.z - b.z};
}
LANES_INLINE vector at(vector c, vector h, lanes t) {
  return (vector) {c.x + t * h.x, c.y + t * h.y, c.z + t * h.z};
}
LANES_INLINE vector load(const lanes *from) { return (vector) {from[0], from[1], from[2]}; }

/* Distance of two segments with half-axes g and h, whose centers differ by r; a and b are the
 * squared half lengths. */
LANES_INLINE lanes segment_distance(vector r, vector g, vector h, scalar a, scalar b) {
  const lanes both = dot(g, h), d = dot(g, r), f = dot(h, r);
  const lanes det = SPREAD(a * b) - both * both;
  const scalar over_a = a > 0 ? 1 / a : 0, over_b = b > 0 ? 1 / b : 0;
  lanes t = within((both * f - b * d) / larger(det, SPREAD(TINY)));
  lanes s = within((both * t + f) * over_b);
  t = within((both * s - d) * over_a);
  r = minus(at(r, g, t), (vector) {s * h.x, s * h.y, s * h.z});
  return lanes_sqrt(dot(r, r));
}

LANES_INLINE along box_distance(const solid *shape, vector p, vector h) {
  const lanes zero = SPREAD(0.0);
  const lanes x = lanes_fabs(p.x) - shape->size[0], y = lanes_fabs(p.y) - shape->size[1];
  const lanes z = lanes_fabs(p.z) - shape->size[2];
  const lanes gx = lanes_select(p.x < zero, -h.x, h.x), gy = lanes_select(p.y < zero, -h.y, h.y);
  const lanes gz = lanes_select(p.z < zero, -h.z, h.z);
  const lanes ox = larger(x, zero), oy = larger(y, zero), oz = larger(z, zero);
  const lanes out = lanes_sqrt(ox * ox + oy * oy + oz * oz);
  const lanes deep = larger(larger(x, y), z);
  const lanes inner = lanes_select(x >= deep, gx, lanes_select(y >= deep, gy, gz));
  const lane_mask outside = out > zero;
  const lanes outer = (ox * gx + oy * gy + oz * gz) / lanes_select(outside, out, SPREAD(1.0));
  return (along) {lanes_select(outside, out, deep), lanes_select(outside, outer, inner)};
}

LANES_INLINE along cylinder_distance(const solid *shape, vector p, vector h) {
  const lanes zero = SPREAD(0.0);
  const lanes from_axis = lanes_sqrt(p.x * p.x + p.y * p.y);
  const lanes around = (p.x * h.x + p.y * h.y) / larger(from_axis, SPREAD(TINY));
  const lanes up = lanes_select(p.z < zero, -h.z, h.z);
  const lanes a = from_axis - shape->size[0], b = lanes_fabs(p.z) - shape->size[1];
  const lanes oa = larger(a, zero), ob = larger(b, zero);
  const lanes out = lanes_sqrt(oa * oa + ob * ob);
  const lane_mask outside = out > zero;
  const lanes outer = (oa * around + ob * up) / lanes_select(outside, out, SPREAD(1.0));
  const lanes inner = lanes_select(a > b, around, up);
  return (along) {lanes_select(outside, out, larger(a, b)), lanes_select(outside, outer, inner)};
}

/* The planes of a convex solid along a segment: linear functions, whose maximum is the distance. */
typedef struct { lanes *line; int64_t count; } envelope;

LANES_INLINE along higher_of(along a, along b) {
  const lane_mask higher = b.value > a.value;
  return (along) {lanes_select(higher, b.value, a.value), lanes_select(higher, b.slope, a.slope)};
}

LANES_INLINE along at_line(const lanes *line, lanes t) {
  return (along) {line[0] + t * line[1], line[1]};
}

LANES_INLINE along highest(envelope planes, lanes t) {
  const along none = {SPREAD(-INFINITY), SPREAD(0.0)};
  const lanes *line = planes.line, *end = line + 2 * planes.count;
  /* Four independent chains hide the latency of the comparisons. */
  along a = none, b = none, c = none, d = none;
  for (; line + 8 <= end; line += 8) {
    a = higher_of(a, at_line(line, t));
    b = higher_of(b, at_line(line + 2, t));
    c = higher_of(c, at_line(line + 4, t));
    d = higher_of(d, at_line(line + 6, t));
  }
  for (; line < end; line += 2) a = higher_of(a, at_line(line, t));
  return higher_of(higher_of(a, b), higher_of(c, d));
}

/* Compute the lines of planes first..last; returns their maximum at the segment's center. */
static LANES_TARGET lanes plane_lines(const scalar *plane, vector c, vector h, lanes *line,
                                    int64_t first, int64_t last) {
  lanes most[4];
  int64_t i, k;
  plane += 4 * first;
  line += 2 * first;
  for (k = 0; k < 4; ++k) most[k] = SPREAD(-INFINITY);
  for (i = first; i < last; ++i, plane += 4, line += 2) {
    line[0] = c.x * plane[0] + c.y * plane[1] + c.z * plane[2] - plane[3];
    line[1] = h.x * plane[0] + h.y * plane[1] + h.z * plane[2];
    most[i % 4] = larger(most[i % 4], line[0]);
  }
  return larger(larger(most[0], most[1]), larger(most[2], most[3]));
}

/* Remove the lines that stay below a bound between `low` and `high` in every unfinished lane;
 * returns the number of remaining lines. */
static LANES_TARGET int64_t remove_low_lines(envelope planes, lanes low, lanes high, lanes bound,
                                    lane_mask finished) {
  int64_t i, count = 0;
  for (i = 0; i < planes.count; ++i) {
    const lanes value = planes.line[2 * i], slope = planes.line[2 * i + 1];
    const lanes most = larger(value + low * slope, value + high * slope);
    if (lanes_all((most < bound) | finished)) continue;
    planes.line[2 * count] = value;
    planes.line[2 * count + 1] = slope;
    ++count;
  }
  return count;
}

static LANES_TARGET along distance_along(const solid *shape, vector c, vector h, envelope planes,
                                     lanes t) {
  const vector p = at(c, h, t);
  if (shape->kind == BOX) return box_distance(shape, p, h);
  if (shape->kind == CYLINDER) return cylinder_distance(shape, p, h);
  return highest(planes, t);
}

/* Lower bound of the minimum of the convex distance along a segment, in the frame of the solid. */
static LANES_TARGET lanes min_along(const solid *shape, vector c, vector h, envelope planes) {
  const lanes zero = SPREAD(0.0);
  lanes low = SPREAD(-1.0), high = SPREAD(1.0), best, bound, result = zero;
  lane_mask finished = (lane_mask) zero;
  along left = distance_along(shape, c, h, planes, low);
  along right = distance_along(shape, c, h, planes, high);
  const lane_mask falls = left.slope < zero, rises = right.slope > zero;
  const lanes ends = lanes_select(falls, right.value, left.value);
  const lane_mask inner = falls & rises;
  int cut;
  best = smaller(left.value, right.value);
  for (cut = 0;; ++cut) {
    const lanes steep = lanes_select(inner, left.slope - right.slope, SPREAD(-1.0));
    const lanes meet =
        (right.value - left.value + left.slope * low - right.slope * high) / steep;
    lanes t;
    lane_mask left_side;
    along sample;
    bound = left.value + left.slope * (meet - low);
    /* The result of a lane must not depend on the number of cuts of the others. */
    result = lanes_select(finished, result, smaller(bound, best));
    finished |= lanes_not(inner) | (best - bound < SPREAD(CONVERGED));
    if (cut == MAX_CUTS || lanes_all(finished)) break;
    /* Cut where the tangents meet; bisect every third time: cuts converge slowly at flat ends. */
    t = cut % 3 == 2 ? (low + high) * (scalar) 0.5 : smaller(larger(meet, low), high);
    sample = distance_along(shape, c, h, planes, t);
    best = smaller(best, sample.value);
    left_side = sample.slope < zero;
    low = lanes_select(left_side, t, low);
    left.value = lanes_select(left_side, sample.value, left.value);
    left.slope = lanes_select(left_side, sample.slope, left.slope);
    high = lanes_select(left_side, high, t);
    right.value = lanes_select(left_side, right.value, sample.value);
    right.slope = lanes_select(left_side, right.slope, sample.slope);
    if (planes.count > 1) {
      planes.count = remove_low_lines(planes, low, high, bound - CONVERGED, finished);
    }
  }
  return lanes_select(inner, result, ends);
}

/* Squared distance of a point from a segment centered at c; `inverse_square` is
 * 1 / half length^2, or 0. */
LANES_INLINE lanes point_distance_squared(const scalar *point, vector c, vector h,
                                          scalar inverse_square) {
  const vector r = {point[0] - c.x, point[1] - c.y, point[2] - c.z};
  const lanes t = within(dot(r, h) * inverse_square);
  const vector offset = minus(r, (vector) {t * h.x, t * h.y, t * h.z});
  return dot(offset, offset);
}

/* Distance of a segment from a cloud if it is below `near`, else any value above `near`. Groups
 * that are farther in every lane are skipped. */
static LANES_TARGET lanes cloud_distance(const scalar *row, int64_t count, vector c, vector h,
                                    scalar half, lanes near) {
  const scalar *end = row + 4 * count, inverse_square = half > 0 ? 1 / (half * half) : 0;
  lanes best = SPREAD(INFINITY);
  int k;
  for (; row < end; row += 4 * (GROUP + 1)) {
    const lanes cutoff = near + row[3];
    const lanes ball = point_distance_squared(row, c, h, inverse_square);
    if (lanes_all((ball >= cutoff * cutoff) | (cutoff < SPREAD(0.0)))) continue;
    for (k = 1; k <= GROUP; ++k) {
      best = smaller(best, point_distance_squared(row + 4 * k, c, h, inverse_square));
    }
    near = smaller(near, lanes_sqrt(best));
  }
  return lanes_sqrt(best);
}

/* Distance of a segment from a solid, minus `radius`; any value above `least` if the distance
 * cannot be below `least` in any lane. */
static LANES_TARGET lanes solid_distance(const clearance_job *job, const solid *shape,
                                         const lanes *pose, vector c, vector h, scalar half,
                                         scalar radius, lanes least, lanes *lines) {
  const envelope planes = {lines, shape->kind == CONVEX ? shape->planes : 0};
  const vector x = load(pose), y = load(pose + 3), z = load(pose + 6);
  const vector r = minus(c, load(pose + 9));
  vector center, half_axis;
  lanes bound;
  if (shape->kind == HALF_SPACE) {
    const vector up = {x.z, y.z, z.z};
    return dot(up, r) - lanes_fabs(dot(up, h)) - radius;
  }
  bound = least + (shape->reach + half + radius);
  if (lanes_all((dot(r, r) >= bound * bound) | (bound < SPREAD(0.0)))) return SPREAD(INFINITY);
  if (shape->kind == CAPSULE) {
    const scalar other = shape->size[1];
    const vector axis = {x.z * other, y.z * other, z.z * other};
    return segment_distance(r, h, axis, half * half, other * other) - (radius + shape->size[0]);
  }
  /* Columns of the rotation are the axes of the solid. */
  center.x = x.x * r.x + y.x * r.y + z.x * r.z;
  center.y = x.y * r.x + y.y * r.y + z.y * r.z;
  center.z = x.z * r.x + y.z * r.y + z.z * r.z;
  half_axis.x = x.x * h.x + y.x * h.y + z.x * h.z;
  half_axis.y = x.y * h.x + y.y * h.y + z.y * h.z;
  half_axis.z = x.z * h.x + y.z * h.y + z.z * h.z;
  if (shape->kind == CLOUD) {
    const scalar thickness = radius + shape->size[0];
    const scalar *points = job->planes + 4 * shape->first;
    return cloud_distance(points, shape->planes, center, half_axis, half, least + thickness)
           - thickness;
  }
  if (shape->kind == CONVEX) {
    const scalar *plane = job->planes + 4 * shape->first;
    const int64_t count = planes.count < FIRST_PLANES ? planes.count : FIRST_PLANES;
    bound = plane_lines(plane, center, half_axis, lines, 0, count);
    if (lanes_all(bound - (half + radius) >= least)) return bound - (half + radius);
    bound = larger(bound, plane_lines(plane, center, half_axis, lines, count, planes.count));
  } else {
    bound = distance_along(shape, center, half_axis, planes, SPREAD(0.0)).value;
  }
  bound -= half + radius;
  if (lanes_all(bound >= least) || half == 0) return bound;
  return min_along(shape, center, half_axis, planes) - radius;
}

/* Append a pair to the recently critical ones, and evict the oldest. */
static void mark_critical(clearance_job *job, int64_t pair) {
  int k = RECENT - 1, i;
  while (k > 0 && job->recent[k] != pair) --k;
  for (i = k; i < RECENT - 1; ++i) job->recent[i] = job->recent[i + 1];
  job->recent[RECENT - 1] = pair;
}

/* Compute the distance of a pair; returns 0 without a distance if it is at least `enough` in all
 * lanes. */
LANES_INLINE int pair_distance(const clearance_job *job, int64_t pair, const lanes *placed, lanes enough,
                       lanes *lines, lanes *distance) {
  const int i = job->pairs[2 * pair], j = job->pairs[2 * pair + 1];
  const vector c = load(placed + 6 * i), h = load(placed + 6 * i + 3);
  const scalar radius = job->radii[i] + job->offsets[pair], half = job->halves[i];
  if (j < N_CAPSULES) {
    const scalar reach = radius + job->radii[j], other = job->halves[j];
    const vector r = minus(c, load(placed + 6 * j));
    const lanes sure = enough + (reach + half + other);
    if (lanes_all((dot(r, r) >= sure * sure) | (sure < SPREAD(0.0)))) return 0;
    *distance =
        segment_distance(r, h, load(placed + 6 * j + 3), half * half, other * other) - reach;
  } else {
    const int64_t number = j - N_CAPSULES;
    *distance = solid_distance(job, job->solids + number, placed + 6 * N_CAPSULES + 12 * number,
                               c, h, half, radius, enough, lines);
  }
  return 1;
}

/* Memory for the distances of LANES configurations. */
typedef struct {
  workspace space;
  lanes *q, *placed;           /* N_Q; outputs of the step graph, then the poses of the scene */
  lanes *lines;                /* values and slopes of a convex solid's planes */
} placing;

/* Return the number of values in this memory. */
static size_t work_size(const clearance_job *job) {
  int64_t max_planes = 0, k;
  for (k = 0; k < N_OWN + job->n_solids; ++k) {
    if (job->solids[k].kind == CONVEX && job->solids[k].planes > max_planes) {
      max_planes = job->solids[k].planes;
    }
  }
  return (size_t) (N_Q + 6 * N_CAPSULES + 12 * (N_OWN + job->n_solids) + 2 * max_planes);
}

static LANES_TARGET void lay_out(placing *buffers, const clearance_job *job) {
  int64_t k;
  buffers->q = buffers->space.extra;
  buffers->placed = buffers->q + N_Q;
  buffers->lines = buffers->placed + 6 * N_CAPSULES + 12 * N_OWN;
  for (k = 0; k < 12 * job->n_solids; ++k) *buffers->lines++ = SPREAD(job->poses[k]);
}

LANES_TARGET DRIVER(clearance, clearance_job) {
  placing buffers;
  int64_t ticks = 0, k;
  scalar *poses, deadline;
  int lane, outcome = set_up(&buffers.space, work_size(job));
  if (outcome != DONE) return outcome;
  lay_out(&buffers, job);
  poses = (scalar *) (buffers.placed + 6 * N_CAPSULES + 12 * N_OWN);
  deadline = monotonic() + job->slice;
  for (; job->next < job->count; job->next += LANES) {
    lanes minimum = SPREAD(job->max_distance), closest = SPREAD(-1.0);
    if (++ticks % CLOCK_INTERVAL == 0 && monotonic() > deadline) {
      outcome = SLICE_OVER;
      break;
    }
    for (lane = 0; lane < LANES; ++lane) {
      const int64_t row = job->next + lane < job->count ? job->next + lane : job->count - 1;
      for (k = 0; k < N_Q; ++k) ((scalar *) buffers.q)[k * LANES + lane] = job->q[row * N_Q + k];
      if (!job->pose_step) continue;
      for (k = 0; k < 12 * job->n_solids; ++k) {
        poses[k * LANES + lane] = job->poses[row * job->pose_step + k];
      }
    }
    buffers.space.arg[0] = buffers.q;
    buffers.space.res[0] = buffers.placed;
    STEP(buffers.space.arg, buffers.space.res, (1 << LANES) - 1);
    /* Recently critical pairs are likely to be critical again. */
    for (k = -RECENT; k < job->n_pairs; ++k) {
      const int64_t pair = k < 0 ? job->recent[RECENT + k] : k;
      const lanes cutoff = job->all_distances ? SPREAD(INFINITY) : minimum;
      lanes distance;
      lane_mask nearer;
      if (pair < 0 || !pair_distance(job, pair, buffers.placed, cutoff, buffers.lines, &distance)) continue;
      if (job->all_distances) {
        for (lane = 0; lane < LANES && job->next + lane < job->count; ++lane) {
          job->all_distances[(job->next + lane) * job->n_pairs + pair] = lanes_at(distance, lane);
        }
      }
      nearer = distance < minimum;
      minimum = lanes_select(nearer, distance, minimum);
      closest = lanes_select(nearer, SPREAD((scalar) pair), closest);
      if (lanes_all(minimum < SPREAD(job->stop_below))) break;
    }
    for (lane = 0; lane < LANES; ++lane) {
      if (lanes_at(minimum, lane) < job->stop_below) {
        mark_critical(job, (int64_t) lanes_at(closest, lane));
      }
    }
    for (lane = 0; lane < LANES && job->next + lane < job->count; ++lane) {
      job->distances[job->next + lane] = lanes_at(minimum, lane);
      job->closest_pairs[job->next + lane] = (int64_t) lanes_at(closest, lane);
    }
  }
  give_back(&buffers.space);
  return outcome;
}
