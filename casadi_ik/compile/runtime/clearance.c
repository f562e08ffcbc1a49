/* Distances of capsules that a step places, from each other and from solids, LANES configurations
 * side by side. The step maps q to the middles and halves of the capsules' segments, and to the
 * poses of the robot's own solids.
 *
 * Of two capsules the distance is exact. Of a capsule and a solid it is that of its segment's point
 * nearest to the solid (deepest inside it), never more than the true one: the signed distance from
 * a convex solid is convex along the segment, and what is given is where two of its tangents meet.
 * From the balls of a cloud it is exact.
 *
 * Expects the macros N_Q, N_CAPSULES, N_OWN (solids of the robot), and the kinds of solids.
 */
enum { MOST_CUTS = 40 };

/* So many planes of a convex solid, which are spread all around, tell whether it is far away. */
enum { FEW = 64 };

/* So many points of a cloud have a ball that holds them, in the row before theirs. */
enum { GROUP = 32 };

/* Where tangents and function agree to this [m], the least is found. */
#define CLOSE (scalar) 1e-7
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

/* Least distance of two segments whose middles are apart by r; a, b: squares of the half lengths. */
LANES_INLINE lanes between(vector r, vector g, vector h, scalar a, scalar b) {
  const lanes both = dot(g, h), d = dot(g, r), f = dot(h, r);
  const lanes det = SPREAD(a * b) - both * both;
  const scalar over_a = a > 0 ? 1 / a : 0, over_b = b > 0 ? 1 / b : 0;
  lanes t = within((both * f - b * d) / larger(det, SPREAD(TINY)));
  lanes s = within((both * t + f) * over_b);
  t = within((both * s - d) * over_a);
  r = minus(at(r, g, t), (vector) {s * h.x, s * h.y, s * h.z});
  return lanes_sqrt(dot(r, r));
}

