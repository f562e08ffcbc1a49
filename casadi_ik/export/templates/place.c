
int @PREFIX@_place_kernel(const scalar *q, scalar *poses, @PREFIX@_memory *memory) {
  workspace space;
  (void) set_up(&space, 0);
  space.arg[0] = q;
  space.res[0] = poses;
  STEP(space.arg, space.res, 0);
  return DONE;
}
