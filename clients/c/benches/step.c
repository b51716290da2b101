// Measures 20,000 steps of the default world, in process or on the server of an instance: ./step [INSTANCE]
#define _POSIX_C_SOURCE 199309L
#include <emberwatch.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#define N 20000
static ew_error error;
static void check(int32_t code) {
    if (code) { fprintf(stderr, "%d %s\n", code, error.message); exit(1); }
}
static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1e6 + t.tv_nsec / 1e3;
}
static int order(const void *a, const void *b) {
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}
int main(int argc, char **argv) {
    ew_server *server;
    ew_lease *lease;
    const ew_answer *answer;
    if (argc > 1) {
        check(ew_attach(argv[1], "bench", 0, 5, &server, &error));
    } else {
        check(ew_embed("", &server, &error));
    }
    check(ew_acquire(server, 0, 1, false, 0, 600, &lease, &error));
    check(ew_reset(lease, NULL, 0, 600, &answer, &error));
    static double times[N], work[N];
    static uint8_t paths[N][64];
    for (int i = 0; i < N; i++)
        for (int j = 0; j < 64; j++) paths[i][j] = rand() >> 8 & 3;
    for (int i = 0; i < 2000; i++) check(ew_step(lease, paths[i], 64, 0, 5, &answer, &error));
    double start = now();
    for (int i = 0; i < N; i++) {
        double t = now();
        check(ew_step(lease, paths[i], 64, 0, 5, &answer, &error));
        times[i] = now() - t;
        work[i] = answer->simulation_nanos / 1e3;
    }
    double all = (now() - start) / N;
    qsort(times, N, sizeof *times, order);
    qsort(work, N, sizeof *work, order);
    printf("C, %s: median %.2f us, p99 %.2f, mean %.2f; simulator: median %.2f, p99 %.2f\n",
           argc > 1 ? "attached" : "in process", times[N / 2], times[N * 99 / 100], all, work[N / 2],
           work[N * 99 / 100]);
    ew_free(lease);
    ew_free(server);
    return 0;
}
