// What the drivers in C and C++ share. A driver reads lines
//
//   PATH METHOD DT STEPS PASSES
//
// runs PASSES times STEPS steps of DT seconds from the mechanism's start, and answers each line with the
// CPU seconds of its thread and the last configuration, or with `error:` and a reason.

#ifndef DRIVER_H
#define DRIVER_H

#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <string.h>
#include <time.h>

struct command {
  char path[1024];
  char method[64];
  double dt;
  long steps;
  long passes;
};

static int read_command(struct command *c) {
  return scanf("%1023s %63s %lf %ld %ld", c->path, c->method, &c->dt, &c->steps, &c->passes) == 5;
}

static double cpu_seconds(void) {
  struct timespec now;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

// Between -1 and 1: the same in all drivers, whatever they are written in.
static double rough_number(long step, long motor) {
  unsigned x = (unsigned)step * 2654435761u + (unsigned)motor * 40503u + 1u;
  x = (x ^ (x >> 15)) * 2246822519u;
  x = (x ^ (x >> 13)) * 3266489917u;
  x ^= x >> 16;
  return (double)x * (2.0 / 4294967296.0) - 1.0;
}

// How long the steps of DOP853 are: Hairer, Nørsett, Wanner, Solving Ordinary Differential Equations I, II.5.
struct stride {
  double h;
  bool rejected;
};

// The error of a step, 1 at the tolerance, from the squares of the estimates of third and fifth order of so many
// numbers, each over its scale.
static double dop853_error(double h, double third, double fifth, double count) {
  const double sum = fifth + 0.01 * third;
  return sum == 0 ? 0 : h * fifth / sqrt(sum * count);
}

// Whether a step with that error is taken; the next one, or the same again, is as long as suits it.
static bool dop853_accept(struct stride *stride, double error) {
  const double factor = error == 0 ? 10 : 0.9 * pow(error, -1.0 / 8);
  const bool accepted = error < 1;
  stride->h *= accepted ? fmin(stride->rejected ? 1 : 10, factor) : fmax(0.2, factor);
  stride->rejected = !accepted;
  return accepted;
}

static void answer(double seconds, const double *q, int n) {
  printf("%.9e", seconds);
  for (int i = 0; i < n; ++i) printf(" %.17g", q[i]);
  printf("\n");
  fflush(stdout);
}

static void refuse(const char *reason) {
  printf("error: %s\n", reason);
  fflush(stdout);
}

#endif
