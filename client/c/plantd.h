/*
 * plantd.h: drives a plant of plantd over shared memory, from a process on the server's machine.
 *
 *     plantd_link *link;
 *     plantd_state state;
 *     double u[1] = {0.0};
 *     if (plantd_link_open("pendulum", NULL, &link) != PLANTD_OK)
 *         errx(1, "%s", plantd_link_error(NULL));
 *     plantd_link_state(link, &state);
 *     for (int k = 0; k < 1000; k++) {
 *         u[0] = -3.0 * state.q.data[0] - state.p.data[0];
 *         if (plantd_link_step(link, u, 1, &state) != PLANTD_OK)
 *             errx(1, "%s", plantd_link_error(link));
 *     }
 *     plantd_link_close(link);
 *
 * Links with `pkg-config --cflags --libs plantd`, or in CMake with `find_package(plantd)` and the target
 * `plantd::plantd`. For C++ there is plantd.hpp. The layout underneath is that of plantd_link.h, which
 * programs that use this library do not need.
 *
 * A link belongs to the thread that has opened it; different threads may have links of different plants.
 * Units are SI, angles are radians.
 */
#ifndef PLANTD_H
#define PLANTD_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* What a call came to; plantd_link_error has it in words. After a failed call the plant is as it was. */
typedef enum plantd_status {
    PLANTD_OK = 0,
    PLANTD_ARGUMENT = 1,         /* a null pointer, a link that is not open, or a time that is none */
    PLANTD_NOT_OPEN = 2,         /* there is no open link of that plant, or it cannot be used */
    PLANTD_LEASE_HELD = 3,       /* somebody else drives the plant */
    PLANTD_TIMEOUT = 4,          /* no answer in time; a step may still be taken */
    PLANTD_SERVER_GONE = 5,      /* reconnect, when it is there again */
    PLANTD_SERVER_RESTARTED = 6, /* reconnect */
    PLANTD_CLOSED = 7,           /* the server has closed the link, or deleted the plant */
    PLANTD_LEASE_LOST = 8,       /* the server has taken the lease back; reconnect */
    PLANTD_DIMENSION = 9,        /* u has not ni + nk entries */
    PLANTD_SEQUENCE = 10,        /* an input was lost; the next step goes on */
    PLANTD_INPUT_NOT_FINITE = 11,
    PLANTD_STEP_FAILED = 12,     /* the step cannot be solved; the next step goes on from here */
    PLANTD_WATCHDOG = 13,        /* a watchdog holds the plant */
    PLANTD_REFUSED = 14,         /* the server refused a message of this library */
    PLANTD_THREAD = 15,          /* another thread has opened the link */
    PLANTD_PANIC = 16            /* an error of this library; close the link */
} plantd_status;

#define PLANTD_POLL_FOREVER UINT64_MAX

/* How to open a link. plantd_options_init fills in what is usual. */
typedef struct plantd_options {
    const char *root;         /* root path of the server's links, as OpenLink returns it; NULL: its default */
    uint64_t poll_ns;         /* polls so long for an answer, ns, before it sleeps; usually 50000 */
    double timeout_s;         /* longest wait for the answer to a step, s; usually 1 */
    double connect_timeout_s; /* longest wait for the link to be open and to answer, s; usually 1 */
} plantd_options;

/* Sizes of a plant. */
typedef struct plantd_dimensions {
    size_t dynamic;        /* dynamic coordinates, nd */
    size_t prescribed;     /* prescribed coordinates, nk */
    size_t inputs;         /* inputs, ni */
    size_t constraints;    /* constraint equations, nc */
    size_t input_len;      /* entries of u, ni + nk: inputs, then next positions of prescribed coordinates */
    double time_step_s;    /* time step, s */
    uint64_t model_digest; /* equal digests mean equal motion */
} plantd_dimensions;

/* Numbers that are the link's: valid until its next call. */
typedef struct plantd_numbers {
    const double *data;
    size_t len;
} plantd_numbers;

/* A state of the plant, and what the solver did to get there. */
typedef struct plantd_state {
    uint64_t step;              /* steps since the plant was created or reset */
    double time_s;              /* plant time, s */
    plantd_numbers q;           /* configuration, nd + nk, m or rad */
    plantd_numbers p;           /* discrete momentum, nd */
    plantd_numbers v;           /* velocity of prescribed coordinates over the last step, nk */
    plantd_numbers velocity;    /* velocity of all coordinates, nd + nk, m/s or rad/s */
    plantd_numbers multipliers; /* constraint impulses of the last step, nc */
    plantd_numbers x;           /* (q, p, v), 2 nd + 2 nk */
    plantd_numbers outputs;     /* what the output channels deliver; empty without channels */
    plantd_numbers lost;        /* for each output channel 1 where its numbers stand for lost ones, else 0 */
    double residual;            /* final residual in units of its own round-off */
    double constraint_residual; /* constraint violation in units of its own round-off */
    double reciprocal_condition;            /* estimate for the Newton matrix, at most 1 */
    double constraint_reciprocal_condition; /* estimate for the constraints; 1 without any */
    uint32_t iterations;            /* residual evaluations */
    uint32_t factorizations;        /* factorizations of the Newton matrix */
    uint32_t redundant_constraints; /* constraint equations that follow from others */
    uint32_t steps;                 /* steps of the method in the time step */
    uint32_t halvings;              /* how often the time step was halved */
} plantd_state;

/* An open link. It holds the plant's lease until it is closed. */
typedef struct plantd_link plantd_link;

/* Version of the library, such as "0.1.0". */
const char *plantd_version(void);

/* Fills in the usual options. */
void plantd_options_init(plantd_options *options);

/* Connects to a plant whose link is open and takes its lease; options may be NULL. Takes tens of
   milliseconds. Writes NULL to *link when it fails. */
plantd_status plantd_link_open(const char *plant, const plantd_options *options, plantd_link **link);

/* Connects again to the same plant with the same options, after PLANTD_SERVER_GONE,
   PLANTD_SERVER_RESTARTED, PLANTD_LEASE_LOST or PLANTD_CLOSED. */
plantd_status plantd_link_reconnect(plantd_link *link);

/* Takes one step with u and waits for the state after it, which is written to *state unless it is NULL. Of
   a plant that runs by itself it waits for the latest state on which the input acted. */
plantd_status plantd_link_step(plantd_link *link, const double *u, size_t count, plantd_state *state);

/* Gives a plant that runs by itself an input, which acts from its next step on, and does not wait. */
plantd_status plantd_link_offer(plantd_link *link, const double *u, size_t count);

/* Waits for the next state of a plant that runs by itself, whatever input acted. */
plantd_status plantd_link_next(plantd_link *link, plantd_state *state);

/* The last state: of the last step, or of the time of the connection. */
plantd_status plantd_link_state(plantd_link *link, plantd_state *state);

/* Sizes and time step of the plant. */
plantd_status plantd_link_dimensions(plantd_link *link, plantd_dimensions *dimensions);

/* What went wrong in the link's last call that failed; with NULL, in this thread's last call that had no
   link: of plantd_link_open above all. Valid until the next call that fails. */
const char *plantd_link_error(const plantd_link *link);

/* Name of a code: "LEASE_HELD". */
const char *plantd_status_name(int status);

/* Gives the lease back and frees the link, which is not to be used any more; NULL is no error. */
plantd_status plantd_link_close(plantd_link *link);

#ifdef __cplusplus
}
#endif

#endif /* PLANTD_H */
