// A server of its own: two threads, lateness, takeover, observers, a stopped and a killed server, forks.
// ./attached INSTANCE SERVER_PROGRAM FOLDER
#include "check.h"

static const char *instance, *program;
static ew_server *server, *second;
static ew_lease *one, *two, *both;
static ew_samples *frames;
static const ew_answer *a;
static const ew_sample *sample;
static uint8_t path[8];

static pid_t start(const char *command, char *const flags[]) {
    pid_t pid = fork();
    if (pid == 0) {
        prctl(PR_SET_PDEATHSIG, SIGKILL); // Even if a check ends this program.
        TRUE(freopen("/dev/null", "w", stderr));
        execv(command, flags);
        _exit(127);
    }
    return pid;
}

static pid_t serve(void) {
    char *flags[] = {"server", "--instance", (char *)instance, "--worlds", "2", "--robots", "2",
                     "--height", "6", "--width", "7", "--moves", "4", "--burn-in", "0",
                     "--publish-truth", "--deadline-millis", "300", "--seed", "3", NULL};
    return start(program, flags);
}

static pid_t record(const char *file) {
    char *flags[] = {"server", "record", "--instance", (char *)instance, "--out", (char *)file, "--truth", "--force", NULL};
    return start(program, flags);
}

struct flier {
    ew_lease *lease;
    int32_t code;
};

static void *fly(void *of) {
    struct flier *it = of;
    ew_error own;
    const uint8_t moves[4] = {3, 3, 1, 1};
    for (int i = 0; i < 50 && it->code == 0; i++) {
        do {
            it->code = ew_step(it->lease, moves, 4, 0, 5, NULL, &own);
        } while (it->code == EW_FAILURE_IN_USE);
    }
    return NULL;
}

static void two_threads(void) {
    IS(0, ew_acquire(server, 0, 1, false, 0, 60, &one, &error));
    FAILS("robot of another client", EW_STATUS_BUSY, ew_acquire(second, 0, 2, false, 0, 60, &two, &error));
    TRUE(error.detail == (uint64_t)getpid());
    IS(0, ew_acquire(second, 1, 1, false, 0, 60, &two, &error));
    struct flier fliers[2] = {{one, 0}, {two, 0}};
    pthread_t threads[2];
    for (int i = 0; i < 2; i++) pthread_create(&threads[i], NULL, fly, &fliers[i]);
    for (int i = 0; i < 2; i++) pthread_join(threads[i], NULL);
    TRUE(fliers[0].code == 0 && fliers[1].code == 0);
    IS(0, ew_observe(one, EW_TEAM_FRAMES, 5, &a, &error));
    TRUE(a->worlds[0].step == 50 && a->n_frames == 1);
}

// A lease is for one thread at a time.
static void one_lease_of_two_threads(void) {
    struct flier flier = {one, 0};
    pthread_t thread;
    pthread_create(&thread, NULL, fly, &flier); // Waits for the deadline in each step, as `two` does not fly.
    int32_t code = 0;
    for (int i = 0; i < 1000 && code == 0; i++) {
        usleep(1000);
        code = ew_observe(one, 0, 5, NULL, &error);
    }
    TRUE(code == EW_FAILURE_IN_USE);
    IS(0, ew_acquire(second, 0, 2, true, 0, 60, &both, &error)); // Ends its steps.
    pthread_join(thread, NULL);
    TRUE(flier.code == EW_STATUS_LEASE_LOST);
    ew_free(both);
    ew_free(one);
    ew_free(two);
    IS(0, ew_acquire(server, 0, 1, false, 0, 60, &one, &error));
    IS(0, ew_acquire(second, 1, 1, false, 0, 60, &two, &error));
    IS(0, ew_observe(one, 0, 5, &a, &error));
    IS(0, ew_observe(two, 0, 5, &a, &error));
}

static void late(void) {
    memset(path, EW_MOVE_RIGHT, sizeof path);
    double start = now();
    IS(0, ew_step(one, path, 4, 0, 5, &a, &error));
    TRUE(now() - start > 0.29 && a->worlds[0].late == 2);
    FAILS("late path", EW_STATUS_LATE, ew_step(two, path, 4, 0, 5, &a, &error));
    IS(0, ew_step(two, path, 4, EW_ACCEPT_LATE, 5, &a, &error));
    IS(0, ew_step(one, path, 4, EW_ACCEPT_LATE, 5, &a, &error));
}

static void samples(void) {
    ew_samples *none = frames;
    IS(EW_FAILURE_INVALID, ew_watch(instance, 9, &none, &error));
    TRUE(!none);
    IS(0, ew_next(frames, 0, 5, &sample, &error));
    const ew_frame *frame = sample->frame;
    TRUE(frame && !sample->truth && frame->header.n_robots == 2 && frame->header.height == 6);
    while (frame->robots[0].n_moves == 0) {
        IS(0, ew_next(frames, 0, 5, &sample, &error));
        frame = sample->frame;
    }
    TRUE(frame->paths[0] <= 3 && frame->frames[0] <= 255);
    ew_samples *truths, *beliefs;
    IS(0, ew_watch(instance, EW_TRUTHS, &truths, &error));
    IS(0, ew_next(truths, 1, 5, &sample, &error));
    TRUE(sample->truth->header.world == 1 && sample->truth->states[41] < 3 && sample->pid);
    IS(0, ew_watch(instance, EW_BELIEFS, &beliefs, &error));
    float belief[3 * 42] = {0.25f};
    const char *names[3] = {"calm", "hidden", "burning"};
    ew_intent intent = {"policy", "test", NULL, names, 0.5};
    IS(EW_FAILURE_INVALID, ew_publish_belief(two, 0, 1, belief, 3, &intent, &error));
    int32_t code = EW_FAILURE_TIMEOUT;
    for (int i = 0; i < 50 && code == EW_FAILURE_TIMEOUT; i++) { // As an agent does in each step.
        IS(0, ew_publish_belief(two, 1, 1, belief, 3, &intent, &error));
        code = ew_next(beliefs, -1, 0.1, &sample, &error);
    }
    TRUE(code == 0);
    const ew_belief *seen = sample->belief;
    TRUE(seen->belief[0] == 0.25f && seen->header.first_robot == 1 && seen->header.n_states == 3);
    TRUE(seen->n_names == 3 && !strcmp(seen->states[2], "burning") && !strcmp(seen->policy, "policy"));
    TRUE(seen->header.pid == (uint32_t)getpid() && seen->plan_millis == 0.5 && !*seen->objective);
    IS(0, ew_publish_belief(two, 1, 1, belief, 3, NULL, &error));
    do {
        IS(0, ew_next(beliefs, 0, 5, &sample, &error));
    } while (strcmp(sample->belief->states[2], "fire") != 0);
    ew_free(truths);
    ew_free(beliefs);
}

