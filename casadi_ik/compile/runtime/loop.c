/* A step run to its end for every solve of a batch: the one loop, for vectors and for one number.
 *
 * Compiled with LANES solves side by side (lanes.c), or, without, for one after the other; each
 * solve's iterates are the same bits. A method may say what follows when a solve's iterations end
 * (`follow`, see loop_job.c): the solve then goes on from another start in the same slot.
 *
 * Side by side a step costs least when all lanes take the same branches, so some more solves than
 * lanes are under way: a lane whose solve ends or changes its stage takes another one of the stage
 * the lanes are in, and when more wait for another stage than lanes are left at work, all turn to
 * that. The rows come as they are made; `places` says whose they are.
 *
 * A step is a function of state and parameters alone, so a state that comes back bit for bit comes
 * back for ever, and so does everything between: such a solve would run to its budget and ends as
 * REPEATED instead. Noticed as by Brent (1980): every state is compared with that of the last
 * iteration whose number is a power of two, so a cycle is found within its length after the first
 * such iteration in it that is no smaller than its length. It begins at FIRST_MARK: most solves end
 * before, and keeping states for a comparison costs.
 *
 * Expects the macros N_STATE, N_PARAMETERS, N_SEATED (those of the parameters that lanes need; a step
 * of stages finds the others in a third argument), N_RECORD, ROW_BYTES, RUNNING, NON_FINITE,
 * REPEATED, CODE_LIMIT, SLOTS, FIRST_MARK, STAGE (the place in the state of the number that tells
 * the stages apart, -1 if there is none) and the function store_row(record, row). Everything that
 * must survive a pause lives in the job's arrays: a call that returns SLICE_OVER or ROWS_FULL is
 * taken up again by calling once more, in either form of the loop.
 */

#define STAGES 12
#define NOBODY (-1)

#ifndef LANES
#define LANES 1
#define LANES_TARGET
#define SPREAD(x) ((lanes) (x))
typedef scalar lanes;
#endif
#define LANE(pack, k, lane) (((scalar *) (pack))[(k) * LANES + (lane)])

/* Solves that wait, by stage. */
typedef struct {
  int known;                   /* stages met so far; more than STAGES share the last place */
  scalar stage[STAGES];
  int height[STAGES];
  int waiting[STAGES][SLOTS];  /* slots */
} queues;

/* What the lanes work on. */
typedef struct {
  int slot[LANES];             /* whose state, or NOBODY */
  int queue;                   /* where its like wait */
  int outcome;                 /* DONE, or why the loop stops */
  lanes *now, *next, *parameters, *record;
  const scalar *own[LANES];    /* parameters of each lane's solve */
} bench;

/* Rows stand by slot where a method writes them, else by solve. */
static scalar *state_of(const loop_job *job, int slot) {
  return job->states + (job->follow ? slot : job->slots[slot]) * job->state_step;
}

static const scalar *parameters_of(const loop_job *job, int slot) {
  return job->parameters + (job->follow ? slot : job->slots[slot]) * job->parameter_step;
}

static int queue_of(queues *all, scalar stage) {
  int i;
  for (i = 0; i < all->known; ++i) {
    if (all->stage[i] == stage) return i;
  }
  if (all->known == STAGES) return STAGES - 1;
  all->stage[all->known] = stage;
  return all->known++;
}

static void queue_up(queues *all, const loop_job *job, int slot) {
  const scalar stage = STAGE < 0 ? 0 : state_of(job, slot)[STAGE < 0 ? 0 : STAGE];
  const int i = queue_of(all, stage == stage ? stage : -1);
  all->waiting[i][all->height[i]++] = slot;
}

/* Iterations since the solve's last start. */
static int64_t spent(const loop_job *job, int slot) {
  return job->iterations[job->slots[slot]] - job->begun[slot];
}

/* Where a slot's solve has ended, or none is: another start of it as the method says, or the next
 * solve. */
static void follow_up(bench *b, queues *all, loop_job *job, int slot) {
  for (;;) {
    int fresh = job->slots[slot] == NOBODY, code = 0;
    if (fresh) {
      if (job->solve == job->count) return;
      job->slots[slot] = job->solve++;
    }
    if (job->follow) {
      int32_t *status = job->status + job->slots[slot];
      code = job->follow(job->method, slot, job->slots[slot], status);
      if (code == GOES_ON) *status = RUNNING;
    } else if (fresh) {
      code = GOES_ON;
    }
    if (code == GOES_ON) {
      job->begun[slot] = job->iterations[job->slots[slot]];
      queue_up(all, job, slot);
      return;
    }
    if (code != DONE) {
      b->outcome = code;
      return;
    }
    job->slots[slot] = NOBODY;
  }
}

