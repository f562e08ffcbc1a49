#define _DEFAULT_SOURCE
#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <string.h>
#include "arm.h"
#include "targets.h"
static arm_solver solver;
static unsigned char stack[1 << 20] __attribute__((aligned(4096)));
static REAL points[3 * ARM_FINGERS], normals[3 * ARM_FINGERS];
static void *work(void *given) {
  int i, k;
  for (i = 0; i < TARGETS; ++i) {
    for (k = 0; k < 3 * ARM_FINGERS; ++k) {
      points[k] = (REAL) targets[i].points[k];
      normals[k] = (REAL) targets[i].normals[k];
    }
    arm_solve(&solver, points, normals, 0);
  }
  return given;
}
int main(void) {
  pthread_attr_t attributes;
  pthread_t thread;
  size_t least = 0;
  memset(stack, 0xa5, sizeof stack);
  arm_init(&solver);
  pthread_attr_init(&attributes);
  pthread_attr_setstack(&attributes, stack, sizeof stack);
  if (pthread_create(&thread, &attributes, work, 0)) return 1;
  pthread_join(thread, 0);
  while (least < sizeof stack && stack[least] == 0xa5) ++least;
  printf("%zu %zu\n", sizeof stack - least, sizeof solver);
  return 0;
}
