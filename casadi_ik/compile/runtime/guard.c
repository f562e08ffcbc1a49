/* Collision avoidance of a follower, appended to clearance.c; see motion/guard.py.
 *
 * A pair is not evaluated while its last known distance, less the largest motion since then (steps of
 * motors times levers), exceeds the distance that it must keep.
 */

/* Pairs near a configuration. */
typedef struct {
  scalar *q_listed;            /* N_Q: configuration at which all pairs were compared; NaN: none yet */
  scalar horizon;              /* pairs that are not listed were at least this far apart there */
  int64_t n_listed, n_candidates;
  int64_t n_checked;           /* pairs that were checked since */
  int64_t *listed;             /* pairs nearer than the horizon */
  scalar *distance_bounds;     /* lower bounds of their distances at q_listed */
  int64_t *candidates;         /* listed pairs that may violate their distance on the present path */
  scalar *required;            /* distances that the candidates must keep on the path */
} nearby_pairs;

typedef struct {
  clearance_job *scene;        /* pairs and solids */
  const scalar *levers;        /* n_pairs rows of ROW: `collision.distances.levers` */
  const scalar *hand;          /* N_Q: 1 for motors beyond a palm */
  const scalar *side;          /* N_Q: number of the side; -1 for motors that move all palms */
  const scalar *max_levers;    /* N_Q: largest lever of each motor over all pairs */
  scalar relist_motion;        /* motion of shapes after which all pairs are compared again */
  nearby_pairs *near_goal, *near_path;

  const scalar *goal;
  scalar avoided_distance;     /* distance below which the goal avoids a pair */
  scalar nudge;                /* step of the finite differences */
  scalar *lacking, *slopes;    /* lacking clearances of the OBSTACLES nearest pairs, 0: none; rows of N_Q */

  const scalar *q, *last_step; /* positions of the motors, and their last step */
  const scalar *wanted_step;   /* next step without obstacles */
  const scalar *change;        /* largest change of a step from cycle to cycle */
  scalar required_distance;    /* distance that every pair must keep */
  const scalar *shares;        /* shares of the requested step that are tried successively before braking */
  int64_t n_shares;
  scalar *share;               /* share of each motor; 0: the motor brakes */
  scalar *step, *q_rest;       /* the step, and the positions at rest after it */
} guard_job;

/* Numbers of a row of levers, padded with zeros to fill vectors. */
enum { ROW = (N_Q + 7) / 8 * 8 };

/* Computes the largest distance of each motor from q_0 on a monotonic path between two configurations;
 * returns an upper bound of the motion of all shapes. */
static LANES_TARGET scalar displacement_bound(const guard_job *job, const scalar *q_0,
                                              const scalar *from, const scalar *to,
                                              scalar *motor_distances) {
  scalar bound = 0;
  int k;
  for (k = 0; k < N_Q; ++k) {
    const scalar a = fabs(from[k] - q_0[k]), b = fabs(to[k] - q_0[k]);
    motor_distances[k] = b > a ? b : a;
    bound += job->max_levers[k] * motor_distances[k];
  }
  return bound;
}

static LANES_TARGET void place_robot(placing *space) {
  space->space.arg[0] = space->q;
  space->space.res[0] = space->placed;
  STEP(space->space.arg, space->space.res, (1 << LANES) - 1);
}

/* Places the shapes of one configuration in all lanes. */
static LANES_TARGET void place_at(placing *space, const scalar *q) {
  int k;
  for (k = 0; k < N_Q; ++k) space->q[k] = SPREAD(q[k]);
  place_robot(space);
}

/* Returns lower bounds of a pair's distance: the distances of its bounding balls. */
LANES_INLINE lanes ball_distance(const clearance_job *scene, int64_t pair, const lanes *placed) {
  const int i = scene->pairs[2 * pair], j = scene->pairs[2 * pair + 1], solid = j - N_CAPSULES;
  const lanes *second = placed + (solid < 0 ? 6 * j : 6 * N_CAPSULES + 12 * solid + 9);
  const scalar reach = solid < 0 ? scene->radii[j] + scene->halves[j] : scene->solids[solid].reach;
  const vector r = minus(load(placed + 6 * i), load(second));
  return lanes_sqrt(dot(r, r)) - (scene->radii[i] + scene->halves[i] + scene->offsets[pair] + reach);
}

/* Lists the pairs whose bounding balls are nearer than the horizon at a configuration, with lower
 * bounds of their distances that are exact below `exact_below`. The balls are compared in scalars: all
 * lanes hold the same configuration, and few pairs pass. */
