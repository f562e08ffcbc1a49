/* Search for the configurations nearest to contacts that are out of reach.
 *
 * Stages: seeds from tables of arm and finger postures; a race, in which all starts make a few steps
 * of the descent; the finish, in which the best ones continue to their minima; the choice.
 *
 * The cost of an arm posture with a rigid hand is linear in 16 features of its palm pose: |p|^2, p,
 * R^T p and R. The cost of a finger posture is linear in 13 features: |p|^2, p, and the axes of its
 * contact frame. Sums have a fixed order, so that results are reproducible.
 */
#include <math.h>

enum { SEED_STAGE, RACE_STAGE, FINISH_STAGE, CHOICE_STAGE };
enum { TILE = 32, ARM_FEATURES = 16, FINGER_FEATURES = 13 };

/* Computes linear costs of all rows of a table. */
LOOPS static void table_costs(const float *features, const float *coefficients, int64_t n_features,
                              int64_t n_rows, float *costs) {
  int64_t row, j;
  int i;
  for (row = 0; row < n_rows; row += TILE) {
    float sums[TILE] = {0};
    for (j = 0; j < n_features; ++j, features += TILE) {
      for (i = 0; i < TILE; ++i) sums[i] += coefficients[j] * features[i];
    }
    memcpy(costs + row, sums, sizeof sums);
  }
}

/* Returns the row with the smallest cost, the first of equal ones. */
LOOPS static int64_t cheapest_row(const float *costs, int64_t n_rows) {
  float minima[TILE], minimum;
  int64_t row;
  int i;
  memcpy(minima, costs, sizeof minima);
  for (row = TILE; row < n_rows; row += TILE) {
    for (i = 0; i < TILE; ++i) minima[i] = costs[row + i] < minima[i] ? costs[row + i] : minima[i];
  }
  minimum = minima[0];
  for (i = 1; i < TILE; ++i) minimum = minima[i] < minimum ? minima[i] : minimum;
  for (row = 0; row < n_rows; ++row) {
    if (costs[row] <= minimum) return row;
  }
  return 0;
}

/* Inserts a row into the list of the `capacity` smallest values; among equal ones the first is kept.
 * Returns the new length. */
static int64_t insert_sorted(scalar value, int64_t row, scalar *values, int64_t *rows,
                             int64_t length, int64_t capacity) {
  int64_t i;
  if (length == capacity && !(value < values[length - 1])) return length;
  i = length < capacity ? length++ : length - 1;
  for (; i > 0 && value < values[i - 1]; --i) {
    values[i] = values[i - 1];
    rows[i] = rows[i - 1];
  }
  values[i] = value;
  rows[i] = row;
  return length;
}

/* Goal of a contact: point and axes (in rows) in some frame, weights of their squared errors. */
typedef struct {
  scalar point[3], axes[9], point_weight, axis_weights[3];
} contact_goal;

static contact_goal goal_of(const nearest_search_job *job, const scalar *parameters, int64_t finger) {
  const scalar *point = parameters + job->points + 3 * finger;
  const scalar *normal = parameters + job->normals + 3 * finger;
  const scalar *tangent = parameters + job->tangents + 3 * finger;
  const scalar *weights = parameters + job->weights + 2 * finger;
  const scalar position_weight = weights[0] / job->length;
  contact_goal goal = {{0}};
  int i, has_tangent = 0;
  for (i = 0; i < 3; ++i) goal.point[i] = point[i], goal.axes[i] = normal[i];
  if (job->tangents >= 0) {
    has_tangent = tangent[0] * tangent[0] + tangent[1] * tangent[1] + tangent[2] * tangent[2] > 0.5;
  }
  if (has_tangent) {
    for (i = 0; i < 3; ++i) {
      const int j = (i + 1) % 3, k = (i + 2) % 3;
      goal.axes[3 + i] = tangent[i];
      goal.axes[6 + i] = normal[j] * tangent[k] - normal[k] * tangent[j];
    }
  }
  goal.point_weight = position_weight * position_weight;
  for (i = 0; i < 3; ++i) {
    goal.axis_weights[i] = weights[1] * weights[1] * (has_tangent ? 0.5 : i == 0);
  }
  return goal;
}

