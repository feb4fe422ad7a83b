/* Calls every function of plantd.h, rightly and wrongly: calls PLANT ROOT */
#include <math.h>
#include <pthread.h>
#include <stdlib.h>

#include "print.h"

#define CHECK(condition)                                                        \
    do {                                                                        \
        if (!(condition)) {                                                     \
            fprintf(stderr, "line %d: %s\n", __LINE__, #condition);             \
            exit(1);                                                            \
        }                                                                       \
    } while (0)

static plantd_link *shared;

static void *call_from_another_thread(void *unused) {
    plantd_state state;
    CHECK(plantd_link_state(shared, &state) == PLANTD_THREAD);
    CHECK(strstr(plantd_link_error(NULL), "thread"));
    CHECK(plantd_link_close(shared) == PLANTD_THREAD);
    return unused;
}

int main(int argc, char **argv) {
    CHECK(argc == 3);
    CHECK(strcmp(plantd_version(), "0.1.0") == 0);
    CHECK(strcmp(plantd_status_name(PLANTD_LEASE_HELD), "LEASE_HELD") == 0);
    CHECK(strcmp(plantd_status_name(PLANTD_PANIC), "PANIC") == 0);
    CHECK(strcmp(plantd_status_name(99), "UNKNOWN") == 0);
    CHECK(strcmp(plantd_status_name(-1), "UNKNOWN") == 0);

    plantd_options options;
    plantd_options_init(NULL);
    plantd_options_init(&options);
    CHECK(options.root == NULL && options.poll_ns == 50000);
    CHECK(options.timeout_s == 1.0 && options.connect_timeout_s == 1.0);
    options.root = argv[2];

    plantd_link *link = (plantd_link *)argv;
    options.connect_timeout_s = 0.05;
    CHECK(plantd_link_open("nobody", &options, &link) == PLANTD_NOT_OPEN && link == NULL);
    CHECK(strstr(plantd_link_error(NULL), "nobody"));
    options.connect_timeout_s = 5.0;
    CHECK(plantd_link_open(argv[1], &options, NULL) == PLANTD_ARGUMENT);
    CHECK(plantd_link_open(NULL, &options, &link) == PLANTD_ARGUMENT);
    CHECK(plantd_link_open("\xff", &options, &link) == PLANTD_ARGUMENT);
    options.timeout_s = NAN;
    CHECK(plantd_link_open(argv[1], &options, &link) == PLANTD_ARGUMENT);
    CHECK(strstr(plantd_link_error(NULL), "timeout_s"));
    options.timeout_s = 10.0;
    options.poll_ns = PLANTD_POLL_FOREVER;
    CHECK(plantd_link_open(argv[1], &options, &link) == PLANTD_OK && link != NULL);

    plantd_link *second;
    CHECK(plantd_link_open(argv[1], &options, &second) == PLANTD_LEASE_HELD && second == NULL);

    plantd_dimensions d;
    CHECK(plantd_link_dimensions(link, &d) == PLANTD_OK);
    CHECK(plantd_link_dimensions(link, NULL) == PLANTD_ARGUMENT);
    CHECK(plantd_link_dimensions(NULL, &d) == PLANTD_ARGUMENT);
    CHECK(d.input_len == d.inputs + d.prescribed && d.time_step_s > 0.0 && d.model_digest != 0);

    plantd_state state;
    CHECK(plantd_link_state(link, NULL) == PLANTD_ARGUMENT);
    CHECK(plantd_link_state(link, &state) == PLANTD_OK && state.step == 0);
    CHECK(state.q.len == d.dynamic + d.prescribed && state.multipliers.len == d.constraints);
    double *u = calloc(d.input_len + 1, sizeof *u);
    for (size_t k = 0; k < d.prescribed; k++) u[d.inputs + k] = state.q.data[d.dynamic + k];

    CHECK(plantd_link_step(NULL, u, d.input_len, &state) == PLANTD_ARGUMENT);
    CHECK(plantd_link_step(link, NULL, d.input_len, &state) == PLANTD_ARGUMENT);
    CHECK(plantd_link_step(link, u, SIZE_MAX, &state) == PLANTD_ARGUMENT);
    CHECK(plantd_link_step(link, u, d.input_len + 1, &state) == PLANTD_DIMENSION);
    CHECK(strstr(plantd_link_error(link), "are needed"));
    CHECK(plantd_link_offer(link, u, 0) == PLANTD_DIMENSION);
    const double good = u[0];
    u[0] = NAN;
    CHECK(plantd_link_step(link, u, d.input_len, &state) == PLANTD_INPUT_NOT_FINITE);
    u[0] = good;
    CHECK(plantd_link_state(link, &state) == PLANTD_OK && state.step == 0);

    shared = link;
    pthread_t thread;
    CHECK(pthread_create(&thread, NULL, call_from_another_thread, NULL) == 0);
    CHECK(pthread_join(thread, NULL) == 0);

    CHECK(plantd_link_step(link, u, d.input_len, NULL) == PLANTD_OK);
    CHECK(plantd_link_step(link, u, d.input_len, &state) == PLANTD_OK && state.step == 2);
    CHECK(plantd_link_close(link) == PLANTD_OK);
    CHECK(plantd_link_close(NULL) == PLANTD_OK);
    CHECK(plantd_link_open(argv[1], &options, &link) == PLANTD_OK);
    CHECK(plantd_link_step(link, u, d.input_len, &state) == PLANTD_OK);
    print_state(&state);
    CHECK(plantd_link_close(link) == PLANTD_OK);
    free(u);
    return 0;
}
