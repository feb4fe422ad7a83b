/* Holds a pendulum where it hangs, over shared memory: pendulum PLANT [ROOT [STEPS]] */
#include <stdio.h>
#include <stdlib.h>

#include "plantd.h"

int main(int argc, char **argv) {
    if (argc < 2) {
        fprintf(stderr, "pendulum PLANT [ROOT [STEPS]]\n");
        return 2;
    }
    plantd_options options;
    plantd_options_init(&options);
    if (argc > 2) options.root = argv[2];
    const long steps = argc > 3 ? atol(argv[3]) : 1000;

    plantd_link *link;
    if (plantd_link_open(argv[1], &options, &link) != PLANTD_OK) {
        fprintf(stderr, "%s\n", plantd_link_error(NULL));
        return 1;
    }
    plantd_state state;
    plantd_link_state(link, &state);
    for (long k = 0; k < steps; k++) {
        const double torque = -3.0 * state.q.data[0] - state.p.data[0];
        if (plantd_link_step(link, &torque, 1, &state) != PLANTD_OK) {
            fprintf(stderr, "%s\n", plantd_link_error(link));
            plantd_link_close(link);
            return 1;
        }
        printf("%.17g %.17g %.17g\n", state.q.data[0], state.p.data[0], state.velocity.data[0]);
    }
    plantd_link_close(link);
    return 0;
}
