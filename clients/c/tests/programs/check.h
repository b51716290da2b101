// What the test programs share: checks, a clock, and a server as a child process.
#define _GNU_SOURCE
#include <emberwatch.h>
#include <pthread.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

_Static_assert(sizeof(ew_error) == 512, "ew_error never changes");
_Static_assert(sizeof(ew_world_result) == 64 && sizeof(ew_robot_result) == 48, "as on the wire");

static ew_error error;

// Checks the code of a call.
#define IS(expected, call)                                                                      \
    do {                                                                                        \
        memset(&error, 0, sizeof error);                                                        \
        int32_t got_ = (call);                                                                  \
        if (got_ != (expected) || (got_ != 0) != (error.message[0] != 0)) {                     \
            fprintf(stderr, "%s:%d: expected %d, got %d: %s\n", __FILE__, __LINE__,             \
                    (int)(expected), (int)got_, error.message);                                 \
            exit(1);                                                                            \
        }                                                                                       \
    } while (0)

#define TRUE(it)                                                                                \
    do {                                                                                        \
        if (!(it)) {                                                                            \
            fprintf(stderr, "%s:%d: %s\n", __FILE__, __LINE__, #it);                            \
            exit(1);                                                                            \
        }                                                                                       \
    } while (0)

// Checks the code of a call, and prints the failure with the time that it took.
#define FAILS(what, expected, call)                                                             \
    do {                                                                                        \
        double start_ = now();                                                                  \
        IS(expected, call);                                                                     \
        printf("%-28s %4d %8.3f s  %s\n", what, (int)(expected), now() - start_, error.message); \
    } while (0)

static inline double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + (double)t.tv_nsec / 1e9;
}

// Runs a check in the child of a fork.
static inline void in_child(bool (*check)(void)) {
    pid_t child = fork();
    if (child == 0) {
        _exit(check() ? 0 : 1);
    }
    int status;
    waitpid(child, &status, 0);
    TRUE(status == 0);
}