/* Writes the coefficients of the cost of a rigid hand; constants are omitted. */
static void arm_coefficients(const nearest_search_job *job, int64_t target, float *result) {
  const scalar *parameters = job->parameters + target * job->n_parameters;
  const scalar *points = job->rigid_points + job->rigid_step * target * 3 * job->n_fingers;
  const scalar *axes = job->rigid_axes + job->rigid_step * target * 9 * job->n_fingers;
  int64_t palm, finger;
  int i, j, k;
  for (palm = 0; palm < job->n_palms; ++palm, result += ARM_FEATURES) {
    scalar sums[ARM_FEATURES] = {0};
    for (finger = 0; finger < job->n_fingers; ++finger) {
      const scalar *point = points + 3 * finger, *axis = axes + 9 * finger;
      const contact_goal goal = goal_of(job, parameters, finger);
      const scalar weight = goal.point_weight;
      if (job->palm_of_finger[finger] != palm) continue;
      sums[0] += weight;
      for (i = 0; i < 3; ++i) {
        sums[1 + i] -= 2 * weight * goal.point[i];
        sums[4 + i] += 2 * weight * point[i];
        for (j = 0; j < 3; ++j) {
          scalar sum = weight * goal.point[i] * point[j];
          for (k = 0; k < 3; ++k) sum += goal.axis_weights[k] * goal.axes[3 * k + i] * axis[3 * k + j];
          sums[7 + 3 * i + j] -= 2 * sum;
        }
      }
    }
    for (i = 0; i < ARM_FEATURES; ++i) result[i] = (float) sums[i];
  }
}

/* Selects the best arm postures of different regions. Returns their number. */
static int64_t find_arms(nearest_search_job *job, int64_t target) {
  const int64_t n = job->n_samples * job->regions;
  float *lowest = job->costs + n;
  int64_t length = 0, region, sample;
  arm_coefficients(job, target, job->coefficients);
  table_costs(job->arm_features, job->coefficients, ARM_FEATURES * job->n_palms, n, job->costs);
  memcpy(lowest, job->costs, (size_t) job->regions * sizeof *lowest);
  for (sample = 1; sample < job->n_samples; ++sample) {
    const float *costs = job->costs + sample * job->regions;
    for (region = 0; region < job->regions; ++region) {
      lowest[region] = costs[region] < lowest[region] ? costs[region] : lowest[region];
    }
  }
  for (region = 0; region < job->regions; ++region) {
    length = insert_sorted((scalar) lowest[region], region, job->sorted_values, job->sorted, length,
                           job->n_candidates);
  }
  for (region = 0; region < length; ++region) {
    int64_t row = job->sorted[region];
    while (!(job->costs[row] <= lowest[job->sorted[region]]) && row + job->regions < n) {
      row += job->regions;
    }
    job->rows[region * (1 + job->n_groups)] = row;
  }
  return length;
}

/* Returns a feature of the arm table. */
static scalar arm_feature(const nearest_search_job *job, int64_t row, int64_t feature) {
  const int64_t n_features = ARM_FEATURES * job->n_palms;
  return (scalar) job->arm_features[(row / TILE * n_features + feature) * TILE + row % TILE];
}

/* Expresses a goal in the frame of the palm of an arm posture; returns the constant of its cost. */
static scalar move_to_palm(const nearest_search_job *job, int64_t row, int64_t palm,
                           contact_goal *goal) {
  scalar rotation[9], offset[3], square = 0;
  contact_goal moved = *goal;
  int i, k;
  for (i = 0; i < 9; ++i) rotation[i] = arm_feature(job, row, ARM_FEATURES * palm + 7 + i);
  for (i = 0; i < 3; ++i) {
    offset[i] = goal->point[i] - arm_feature(job, row, ARM_FEATURES * palm + 1 + i);
    square += offset[i] * offset[i];
  }
  for (i = 0; i < 3; ++i) {
    moved.point[i] = rotation[i] * offset[0] + rotation[3 + i] * offset[1] + rotation[6 + i] * offset[2];
    for (k = 0; k < 9; k += 3) {
      moved.axes[k + i] = rotation[i] * goal->axes[k] + rotation[3 + i] * goal->axes[k + 1]
                        + rotation[6 + i] * goal->axes[k + 2];
    }
  }
  *goal = moved;
  return goal->point_weight * square;
}

