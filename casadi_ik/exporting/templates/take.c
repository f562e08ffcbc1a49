
static int take(workspace *space, @PREFIX@_memory *memory) {
  space->arg = memory->arg;
  space->res = memory->res;
  space->iw = memory->iw;
  space->w = memory->w;
  space->extra = memory->w + N_W;
  space->mem = 0;
  return DONE;
}