static LANES_TARGET void list_nearby_pairs(const guard_job *job, placing *space, nearby_pairs *pairs,
                                           const scalar *q, scalar exact_below) {
  const clearance_job *scene = job->scene;
  int64_t pair;
  place_at(space, q);
  pairs->n_listed = pairs->n_checked = 0;
  for (pair = 0; pair < scene->n_pairs; ++pair) {
    const int i = scene->pairs[2 * pair], j = scene->pairs[2 * pair + 1], solid = j - N_CAPSULES;
    const lanes *a = space->placed + 6 * i;
    const lanes *b = space->placed + (solid < 0 ? 6 * j : 6 * N_CAPSULES + 12 * solid + 9);
    const scalar x = lanes_at(a[0], 0) - lanes_at(b[0], 0);
    const scalar y = lanes_at(a[1], 0) - lanes_at(b[1], 0);
    const scalar z = lanes_at(a[2], 0) - lanes_at(b[2], 0);
    const scalar radii = scene->radii[i] + scene->halves[i] + scene->offsets[pair]
                         + (solid < 0 ? scene->radii[j] + scene->halves[j] : scene->solids[solid].reach);
    const scalar square = x * x + y * y + z * z, limit = pairs->horizon + radii;
    scalar bound;
    lanes distance;
    if (limit > 0 && square >= limit * limit) continue;
    bound = sqrt(square) - radii;
    if (!(bound >= exact_below)) {
      bound = exact_below;
      if (pair_distance(scene, pair, space->placed, SPREAD(exact_below), space->lines, &distance)) {
        bound = lanes_at(distance, 0);
      }
    }
    pairs->distance_bounds[pairs->n_listed] = bound;
    pairs->listed[pairs->n_listed++] = pair;
  }
}

/* Selects the pairs that may come nearer than a distance on a monotonic path. */
static LANES_TARGET void select_candidates(const guard_job *job, placing *space, nearby_pairs *pairs,
                                           const scalar *from, const scalar *to, scalar required) {
  scalar motor_distances[ROW] = {0};
  const scalar path_motion = displacement_bound(job, from, from, to, motor_distances);
  scalar motion = displacement_bound(job, pairs->q_listed, from, to, motor_distances);
  int64_t i;
  int k;
  /* Listing costs no more than the candidates that exist only because motors have moved on. */
  if (!(required + motion <= pairs->horizon)
      || (pairs->n_checked > job->scene->n_pairs && 2 * path_motion < motion)) {
    memcpy(pairs->q_listed, from, N_Q * sizeof(scalar));
    motion = displacement_bound(job, pairs->q_listed, from, to, motor_distances);
    pairs->horizon = required + motion + job->relist_motion;
    list_nearby_pairs(job, space, pairs, from, required + motion);
  }
  pairs->n_candidates = 0;
  for (i = 0; i < pairs->n_listed; ++i) {
    const scalar *lever = job->levers + pairs->listed[i] * ROW;
    scalar surplus = pairs->distance_bounds[i] - required;
    lanes pair_motion = SPREAD(0.0), row, distances;
    if (surplus >= motion) continue;
    ++pairs->n_checked;
    for (k = 0; k < ROW; k += LANES) {
      memcpy(&row, lever + k, sizeof(lanes));
      memcpy(&distances, motor_distances + k, sizeof(lanes));
      pair_motion += row * distances;
    }
    for (k = 0; k < LANES; ++k) surplus -= lanes_at(pair_motion, k);
    if (surplus >= 0) continue;
    pairs->required[pairs->n_candidates] = required;
    pairs->candidates[pairs->n_candidates++] = pairs->listed[i];
  }
}

/* Inserts a pair into the list of the nearest pairs, which is sorted by distance. */
static void insert_nearest(scalar *distances, int64_t *nearest, int64_t pair, scalar distance) {
  int64_t k = OBSTACLES + 1;
  for (; k > 0 && distance < distances[k - 1]; --k) {
    if (k > OBSTACLES) continue;
    distances[k] = distances[k - 1];
    nearest[k] = nearest[k - 1];
  }
  if (k > OBSTACLES) return;
  distances[k] = distance;
  nearest[k] = pair;
}

/* Computes the lacking clearances of the nearest pairs at the goal and their gradients. A pair lacks
 * the part of its distance below `avoided_distance`, multiplied by how much nearer it is than the
 * nearest pair beyond the list, relative to the width of the avoided zone. A pair that enters the list
 * or leaves it therefore lacks nothing: the lacking clearances are continuous functions of the goal. */