LANES_INLINE along of_box(const solid *one, vector p, vector h) {
  const lanes zero = SPREAD(0.0);
  const lanes x = lanes_fabs(p.x) - one->size[0], y = lanes_fabs(p.y) - one->size[1];
  const lanes z = lanes_fabs(p.z) - one->size[2];
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

LANES_INLINE along of_cylinder(const solid *one, vector p, vector h) {
  const lanes zero = SPREAD(0.0);
  const lanes from_axis = lanes_sqrt(p.x * p.x + p.y * p.y);
  const lanes around = (p.x * h.x + p.y * h.y) / larger(from_axis, SPREAD(TINY));
  const lanes up = lanes_select(p.z < zero, -h.z, h.z);
  const lanes a = from_axis - one->size[0], b = lanes_fabs(p.z) - one->size[1];
  const lanes oa = larger(a, zero), ob = larger(b, zero);
  const lanes out = lanes_sqrt(oa * oa + ob * ob);
  const lane_mask outside = out > zero;
  const lanes outer = (oa * around + ob * up) / lanes_select(outside, out, SPREAD(1.0));
  const lanes inner = lanes_select(a > b, around, up);
  return (along) {lanes_select(outside, out, larger(a, b)), lanes_select(outside, outer, inner)};
}

/* A convex solid's planes along a segment: a straight line each, of which the highest counts. */
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
  /* Four at a time: each comparison waits for the one before. */
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

/* The lines of some planes; their highest in the middle is what is given. */
static LANES_TARGET lanes of_planes(const scalar *plane, vector c, vector h, lanes *line,
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

/* Without the lines that in no lane still looked at come up to a bound between two places. */
static LANES_TARGET int64_t thinned(envelope planes, lanes low, lanes high, lanes bound,
                                    lane_mask over) {
  int64_t i, kept = 0;
  for (i = 0; i < planes.count; ++i) {
    const lanes value = planes.line[2 * i], slope = planes.line[2 * i + 1];
    const lanes most = larger(value + low * slope, value + high * slope);
    if (lanes_all((most < bound) | over)) continue;
    planes.line[2 * kept] = value;
    planes.line[2 * kept + 1] = slope;
    ++kept;
  }
  return kept;
}

static LANES_TARGET along from_solid(const solid *one, vector c, vector h, envelope planes,
                                     lanes t) {
  const vector p = at(c, h, t);
  if (one->kind == BOX) return of_box(one, p, h);
  if (one->kind == CYLINDER) return of_cylinder(one, p, h);
  return highest(planes, t);
}

/* Lower bound of the least of the convex distance along a segment in the solid's frame. */
static LANES_TARGET lanes lowest(const solid *one, vector c, vector h, envelope planes) {
  const lanes zero = SPREAD(0.0);
  lanes low = SPREAD(-1.0), high = SPREAD(1.0), best, bound, found = zero;
  lane_mask over = (lane_mask) zero;
  along left = from_solid(one, c, h, planes, low), right = from_solid(one, c, h, planes, high);
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
    along here;
    bound = left.value + left.slope * (meet - low);
    /* What a lane comes to does not depend on how long the others take. */
    found = lanes_select(over, found, smaller(bound, best));
    over |= lanes_not(inner) | (best - bound < SPREAD(CLOSE));
    if (cut == MOST_CUTS || lanes_all(over)) break;
    /* Where the tangents meet; every third time the middle, since flat ends creep. */
    t = cut % 3 == 2 ? (low + high) * (scalar) 0.5 : smaller(larger(meet, low), high);
    here = from_solid(one, c, h, planes, t);
    best = smaller(best, here.value);
    left_side = here.slope < zero;
    low = lanes_select(left_side, t, low);
    left.value = lanes_select(left_side, here.value, left.value);
    left.slope = lanes_select(left_side, here.slope, left.slope);
    high = lanes_select(left_side, high, t);
    right.value = lanes_select(left_side, right.value, here.value);
    right.slope = lanes_select(left_side, right.slope, here.slope);
    if (planes.count > 1) planes.count = thinned(planes, low, high, bound - CLOSE, over);
  }
  return lanes_select(inner, found, ends);
}

/* Square of the distance of a point from a segment about c; over: one by the square of its half. */
LANES_INLINE lanes off_point(const scalar *point, vector c, vector h, scalar over) {
  const vector r = {point[0] - c.x, point[1] - c.y, point[2] - c.z};
  const lanes t = within(dot(r, h) * over);
  const vector off = minus(r, (vector) {t * h.x, t * h.y, t * h.z});
  return dot(off, off);
}

/* Distance of a segment from the points of a cloud that are nearer than `near`; else anything above
 * it. What lies in groups that are farther in every lane is not looked at. */
static LANES_TARGET lanes off_cloud(const scalar *row, int64_t count, vector c, vector h,
                                    scalar half, lanes near) {
  const scalar *end = row + 4 * count, over = half > 0 ? 1 / (half * half) : 0;
  lanes best = SPREAD(INFINITY);
  int k;
  for (; row < end; row += 4 * (GROUP + 1)) {
    const lanes far = near + row[3];
    if (lanes_all((off_point(row, c, h, over) >= far * far) | (far < SPREAD(0.0)))) continue;
    for (k = 1; k <= GROUP; ++k) best = smaller(best, off_point(row + 4 * k, c, h, over));
    near = smaller(near, lanes_sqrt(best));
  }
  return lanes_sqrt(best);
}

/* Distance of a capsule's segment from a solid, less `radius`; where the least distances are below
 * what this can be at all, anything above them. */
static LANES_TARGET lanes off_solid(const clearance_job *job, const solid *one, const lanes *pose,
                                    vector c, vector h, scalar half, scalar radius, lanes least,
                                    lanes *lines) {
  const envelope planes = {lines, one->kind == CONVEX ? one->planes : 0};
  const vector x = load(pose), y = load(pose + 3), z = load(pose + 6);
  const vector r = minus(c, load(pose + 9));
  vector place, way;
  lanes sure;
  if (one->kind == HALF_SPACE) {
    const vector up = {x.z, y.z, z.z};
    return dot(up, r) - lanes_fabs(dot(up, h)) - radius;
  }
  sure = least + (one->reach + half + radius);
  if (lanes_all((dot(r, r) >= sure * sure) | (sure < SPREAD(0.0)))) return SPREAD(INFINITY);
  if (one->kind == CAPSULE) {
    const scalar other = one->size[1];
    const vector axis = {x.z * other, y.z * other, z.z * other};
    return between(r, h, axis, half * half, other * other) - (radius + one->size[0]);
  }
  /* The rotation's columns are the solid's axes. */
  place.x = x.x * r.x + y.x * r.y + z.x * r.z;
  place.y = x.y * r.x + y.y * r.y + z.y * r.z;
  place.z = x.z * r.x + y.z * r.y + z.z * r.z;
  way.x = x.x * h.x + y.x * h.y + z.x * h.z;
  way.y = x.y * h.x + y.y * h.y + z.y * h.z;
  way.z = x.z * h.x + y.z * h.y + z.z * h.z;
  if (one->kind == CLOUD) {
    const scalar wide = radius + one->size[0];
    return off_cloud(job->planes + 4 * one->first, one->planes, place, way, half, least + wide)
           - wide;
  }
  if (one->kind == CONVEX) {
    const scalar *plane = job->planes + 4 * one->first;
    const int64_t some = planes.count < FEW ? planes.count : FEW;
    sure = of_planes(plane, place, way, lines, 0, some);
    if (lanes_all(sure - (half + radius) >= least)) return sure - (half + radius);
    sure = larger(sure, of_planes(plane, place, way, lines, some, planes.count));
  } else {
    sure = from_solid(one, place, way, planes, SPREAD(0.0)).value;
  }
  sure -= half + radius;
  if (lanes_all(sure >= least) || half == 0) return sure;
  return lowest(one, place, way, planes) - radius;
}

/* Puts a pair to the end of the recent ones, which is looked at last of them; the first goes. */
static void blocked_by(clearance_job *job, int64_t pair) {
  int k = RECENT - 1, i;
  while (k > 0 && job->recent[k] != pair) --k;
  for (i = k; i < RECENT - 1; ++i) job->recent[i] = job->recent[i + 1];
  job->recent[RECENT - 1] = pair;
}

/* Distance of a pair; 0: in all lanes it is at least `enough`, and not worked out. */
LANES_INLINE int apart(const clearance_job *job, int64_t pair, const lanes *placed, lanes enough,
                       lanes *lines, lanes *distance) {
  const int i = job->pairs[2 * pair], j = job->pairs[2 * pair + 1];
  const vector c = load(placed + 6 * i), h = load(placed + 6 * i + 3);
  const scalar radius = job->radii[i] + job->offsets[pair], half = job->halves[i];
  if (j < N_CAPSULES) {
    const scalar reach = radius + job->radii[j], other = job->halves[j];
    const vector r = minus(c, load(placed + 6 * j));
    const lanes sure = enough + (reach + half + other);
    if (lanes_all((dot(r, r) >= sure * sure) | (sure < SPREAD(0.0)))) return 0;
    *distance = between(r, h, load(placed + 6 * j + 3), half * half, other * other) - reach;
  } else {
    const int64_t number = j - N_CAPSULES;
    *distance = off_solid(job, job->solids + number, placed + 6 * N_CAPSULES + 12 * number, c, h,
                          half, radius, enough, lines);
  }
  return 1;
}

/* What distances of LANES configurations are worked out on. */
typedef struct {
  workspace space;
  lanes *q, *placed;           /* N_Q; the numbers of the step, then the poses of the scene */
  lanes *lines;                /* of a convex solid's planes */
} placing;

/* How many numbers these are. */
static size_t room(const clearance_job *job) {
  int64_t most = 0, k;
  for (k = 0; k < N_OWN + job->n_solids; ++k) {
    if (job->solids[k].kind == CONVEX && job->solids[k].planes > most) {
      most = job->solids[k].planes;
    }
  }
  return (size_t) (N_Q + 6 * N_CAPSULES + 12 * (N_OWN + job->n_solids) + 2 * most);
}

static LANES_TARGET void lay_out(placing *here, const clearance_job *job) {
  int64_t k;
  here->q = here->space.extra;
  here->placed = here->q + N_Q;
  here->lines = here->placed + 6 * N_CAPSULES + 12 * N_OWN;
  for (k = 0; k < 12 * job->n_solids; ++k) *here->lines++ = SPREAD(job->poses[k]);
}

LANES_TARGET DRIVER(clearance, clearance_job) {
  placing here;
  int64_t ticks = 0, k;
  scalar *poses, limit;
  int lane, outcome = set_up(&here.space, room(job));
  if (outcome != DONE) return outcome;
  lay_out(&here, job);
  poses = (scalar *) (here.placed + 6 * N_CAPSULES + 12 * N_OWN);
  limit = monotonic() + job->slice;
  for (; job->next < job->count; job->next += LANES) {
    lanes least = SPREAD(job->most), who = SPREAD(-1.0);
    if (++ticks % CLOCK_INTERVAL == 0 && monotonic() > limit) {
      outcome = SLICE_OVER;
      break;
    }
    for (lane = 0; lane < LANES; ++lane) {
      const int64_t row = job->next + lane < job->count ? job->next + lane : job->count - 1;
      for (k = 0; k < N_Q; ++k) ((scalar *) here.q)[k * LANES + lane] = job->q[row * N_Q + k];
      if (!job->pose_step) continue;
      for (k = 0; k < 12 * job->n_solids; ++k) {
        poses[k * LANES + lane] = job->poses[row * job->pose_step + k];
      }
    }
    here.space.arg[0] = here.q;
    here.space.res[0] = here.placed;
    STEP(here.space.arg, here.space.res, (1 << LANES) - 1);
    /* What was in the way last may be in the way again. */
    for (k = -RECENT; k < job->n_pairs; ++k) {
      const int64_t pair = k < 0 ? job->recent[RECENT + k] : k;
      const lanes enough = job->every ? SPREAD(INFINITY) : least;
      lanes distance;
      lane_mask nearer;
      if (pair < 0 || !apart(job, pair, here.placed, enough, here.lines, &distance)) continue;
      if (job->every) {
        for (lane = 0; lane < LANES && job->next + lane < job->count; ++lane) {
          job->every[(job->next + lane) * job->n_pairs + pair] = lanes_at(distance, lane);
        }
      }
      nearer = distance < least;
      least = lanes_select(nearer, distance, least);
      who = lanes_select(nearer, SPREAD((scalar) pair), who);
      if (lanes_all(least < SPREAD(job->enough))) break;
    }
    for (lane = 0; lane < LANES; ++lane) {
      if (lanes_at(least, lane) < job->enough) blocked_by(job, (int64_t) lanes_at(who, lane));
    }
    for (lane = 0; lane < LANES && job->next + lane < job->count; ++lane) {
      job->least[job->next + lane] = lanes_at(least, lane);
      job->closest[job->next + lane] = (int64_t) lanes_at(who, lane);
    }
  }
  give_back(&here.space);
  return outcome;
}
