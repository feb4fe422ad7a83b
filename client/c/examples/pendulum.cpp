// Holds a pendulum where it hangs, over shared memory: pendulum PLANT [ROOT [STEPS]]
#include <cstdio>
#include <cstdlib>

#include "plantd.hpp"

int main(int argc, char **argv) try {
    if (argc < 2) throw std::invalid_argument("pendulum PLANT [ROOT [STEPS]]");
    plantd::Options options;
    if (argc > 2) options.root = argv[2];
    const long steps = argc > 3 ? std::atol(argv[3]) : 1000;

    plantd::Link link(argv[1], options);
    plantd::State state = link.state();
    for (long k = 0; k < steps; ++k) {
        state = link.step({-3.0 * state.q[0] - state.p[0]});
        std::printf("%.17g %.17g %.17g\n", state.q[0], state.p[0], state.velocity[0]);
    }
} catch (const std::exception &error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
}
