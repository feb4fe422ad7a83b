/*
 * plantd_link.h: layout of the shared-memory link of plantd, version 5.
 *
 * A message is one plantd_link_header (the user header of an iceoryx2 sample) and a slice of
 * double. Each open plant has, in an iceoryx2 domain of the server,
 *
 *     plantd/5/<plant>/input   publish-subscribe and event, drivers to server
 *     plantd/5/<plant>/state   publish-subscribe and event, server to drivers
 *
 * Each start of a server has a domain of its own under the server's root path. The file
 * <root>/<plant>.link says in which one a plant's link is: its first line is the name <domain>, six
 * hexadecimal digits; each further line is the size in bytes and the name of a segment in /dev/shm that
 * the server has made. Without further lines the link is not open yet. The server lives as long as a
 * shared flock of the directory <root>/<domain> fails with EWOULDBLOCK. To become a member, a driver
 *
 * - makes sure that the root is no symbolic link, and that it belongs to its own user and to nobody
 *   else (mode 0700);
 * - opens or creates the file <root>/<domain>/<pid>.member (mode 0600) and keeps a shared flock of it
 *   until it has left the domain; <pid> is the first number of the line NSpid in /proc/self/status.
 *   If the path then names another file or none, it was too late, and the driver does so again;
 * - makes sure that the segments in the link file are its own user's, closed to others (mode 0600), and
 *   of the sizes given there;
 * - opens the services with an iceoryx2 0.10 configuration with the root path <root>/<domain> and the
 *   prefix plantd5_<domain>_, without clean-up of dead nodes: the server does it.
 *
 * Who leaves a domain that has neither server nor members any more may remove its segments and then its
 * directory, under an exclusive flock of the root; the next server does so in any case. When the file
 * <root>/<plant>.link names another domain than the driver's, the server has restarted.
 *
 * The publish-subscribe services have the payload type
 * "f64" (dynamic), the user header type PLANTD_LINK_TYPE_NAME, and the attributes
 * plantd.layout = "5" and plantd.schema = PLANTD_LINK_SCHEMA_HASH as sixteen hexadecimal digits.
 *
 * Conversation:
 *
 * 1. The driver sends ATTACH with a random `driver` number, its process id and its process's start
 *    time. The server takes the plant's lease and answers ATTACHED with its own random `server`
 *    number and the current state, or FAILURE with LEASE_HELD. An ATTACH that is not answered is
 *    repeated.
 * 2. For each step the driver sends one INPUT with `sequence` one higher than the last (the first is
 *    1) and waits for STATE or FAILURE with the same `sequence`. A failed step leaves the plant as
 *    it was, and the conversation goes on.
 * 3. The driver sends DETACH, or dies: the server notices and takes the lease back.
 *
 * The orientation of a ball joint takes three entries of q, a rotation vector: a controller takes the
 * difference of two of them on the rotation group, log(R_reference' R).
 *
 * The server broadcasts; a driver ignores messages with another `driver` number than its own, except
 * CLOSED. A `server` number other than the one in ATTACHED means that the server has restarted or
 * has reopened the link: attach again.
 *
 * Each message says how long its sender polls for what comes next (stamp_ns + poll_ns on
 * CLOCK_MONOTONIC); after that it sleeps on its event listener. Who has sent a message looks at the
 * clock afterwards, behind a full memory barrier, and notifies if the receiver's polling time is
 * over. A receiver polls once more after its time is over, before it sleeps.
 */
#ifndef PLANTD_LINK_H
#define PLANTD_LINK_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define PLANTD_LINK_LAYOUT_VERSION 5u
#define PLANTD_LINK_MAGIC 0x746e6c70u /* "plnt" */
#define PLANTD_LINK_SCHEMA_HASH UINT64_C(0x8e73cfd450056052)
#define PLANTD_LINK_TYPE_NAME "PlantdLinkHeader5"
#define PLANTD_LINK_POLL_FOREVER_NS UINT64_MAX

/* What a message is. */
enum plantd_link_kind {
    PLANTD_LINK_ATTACH = 1,    /* driver: asks for the lease; no payload */
    PLANTD_LINK_INPUT = 2,     /* driver: input of one step; payload u, ni + nk entries */
    PLANTD_LINK_DETACH = 3,    /* driver: gives the lease back; no payload, no answer */
    PLANTD_LINK_ATTACHED = 16, /* server: the lease is the driver's; payload as in STATE */
    PLANTD_LINK_STATE = 17,    /* server: a step was taken; payload q (nd + nk), p (nd), v (nk),
                                  multipliers (nc), velocity (nd + nk), outputs (ny), and for
                                  each output channel 1 where its numbers stand for lost ones,
                                  else 0; v is that of the prescribed coordinates alone, over the
                                  last step, and velocity that of all coordinates, m/s or rad/s,
                                  which belongs to the momentum projected onto the constraints */
    PLANTD_LINK_FAILURE = 18,  /* server: refused or failed, see code; the plant is as it was */
    PLANTD_LINK_CLOSED = 19    /* server: the link ends, see code */
};

