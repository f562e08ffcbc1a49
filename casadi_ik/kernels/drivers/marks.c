
/* Whether later states are compared with that of this iteration. */
static int is_marked(int64_t iteration) {
  return iteration >= FIRST_MARK && !(iteration & (iteration - 1));
}
