/* The loop: runs a step until each solve of a batch ends.
 *
 * Compiled with LANES solves in vector lanes (lanes.c), or with one; the iterates of a solve are the
 * same bit for bit. When a solve ends, the method's callback `follow` (jobs.c) may start it again
 * in the same slot.
 *
 * A step in lanes is cheapest if all lanes take the same branch. There are therefore more slots than
 * lanes: a lane whose solve ends or changes its stage is refilled with a solve in the current stage,
 * and when more solves wait in another stage than lanes are busy, all lanes switch to that stage. Rows
 * are stored in the order of computation; `row_owners` holds their solve and iteration.
 *
 * A step depends on state and parameters alone, so a state that repeats bit for bit repeats forever;
 * such a solve ends as REPEATED. Cycles are detected as by Brent (1980): every state is compared with
 * that of the last iteration whose number is a power of two. The comparison starts at FIRST_MARK,
 * since most solves end earlier and storing states costs time.
 *
 * Requires the macros N_STATE, N_PARAMETERS, N_LOADED (number of parameters that lanes load; a step of
 * stages reads the others through its third argument), N_RECORD, ROW_BYTES, RUNNING, NON_FINITE,
 * REPEATED, CODE_LIMIT, SLOTS, FIRST_MARK, STAGE (index of the stage in the state; -1 without
 * stages), STEP_STAGES (number of stages) and the function store_row(record, row). All data that must survive a pause are in the job: after
 * SLICE_OVER or ROWS_FULL either form of the loop can be called again.
 */

/* A queue for every stage, and one for a stage number that is not a number. */
#define N_QUEUES (STEP_STAGES + 1)
#define EMPTY (-1)

#ifndef LANES
#define LANES 1
#define LANES_TARGET
#define SPREAD(x) ((lanes) (x))
typedef scalar lanes;
#endif
#define LANE(pack, k, lane) (((scalar *) (pack))[(k) * LANES + (lane)])

/* Waiting slots by stage. */
typedef struct {
  int stage_count;             /* stages met so far */
  scalar stage[N_QUEUES];
  int height[N_QUEUES];
  int waiting[N_QUEUES][SLOTS];  /* slots */
} queues;

/* State of the lanes. */
typedef struct {
  int slot[LANES];             /* slot in each lane, or EMPTY */
  int queue;                   /* queue of the current stage */
  int outcome;                 /* DONE, or the reason to stop */
  lanes *now, *next, *parameters, *record;
  const scalar *own[LANES];    /* all parameters of each lane */
} lane_set;

/* States and parameters are indexed by slot if a callback writes them, otherwise by solve. */
static scalar *state_of(const loop_job *job, int slot) {
  return job->states + (job->follow ? slot : job->slots[slot]) * job->state_step;
}

static const scalar *parameters_of(const loop_job *job, int slot) {
  return job->parameters + (job->follow ? slot : job->slots[slot]) * job->parameter_step;
}

static int queue_of(queues *all, scalar stage) {
  int i;
  for (i = 0; i < all->stage_count; ++i) {
    if (all->stage[i] == stage) return i;
  }
  if (all->stage_count == N_QUEUES) return N_QUEUES - 1;
  all->stage[all->stage_count] = stage;
  return all->stage_count++;
}

static void enqueue(queues *all, const loop_job *job, int slot) {
  const scalar stage = STAGE < 0 ? 0 : state_of(job, slot)[STAGE < 0 ? 0 : STAGE];
  const int i = queue_of(all, stage == stage ? stage : -1);
  all->waiting[i][all->height[i]++] = slot;
}

/* Returns the iterations since the last start of the solve in a slot. */
static int64_t iterations_since_start(const loop_job *job, int slot) {
  return job->iterations[job->slots[slot]] - job->iterations_before[slot];
}

/* Refills a slot whose solve has ended: asks the method for a restart, otherwise loads the next
 * solve. */
static void refill_slot(lane_set *b, queues *all, loop_job *job, int slot) {
  for (;;) {
    int is_new = job->slots[slot] == EMPTY, code = 0;
    if (is_new) {
      if (job->solve == job->count) return;
      job->slots[slot] = job->solve++;
    }
    if (job->follow) {
      int32_t *status = job->status + job->slots[slot];
      code = job->follow(job->method, slot, job->slots[slot], status);
      if (code == CONTINUES) *status = RUNNING;
    } else if (is_new) {
      code = CONTINUES;
    }
    if (code == CONTINUES) {
      job->iterations_before[slot] = job->iterations[job->slots[slot]];
      enqueue(all, job, slot);
      return;
    }
    if (code != DONE) {
      b->outcome = code;
      return;
    }
    job->slots[slot] = EMPTY;
  }
}