/* Chooses the best row of each group of fingers for an arm posture; returns the cost. */
static scalar choose_fingers(nearest_search_job *job, int64_t target, int64_t *rows) {
  const scalar *parameters = job->parameters + target * job->n_parameters;
  scalar cost = 0;
  int64_t g, finger;
  int i;
  for (g = 0; g < job->n_groups; ++g) {
    const finger_group *group = job->groups + g;
    float *next = job->coefficients;
    for (finger = 0; finger < group->n_fingers; ++finger, next += FINGER_FEATURES) {
      const int64_t number = group->fingers[finger];
      contact_goal goal = goal_of(job, parameters, number);
      cost += move_to_palm(job, rows[0], job->palm_of_finger[number], &goal);
      next[0] = (float) goal.point_weight;
      for (i = 0; i < 3; ++i) next[1 + i] = (float) (-2 * goal.point_weight * goal.point[i]);
      for (i = 0; i < 9; ++i) next[4 + i] = (float) (-2 * goal.axis_weights[i / 3] * goal.axes[i]);
    }
    table_costs(group->features, job->coefficients, FINGER_FEATURES * group->n_fingers, group->n_rows,
                job->costs);
    rows[1 + g] = cheapest_row(job->costs, group->n_rows);
    cost += (scalar) job->costs[rows[1 + g]];
  }
  return cost;
}

/* Writes the first state of a descent, within the bounds. */
static void begin_descent(const nearest_search_job *job, const scalar *parameters, const scalar *q,
                          scalar *state) {
  int64_t i;
  memset(state, 0, (size_t) job->n_state * sizeof *state);
  for (i = 0; i < job->n_motors; ++i) {
    const scalar low = parameters[job->lower + i], high = parameters[job->upper + i];
    state[job->state_q + i] = q[i] < low ? low : q[i] > high ? high : q[i];
  }
  state[job->state_damping] = job->damping;
}

/* Writes a seed to a state, which also serves as work memory. */
static void write_seed(const nearest_search_job *job, const scalar *parameters, const int64_t *rows,
                       scalar *q, scalar *state) {
  int64_t g, i;
  memcpy(q, job->home, (size_t) job->n_motors * sizeof *q);
  for (i = 0; i < job->n_arm_motors; ++i) {
    q[job->arm_motors[i]] = (scalar) job->arm_postures[rows[0] * job->n_arm_motors + i];
  }
  for (g = 0; g < job->n_groups; ++g) {
    const finger_group *group = job->groups + g;
    for (i = 0; i < group->n_motors; ++i) {
      q[group->motors[i]] = (scalar) group->postures[rows[1 + g] * group->n_motors + i];
    }
  }
  begin_descent(job, parameters, q, state);
}

/* Writes the starts of a target: q0, the end of its solve, and seeds. */
static void find_starts(nearest_search_job *job, int64_t target) {
  const scalar *parameters = job->parameters + target * job->n_parameters;
  const scalar *q0 = job->q0 + target * job->n_motors, *last_q = job->last_q + target * job->n_motors;
  scalar *state = job->states + target * job->n_starts * job->n_state;
  scalar *q = job->q + target * job->n_motors;
  const int64_t n_rows = 1 + job->n_groups, n_candidates = find_arms(job, target);
  int64_t length = 0, i, is_known = 1;
  for (i = 0; i < job->n_motors; ++i) is_known &= last_q[i] - last_q[i] == 0;
  begin_descent(job, parameters, q0, state);
  begin_descent(job, parameters, is_known ? last_q : q0, state + job->n_state);
  for (i = 0; i < n_candidates; ++i) {
    const scalar cost = job->n_groups ? choose_fingers(job, target, job->rows + i * n_rows) : (scalar) i;
    length = insert_sorted(cost, i, job->sorted_values, job->sorted, length, job->n_starts - 2);
  }
  for (i = 2; i < job->n_starts; ++i) {
    write_seed(job, parameters, job->rows + job->sorted[i - 2] * n_rows, q, state + i * job->n_state);
  }
}

/* Returns the largest motion of a motor from q0, relative to its range. */
static scalar travel_of(const nearest_search_job *job, int64_t start) {
  const scalar *q = job->states + start * job->n_state + job->state_q;
  const scalar *q0 = job->q0 + start / job->n_starts * job->n_motors;
  scalar travel = 0;
  int64_t i;
  for (i = 0; i < job->n_motors; ++i) {
    const scalar motion = fabs(q[i] - q0[i]) / job->ranges[i];
    if (motion > travel) travel = motion;
  }
  return travel;
}

/* Returns the descent with the least travel among the first of an order by distance whose distances
 * exceed the smallest one by a relative difference at most. */
static int64_t nearest_tied(const nearest_search_job *job, const int64_t *order, int64_t length,
                            scalar difference) {
  scalar least = INFINITY;
  int64_t i, nearest = order[0];
  for (i = 0; i < length && job->sorted_values[i] <= job->sorted_values[0] * (1 + difference); ++i) {
    const scalar travel = travel_of(job, order[i]);
    if (!(travel < least)) continue;
    least = travel;
    nearest = order[i];
  }
  return nearest;
}

