// Uses every member of plantd.hpp, rightly and wrongly: calls PLANT ROOT
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <vector>

#include "plantd.hpp"
#include "print.h"

#define CHECK(condition)                                                        \
    do {                                                                        \
        if (!(condition)) {                                                     \
            std::fprintf(stderr, "line %d: %s\n", __LINE__, #condition);        \
            std::exit(1);                                                       \
        }                                                                       \
    } while (0)

template <class Call> static plantd_status code_of(Call call) {
    try {
        call();
    } catch (const plantd::Error &error) {
        CHECK(std::strlen(error.what()) > 0 && !error.is_disconnected());
        return error.code();
    }
    return PLANTD_OK;
}

static plantd_numbers numbers(std::span<const double> span) { return {span.data(), span.size()}; }

int main(int argc, char **argv) {
    CHECK(argc == 3);
    plantd::Options options{.root = argv[2], .connect_timeout = std::chrono::milliseconds(50)};
    CHECK(code_of([&] { plantd::Link("nobody", options); }) == PLANTD_NOT_OPEN);
    options.timeout = std::chrono::seconds(10);
    options.connect_timeout = std::chrono::seconds(5);
    options.poll_forever = true;
    std::vector<double> u;
    {
        plantd::Link link(argv[1], options);
        CHECK(code_of([&] { plantd::Link(argv[1], options); }) == PLANTD_LEASE_HELD);
        const plantd_dimensions &d = link.dimensions();
        plantd::State state = link.state();
        u.assign(d.input_len, 0.0);
        for (std::size_t k = 0; k < d.prescribed; ++k) u[d.inputs + k] = state.q[d.dynamic + k];
        CHECK(link.time_step_s() == d.time_step_s && state.step == 0);
        CHECK(code_of([&] { link.step({1.0}); }) == PLANTD_DIMENSION);
        CHECK(code_of([&] { link.offer({}); }) == PLANTD_DIMENSION);
        std::vector<double> wrong(u.size(), NAN);
        CHECK(code_of([&] { link.step(wrong); }) == PLANTD_INPUT_NOT_FINITE);
        CHECK(link.step(u).step == 1);
        // A link that is moved from closes nothing.
        plantd::Link other = std::move(link);
        CHECK(code_of([&] { link.state(); }) == PLANTD_ARGUMENT);
        CHECK(other.step(u).step == 2);
    }
    plantd::Link link(argv[1], options);
    const plantd::State s = link.step(u);
    const plantd_state raw = {
        s.step, s.time_s, numbers(s.q), numbers(s.p), numbers(s.v), numbers(s.velocity),
        numbers(s.multipliers), numbers(s.x), numbers(s.outputs), numbers(s.lost),
        s.residual, s.constraint_residual, s.reciprocal_condition, s.constraint_reciprocal_condition,
        s.iterations, s.factorizations, s.redundant_constraints, s.steps, s.halvings};
    print_state(&raw);
}