static void load_lane(lane_set *b, const loop_job *job, int lane, int slot) {
  const scalar *state = state_of(job, slot), *parameters = parameters_of(job, slot);
  int k;
  for (k = 0; k < N_STATE; ++k) LANE(b->now, k, lane) = state[k];
#if LANES == 1
  b->parameters = (lanes *) parameters;
#else
  for (k = 0; k < N_LOADED; ++k) LANE(b->parameters, k, lane) = parameters[k];
#endif
  b->own[lane] = parameters;
  b->slot[lane] = slot;
}

static void store_lane(lane_set *b, const loop_job *job, int lane, const lanes *state) {
  scalar *destination = state_of(job, b->slot[lane]);
  int k;
  for (k = 0; k < N_STATE; ++k) destination[k] = LANE(state, k, lane);
  b->slot[lane] = EMPTY;
}

/* Loads solves into empty lanes, switching the stage if that fills more; returns the busy lanes. */
static int fill(lane_set *b, queues *all, const loop_job *job) {
  int lane, i, busy = 0, fullest = 0;
  for (lane = 0; lane < LANES; ++lane) {
    if (b->slot[lane] == EMPTY && all->height[b->queue] > 0) {
      load_lane(b, job, lane, all->waiting[b->queue][--all->height[b->queue]]);
    }
    busy += b->slot[lane] != EMPTY;
  }
  if (busy == LANES) return busy;
  for (i = 1; i < all->stage_count; ++i) {
    if (all->height[i] > all->height[fullest]) fullest = i;
  }
  if (all->height[fullest] <= busy) return busy;
  for (lane = 0; lane < LANES; ++lane) {
    const int slot = b->slot[lane];
    if (slot == EMPTY) continue;
    store_lane(b, job, lane, b->now);
    enqueue(all, job, slot);
  }
  b->queue = fullest;
  for (lane = 0; lane < LANES && all->height[fullest] > 0; ++lane) {
    load_lane(b, job, lane, all->waiting[fullest][--all->height[fullest]]);
  }
  return lane;
}

static void write_row(const lane_set *b, loop_job *job, int lane, int64_t solve) {
  scalar record_values[N_RECORD + 1];
  int k;
  for (k = 0; k < N_RECORD; ++k) record_values[k] = LANE(b->record, k, lane);
  job->row_owners[2 * job->n_rows] = solve;
  job->row_owners[2 * job->n_rows + 1] = job->iterations[solve] - 1;
  store_row(record_values, job->rows + ROW_BYTES * job->n_rows++);
}

/* Tests which lanes have a finite state: x * 0 is 0 for finite x and NaN otherwise. Sums need no
 * branch, and four of them are independent of each other. */
LANES_TARGET static void check_finite(const lane_set *b, int *finite) {
  lanes sum[4], total;
  int k, i;
  for (i = 0; i < 4; ++i) sum[i] = SPREAD(0.0);
  for (k = 0; k + 4 <= N_STATE; k += 4) {
    for (i = 0; i < 4; ++i) sum[i] += b->next[k + i] * SPREAD(0.0);
  }
  for (; k < N_STATE; ++k) sum[0] += b->next[k] * SPREAD(0.0);
  total = (sum[0] + sum[1]) + (sum[2] + sum[3]);
  for (i = 0; i < LANES; ++i) finite[i] = LANE(&total, 0, i) == 0;
}

/* Returns 1 if later states are compared with the state of this iteration. */
static int is_marked(int64_t iteration) {
  return iteration >= FIRST_MARK && !(iteration & (iteration - 1));
}

/* Returns 1 if the state equals the marked one; the first elements nearly always differ. */
static int is_repeated(const lane_set *b, const scalar *mark, int lane) {
  int k;
  for (k = 0; k < N_STATE; ++k) {
    if (memcmp(&LANE(b->now, k, lane), mark + k, sizeof(scalar))) return 0;
  }
  return 1;
}

static void end_solve(lane_set *b, queues *all, loop_job *job, int lane, int32_t status, lanes *state) {
  const int slot = b->slot[lane];
  job->status[job->slots[slot]] = status;
  store_lane(b, job, lane, state);
  refill_slot(b, all, job, slot);
}

/* Processes a lane after an iteration; the new state is in `now`, the previous one in `next`.
 * Returns 1 if the lane is free. */