static int64_t insert_descent(nearest_search_job *job, int64_t start, int64_t length) {
  const scalar distance = job->states[start * job->n_state + job->state_distance];
  return insert_sorted(distance, start, job->sorted_values, job->sorted, length, job->n_starts);
}

/* Selects the descents with the smallest distances, one of several with nearly equal distances, and
 * of those tied with the smallest distance also the one with the least travel. The list is padded
 * with -1. */
static void select_finalists(nearest_search_job *job, int64_t target) {
  int64_t *finalists = job->finalists + target * job->n_finalists, length = 0, count = 1, i;
  for (i = 0; i < job->n_starts; ++i) length = insert_descent(job, target * job->n_starts + i, length);
  finalists[0] = job->sorted[0];
  i = nearest_tied(job, job->sorted, length, job->duplicate_gap);
  if (i != finalists[0] && count < job->n_finalists) finalists[count++] = i;
  for (i = 1; i < length && count < job->n_finalists; ++i) {
    if (job->sorted_values[i] > job->sorted_values[i - 1] * (1 + job->duplicate_gap)) {
      finalists[count++] = job->sorted[i];
    }
  }
  while (count < job->n_finalists) finalists[count++] = -1;
}

/* Writes the nearest configuration of a target and its distance; the travel from q0 decides ties. */
static void choose(nearest_search_job *job, int64_t target) {
  const int64_t *finalists = job->finalists + target * job->n_finalists;
  int64_t length = 0, i;
  for (i = 0; i < job->n_finalists && finalists[i] >= 0; ++i) {
    length = insert_descent(job, finalists[i], length);
  }
  i = nearest_tied(job, job->sorted, length, job->tie);
  memcpy(job->q + target * job->n_motors, job->states + i * job->n_state + job->state_q,
         (size_t) job->n_motors * sizeof(scalar));
  job->distances[target] = job->states[i * job->n_state + job->state_distance];
}

/* Loads a descent into a slot of the loop, or stores its last state. */
static int follow(void *method, int64_t slot, int64_t solve, int32_t *status) {
  nearest_search_job *job = method;
  const int64_t start = job->stage == RACE_STAGE ? solve : job->finalists[solve];
  const size_t size = (size_t) job->n_state * sizeof(scalar);
  scalar *memory = job->slot_memory + slot * (job->n_state + job->n_parameters);
  if (start < 0) return DONE;
  if (*status != UNBEGUN) {
    memcpy(job->states + start * job->n_state, memory, size);
    return DONE;
  }
  memcpy(memory, job->states + start * job->n_state, size);
  memcpy(memory + job->n_state, job->parameters + start / job->n_starts * job->n_parameters,
         (size_t) job->n_parameters * sizeof(scalar));
  return CONTINUES;
}

static void begin_loop(nearest_search_job *job, int64_t count, int64_t max_iterations) {
  loop_job *loop = job->loop;
  int64_t i;
  for (i = 0; i < count; ++i) {
    loop->status[i] = UNBEGUN;
    loop->iterations[i] = 0;
    loop->seconds[i] = 0;
  }
  for (i = 0; i < loop->slot_count; ++i) loop->slots[i] = -1;
  loop->states = job->slot_memory;
  loop->parameters = job->slot_memory + job->n_state;
  loop->state_step = loop->parameter_step = job->n_state + job->n_parameters;
  loop->follow = follow;
  loop->method = job;
  loop->count = count;
  loop->solve = 0;
  loop->max_iterations = max_iterations;
}

static int run_loop(nearest_search_job *job) {
  int code = FEW_LEFT;
  if (job->lane_loop) code = job->lane_loop(job->loop);
  return code == FEW_LEFT ? job->scalar_loop(job->loop) : code;
}

NEAREST_SEARCH {
  for (; job->stage <= job->last_stage; ++job->stage) {
    int64_t target;
    int code;
    if (job->stage == RACE_STAGE || job->stage == FINISH_STAGE) {
      if ((code = run_loop(job)) != DONE) return code;
    }
    for (target = 0; target < job->count; ++target) {
      if (job->stage == SEED_STAGE) find_starts(job, target);
      if (job->stage == RACE_STAGE) select_finalists(job, target);
      if (job->stage == CHOICE_STAGE) choose(job, target);
    }
    if (job->stage == SEED_STAGE) begin_loop(job, job->count * job->n_starts, job->race_steps);
    if (job->stage == RACE_STAGE) begin_loop(job, job->count * job->n_finalists, job->max_iterations);
  }
  return DONE;
}
