// plantd.hpp: drives a plant of plantd over shared memory, in C++20.
//
//     plantd::Link link("pendulum");
//     plantd::State state = link.state();
//     for (int k = 0; k < 1000; ++k) {
//         const double u = -3.0 * state.q[0] - state.p[0];
//         state = link.step({&u, 1});
//     }
//
// A link holds the plant's lease until it is destroyed, and belongs to the thread that has made it. Calls
// that fail throw plantd::Error; the plant is then as it was. See plantd.h for units and sizes.
#ifndef PLANTD_HPP
#define PLANTD_HPP

#include <chrono>
#include <cstdint>
#include <initializer_list>
#include <memory>
#include <optional>
#include <span>
#include <stdexcept>
#include <string>

#include "plantd.h"

namespace plantd {

// Why a call failed.
class Error : public std::runtime_error {
public:
    Error(plantd_status code, const std::string &message) : std::runtime_error(message), code_(code) {}

    plantd_status code() const noexcept { return code_; }

    // Whether Link::reconnect is the way on.
    bool is_disconnected() const noexcept {
        return code_ == PLANTD_SERVER_GONE || code_ == PLANTD_SERVER_RESTARTED ||
               code_ == PLANTD_CLOSED || code_ == PLANTD_LEASE_LOST;
    }

private:
    plantd_status code_;
};

// How to open a link.
struct Options {
    std::optional<std::string> root = std::nullopt;    // root path of the server's links
    std::chrono::nanoseconds poll = std::chrono::microseconds(50); // polls so long before it sleeps
    bool poll_forever = false;                         // fastest, and takes a processor while it waits
    std::chrono::duration<double> timeout{1.0};        // longest wait for the answer to a step
    std::chrono::duration<double> connect_timeout{1.0};
};

// A state of the plant. The spans are the link's: valid until its next call.
struct State {
    std::uint64_t step;
    double time_s;
    std::span<const double> q, p, v, velocity, multipliers, x, outputs, lost;
    std::uint32_t iterations, factorizations, redundant_constraints, steps, halvings;
    double residual, constraint_residual, reciprocal_condition, constraint_reciprocal_condition;
};

// An open link.
class Link {
public:
    explicit Link(const std::string &plant, const Options &options = {}) {
        plantd_options raw;
        plantd_options_init(&raw);
        raw.root = options.root ? options.root->c_str() : nullptr;
        raw.poll_ns = options.poll_forever ? PLANTD_POLL_FOREVER
                                           : static_cast<std::uint64_t>(options.poll.count());
        raw.timeout_s = options.timeout.count();
        raw.connect_timeout_s = options.connect_timeout.count();
        plantd_link *link = nullptr;
        const plantd_status status = plantd_link_open(plant.c_str(), &raw, &link);
        if (status != PLANTD_OK) throw Error(status, plantd_link_error(nullptr));
        link_.reset(link);
        check(plantd_link_dimensions(link, &dimensions_));
    }

    // Takes one step with u, ni + nk entries.
    State step(std::span<const double> u) {
        plantd_state state;
        check(plantd_link_step(link_.get(), u.data(), u.size(), &state));
        return view(state);
    }
    State step(std::initializer_list<double> u) { return step(std::span<const double>(u.begin(), u.size())); }

    // Gives a plant that runs by itself an input, and does not wait.
    void offer(std::span<const double> u) { check(plantd_link_offer(link_.get(), u.data(), u.size())); }

    // Waits for the next state of a plant that runs by itself.
    State next() {
        plantd_state state;
        check(plantd_link_next(link_.get(), &state));
        return view(state);
    }

    // The last state.
    State state() {
        plantd_state state;
        check(plantd_link_state(link_.get(), &state));
        return view(state);
    }

    // Connects again, after an error that is_disconnected().
    void reconnect() {
        check(plantd_link_reconnect(link_.get()));
        check(plantd_link_dimensions(link_.get(), &dimensions_));
    }

    const plantd_dimensions &dimensions() const noexcept { return dimensions_; }
    double time_step_s() const noexcept { return dimensions_.time_step_s; }

private:
    struct Close {
        void operator()(plantd_link *link) const noexcept { plantd_link_close(link); }
    };

    void check(plantd_status status) const {
        if (status == PLANTD_OK) return;
        const bool has_message = status != PLANTD_ARGUMENT && status != PLANTD_THREAD;
        throw Error(status, plantd_link_error(has_message ? link_.get() : nullptr));
    }

    static std::span<const double> span(plantd_numbers numbers) { return {numbers.data, numbers.len}; }

    static State view(const plantd_state &s) {
        return {s.step, s.time_s, span(s.q), span(s.p), span(s.v), span(s.velocity),
                span(s.multipliers), span(s.x), span(s.outputs), span(s.lost),
                s.iterations, s.factorizations, s.redundant_constraints, s.steps, s.halvings,
                s.residual, s.constraint_residual, s.reciprocal_condition,
                s.constraint_reciprocal_condition};
    }

    std::unique_ptr<plantd_link, Close> link_;
    plantd_dimensions dimensions_{};
};

} // namespace plantd

#endif // PLANTD_HPP
