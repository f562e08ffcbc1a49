/* What keeps a follower clear, behind clearance.c: see `motion.clear`.
 *
 * Of a pair nothing is worked out while what it was apart, less what motors can have moved it since,
 * is more than enough: steps of motors times levers.
 */

/* Numbers of a row of levers, the last of them zeros: as many as fill vectors. */
enum { ROW = (N_Q + 7) / 8 * 8 };

/* How far motors are from a place, at most on a way that turns nowhere, and what that moves. */
static LANES_TARGET scalar strayed(const guard_job *job, const scalar *at, const scalar *from,
                                   const scalar *to, scalar *far) {
  scalar most = 0;
  int k;
  for (k = 0; k < N_Q; ++k) {
    const scalar a = fabs(from[k] - at[k]), b = fabs(to[k] - at[k]);
    far[k] = b > a ? b : a;
    most += job->widest[k] * far[k];
  }
  return most;
}

static LANES_TARGET void place(placing *space) {
  space->space.arg[0] = space->q;
  space->space.res[0] = space->placed;
  STEP(space->space.arg, space->space.res, (1 << LANES) - 1);
}

/* Places all lanes at once. */
static LANES_TARGET void place_at(placing *space, const scalar *q) {
  int k;
  for (k = 0; k < N_Q; ++k) space->q[k] = SPREAD(q[k]);
  place(space);
}

/* Lower bound of a pair's distance: how far the balls about its shapes are apart. */
LANES_INLINE lanes balls_apart(const clearance_job *about, int64_t pair, const lanes *placed) {
  const int i = about->pairs[2 * pair], j = about->pairs[2 * pair + 1], solid = j - N_CAPSULES;
  const lanes *other = placed + (solid < 0 ? 6 * j : 6 * N_CAPSULES + 12 * solid + 9);
  const scalar reach = solid < 0 ? about->radii[j] + about->halves[j] : about->solids[solid].reach;
  const vector r = minus(load(placed + 6 * i), load(other));
  return lanes_sqrt(dot(r, r)) - (about->radii[i] + about->halves[i] + about->offsets[pair] + reach);
}

/* Lists the pairs whose bounding balls are nearer than the horizon at a configuration, with a lower
 * bound of their distances that is exact below `sure`. The balls are compared in scalars: all lanes
 * hold the same configuration, and few pairs pass. */
static LANES_TARGET void look(const guard_job *job, placing *space, surroundings *here,
                              const scalar *from, scalar sure) {
  const clearance_job *about = job->about;
  int64_t pair;
  place_at(space, from);
  here->n_near = here->spent = 0;
  for (pair = 0; pair < about->n_pairs; ++pair) {
    const int i = about->pairs[2 * pair], j = about->pairs[2 * pair + 1], solid = j - N_CAPSULES;
    const lanes *a = space->placed + 6 * i;
    const lanes *b = space->placed + (solid < 0 ? 6 * j : 6 * N_CAPSULES + 12 * solid + 9);
    const scalar x = lanes_at(a[0], 0) - lanes_at(b[0], 0);
    const scalar y = lanes_at(a[1], 0) - lanes_at(b[1], 0);
    const scalar z = lanes_at(a[2], 0) - lanes_at(b[2], 0);
    const scalar radii = about->radii[i] + about->halves[i] + about->offsets[pair]
                         + (solid < 0 ? about->radii[j] + about->halves[j] : about->solids[solid].reach);
    const scalar square = x * x + y * y + z * z, beyond = here->horizon + radii;
    scalar known;
    lanes distance;
    if (beyond > 0 && square >= beyond * beyond) continue;
    known = sqrt(square) - radii;
    if (!(known >= sure)) {
      known = sure;
      if (apart(about, pair, space->placed, SPREAD(sure), space->lines, &distance)) {
        known = lanes_at(distance, 0);
      }
    }
    here->known[here->n_near] = known;
    here->near[here->n_near++] = pair;
  }
}

/* Lists the pairs that may come nearer than a distance on a way that turns nowhere. */
static LANES_TARGET void come_close(const guard_job *job, placing *space, surroundings *here,
                                    const scalar *from, const scalar *to, scalar wanted) {
  scalar far[ROW] = {0};
  const scalar least = strayed(job, from, from, to, far);
  scalar most = strayed(job, here->at, from, to, far);
  int64_t i;
  int k;
  /* A look costs no more than pairs that come into question because motors have gone on. */
  if (!(wanted + most <= here->horizon)
      || (here->spent > job->about->n_pairs && 2 * least < most)) {
    memcpy(here->at, from, N_Q * sizeof(scalar));
    most = strayed(job, here->at, from, to, far);
    here->horizon = wanted + most + job->spare;
    look(job, space, here, from, wanted + most);
  }
  here->n_close = 0;
  for (i = 0; i < here->n_near; ++i) {
    const scalar *lever = job->levers + here->near[i] * ROW;
    scalar left = here->known[i] - wanted;
    lanes sum = SPREAD(0.0), row, way;
    if (left >= most) continue;
    ++here->spent;
    for (k = 0; k < ROW; k += LANES) {
      memcpy(&row, lever + k, sizeof(lanes));
      memcpy(&way, far + k, sizeof(lanes));
      sum += row * way;
    }
    for (k = 0; k < LANES; ++k) left -= lanes_at(sum, k);
    if (left >= 0) continue;
    here->limits[here->n_close] = wanted;
    here->close[here->n_close++] = here->near[i];
  }
}

