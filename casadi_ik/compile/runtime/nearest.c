/* Nearest points on a triangle mesh, by a tree of bounding boxes, and the triangles that meet there.
 *
 * The tree is complete and binary: node i has the children 2 i + 1 and 2 i + 2, and the last
 * `leaves` nodes hold up to LEAF triangles each, in the order in which they are given.
 */
enum { LEAF = 4, MOST_LEVELS = 64 };

typedef struct {
  const scalar *corners;       /* (t, 3, 3) */
  const scalar *normals;       /* (t, 3) unit */
  const scalar *boxes;         /* (nodes, 6) lower and upper corner; empty ones are inverted */
  const scalar *queries;       /* (count, 3) */
  scalar *feet;                /* (count, 3) nearest points */
  scalar *ways;                /* (count, 3) mean normals of the triangles that meet there */
  scalar *spread;              /* (count) least cosine of that normal with one of theirs */
  scalar coincident;           /* triangles meet at a point if they are this near to it */
  int64_t n_triangles, leaves, count, next;
  scalar slice;
} nearest_job;

static scalar square_to_box(const scalar *box, const scalar *p) {
  scalar sum = 0;
  int k;
  for (k = 0; k < 3; ++k) {
    const scalar below = box[k] - p[k], above = p[k] - box[3 + k];
    const scalar out = below > above ? below : above;
    if (out > 0) sum += out * out;
  }
  return box[0] > box[3] ? INFINITY : sum;
}

/* The nearest point of a segment. */
static void foot_on_segment(const scalar *a, const scalar *b, const scalar *p, scalar *foot) {
  scalar along = 0, square = 0;
  int k;
  for (k = 0; k < 3; ++k) {
    along += (b[k] - a[k]) * (p[k] - a[k]);
    square += (b[k] - a[k]) * (b[k] - a[k]);
  }
  along = square > 0 ? along / square : 0;
  along = along < 0 ? 0 : along > 1 ? 1 : along;
  for (k = 0; k < 3; ++k) foot[k] = a[k] + along * (b[k] - a[k]);
}

static scalar square_between(const scalar *a, const scalar *b) {
  const scalar x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2];
  return x * x + y * y + z * z;
}

/* The nearest point of a triangle: its projection if that is inside, else on the nearest edge.
 * Returns the squared distance. */
static scalar foot_on_triangle(const nearest_job *job, int64_t triangle, const scalar *p,
                               scalar *foot) {
  const scalar *corner = job->corners + 9 * triangle, *normal = job->normals + 3 * triangle;
  scalar height = 0, best = INFINITY, projection[3], other[3];
  int inside = 1, i, k;
  for (k = 0; k < 3; ++k) height += (p[k] - corner[k]) * normal[k];
  for (k = 0; k < 3; ++k) projection[k] = p[k] - height * normal[k];
  for (i = 0; i < 3; ++i) {
    const scalar *a = corner + 3 * i, *b = corner + 3 * ((i + 1) % 3);
    const scalar e[3] = {b[0] - a[0], b[1] - a[1], b[2] - a[2]};
    const scalar d[3] = {projection[0] - a[0], projection[1] - a[1], projection[2] - a[2]};
    inside &= normal[0] * (e[1] * d[2] - e[2] * d[1]) + normal[1] * (e[2] * d[0] - e[0] * d[2])
            + normal[2] * (e[0] * d[1] - e[1] * d[0]) >= 0;
  }
  if (inside) {
    memcpy(foot, projection, sizeof projection);
    return height * height;
  }
  for (i = 0; i < 3; ++i) {
    scalar square;
    foot_on_segment(corner + 3 * i, corner + 3 * ((i + 1) % 3), p, other);
    square = square_between(other, p);
    if (square < best) {
      best = square;
      memcpy(foot, other, sizeof other);
    }
  }
  return best;
}

/* Finds the nearest point. */
static void find_foot(const nearest_job *job, const scalar *p, scalar *foot) {
  int64_t stack[MOST_LEVELS], node, i;
  scalar best = INFINITY, candidate[3];
  int depth = 0;
  stack[depth++] = 0;
  while (depth) {
    node = stack[--depth];
    if (square_to_box(job->boxes + 6 * node, p) >= best) continue;
    if (node >= job->leaves - 1) {
      const int64_t first = LEAF * (node - job->leaves + 1);
      for (i = first; i < first + LEAF && i < job->n_triangles; ++i) {
        const scalar square = foot_on_triangle(job, i, p, candidate);
        if (square < best) {
          best = square;
          memcpy(foot, candidate, sizeof candidate);
        }
      }
    } else {
      const int64_t left = 2 * node + 1;
      const int nearer = square_to_box(job->boxes + 6 * left, p)
                      <= square_to_box(job->boxes + 6 * (left + 1), p);
      stack[depth++] = left + nearer;      /* the nearer child is visited first */
      stack[depth++] = left + !nearer;
    }
  }
}

/* Adds the normals of the triangles that meet at a point to `way`; or, in the second pass, takes the
 * least cosine of `way` with one of them. */
static scalar gather(const nearest_job *job, const scalar *p, scalar *way, int second) {
  const scalar reach = job->coincident * job->coincident;
  int64_t stack[MOST_LEVELS], node, i;
  scalar least = 1, foot[3];
  int depth = 0, k;
  stack[depth++] = 0;
  while (depth) {
    node = stack[--depth];
    if (square_to_box(job->boxes + 6 * node, p) > reach) continue;
    if (node < job->leaves - 1) {
      stack[depth++] = 2 * node + 2;
      stack[depth++] = 2 * node + 1;
      continue;
    }
    const int64_t first = LEAF * (node - job->leaves + 1);
    for (i = first; i < first + LEAF && i < job->n_triangles; ++i) {
      const scalar *normal = job->normals + 3 * i;
      if (foot_on_triangle(job, i, p, foot) > reach) continue;
      if (second) {
        const scalar cosine = way[0] * normal[0] + way[1] * normal[1] + way[2] * normal[2];
        least = cosine < least ? cosine : least;
      } else {
        for (k = 0; k < 3; ++k) way[k] += normal[k];
      }
    }
  }
  return least;
}

DRIVER(nearest, nearest_job) {
  const scalar limit = monotonic() + job->slice;
  int k;
  for (; job->next < job->count; ++job->next) {
    const scalar *p = job->queries + 3 * job->next;
    scalar *foot = job->feet + 3 * job->next, *way = job->ways + 3 * job->next, length;
    find_foot(job, p, foot);
    for (k = 0; k < 3; ++k) way[k] = 0;
    gather(job, foot, way, 0);
    length = sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2]);
    for (k = 0; k < 3; ++k) way[k] = length > 1e-9 ? way[k] / length : 0;
    job->spread[job->next] = gather(job, foot, way, 1);
    if (job->next % 64 == 63 && monotonic() > limit) {
      ++job->next;
      return SLICE_OVER;
    }
  }
  return DONE;
}
