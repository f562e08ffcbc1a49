
int @PREFIX@_place_kernel(const double *q, double *places, @PREFIX@_memory *memory) {
  workspace space;
  (void) take(&space, memory);
  space.arg[0] = q;
  space.res[0] = places;
  return STEP(space.arg, space.res, space.iw, space.w, 0);
}