/* Inserts a pair into the list of the nearest pairs, which is sorted by distance. */
static void insert_nearest(scalar *near, int64_t *nearest, int64_t pair, scalar distance) {
  int64_t k = OBSTACLES + 1;
  for (; k > 0 && distance < near[k - 1]; --k) {
    if (k > OBSTACLES) continue;
    near[k] = near[k - 1];
    nearest[k] = nearest[k - 1];
  }
  if (k > OBSTACLES) return;
  near[k] = distance;
  nearest[k] = pair;
}

/* Computes the lacking clearances of the nearest pairs at the goal and their gradients. Clearance is
 * lacking up to the distance of the nearest pair beyond the list: a pair that enters the list or
 * leaves it lacks nothing there, so the lacking clearances are continuous functions of the goal. */
LANES_TARGET DRIVER(keep_away, guard_job) {
  const clearance_job *about = job->about;
  surroundings *here = job->by_goal;
  placing space;
  scalar near[OBSTACLES + 1];
  int64_t nearest[OBSTACLES + 1], few = OBSTACLES, i, k;
  int motor = 0, lane, outcome = set_up(&space.space, room(about));
  if (outcome != DONE) return outcome;
  lay_out(&space, about);
  come_close(job, &space, here, job->goal, job->goal, job->minded);
  for (i = 0; i <= few; ++i) near[i] = job->minded;
  if (here->n_close) place_at(&space, job->goal);
  for (i = 0; i < here->n_close; ++i) {
    lanes distance;
    if (apart(about, here->close[i], space.placed, SPREAD(job->minded), space.lines, &distance)) {
      insert_nearest(near, nearest, here->close[i], lanes_at(distance, 0));
    }
  }
  for (i = 0; i < few; ++i) job->rooms[i] = near[few] - near[i];
  for (i = 0; i < few && job->rooms[i] > 0; ++i) {
    memset(job->slopes + i * N_Q, 0, N_Q * sizeof(scalar));
  }
  few = i;
  while (few && motor < N_Q) {
    int nudged[LANES], count = 0;
    for (; motor < N_Q && count < LANES; ++motor) {
      for (i = 0; i < few && job->levers[nearest[i] * ROW + motor] == 0; ++i) continue;
      if (i < few) nudged[count++] = motor;
    }
    if (!count) break;
    for (k = 0; k < N_Q; ++k) space.q[k] = SPREAD(job->goal[k]);
    for (lane = 0; lane < count; ++lane) ((scalar *) (space.q + nudged[lane]))[lane] += job->nudge;
    place(&space);
    for (i = 0; i < few; ++i) {
      lanes distance;
      apart(about, nearest[i], space.placed, SPREAD(INFINITY), space.lines, &distance);
      for (lane = 0; lane < count; ++lane) {
        job->slopes[i * N_Q + nudged[lane]] = (lanes_at(distance, lane) - near[i]) / job->nudge;
      }
    }
  }
  give_back(&space.space);
  return outcome;
}

/* Where a motor is after so many cycles: the first makes the step, in all others it brakes. */
LANES_INLINE lanes after(const guard_job *job, int motor, lanes cycles) {
  const scalar step = fabs(job->step[motor]), change = job->change[motor];
  const lanes braked = smaller(cycles - 1, SPREAD(floor(step / change)));
  const lanes way = step * (braked + 1) - change * braked * (braked + 1) / 2;
  return job->q[motor] + (job->step[motor] < 0 ? -way : way);
}

/* Marks motors that a pair holds back: those of a hand that can part it by itself, else whole sides;
 * a trunk's motor all. */
static void hold_back(const guard_job *job, const scalar *lever, int *held) {
  int k, i;
  for (k = 0; k < N_Q; ++k) {
    if (!(lever[k] > 0)) continue;
    held[k] = 1;
    for (i = 0; !(job->hand[k] > 0) && i < N_Q; ++i) {
      held[i] |= job->side[k] < 0 || job->side[i] == job->side[k];
    }
  }
}

/* Marks motors that move pairs nearer than is free, or nearer than they are if that is less, in any
 * cycle from one to another. Those cycles alone are left out between which a pair has no time for it:
 *
 *     its least distance >= (distance before + distance after - motion between) / 2
 */
