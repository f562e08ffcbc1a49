/* Nearest points on a triangle mesh and mean normals of the adjacent triangles.
 *
 * The search uses a complete binary tree of bounding boxes: node i has the children 2 i + 1 and
 * 2 i + 2, and the last `leaves` nodes hold up to LEAF_SIZE triangles each, in the order of the mesh.
 */
enum { LEAF_SIZE = 4, MAX_LEVELS = 64 };

typedef struct {
  const scalar *corners;       /* (t, 3, 3) */
  const scalar *normals;       /* (t, 3) unit */
  const scalar *boxes;         /* (nodes, 6) lower and upper corners; lower > upper for empty boxes */
  const scalar *queries;       /* (count, 3) */
  scalar *feet;                /* (count, 3) nearest points */
  scalar *mean_normals;        /* (count, 3) mean normals of the adjacent triangles */
  scalar *min_cosines;         /* (count) minimum cosines of the mean normals with these normals */
  scalar coincident;           /* maximum distance of adjacent triangles from a nearest point */
  int64_t n_triangles, leaves, count, next;
  scalar slice;
} nearest_job;

/* Return the squared distance from a box, INFINITY for an empty one. */
static scalar square_to_box(const scalar *box, const scalar *p) {
  scalar sum = 0;
  int k;
  for (k = 0; k < 3; ++k) {
    const scalar below = box[k] - p[k], above = p[k] - box[3 + k];
    const scalar distance = below > above ? below : above;
    if (distance > 0) sum += distance * distance;
  }
  return box[0] > box[3] ? INFINITY : sum;
}

/* Compute the nearest point of a segment. */
static void foot_on_segment(const scalar *a, const scalar *b, const scalar *p, scalar *foot) {
  scalar t = 0, square = 0;
  int k;
  for (k = 0; k < 3; ++k) {
    t += (b[k] - a[k]) * (p[k] - a[k]);
    square += (b[k] - a[k]) * (b[k] - a[k]);
  }
  t = square > 0 ? t / square : 0;
  t = t < 0 ? 0 : t > 1 ? 1 : t;
  for (k = 0; k < 3; ++k) foot[k] = a[k] + t * (b[k] - a[k]);
}

static scalar square_between(const scalar *a, const scalar *b) {
  const scalar x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2];
  return x * x + y * y + z * z;
}

/* Compute the nearest point of a triangle: the projection if it is inside, else a point on an edge.
 * Return the squared distance. */
static scalar foot_on_triangle(const nearest_job *job, int64_t triangle, const scalar *p,
                               scalar *foot) {
  const scalar *corner = job->corners + 9 * triangle, *normal = job->normals + 3 * triangle;
  scalar height = 0, best = INFINITY, projection[3], edge_point[3];
  int is_inside = 1, i, k;
  for (k = 0; k < 3; ++k) height += (p[k] - corner[k]) * normal[k];
  for (k = 0; k < 3; ++k) projection[k] = p[k] - height * normal[k];
  for (i = 0; i < 3; ++i) {
    const scalar *a = corner + 3 * i, *b = corner + 3 * ((i + 1) % 3);
    const scalar e[3] = {b[0] - a[0], b[1] - a[1], b[2] - a[2]};
    const scalar d[3] = {projection[0] - a[0], projection[1] - a[1], projection[2] - a[2]};
    is_inside &= normal[0] * (e[1] * d[2] - e[2] * d[1]) + normal[1] * (e[2] * d[0] - e[0] * d[2])
            + normal[2] * (e[0] * d[1] - e[1] * d[0]) >= 0;
  }
  if (is_inside) {
    memcpy(foot, projection, sizeof projection);
    return height * height;
  }
  for (i = 0; i < 3; ++i) {
    scalar square;
    foot_on_segment(corner + 3 * i, corner + 3 * ((i + 1) % 3), p, edge_point);
    square = square_between(edge_point, p);
    if (square < best) {
      best = square;
      memcpy(foot, edge_point, sizeof edge_point);
    }
  }
  return best;
}

/* Compute the nearest point of the mesh. */
static void find_foot(const nearest_job *job, const scalar *p, scalar *foot) {
  int64_t stack[MAX_LEVELS], node, i;
  scalar best = INFINITY, candidate[3];
  int depth = 0;
  stack[depth++] = 0;
  while (depth) {
    node = stack[--depth];
    if (square_to_box(job->boxes + 6 * node, p) >= best) continue;
    if (node >= job->leaves - 1) {
      const int64_t first = LEAF_SIZE * (node - job->leaves + 1);
      for (i = first; i < first + LEAF_SIZE && i < job->n_triangles; ++i) {
        const scalar square = foot_on_triangle(job, i, p, candidate);
        if (square < best) {
          best = square;
          memcpy(foot, candidate, sizeof candidate);
        }
      }
    } else {
      const int64_t child = 2 * node + 1;
      const int nearer = square_to_box(job->boxes + 6 * child, p)
                      <= square_to_box(job->boxes + 6 * (child + 1), p);
      stack[depth++] = child + nearer;     /* the closest child is visited first */
      stack[depth++] = child + !nearer;
    }
  }
}

/* Visit the triangles that are adjacent to a point. The first pass adds their normals to `mean`; the
 * second pass returns the minimum cosine of `mean` with one of them. */
static scalar visit_adjacent(const nearest_job *job, const scalar *p, scalar *mean, int is_second) {
  const scalar reach = job->coincident * job->coincident;
  int64_t stack[MAX_LEVELS], node, i;
  scalar min_cosine = 1, foot[3];
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
    const int64_t first = LEAF_SIZE * (node - job->leaves + 1);
    for (i = first; i < first + LEAF_SIZE && i < job->n_triangles; ++i) {
      const scalar *normal = job->normals + 3 * i;
      if (foot_on_triangle(job, i, p, foot) > reach) continue;
      if (is_second) {
        const scalar cosine = mean[0] * normal[0] + mean[1] * normal[1] + mean[2] * normal[2];
        min_cosine = cosine < min_cosine ? cosine : min_cosine;
      } else {
        for (k = 0; k < 3; ++k) mean[k] += normal[k];
      }
    }
  }
  return min_cosine;
}

DRIVER(nearest, nearest_job) {
  const scalar limit = monotonic() + job->slice;
  int k;
  for (; job->next < job->count; ++job->next) {
    const scalar *p = job->queries + 3 * job->next;
    scalar *foot = job->feet + 3 * job->next, *mean = job->mean_normals + 3 * job->next, length;
    find_foot(job, p, foot);
    for (k = 0; k < 3; ++k) mean[k] = 0;
    visit_adjacent(job, foot, mean, 0);
    length = sqrt(mean[0] * mean[0] + mean[1] * mean[1] + mean[2] * mean[2]);
    for (k = 0; k < 3; ++k) mean[k] = length > 1e-9 ? mean[k] / length : 0;
    job->min_cosines[job->next] = visit_adjacent(job, foot, mean, 1);
    if (job->next % 64 == 63 && monotonic() > limit) {
      ++job->next;
      return SLICE_OVER;
    }
  }
  return DONE;
}
