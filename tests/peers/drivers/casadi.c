// Straight-line C that CasADi generated for one mechanism: accelerations by the articulated-body algorithm,
// semi-implicit Euler with them, and its derivatives by CasADi's automatic differentiation. PATH is a shared library.
//
// Methods: `euler`, `rk4`, `dop853:TOLERANCE` (DT times STEPS is the whole time then), `euler-ab`; `euler-rough` under
// torques that change at each step.

#include <dlfcn.h>
#include <stdlib.h>

#include "dop853.h"  // A, B, E3, E5 of the pair, written by compare.py
#include "driver.h"

typedef int function(const double **arguments, double **results, long long *, double *, int);

// Work space beyond what any of the functions asks for: SX functions keep theirs on the stack.
static double work[1 << 16];
static long long integers[1 << 10];

struct mechanism {
  int n;
  function *euler, *euler_ab, *accelerations;
  const double *start, *rough;
  // The state, torques, and the columns of A and B.
  double *y, *u, *A, *B;
  // Rates of the state at thirteen stages, and where one of them is.
  double *rates[13], *stage;
};

static void close_mechanism(struct mechanism *m) {
  free(m->y), free(m->u), free(m->A), free(m->B), free(m->stage);
  for (int s = 0; s < 13; ++s) free(m->rates[s]);
}

static bool open_mechanism(struct mechanism *m, void *library) {
  m->euler = (function *)dlsym(library, "euler");
  m->euler_ab = (function *)dlsym(library, "euler_ab");
  m->accelerations = (function *)dlsym(library, "accelerations");
  m->start = (const double *)dlsym(library, "mechanism_start");
  m->rough = (const double *)dlsym(library, "mechanism_rough");
  const int *size = (const int *)dlsym(library, "mechanism_size");
  if (!m->euler || !m->accelerations || !m->start || !m->rough || !size) return false;
  m->n = *size;
  const size_t bytes = (size_t)m->n * sizeof(double);
  m->y = malloc(2 * bytes), m->stage = malloc(2 * bytes), m->u = calloc((size_t)m->n, sizeof(double));
  m->A = malloc(4 * bytes * (size_t)m->n), m->B = malloc(2 * bytes * (size_t)m->n);
  for (int s = 0; s < 13; ++s) m->rates[s] = malloc(2 * bytes);
  return true;
}

static void step(struct mechanism *m, function *map, double h) {
  const double *arguments[] = {m->y, m->y + m->n, m->u, &h};
  double *results[] = {m->y, m->y + m->n, m->A, m->B};
  map(arguments, results, integers, work, 0);
}

static void rate(struct mechanism *m, const double *y, double *rates) {
  memcpy(rates, y + m->n, (size_t)m->n * sizeof(double));
  const double *arguments[] = {y, y + m->n, m->u};
  double *results[] = {rates + m->n};
  m->accelerations(arguments, results, integers, work, 0);
}

static void rk4(struct mechanism *m, double h) {
  const int n = 2 * m->n;
  double **k = m->rates;
  rate(m, m->y, k[0]);
  for (int s = 1; s < 4; ++s) {
    const double ahead = s < 3 ? 0.5 * h : h;
    for (int i = 0; i < n; ++i) m->stage[i] = m->y[i] + ahead * k[s - 1][i];
    rate(m, m->stage, k[s]);
  }
  for (int i = 0; i < n; ++i) m->y[i] += h / 6 * (k[0][i] + 2 * k[1][i] + 2 * k[2][i] + k[3][i]);
}

// Where a combination of the first rates leads.
static void go(struct mechanism *m, double h, const double *weights, int count) {
  const int n = 2 * m->n;
  for (int i = 0; i < n; ++i) {
    double sum = 0;
    for (int s = 0; s < count; ++s) sum += weights[s] * m->rates[s][i];
    m->stage[i] = m->y[i] + h * sum;
  }
}

// False if the motion is lost.
static bool dop853(struct mechanism *m, double end, double tolerance) {
  const int n = 2 * m->n;
  double t = 0;
  struct stride stride = {0.01, false};
  rate(m, m->y, m->rates[0]);
  while (t < end) {
    const double h = stride.h = fmin(stride.h, end - t);
    for (int s = 1; s < 12; ++s) {
      go(m, h, DOP853_A[s], s);
      rate(m, m->stage, m->rates[s]);
    }
    go(m, h, DOP853_B, 12);
    rate(m, m->stage, m->rates[12]);
    double third = 0, fifth = 0;
    for (int i = 0; i < n; ++i) {
      double e3 = 0, e5 = 0;
      for (int s = 0; s < 13; ++s) {
        e3 += DOP853_E3[s] * m->rates[s][i];
        e5 += DOP853_E5[s] * m->rates[s][i];
      }
      const double scale = tolerance * (1 + fmax(fabs(m->y[i]), fabs(m->stage[i])));
      third += e3 / scale * (e3 / scale);
      fifth += e5 / scale * (e5 / scale);
    }
    const double error = dop853_error(h, third, fifth, n);
    if (!isfinite(error)) return false;
    if (dop853_accept(&stride, error)) {
      t += h;
      memcpy(m->y, m->stage, (size_t)n * sizeof(double));
      double *last = m->rates[12];
      m->rates[12] = m->rates[0], m->rates[0] = last;
    }
  }
  return true;
}

// One pass from the start; the reason if it cannot be run.
static const char *run(struct mechanism *m, const struct command *c) {
  memcpy(m->y, m->start, 2 * (size_t)m->n * sizeof(double));
  if (!strncmp(c->method, "dop853:", 7)) {
    return dop853(m, c->dt * (double)c->steps, atof(c->method + 7)) ? NULL : "the motion is lost";
  }
  const bool is_rough = !strcmp(c->method, "euler-rough");
  const bool has_derivatives = !strcmp(c->method, "euler-ab");
  const bool is_euler = is_rough || !strcmp(c->method, "euler");
  if (!is_euler && strcmp(c->method, "rk4") && !(has_derivatives && m->euler_ab)) return "no such method";
  for (long k = 0; k < c->steps; ++k) {
    for (int i = 0; is_rough && i < m->n; ++i) m->u[i] = m->rough[i] * rough_number(k, i);
    if (is_euler) {
      step(m, m->euler, c->dt);
    } else if (has_derivatives) {
      step(m, m->euler_ab, c->dt);
    } else {
      rk4(m, c->dt);
    }
  }
  memset(m->u, 0, (size_t)m->n * sizeof(double));
  return NULL;
}

int main(void) {
  struct command c;
  char path[1024] = "";
  void *library = NULL;
  struct mechanism m = {0};
  while (read_command(&c)) {
    if (strcmp(path, c.path)) {
      close_mechanism(&m);
      if (library) dlclose(library);
      m = (struct mechanism){0};
      path[0] = 0;
      library = dlopen(c.path, RTLD_NOW);
      if (!library || !open_mechanism(&m, library)) {
        refuse(library ? "a mechanism is not whole" : dlerror());
        continue;
      }
      strcpy(path, c.path);
    }
    const double begin = cpu_seconds();
    const char *reason = NULL;
    for (long pass = 0; pass < c.passes && !reason; ++pass) reason = run(&m, &c);
    if (reason) {
      refuse(reason);
    } else {
      answer(cpu_seconds() - begin, m.y, m.n);
    }
  }
  return 0;
}