static void sit_down(bench *b, const loop_job *job, int lane, int slot) {
  const scalar *state = state_of(job, slot), *given = parameters_of(job, slot);
  int k;
  for (k = 0; k < N_STATE; ++k) LANE(b->now, k, lane) = state[k];
#if LANES == 1
  b->parameters = (lanes *) given;
#else
  for (k = 0; k < N_SEATED; ++k) LANE(b->parameters, k, lane) = given[k];
#endif
  b->own[lane] = given;
  b->slot[lane] = slot;
}

static void stand_up(bench *b, const loop_job *job, int lane, const lanes *state) {
  scalar *to = state_of(job, b->slot[lane]);
  int k;
  for (k = 0; k < N_STATE; ++k) to[k] = LANE(state, k, lane);
  b->slot[lane] = NOBODY;
}

/* As many lanes as possible get a solve; returns how many have one. */
static int fill(bench *b, queues *all, const loop_job *job) {
  int lane, i, busy = 0, most = 0;
  for (lane = 0; lane < LANES; ++lane) {
    if (b->slot[lane] == NOBODY && all->height[b->queue] > 0) {
      sit_down(b, job, lane, all->waiting[b->queue][--all->height[b->queue]]);
    }
    busy += b->slot[lane] != NOBODY;
  }
  if (busy == LANES) return busy;
  for (i = 1; i < all->known; ++i) {
    if (all->height[i] > all->height[most]) most = i;
  }
  if (all->height[most] <= busy) return busy;
  for (lane = 0; lane < LANES; ++lane) {
    const int slot = b->slot[lane];
    if (slot == NOBODY) continue;
    stand_up(b, job, lane, b->now);
    queue_up(all, job, slot);
  }
  b->queue = most;
  for (lane = 0; lane < LANES && all->height[most] > 0; ++lane) {
    sit_down(b, job, lane, all->waiting[most][--all->height[most]]);
  }
  return lane;
}

static void write_row(const bench *b, loop_job *job, int lane, int64_t solve) {
  scalar own[N_RECORD + 1];
  int k;
  for (k = 0; k < N_RECORD; ++k) own[k] = LANE(b->record, k, lane);
  job->places[2 * job->used] = solve;
  job->places[2 * job->used + 1] = job->iterations[solve] - 1;
  store_row(own, job->rows + ROW_BYTES * job->used++);
}

/* Which lanes have a finite state: x * 0 is 0 for finite x and NaN otherwise; sums have no branch
 * and no library call, and four of them need not wait for each other. */
