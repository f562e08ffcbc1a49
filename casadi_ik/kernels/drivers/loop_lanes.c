/* loop.c for LANES solves side by side, each as it would be alone: see there.
 *
 * A step costs least when all lanes take the same branches, so some more solves than lanes are under
 * way: a lane whose solve ends or changes its stage takes another one of the stage the lanes are
 * in, and when more wait for another stage than lanes are left at work, all turn to that. The rows
 * come as they are made; `places` says whose they are.
 *
 * Expects what loop.c does, and N_PARAMETERS, SLOTS and STAGE, the place in the state of the
 * number that tells the stages apart, -1 if there is none.
 */

#define STAGES 8
#define NOBODY (-1)

/* Solves that wait, by stage. */
typedef struct {
  int known;                   /* stages met so far; more than STAGES share the last place */
  double stage[STAGES];
  int height[STAGES];
  int waiting[STAGES][SLOTS];  /* slots */
} queues;

/* What the lanes work on. */
typedef struct {
  int slot[LANES];             /* whose state, or NOBODY */
  int queue;                   /* where its like wait */
  lanes *now, *next, *parameters, *record;
} bench;

#define LANE(pack, k, lane) (((double *) (pack))[(k) * LANES + (lane)])

static int queue_of(queues *all, double stage) {
  int i;
  for (i = 0; i < all->known; ++i) {
    if (all->stage[i] == stage) return i;
  }
  if (all->known == STAGES) return STAGES - 1;
  all->stage[all->known] = stage;
  return all->known++;
}

static void queue_up(queues *all, const loop_job *job, int slot) {
  const double stage = STAGE < 0 ? 0 : job->states[job->slots[slot] * N_STATE + STAGE];
  const int i = queue_of(all, stage == stage ? stage : -1);
  all->waiting[i][all->height[i]++] = slot;
}

/* The next solve gets a slot. */
static void admit(queues *all, loop_job *job, int slot) {
  job->slots[slot] = NOBODY;
  if (job->solve == job->count) return;
  job->slots[slot] = job->solve++;
  queue_up(all, job, slot);
}

static void sit_down(bench *b, const loop_job *job, int lane, int slot) {
  const int64_t solve = job->slots[slot];
  const double *state = job->states + solve * N_STATE;
  const double *given = job->parameters + solve * job->parameter_step;
  int k;
  for (k = 0; k < N_STATE; ++k) LANE(b->now, k, lane) = state[k];
  for (k = 0; k < N_PARAMETERS; ++k) LANE(b->parameters, k, lane) = given[k];
  b->slot[lane] = slot;
}

static void stand_up(bench *b, loop_job *job, int lane, const lanes *state) {
  double *to = job->states + job->slots[b->slot[lane]] * N_STATE;
  int k;
  for (k = 0; k < N_STATE; ++k) to[k] = LANE(state, k, lane);
  b->slot[lane] = NOBODY;
}

/* As many lanes as possible get a solve; returns how many have one. */
static int fill(bench *b, queues *all, loop_job *job) {
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
  double own[N_RECORD + 1];
  int k;
  for (k = 0; k < N_RECORD; ++k) own[k] = LANE(b->record, k, lane);
  job->places[2 * job->used] = solve;
  job->places[2 * job->used + 1] = job->iterations[solve] - 1;
  store_row(own, job->rows + ROW_BYTES * job->used++);
}

/* Which lanes have a finite state. */
LANES_TARGET static void examine(const bench *b, lane_mask *finite) {
  lanes sum = {0};
  int k;
  for (k = 0; k < N_STATE; ++k) sum += b->next[k] * SPREAD(0.0);
  *finite = (lane_mask) (sum == SPREAD(0.0));
}

/* Whether the state is once more the one marked; nearly always its first numbers tell. */
static int is_repeated(const bench *b, const double *mark, int lane) {
  int k;
  for (k = 0; k < N_STATE; ++k) {
    if (memcmp(&LANE(b->now, k, lane), mark + k, sizeof(double))) return 0;
  }
  return 1;
}

