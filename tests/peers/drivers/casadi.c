// Straight-line C that CasADi generated for one mechanism: semi-implicit Euler by the articulated-body
// algorithm, and its derivatives by CasADi's automatic differentiation. PATH is a shared library.
//
// Methods: `euler`, `euler-ab`.

#include <dlfcn.h>
#include <stdlib.h>

#include "driver.h"

typedef int function(const double **arguments, double **results, long long *, double *, int);

// Work space beyond what any of the functions asks for: SX functions keep theirs on the stack.
static double work[1 << 16];
static long long integers[1 << 10];

int main(void) {
  struct command c;
  char path[1024] = "";
  void *library = NULL;
  while (read_command(&c)) {
    if (strcmp(path, c.path)) {
      if (library) dlclose(library);
      library = dlopen(c.path, RTLD_NOW);
      strcpy(path, library ? c.path : "");
      if (!library) {
        refuse(dlerror());
        continue;
      }
    }
    const int derivatives = !strcmp(c.method, "euler-ab");
    function *step = (function *)dlsym(library, derivatives ? "euler_ab" : "euler");
    const double *start = (const double *)dlsym(library, "mechanism_start");
    const int n = *(const int *)dlsym(library, "mechanism_size");
    if (!step) {
      refuse("no such method");
      continue;
    }
    const size_t size = (size_t)n * sizeof(double);
    double *q = malloc(size), *v = malloc(size), *u = calloc((size_t)n, sizeof(double));
    double *A = malloc(4 * size * (size_t)n), *B = malloc(2 * size * (size_t)n);
    const double begin = cpu_seconds();
    for (long pass = 0; pass < c.passes; ++pass) {
      memcpy(q, start, size);
      memcpy(v, start + n, size);
      for (long k = 0; k < c.steps; ++k) {
        const double *arguments[] = {q, v, u, &c.dt};
        double *results[] = {q, v, A, B};
        step(arguments, results, integers, work, 0);
      }
    }
    answer(cpu_seconds() - begin, q, n);
    free(q), free(v), free(u), free(A), free(B);
  }
  return 0;
}