/* Why something was refused, failed or ended. */
enum plantd_link_code {
    PLANTD_LINK_CODE_LAYOUT = 1,           /* magic, version or schema hash is another one */
    PLANTD_LINK_CODE_KIND = 2,             /* not a message that a driver sends */
    PLANTD_LINK_CODE_LEASE_HELD = 3,       /* detail_a: a holder; detail_b: its process id */
    PLANTD_LINK_CODE_NOT_ATTACHED = 4,     /* the sender does not hold the lease */
    PLANTD_LINK_CODE_SEQUENCE = 5,         /* detail_a: the number that was expected */
    PLANTD_LINK_CODE_DIMENSION = 6,        /* detail_a: entries needed; detail_b: entries given */
    PLANTD_LINK_CODE_INPUT_NOT_FINITE = 7, /* detail_a: which entry; detail_value: its value */
    PLANTD_LINK_CODE_NOT_CONVERGED = 8,    /* iterations, residual */
    PLANTD_LINK_CODE_NOT_FINITE = 9,       /* iterations */
    PLANTD_LINK_CODE_SINGULAR = 10,        /* detail_a: coordinate; detail_value: relative pivot */
    PLANTD_LINK_CODE_PLANT_DELETED = 11,
    PLANTD_LINK_CODE_LINK_CLOSED = 12,
    PLANTD_LINK_CODE_TOO_FAST = 13,        /* detail_a: coordinate; detail_value: its increment, rad,
                                              more than half a turn */
    PLANTD_LINK_CODE_SINGULAR_CONSTRAINTS = 14, /* detail_a: first constraint equation; detail_b: how
                                                   many; detail_value: reciprocal condition */
    PLANTD_LINK_CODE_INCONSISTENT_CONSTRAINTS = 15, /* detail_a, detail_b: as above; detail_value: the
                                                       largest violation */
    PLANTD_LINK_CODE_WATCHDOG = 16         /* a watchdog holds the plant; detail_a: its index;
                                              detail_value: its quantity; residual: the bound that it
                                              left; detail_b: which quantity, 1 + the index of a
                                              coordinate, a coordinate's velocity, a constraint or
                                              the energy, with 0, 1, 2 or 3 in the upper half */
};

/* In code of a STATE: the plant runs by itself, the message answers no input, and sequence is that of the
   input in force; no new input had come; there was no valid input. */
#define PLANTD_LINK_LIVE 0x80000000u
#define PLANTD_LINK_LIVE_INPUT_LATE 1u
#define PLANTD_LINK_LIVE_INPUT_SAFE 2u

/* Who holds a lease. */
enum plantd_link_holder {
    PLANTD_LINK_HOLDER_STEP = 1,  /* a call of Step */
    PLANTD_LINK_HOLDER_DRIVE = 2, /* a Drive stream */
    PLANTD_LINK_HOLDER_LINK = 3   /* a driver over shared memory */
};

/* Header of every message, native byte order. Fields that a message does not use are zero. */
struct plantd_link_header {
    uint32_t magic;               /* PLANTD_LINK_MAGIC */
    uint32_t layout_version;      /* PLANTD_LINK_LAYOUT_VERSION */
    uint64_t schema_hash;         /* PLANTD_LINK_SCHEMA_HASH */
    uint64_t server;              /* random number of the server's side; zero in ATTACH */
    uint64_t driver;              /* random number of the driver; zero only in CLOSED */
    uint64_t sequence;            /* number of the input, repeated in its answer */
    uint64_t step;                /* steps since the plant was created or reset */
    double time_s;                /* plant time, s */
    double time_step_s;           /* time step of the plant, s */
    uint64_t model_digest;        /* equal digests mean equal motion */
    uint64_t stamp_ns;            /* when the message was sent, CLOCK_MONOTONIC, ns */
    uint64_t poll_ns;             /* how long from then on the sender polls, ns */
    uint64_t process_start;       /* start of the sender's process, field 22 of /proc/<pid>/stat */
    uint32_t pid;                 /* process id of the sender */
    uint32_t kind;                /* enum plantd_link_kind */
    uint32_t code;                /* enum plantd_link_code, or zero */
    uint32_t dynamic;             /* dynamic coordinates, nd */
    uint32_t prescribed;          /* prescribed coordinates, nk */
    uint32_t inputs;              /* inputs, ni */
    uint32_t constraints;         /* constraint equations, nc */
    uint32_t iterations;          /* residual evaluations of the step */
    uint32_t factorizations;      /* factorizations of the step */
    uint32_t redundant_constraints; /* constraint equations that follow from others */
    uint32_t steps;               /* steps of the method in the time step */
    uint32_t halvings;            /* how often the time step was halved */
    uint32_t outputs;             /* numbers of the output channels, ny */
    uint32_t output_channels;     /* output channels, with a flag each */
    double residual;              /* final residual in units of its own round-off */
    double constraint_residual;   /* constraint violation in units of its own round-off */
    double reciprocal_condition;  /* estimate for the Newton matrix, at most 1 */
    double constraint_reciprocal_condition; /* the same for the constraints; 1 without any */
    uint64_t detail_a;            /* first detail of a failure */
    uint64_t detail_b;            /* second detail of a failure */
    double detail_value;          /* number that goes with a failure */
};

#ifdef __cplusplus
}
#endif

#endif /* PLANTD_LINK_H */
