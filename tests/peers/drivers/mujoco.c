// MuJoCo: `mj_step` with its integrators, and finite differences of it.
//
// Methods: `euler`, `implicitfast`, `rk4`, `euler-ab`; with `-rough`, new torques at each step.

#include <stdlib.h>

#include <mujoco/mujoco.h>

#include "driver.h"

static int integrator(const char *method) {
  if (!strncmp(method, "euler", 5)) return mjINT_EULER;
  if (!strncmp(method, "implicitfast", 12)) return mjINT_IMPLICITFAST;
  if (!strncmp(method, "rk4", 3)) return mjINT_RK4;
  return -1;
}

// A motion that is lost shows in its error.
static void ignore(const char *message) { (void)message; }

int main(void) {
  mju_user_warning = ignore;
  struct command c;
  char path[1024] = "", reason[1000];
  mjModel *m = NULL;
  mjData *d = NULL;
  while (read_command(&c)) {
    if (strcmp(path, c.path)) {
      mj_deleteData(d);
      mj_deleteModel(m);
      d = NULL;
      m = mj_loadXML(c.path, NULL, reason, sizeof reason);
      strcpy(path, m ? c.path : "");
      if (!m) {
        refuse(reason);
        continue;
      }
      d = mj_makeData(m);
    }
    if (integrator(c.method) < 0) {
      refuse("no such method");
      continue;
    }
    m->opt.integrator = integrator(c.method);
    m->opt.timestep = c.dt;
    const int derivatives = !strncmp(c.method, "euler-ab", 8);
    const int rough = strstr(c.method, "-rough") != NULL && m->nuser_actuator > 0;
    const size_t n = (size_t)m->nv;
    double *A = derivatives ? malloc(4 * n * n * sizeof(double)) : NULL;
    double *B = derivatives ? malloc(2 * n * (size_t)m->nu * sizeof(double)) : NULL;
    const double begin = cpu_seconds();
    for (long pass = 0; pass < c.passes; ++pass) {
      mj_resetDataKeyframe(m, d, 0);
      for (long k = 0; k < c.steps; ++k) {
        for (int i = 0; rough && i < m->nu; ++i) d->ctrl[i] = m->actuator_user[i] * rough_number(k, i);
        if (derivatives) mjd_transitionFD(m, d, 1e-6, 0, A, B, NULL, NULL);
        mj_step(m, d);
      }
    }
    answer(cpu_seconds() - begin, d->qpos, m->nq);
    free(A);
    free(B);
  }
  return 0;
}
