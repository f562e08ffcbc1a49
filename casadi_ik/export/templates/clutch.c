/* The clutch of a follower: displacement from the targets of an operator to those of the robot, such that
 * the first target after a pause does not move the robot. Points are translated, and normals and palms are
 * rotated. Each finger and palm is anchored when its first target arrives. */

/* Contacts and palm of a posture in the base frame; rotations are stored row by row. */
typedef struct {
  double points[N_FINGERS][3], normals[N_FINGERS][3];
#if MOVES_PALM
  double p_base_palm[3], R_base_palm[9];
#endif
} measurement;

/* Measures the contacts and the palm of a posture.
 *
 * The residual of a cycle with unused contacts and a palm target of zeros, all with weight 1, consists
 * of points / LENGTH, normals - UNUSED_NORMAL, p_base_palm / LENGTH, and R_base_palm column by column.
 * Equal bounds keep the motors at the posture during this cycle. */
static void measure(@PREFIX@_follower *follower, const double *q, measurement *result) {
  double parameters[sizeof follower->parameters / sizeof(double)];
  double record[sizeof follower->record / sizeof(double)];
  const double *residual = follower->new_state + STATE_RESIDUAL;
  int i, k;
  memcpy(parameters, follower->parameters, sizeof parameters);
  memcpy(record, follower->record, sizeof record);
  set_unused_contacts(follower, 1.0);
#if MOVES_PALM
  memset(follower->parameters + PARAMETER_PALM_POINT, 0, 3 * sizeof(double));
  memset(follower->parameters + PARAMETER_PALM_AXES, 0, 9 * sizeof(double));
  set_palm_weight(follower, 1.0);
#endif
  copy(follower->parameters + PARAMETER_LOWER, q, N_MOTORS);
  copy(follower->parameters + PARAMETER_UPPER, q, N_MOTORS);
  (void) evaluate_cycle_from_rest(follower, q);
  memcpy(follower->parameters, parameters, sizeof parameters);
  memcpy(follower->record, record, sizeof record);
  for (i = 0; i < N_FINGERS; ++i) {
    for (k = 0; k < 3; ++k) {
      result->points[i][k] = LENGTH * residual[3 * i + k];
      result->normals[i][k] = residual[3 * N_FINGERS + 3 * i + k] + UNUSED_NORMAL[k];
    }
  }
#if MOVES_PALM
  residual += 6 * N_FINGERS;
  for (i = 0; i < 3; ++i) {
    result->p_base_palm[i] = LENGTH * residual[i];
    for (k = 0; k < 3; ++k) result->R_base_palm[3 * i + k] = residual[3 + 3 * k + i];
  }
#endif
}

/* Stores a vector of length 1 that is perpendicular to a vector. */
static void unit_perpendicular(const double *a, double *axis) {
  const double x = fabs(a[0]), y = fabs(a[1]), z = fabs(a[2]);
  /* The cross product with the coordinate axis of the smallest component is the longest. */
  const int smallest = x <= y && x <= z ? 0 : y <= z ? 1 : 2;
  const double e[3] = {smallest == 0, smallest == 1, smallest == 2};
  const double cross[3] = {a[1] * e[2] - a[2] * e[1], a[2] * e[0] - a[0] * e[2], a[0] * e[1] - a[1] * e[0]};
  const double length = sqrt(cross[0] * cross[0] + cross[1] * cross[1] + cross[2] * cross[2]);
  int i;
  for (i = 0; i < 3; ++i) axis[i] = cross[i] / length;
}

/* Computes the smallest rotation that turns a vector into the direction of another, row by row. */
static void rotation_between(const double *a, const double *b, double *rotation) {
  const double length = sqrt((a[0] * a[0] + a[1] * a[1] + a[2] * a[2]) * (b[0] * b[0] + b[1] * b[1] + b[2] * b[2]));
  const double cosine = (a[0] * b[0] + a[1] * b[1] + a[2] * b[2]) / length;
  const double v[3] = {(a[1] * b[2] - a[2] * b[1]) / length, (a[2] * b[0] - a[0] * b[2]) / length,
                       (a[0] * b[1] - a[1] * b[0]) / length};
  double axis[3];
  int i, k;
  if (cosine < -1 + 1e-12) { /* half a turn about any perpendicular axis: 2 axis axis' - I */
    unit_perpendicular(a, axis);
    for (i = 0; i < 3; ++i) {
      for (k = 0; k < 3; ++k) rotation[3 * i + k] = 2 * (axis[i] * axis[k]) - (i == k);
    }
    return;
  }
  /* v v' / (1 + cosine) + cosine I + [v]x, where v is the axis times the sine of the angle */
  for (i = 0; i < 3; ++i) {
    for (k = 0; k < 3; ++k) {
      rotation[3 * i + k] = v[i] * v[k] / (1 + cosine) + (i == k ? cosine : 0.0);
    }
  }
  rotation[1] -= v[2];
  rotation[2] += v[1];
  rotation[3] += v[2];
  rotation[5] -= v[0];
  rotation[6] -= v[1];
  rotation[7] += v[0];
}

