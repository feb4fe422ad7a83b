/* Prints a state so that every bit can be compared. */
#include <inttypes.h>
#include <stdio.h>
#include <string.h>

#include "plantd.h"

static void print_numbers(const char *name, plantd_numbers numbers) {
    printf("%s", name);
    for (size_t i = 0; i < numbers.len; i++) {
        uint64_t bits;
        memcpy(&bits, &numbers.data[i], sizeof bits);
        printf(" %016" PRIx64, bits);
    }
    printf("\n");
}

static void print_number(const char *name, double number) {
    const plantd_numbers one = {&number, 1};
    print_numbers(name, one);
}

static void print_state(const plantd_state *s) {
    printf("step %" PRIu64 "\n", s->step);
    print_number("time_s", s->time_s);
    print_numbers("q", s->q);
    print_numbers("p", s->p);
    print_numbers("v", s->v);
    print_numbers("velocity", s->velocity);
    print_numbers("multipliers", s->multipliers);
    print_numbers("x", s->x);
    print_numbers("outputs", s->outputs);
    print_numbers("lost", s->lost);
    print_number("residual", s->residual);
    print_number("constraint_residual", s->constraint_residual);
    print_number("reciprocal_condition", s->reciprocal_condition);
    print_number("constraint_reciprocal_condition", s->constraint_reciprocal_condition);
    printf("%u %u %u %u %u\n", s->iterations, s->factorizations, s->redundant_constraints, s->steps,
           s->halvings);
}
