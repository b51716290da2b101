// Flies a robot at 10 Hz beside other clients, like a node of a robot: ./node INSTANCE SECONDS
// Late teammates, a takeover of its robot and a restart of the server do not end it.
#define _POSIX_C_SOURCE 200809L
#include <emberwatch.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

static ew_server *server;
static ew_lease *lease;
static ew_error error;

// Attaches to the instance, and acquires robot 0 to continue the episode.
static int32_t begin(const char *instance, const ew_answer **seen) {
    ew_free(lease), ew_free(server);
    lease = NULL;
    server = NULL;
    int32_t code = ew_attach(instance, "node.c", 1, 1, &server, &error);
    if (code == 0) code = ew_acquire(server, 0, 1, false, 2, 60, &lease, &error);
    if (code == 0) code = ew_observe(lease, 0, 1, seen, &error);
    return code;
}

// Plans from the last frame. Replace it by yours.
static void plan(const ew_answer *seen, uint8_t *path, uint32_t n_moves) {
    uint32_t n_seen = 0;
    for (uint32_t cell = 0; cell < seen->height * seen->width; cell++) n_seen += seen->frames[cell] != 255;
    for (uint32_t move = 0; move < n_moves; move++) path[move] = (uint8_t)((n_seen + rand()) >> 8 & 3);
}

int main(int argc, char **argv) {
    if (argc != 3) return 2;
    const int n_steps = 10 * atoi(argv[2]);
    static uint8_t path[4096];
    const ew_answer *seen = NULL;
    struct timespec next;
    clock_gettime(CLOCK_MONOTONIC, &next);
    for (int step = 0; step < n_steps; step++) {
        int32_t code = seen ? 0 : begin(argv[1], &seen);
        if (code == 0) {
            const uint32_t n_moves = ew_info_of(server)->n_moves;
            plan(seen, path, n_moves);
            code = ew_step(lease, path, n_moves, EW_ACCEPT_LATE, 0.08, &seen, &error);
        }
        if (code != 0) {
            fprintf(stderr, "step %d: %d, %s\n", step, (int)code, error.message);
            seen = NULL; // Begins again, without the steps that were missed.
            clock_gettime(CLOCK_MONOTONIC, &next);
        }
        next.tv_nsec += 100000000;
        next.tv_sec += next.tv_nsec / 1000000000;
        next.tv_nsec %= 1000000000;
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &next, NULL);
    }
    if (seen) printf("k = %llu after %d steps\n", (unsigned long long)seen->worlds[0].step, n_steps);
    ew_free(lease);
    ew_free(server);
    return 0;
}