LANES_TARGET DRIVER(keep_away, guard_job) {
  const clearance_job *scene = job->scene;
  nearby_pairs *pairs = job->near_goal;
  placing space;
  scalar distances[OBSTACLES + 1];
  int64_t nearest[OBSTACLES + 1], count = OBSTACLES, i, k;
  int motor = 0, lane, outcome = set_up(&space.space, work_size(scene));
  if (outcome != DONE) return outcome;
  lay_out(&space, scene);
  select_candidates(job, &space, pairs, job->goal, job->goal, job->avoided_distance);
  for (i = 0; i <= count; ++i) distances[i] = job->avoided_distance;
  if (pairs->n_candidates) place_at(&space, job->goal);
  for (i = 0; i < pairs->n_candidates; ++i) {
    lanes distance;
    if (pair_distance(scene, pairs->candidates[i], space.placed, SPREAD(job->avoided_distance), space.lines,
              &distance)) {
      insert_nearest(distances, nearest, pairs->candidates[i], lanes_at(distance, 0));
    }
  }
  for (i = 0; i < count; ++i) {
    const scalar zone = job->avoided_distance - job->required_distance;
    job->lacking[i] = (distances[count] - distances[i]) / zone * (job->avoided_distance - distances[i]);
  }
  for (i = 0; i < count && job->lacking[i] > 0; ++i) {
    memset(job->slopes + i * N_Q, 0, N_Q * sizeof(scalar));
  }
  count = i;
  while (count && motor < N_Q) {
    int nudged[LANES], n_nudged = 0;
    for (; motor < N_Q && n_nudged < LANES; ++motor) {
      for (i = 0; i < count && job->levers[nearest[i] * ROW + motor] == 0; ++i) continue;
      if (i < count) nudged[n_nudged++] = motor;
    }
    if (!n_nudged) break;
    for (k = 0; k < N_Q; ++k) space.q[k] = SPREAD(job->goal[k]);
    for (lane = 0; lane < n_nudged; ++lane) ((scalar *) (space.q + nudged[lane]))[lane] += job->nudge;
    place_robot(&space);
    for (i = 0; i < count; ++i) {
      lanes distance;
      pair_distance(scene, nearest[i], space.placed, SPREAD(INFINITY), space.lines, &distance);
      for (lane = 0; lane < n_nudged; ++lane) {
        job->slopes[i * N_Q + nudged[lane]] = (lanes_at(distance, lane) - distances[i]) / job->nudge;
      }
    }
  }
  give_back(&space.space);
  return outcome;
}

/* Returns the positions of a motor after some cycles: the first makes the step, the others brake. */
LANES_INLINE lanes position_after(const guard_job *job, int motor, lanes cycles) {
  const scalar step = fabs(job->step[motor]), change = job->change[motor];
  const lanes braked = smaller(cycles - 1, SPREAD(floor(step / change)));
  const lanes distance = step * (braked + 1) - change * braked * (braked + 1) / 2;
  return job->q[motor] + (job->step[motor] < 0 ? -distance : distance);
}

/* Marks the motors that a pair stops: those of a hand that can separate it alone, otherwise whole
 * sides, or all motors if the trunk moves it. */
static void mark_blocking_motors(const guard_job *job, const scalar *lever, int *is_blocking) {
  int k, i;
  for (k = 0; k < N_Q; ++k) {
    if (!(lever[k] > 0)) continue;
    is_blocking[k] = 1;
    for (i = 0; !(job->hand[k] > 0) && i < N_Q; ++i) {
      is_blocking[i] |= job->side[k] < 0 || job->side[i] == job->side[k];
    }
  }
}

/* Marks the motors of pairs that violate their required distance in a cycle of an interval; a pair that
 * is nearer already must not come nearer. Returns 1 if there is such a pair. Skips only the cycles in
 * between which a pair cannot violate it:
 *
 *     least distance >= (distance before + distance after - motion in between) / 2
 */