LANES_TARGET static void examine(const bench *b, int *finite) {
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

/* Whether later states are compared with that of this iteration. */
static int is_marked(int64_t iteration) {
  return iteration >= FIRST_MARK && !(iteration & (iteration - 1));
}

/* Whether the state is once more the one marked; nearly always its first numbers tell. */
static int is_repeated(const bench *b, const scalar *mark, int lane) {
  int k;
  for (k = 0; k < N_STATE; ++k) {
    if (memcmp(&LANE(b->now, k, lane), mark + k, sizeof(scalar))) return 0;
  }
  return 1;
}

static void end(bench *b, queues *all, loop_job *job, int lane, int32_t status, lanes *state) {
  const int slot = b->slot[lane];
  job->status[job->slots[slot]] = status;
  stand_up(b, job, lane, state);
  follow_up(b, all, job, slot);
}

/* What comes of a lane's solve after a step; the state is in `now`, the one before in `next`.
 * Whether another solve may take the lane. */
static int settle(bench *b, queues *all, loop_job *job, int lane, scalar code, int finite) {
  const int slot = b->slot[lane];
  const int64_t iteration = spent(job, slot);
  scalar *mark = job->mark + slot * N_STATE;
  int32_t status;
  int k;
  /* Written so that a NaN code fails the test too. */
  if (!(code > -CODE_LIMIT && code < CODE_LIMIT) || !finite) {
    end(b, all, job, lane, NON_FINITE, b->next);
    return 1;
  }
  status = (int32_t) code;
  if (status == RUNNING && iteration > FIRST_MARK && is_repeated(b, mark, lane)) status = REPEATED;
  if (is_marked(iteration)) {
    for (k = 0; k < N_STATE; ++k) mark[k] = LANE(b->now, k, lane);
  }
  if (status != RUNNING || iteration == job->max_iterations) {
    end(b, all, job, lane, status, b->now);
    return 1;
  }
#if STAGE >= 0 && LANES > 1
  if (LANE(b->now, STAGE, lane) != LANE(b->next, STAGE, lane)) {
    stand_up(b, job, lane, b->now);
    queue_up(all, job, slot);
    return 1;
  }
#endif
  return 0;
}

/* The seconds since last time, shared by the solves that had the lanes. */
static void share(const int64_t *solves, int busy, const loop_job *job, scalar *since) {
  const scalar now = monotonic(), each = (now - *since) / busy;
  int lane;
  for (lane = 0; lane < LANES; ++lane) {
    if (solves[lane] != NOBODY) job->seconds[solves[lane]] += each;
  }
  *since = now;
}

static void begin(bench *b, queues *all, loop_job *job, lanes *memory) {
  int slot, lane;
  b->now = memory;
  b->next = b->now + N_STATE;
  b->parameters = b->next + N_STATE;
  b->record = b->parameters + N_PARAMETERS;
  b->queue = 0;
  b->outcome = DONE;
  all->known = 0;
  memset(all->height, 0, sizeof all->height);
  for (lane = 0; lane < LANES; ++lane) b->slot[lane] = NOBODY;
  for (slot = 0; slot < job->slot_count && b->outcome == DONE; ++slot) {
    const int64_t solve = job->slots[slot];
    if (solve == NOBODY || job->status[solve] != RUNNING
        || spent(job, slot) == job->max_iterations) follow_up(b, all, job, slot);
    else queue_up(all, job, slot);
  }
}

/* Whether so few solves are left that one after the other takes less time than side by side. */
static int is_few(const loop_job *job) {
  int64_t left = 0;
  int slot;
  if (LANES == 1 || job->solve < job->count) return 0;
  for (slot = 0; slot < job->slot_count; ++slot) left += job->slots[slot] != NOBODY;
  return left < job->fewest;
}

LANES_TARGET DRIVER(loop, loop_job) {
  workspace space;
  queues all;
  bench b;
  lanes code, *last;
  int64_t ticks = 0, solves[LANES];
  scalar limit, since;
  int finite[LANES], lane, busy, outcome = set_up(&space, 2 * N_STATE + N_PARAMETERS + N_RECORD);
  if (outcome != DONE) return outcome;
  since = monotonic();
  limit = since + job->slice;
  begin(&b, &all, job, (lanes *) space.extra);

  while (b.outcome == DONE && (busy = fill(&b, &all, job))) {
    int changed = 0, wanted = 0;
    if (is_few(job)) b.outcome = FEW_LEFT;
    for (lane = 0; lane < LANES; ++lane) {
      solves[lane] = b.slot[lane] == NOBODY ? NOBODY : job->slots[b.slot[lane]];
      if (solves[lane] != NOBODY) wanted |= 1 << lane;
    }
    while (!changed) {
      if (job->rows && job->used + LANES > job->capacity) b.outcome = ROWS_FULL;
      if (++ticks % CLOCK_INTERVAL == 0 && monotonic() > limit) b.outcome = SLICE_OVER;
      if (job->left <= 0) b.outcome = SLICE_OVER;
      if (b.outcome != DONE) break;
      space.arg[0] = (const real *) b.now;
      space.arg[1] = (const real *) b.parameters;
      space.arg[2] = (const real *) b.own;
      space.res[0] = (real *) b.next;
      space.res[1] = job->rows ? (real *) b.record : NULL;
      space.res[2] = (real *) &code;
      STEP(space.arg, space.res, wanted);
      --job->left;
      examine(&b, finite);
      last = b.now;
      b.now = b.next;
      b.next = last;
      for (lane = 0; lane < LANES; ++lane) {
        if (solves[lane] == NOBODY) continue;
        ++job->iterations[solves[lane]];
        if (job->rows) write_row(&b, job, lane, solves[lane]);
        changed |= settle(&b, &all, job, lane, LANE(&code, 0, lane), finite[lane]);
      }
    }
    share(solves, busy, job, &since);
  }
  for (lane = 0; lane < LANES; ++lane) {
    if (b.slot[lane] != NOBODY) stand_up(&b, job, lane, b.now);
  }
  give_back(&space);
  return b.outcome;
}