static void takeover(void) {
    IS(0, ew_acquire(second, 0, 2, true, 0, 60, &both, &error));
    FAILS("robot taken over", EW_STATUS_LEASE_LOST, ew_step(one, path, 4, 0, 5, &a, &error));
    uint64_t seed = 5;
    IS(0, ew_reset(both, &seed, 1, 60, &a, &error));
    TRUE(a->worlds[0].seed == 5 && a->worlds[0].step == 0);
}

static bool child_attaches(void) {
    ew_server *own;
    bool is_refused = ew_step(both, path, 8, 0, 5, NULL, &error) == EW_FAILURE_FORKED;
    ew_free(both);
    ew_free(second);
    bool works = ew_attach(instance, "child", 0, 5, &own, &error) == 0;
    ew_free(own);
    return is_refused && works;
}

static void recording(const char *file) {
    ew_samples *records;
    IS(EW_FAILURE_INVALID, ew_open_recording("/none", &records, &error));
    IS(EW_FAILURE_INVALID, ew_open_recording(program, &records, &error));
    IS(0, ew_open_recording(file, &records, &error));
    IS(0, ew_next(records, 0, 0, &sample, &error));
    TRUE(sample->server && sample->server->n_worlds == 2);
    int n_frames = 0, n_truths = 0;
    for (;;) {
        IS(0, ew_next(records, 0, 0, &sample, &error));
        if (!sample->frame && !sample->truth) break;
        n_frames += sample->frame && sample->frame->header.world == 0;
        n_truths += sample->truth && sample->truth->header.world == 0;
    }
    TRUE(n_frames > 0 && n_truths > 0 && !sample->server);
    ew_free(records);
    struct stat size;
    TRUE(stat(file, &size) == 0 && truncate(file, size.st_size - 10) == 0);
    IS(0, ew_open_recording(file, &records, &error));
    int32_t code;
    while ((code = ew_next(records, -1, 0, &sample, &error)) == 0) {
    }
    TRUE(code == EW_FAILURE_BAD_ANSWER && ew_next(records, -1, 0, &sample, &error) == code);
    printf("recording cut short          %4d           %s\n", code, error.message);
    ew_free(records);
}

int main(int argc, char **argv) {
    TRUE(argc == 4);
    instance = argv[1];
    program = argv[2];
    char file[256];
    snprintf(file, sizeof file, "%s/c.recording", argv[3]);
    IS(EW_FAILURE_INVALID, ew_attach("a b", "test", 0, 5, &server, &error));
    FAILS("no server", EW_FAILURE_NO_SERVER, ew_attach(instance, "test", 0, 5, &server, &error));
    FAILS("no server, waits 0.3 s", EW_FAILURE_NO_SERVER, ew_attach(instance, "test", 0.3, 5, &server, &error));
    IS(0, ew_watch(instance, EW_FRAMES, &frames, &error));
    FAILS("no sample", EW_FAILURE_TIMEOUT, ew_next(frames, -1, 0.05, &sample, &error));
    pid_t pid = serve();
    IS(0, ew_attach(instance, "test", 20, 5, &server, &error));
    IS(0, ew_attach(instance, "second", 0, 5, &second, &error));
    pid_t recorder = record(file);
    two_threads();
    one_lease_of_two_threads();
    late();
    samples();
    takeover();
    kill(pid, SIGSTOP);
    FAILS("stopped server", EW_FAILURE_TIMEOUT, ew_step(both, path, 8, 0, 0.2, &a, &error));
    kill(pid, SIGCONT);
    IS(0, ew_observe(both, 0, 5, &a, &error));
    in_child(child_attaches);
    IS(0, ew_step(both, path, 8, 0, 5, &a, &error));
    int status;
    kill(recorder, SIGTERM);
    waitpid(recorder, &status, 0);
    recording(file);
    kill(pid, SIGKILL);
    waitpid(pid, &status, 0);
    FAILS("killed server, step", EW_FAILURE_SERVER_GONE, ew_step(both, path, 8, 0, 5, &a, &error));
    FAILS("killed server, status", EW_FAILURE_SERVER_GONE, ew_status_of(server, 5, NULL, &error));
    ew_free(one);
    ew_free(two);
    ew_free(both);
    ew_free(server);
    ew_free(second);
    pid = serve();
    IS(0, ew_attach(instance, "again", 20, 5, &server, &error));
    do {
        IS(0, ew_next(frames, -1, 5, &sample, &error));
    } while (sample->pid != (uint32_t)pid);
    ew_free(server);
    ew_free(frames);
    kill(pid, SIGTERM);
    waitpid(pid, &status, 0);
    return 0;
}