static int finish_iteration(lane_set *b, queues *all, loop_job *job, int lane, scalar code, int finite) {
  const int slot = b->slot[lane];
  const int64_t iteration = iterations_since_start(job, slot);
  scalar *mark = job->mark + slot * N_STATE;
  int32_t status;
  int k;
  /* A NaN code fails this test too. */
  if (!(code > -CODE_LIMIT && code < CODE_LIMIT) || !finite) {
    end_solve(b, all, job, lane, NON_FINITE, b->next);
    return 1;
  }
  status = (int32_t) code;
  if (status == RUNNING && iteration > FIRST_MARK && is_repeated(b, mark, lane)) status = REPEATED;
  if (is_marked(iteration)) {
    for (k = 0; k < N_STATE; ++k) mark[k] = LANE(b->now, k, lane);
  }
  if (status != RUNNING || iteration == job->max_iterations) {
    end_solve(b, all, job, lane, status, b->now);
    return 1;
  }
#if STAGE >= 0 && LANES > 1
  if (LANE(b->now, STAGE, lane) != LANE(b->next, STAGE, lane)) {
    store_lane(b, job, lane, b->now);
    enqueue(all, job, slot);
    return 1;
  }
#endif
  return 0;
}

/* Adds the time since the last call to the solves in the lanes, in equal shares. */
static void add_seconds(const int64_t *solves, int busy, const loop_job *job, scalar *since) {
  const scalar now = monotonic(), each = (now - *since) / busy;
  int lane;
  for (lane = 0; lane < LANES; ++lane) {
    if (solves[lane] != EMPTY) job->seconds[solves[lane]] += each;
  }
  *since = now;
}

static void start_loop(lane_set *b, queues *all, loop_job *job, lanes *memory) {
  int slot, lane;
  b->now = memory;
  b->next = b->now + N_STATE;
  b->parameters = b->next + N_STATE;
  b->record = b->parameters + N_PARAMETERS;
  b->queue = 0;
  b->outcome = DONE;
  all->stage_count = 0;
  memset(all->height, 0, sizeof all->height);
  for (lane = 0; lane < LANES; ++lane) b->slot[lane] = EMPTY;
  for (slot = 0; slot < job->slot_count && b->outcome == DONE; ++slot) {
    const int64_t solve = job->slots[slot];
    if (solve == EMPTY || job->status[solve] != RUNNING
        || iterations_since_start(job, slot) == job->max_iterations) refill_slot(b, all, job, slot);
    else enqueue(all, job, slot);
  }
}

/* Returns 1 if so few solves remain that the loop without lanes is faster. */
static int is_few(const loop_job *job) {
  int64_t remaining = 0;
  int slot;
  if (LANES == 1 || job->solve < job->count) return 0;
  for (slot = 0; slot < job->slot_count; ++slot) remaining += job->slots[slot] != EMPTY;
  return remaining < job->min_solves;
}

LANES_TARGET DRIVER(loop, loop_job) {
  workspace space;
  queues all;
  lane_set b;
  lanes code, *last;
  int64_t ticks = 0, solves[LANES];
  scalar limit, since;
  int finite[LANES], lane, busy, outcome = set_up(&space, 2 * N_STATE + N_PARAMETERS + N_RECORD);
  if (outcome != DONE) return outcome;
  since = monotonic();
  limit = since + job->slice;
  start_loop(&b, &all, job, (lanes *) space.extra);

  while (b.outcome == DONE && (busy = fill(&b, &all, job))) {
    int changed = 0, active_lanes = 0;
    if (is_few(job)) b.outcome = FEW_LEFT;
    for (lane = 0; lane < LANES; ++lane) {
      solves[lane] = b.slot[lane] == EMPTY ? EMPTY : job->slots[b.slot[lane]];
      if (solves[lane] != EMPTY) active_lanes |= 1 << lane;
    }
    while (!changed) {
      if (job->rows && job->n_rows + LANES > job->capacity) b.outcome = ROWS_FULL;
      if (++ticks % CLOCK_INTERVAL == 0 && monotonic() > limit) b.outcome = SLICE_OVER;
      if (job->remaining_steps <= 0) b.outcome = SLICE_OVER;
      if (b.outcome != DONE) break;
      space.arg[0] = (const real *) b.now;
      space.arg[1] = (const real *) b.parameters;
      space.arg[2] = (const real *) b.own;
      space.res[0] = (real *) b.next;
      space.res[1] = job->rows ? (real *) b.record : NULL;
      space.res[2] = (real *) &code;
      STEP(space.arg, space.res, active_lanes);
      --job->remaining_steps;
      check_finite(&b, finite);
      last = b.now;
      b.now = b.next;
      b.next = last;
      for (lane = 0; lane < LANES; ++lane) {
        if (solves[lane] == EMPTY) continue;
        ++job->iterations[solves[lane]];
        if (job->rows) write_row(&b, job, lane, solves[lane]);
        changed |= finish_iteration(&b, &all, job, lane, LANE(&code, 0, lane), finite[lane]);
      }
    }
    add_seconds(solves, busy, job, &since);
  }
  for (lane = 0; lane < LANES; ++lane) {
    if (b.slot[lane] != EMPTY) store_lane(&b, job, lane, b.now);
  }
  give_back(&space);
  return b.outcome;
}