static LANES_TARGET int find_touching(const guard_job *job, placing *space, int64_t from,
                                       int64_t to, int64_t n_pairs, int *touching) {
  const surroundings *here = job->by_way;
  int64_t cycle[LANES], n_unsure = 0, i;
  int unsure[LANES] = {0}, found = 0, lane, k;
  lanes now, next, moved[N_Q], longest = SPREAD(0.0);
  scalar way = 0;
  for (lane = 0; lane < LANES; ++lane) {
    cycle[lane] = from + (to - from) * lane / (LANES - 1);
    ((scalar *) &now)[lane] = (scalar) cycle[lane];
    ((scalar *) &next)[lane] = (scalar) (from + (to - from) * (lane + 1) / (LANES - 1));
  }
  for (k = 0; k < N_Q; ++k) {
    space->q[k] = after(job, k, now);
    moved[k] = lanes_fabs(after(job, k, next) - space->q[k]);
    longest += job->widest[k] * moved[k];
  }
  for (lane = 0; lane < LANES; ++lane) {
    if (!(lanes_at(longest, lane) <= way)) way = lanes_at(longest, lane);
  }
  place(space);
  for (i = 0; i < n_pairs; ++i) {
    const int64_t pair = here->close[i];
    const scalar *lever = job->levers + pair * ROW;
    lanes distance, motion = SPREAD(0.0);
    scalar most = 0, limit = here->limits[i];
    int touches = 0, again = 0;
    if (lanes_all(balls_apart(job->about, pair, space->placed) >= SPREAD(job->enough + way / 2))) {
      continue;
    }
    for (k = 0; k < N_Q; ++k) motion += lever[k] * moved[k];
    for (lane = 0; lane < LANES; ++lane) {
      if (!(lanes_at(motion, lane) <= most)) most = lanes_at(motion, lane);
    }
    if (!apart(job->about, pair, space->placed, SPREAD(job->enough + most / 2), space->lines,
               &distance)) {
      continue;
    }
    if (from == 0 && lanes_at(distance, 0) < limit) limit = lanes_at(distance, 0);
    for (lane = 0; lane < LANES; ++lane) {
      touches |= !(lanes_at(distance, lane) >= limit);
      if (lane < LANES - 1 && cycle[lane + 1] - cycle[lane] > 1) {
        const scalar both = lanes_at(distance, lane) + lanes_at(distance, lane + 1);
        const int missed = !(both - lanes_at(motion, lane) >= 2 * limit);
        unsure[lane] |= missed;
        again |= missed;
      }
    }
    if (again) {
      /* The pairs that have to be looked at again come first. */
      here->close[i] = here->close[n_unsure];
      here->limits[i] = here->limits[n_unsure];
      here->close[n_unsure] = pair;
      here->limits[n_unsure++] = limit;
    }
    found |= touches;
    if (touches) hold_back(job, lever, touching);
  }
  for (lane = 0; !found && lane < LANES - 1; ++lane) {
    if (!unsure[lane]) continue;
    found = find_touching(job, space, cycle[lane], cycle[lane + 1], n_unsure, touching);
  }
  return found;
}

/* Makes of a step so much that the robot stays free and can come to rest free: motors that move a
 * pair too near make less of theirs, and brake at last. What all motors of a pair that brake lead to
 * was free in the cycle before. */
LANES_TARGET DRIVER(stop_in_time, guard_job) {
  placing space;
  int tried[N_Q] = {0}, touching[N_Q], k, less, outcome = set_up(&space.space, room(job->about));
  if (outcome != DONE) return outcome;
  lay_out(&space, job->about);
  do {
    scalar cycles = 0, sum = 0;
    int going = 0;
    for (k = 0; k < N_Q; ++k) {
      const scalar left = fabs(job->last[k]) - job->change[k];
      const scalar braked = left > 0 ? (job->last[k] < 0 ? -left : left) : 0;
      job->part[k] = tried[k] < job->n_shares ? job->shares[tried[k]] : 0;
      job->step[k] = braked;
      if (job->part[k] > 0) job->step[k] += job->part[k] * (job->wanted[k] - braked);
      going |= tried[k] < job->n_shares;
      cycles = fmax(cycles, floor(fabs(job->step[k]) / job->change[k]) + 1);
    }
    for (k = 0; k < N_Q; ++k) {
      sum += job->rest[k] = lanes_at(after(job, k, SPREAD(cycles)), 0);
      touching[k] = 0;
    }
    if (!going) break;
    if (isfinite(sum)) {
      come_close(job, &space, job->by_way, job->q, job->rest, job->enough);
      find_touching(job, &space, 0, (int64_t) cycles, job->by_way->n_close, touching);
    } else {
      /* What is no number is nowhere. */
      for (k = 0; k < N_Q; ++k) touching[k] = 1;
    }
    for (less = k = 0; k < N_Q; ++k) {
      if (!touching[k] || tried[k] == job->n_shares) continue;
      ++tried[k];
      less = 1;
    }
  } while (less);
  give_back(&space.space);
  return outcome;
}