static LANES_TARGET int find_touching(const guard_job *job, placing *space, int64_t first, int64_t last,
                                      int64_t n_pairs, int *is_blocking) {
  const nearby_pairs *pairs = job->near_path;
  int64_t cycle[LANES], n_uncertain = 0, i;
  int is_uncertain[LANES] = {0}, any_touch = 0, lane, k;
  lanes now, next, moved[N_Q], motion_bounds = SPREAD(0.0);
  scalar largest_bound = 0;
  for (lane = 0; lane < LANES; ++lane) {
    cycle[lane] = first + (last - first) * lane / (LANES - 1);
    ((scalar *) &now)[lane] = (scalar) cycle[lane];
    ((scalar *) &next)[lane] = (scalar) (first + (last - first) * (lane + 1) / (LANES - 1));
  }
  for (k = 0; k < N_Q; ++k) {
    space->q[k] = position_after(job, k, now);
    moved[k] = lanes_fabs(position_after(job, k, next) - space->q[k]);
    motion_bounds += job->max_levers[k] * moved[k];
  }
  for (lane = 0; lane < LANES; ++lane) {
    if (!(lanes_at(motion_bounds, lane) <= largest_bound)) largest_bound = lanes_at(motion_bounds, lane);
  }
  place_robot(space);
  for (i = 0; i < n_pairs; ++i) {
    const int64_t pair = pairs->candidates[i];
    const scalar *lever = job->levers + pair * ROW;
    lanes distance, motion = SPREAD(0.0);
    scalar largest = 0, required = pairs->required[i];
    int touches = 0, needs_refinement = 0;
    if (lanes_all(ball_distance(job->scene, pair, space->placed)
                  >= SPREAD(job->required_distance + largest_bound / 2))) {
      continue;
    }
    for (k = 0; k < N_Q; ++k) motion += lever[k] * moved[k];
    for (lane = 0; lane < LANES; ++lane) {
      if (!(lanes_at(motion, lane) <= largest)) largest = lanes_at(motion, lane);
    }
    if (!pair_distance(job->scene, pair, space->placed, SPREAD(job->required_distance + largest / 2),
               space->lines, &distance)) {
      continue;
    }
    if (first == 0 && lanes_at(distance, 0) < required) required = lanes_at(distance, 0);
    for (lane = 0; lane < LANES; ++lane) {
      touches |= !(lanes_at(distance, lane) >= required);
      if (lane < LANES - 1 && cycle[lane + 1] - cycle[lane] > 1) {
        const scalar sum = lanes_at(distance, lane) + lanes_at(distance, lane + 1);
        const int may_touch = !(sum - lanes_at(motion, lane) >= 2 * required);
        is_uncertain[lane] |= may_touch;
        needs_refinement |= may_touch;
      }
    }
    if (needs_refinement) {
      /* Pairs that shorter intervals have to decide come first. */
      pairs->candidates[i] = pairs->candidates[n_uncertain];
      pairs->required[i] = pairs->required[n_uncertain];
      pairs->candidates[n_uncertain] = pair;
      pairs->required[n_uncertain++] = required;
    }
    any_touch |= touches;
    if (touches) mark_blocking_motors(job, lever, is_blocking);
  }
  for (lane = 0; !any_touch && lane < LANES - 1; ++lane) {
    if (!is_uncertain[lane]) continue;
    any_touch = find_touching(job, space, cycle[lane], cycle[lane + 1], n_uncertain, is_blocking);
  }
  return any_touch;
}

/* Compute the largest share of the requested step after which the robot is collision-free and can stop
 * without collision. The motors of a pair that gets too close take smaller shares and finally brake;
 * braking of all motors of a pair was checked in the previous cycle. */
LANES_TARGET DRIVER(stop_in_time, guard_job) {
  placing space;
  int attempts[N_Q] = {0}, is_blocking[N_Q], k, is_reduced, outcome = set_up(&space.space, work_size(job->scene));
  if (outcome != DONE) return outcome;
  lay_out(&space, job->scene);
  do {
    scalar cycles = 0, sum = 0;
    int any_moves = 0;
    for (k = 0; k < N_Q; ++k) {
      const scalar speed = fabs(job->last_step[k]) - job->change[k];
      const scalar braked = speed > 0 ? (job->last_step[k] < 0 ? -speed : speed) : 0;
      job->share[k] = attempts[k] < job->n_shares ? job->shares[attempts[k]] : 0;
      job->step[k] = braked;
      if (job->share[k] > 0) job->step[k] += job->share[k] * (job->wanted_step[k] - braked);
      any_moves |= attempts[k] < job->n_shares;
      cycles = fmax(cycles, floor(fabs(job->step[k]) / job->change[k]) + 1);
    }
    for (k = 0; k < N_Q; ++k) {
      sum += job->q_rest[k] = lanes_at(position_after(job, k, SPREAD(cycles)), 0);
      is_blocking[k] = 0;
    }
    if (!any_moves) break;
    if (isfinite(sum)) {
      select_candidates(job, &space, job->near_path, job->q, job->q_rest, job->required_distance);
      find_touching(job, &space, 0, (int64_t) cycles, job->near_path->n_candidates, is_blocking);
    } else {
      /* Non-finite input: all motors brake. */
      for (k = 0; k < N_Q; ++k) is_blocking[k] = 1;
    }
    for (is_reduced = k = 0; k < N_Q; ++k) {
      if (!is_blocking[k] || attempts[k] == job->n_shares) continue;
      ++attempts[k];
      is_reduced = 1;
    }
  } while (is_reduced);
  give_back(&space.space);
  return outcome;
}