/* What comes of a lane's solve after a step; the state is in `now`, the one before in `next`. */
static int settle(
    bench *b, queues *all, loop_job *job, int lane, double code, int finite) {
  const int slot = b->slot[lane];
  const int64_t solve = job->slots[slot], iteration = job->iterations[solve];
  double *mark = job->mark + slot * N_STATE;
  int32_t status;
  int k;
  /* Written so that a NaN code fails the test too. */
  if (!(code > -CODE_LIMIT && code < CODE_LIMIT) || !finite) {
    status = NON_FINITE;
  } else {
    status = (int32_t) code;
    if (status == RUNNING && iteration > FIRST_MARK && is_repeated(b, mark, lane)) {
      status = REPEATED;
    }
  }
  if (is_marked(iteration)) {
    for (k = 0; k < N_STATE; ++k) mark[k] = LANE(b->now, k, lane);
  }
  job->status[solve] = status;
  if (status != RUNNING || iteration == job->max_iterations) {
    stand_up(b, job, lane, status == NON_FINITE ? b->next : b->now);
    admit(all, job, slot);
    return 1;
  }
#if STAGE >= 0
  if (LANE(b->now, STAGE, lane) != LANE(b->next, STAGE, lane)) {
    stand_up(b, job, lane, b->now);
    queue_up(all, job, slot);
    return 1;
  }
#endif
  return 0;
}

/* The seconds since last time, shared by the solves that had the lanes. */
static void share(const int64_t *solves, int busy, const loop_job *job, double *since) {
  const double now = monotonic(), each = (now - *since) / busy;
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
  memset(all, 0, sizeof *all);
  for (lane = 0; lane < LANES; ++lane) b->slot[lane] = NOBODY;
  for (slot = 0; slot < SLOTS; ++slot) {
    if (job->slots[slot] == NOBODY) admit(all, job, slot);
    else queue_up(all, job, slot);
  }
}

EXPORT LANES_TARGET int casadi_ik_loop_lanes(loop_job *job) {
  workspace space;
  queues all;
  bench b;
  lanes code, *last;
  lane_mask finite;
  int64_t ticks = 0;
  double limit, since;
  int64_t solves[LANES];
  int lane, busy, outcome = set_up(&space, 2 * N_STATE + N_PARAMETERS + N_RECORD);
  if (outcome != DONE) return outcome;
  begin(&b, &all, job, space.extra);
  since = monotonic();
  limit = since + job->slice;

  while (outcome == DONE && (busy = fill(&b, &all, job))) {
    int changed = 0, wanted = 0;
    for (lane = 0; lane < LANES; ++lane) {
      solves[lane] = b.slot[lane] == NOBODY ? NOBODY : job->slots[b.slot[lane]];
      if (solves[lane] != NOBODY) wanted |= 1 << lane;
    }
    while (!changed) {
      if (job->rows && job->used + LANES > job->capacity) outcome = ROWS_FULL;
      if (++ticks % CLOCK_INTERVAL == 0 && monotonic() > limit) outcome = SLICE_OVER;
      if (outcome != DONE) break;
      space.arg[0] = b.now;
      space.arg[1] = b.parameters;
      space.res[0] = b.next;
      space.res[1] = job->rows ? b.record : NULL;
      space.res[2] = &code;
      if (STEP(space.arg, space.res, space.iw, space.w, wanted)) {
        outcome = STEP_FAILED;
        break;
      }
      examine(&b, &finite);
      last = b.now;
      b.now = b.next;
      b.next = last;
      for (lane = 0; lane < LANES; ++lane) {
        if (solves[lane] == NOBODY) continue;
        ++job->iterations[solves[lane]];
        if (job->rows) write_row(&b, job, lane, solves[lane]);
        changed |= settle(&b, &all, job, lane, code[lane], finite[lane] != 0);
      }
    }
    share(solves, busy, job, &since);
  }
  for (lane = 0; lane < LANES; ++lane) {
    if (b.slot[lane] != NOBODY) stand_up(&b, job, lane, b.now);
  }
  give_back(&space);
  return outcome;
}