static int is_new_point(const @PREFIX@_follower *follower, int finger) {
  return follower->parameters[PARAMETER_WEIGHTS + 2 * finger] > 0 && !follower->has_point_offset[finger];
}

static int is_new_normal(const @PREFIX@_follower *follower, int finger) {
  return follower->parameters[PARAMETER_WEIGHTS + 2 * finger + 1] > 0 && !follower->has_normal_rotation[finger];
}

static int is_new_palm(const @PREFIX@_follower *follower) {
#if MOVES_PALM
  return follower->parameters[PARAMETER_PALM_WEIGHT] > 0 && !follower->has_palm_offset;
#else
  (void) follower;
  return 0;
#endif
}

/* Computes the displacements of contacts and palm that are new since the follower was resumed: they lead
 * from the target to the posture at which the motors can rest. */
static void anchor_new_targets(@PREFIX@_follower *follower) {
  const double *parameters = follower->parameters;
  double q[N_MOTORS];
  measurement at_rest;
  int i, k, is_any_new = is_new_palm(follower);
  for (i = 0; i < N_FINGERS; ++i) is_any_new |= is_new_point(follower, i) || is_new_normal(follower, i);
  if (!is_any_new) return;
  posture_at_rest(follower, q);
  measure(follower, q, &at_rest);
  for (i = 0; i < N_FINGERS; ++i) {
    const double *point = parameters + PARAMETER_POINTS + 3 * i, *normal = parameters + PARAMETER_NORMALS + 3 * i;
    if (is_new_point(follower, i)) {
      for (k = 0; k < 3; ++k) follower->point_offsets[i][k] = at_rest.points[i][k] - point[k];
      follower->has_point_offset[i] = 1;
    }
    if (is_new_normal(follower, i)) {
      rotation_between(normal, at_rest.normals[i], follower->normal_rotations[i]);
      follower->has_normal_rotation[i] = 1;
    }
  }
#if MOVES_PALM
  if (is_new_palm(follower)) {
    const double *target = parameters + PARAMETER_PALM_AXES, *R = at_rest.R_base_palm;
    for (i = 0; i < 3; ++i) {
      follower->palm_offset[i] = at_rest.p_base_palm[i] - parameters[PARAMETER_PALM_POINT + i];
      for (k = 0; k < 3; ++k) { /* target' R_base_palm */
        follower->palm_rotation[3 * i + k] = target[i] * R[k] + target[3 + i] * R[3 + k] + target[6 + i] * R[6 + k];
      }
    }
    follower->has_palm_offset = 1;
  }
#endif
}

/* Displaces the target such that the first target after a pause does not move the robot. */
static void displace_target(@PREFIX@_follower *follower) {
  double *parameters = follower->parameters, *weights = parameters + PARAMETER_WEIGHTS;
  int i, k;
  anchor_new_targets(follower);
  for (i = 0; i < N_FINGERS; ++i) {
    double *point = parameters + PARAMETER_POINTS + 3 * i, *normal = parameters + PARAMETER_NORMALS + 3 * i;
    const double *R = follower->normal_rotations[i], n[3] = {normal[0], normal[1], normal[2]};
    for (k = 0; k < 3; ++k) {
      if (weights[2 * i] > 0) point[k] += follower->point_offsets[i][k];
      if (weights[2 * i + 1] > 0) normal[k] = R[3 * k] * n[0] + R[3 * k + 1] * n[1] + R[3 * k + 2] * n[2];
    }
  }
#if MOVES_PALM
  if (parameters[PARAMETER_PALM_WEIGHT] > 0) {
    double axes[9], *target = parameters + PARAMETER_PALM_AXES;
    const double *R = follower->palm_rotation;
    copy(axes, target, 9);
    for (i = 0; i < 3; ++i) {
      parameters[PARAMETER_PALM_POINT + i] += follower->palm_offset[i];
      for (k = 0; k < 3; ++k) {
        target[3 * i + k] = axes[3 * i] * R[k] + axes[3 * i + 1] * R[3 + k] + axes[3 * i + 2] * R[6 + k];
      }
    }
  }
#endif
}
