// Worlds in this process: arguments, refusals, answers, beliefs, forks, interrupts.
#include "check.h"

static ew_lease *lease;
static ew_server *server;
static uint8_t paths[24];
static atomic_bool interrupted;

static bool is_interrupted(void) { return interrupted; }

static void on_alarm(int signal) {
    (void)signal;
    interrupted = true;
}

static void arguments(void) {
    IS(EW_FAILURE_INVALID, ew_embed("worlds = 0", &server, &error));
    IS(EW_FAILURE_INVALID, ew_embed("colour = 1", &server, &error));
    IS(EW_FAILURE_INVALID, ew_embed("instance = 'lab'", &server, &error)); // Only for servers.
    TRUE(strstr(error.message, "instance"));
    IS(EW_FAILURE_INVALID, ew_embed("worlds", &server, &error));
    IS(EW_FAILURE_INVALID, ew_embed(NULL, &server, &error));
    IS(EW_FAILURE_INVALID, ew_embed("\xff", &server, &error));
    TRUE(ew_embed("", NULL, NULL) == EW_FAILURE_INVALID);
    // A message is cut between characters.
    ew_samples *recording;
    char path_of_two_bytes[1001] = {0};
    for (int i = 0; i < 1000; i += 2) memcpy(path_of_two_bytes + i, "\xc3\xa9", 2);
    IS(EW_FAILURE_INVALID, ew_open_recording(path_of_two_bytes, &recording, &error));
    TRUE(strlen(error.message) == 494 && error.message[493] == '\xa9');
    TRUE(ew_info_of(NULL) == NULL);
}

// A pipe as a model file could block its reader forever.
static void pipe_as_model(void) {
    char path[] = "/tmp/emberwatch-c-XXXXXX", settings[128];
    TRUE(mkdtemp(path));
    snprintf(settings, sizeof settings, "%s/pipe", path);
    TRUE(mkfifo(settings, 0600) == 0);
    snprintf(settings, sizeof settings, "model = '%s/pipe'", path);
    signal(SIGALRM, on_alarm);
    ew_interrupt_when(is_interrupted);
    alarm(1);
    FAILS("pipe as model, interrupted", EW_FAILURE_INTERRUPTED, ew_embed(settings, &server, &error));
    interrupted = false;
    snprintf(settings, sizeof settings, "rm -r %s", path);
    TRUE(system(settings) == 0);
}

static void flights(void) {
    const ew_answer *a;
    ew_lease *none;
    IS(0, ew_embed("worlds = 3\nrobots = 2\nheight = 6\nwidth = 7\nmoves = 4\nburn_in = 0\n"
                   "publish_truth = true\nmax_steps = 2", &server, &error));
    const ew_info *info = ew_info_of(server);
    TRUE(info->n_worlds == 3 && info->n_states == 3 && info->rewards[2] == 1.0 && !info->no_fly);
    TRUE(!strcmp(info->states[2], "fire") && !strcmp(info->observations[0], "normal"));
    TRUE(!strcmp(info->build, ew_version()));
    IS(EW_STATUS_NO_SUCH_ROBOT, ew_acquire(server, 6, 1, false, 0, 5, &none, &error));
    TRUE(error.detail == 6 && error.code == EW_STATUS_NO_SUCH_ROBOT);
    IS(EW_FAILURE_INVALID, ew_acquire(NULL, 0, 6, false, 0, 5, &none, &error));
    IS(0, ew_acquire(server, 0, 6, false, 0, 5, &lease, &error));
    IS(EW_FAILURE_INVALID, ew_step((ew_lease *)server, NULL, 0, 0, 5, &a, &error));
    IS(EW_FAILURE_INVALID, ew_leave_belief(lease, 0, "too early", NULL, 0, 5, &error));
    uint64_t seeds[3] = {1, 2, 3};
    IS(EW_FAILURE_INVALID, ew_reset(lease, seeds, 2, 5, &a, &error));
    IS(EW_FAILURE_INVALID, ew_reset(lease, seeds, (size_t)-1, 5, &a, &error));
    IS(EW_FAILURE_INVALID, ew_reset(lease, seeds, 3, -1, &a, &error));
    IS(EW_FAILURE_INVALID, ew_acquire(server, 0, 6, false, -1, 5, &none, &error));
    TRUE(!none);
    IS(0, ew_reset(lease, seeds, 3, 60, &a, &error));
    TRUE(a->n_robots == 6 && a->n_worlds == 3 && a->n_frames == 6 && a->height == 6 && a->width == 7);
    TRUE(a->worlds[2].seed == 3 && a->frames[0] == 255 && a->lease != 0);
    IS(EW_FAILURE_INVALID, ew_step(lease, paths, 23, 0, 5, &a, &error));
    paths[5] = 9;
    IS(EW_FAILURE_INVALID, ew_step(lease, paths, 24, 0, 5, &a, &error));
    paths[5] = EW_MOVE_DOWN;
    IS(0, ew_step(lease, paths, 24, EW_TEAM_FRAMES, 5, &a, &error));
    TRUE(a->n_frames == 3 && a->worlds[1].step == 1 && a->robots[1].n_moves == 4);
    IS(EW_STATUS_NOT_PERMITTED, ew_step(lease, paths, 24, EW_FULL_COVERAGE, 5, &a, &error));
    IS(EW_STATUS_UNKNOWN_FLAGS, ew_step(lease, paths, 24, 4, 5, &a, &error));
    const uint8_t *states;
    IS(0, ew_states(server, 2, &states, &error));
    TRUE(states[0] < 3 && states[41] < 3);
    IS(EW_FAILURE_INVALID, ew_states(server, 3, &states, &error));
    IS(EW_FAILURE_INVALID, ew_states(server, UINT32_MAX, &states, &error));
    TRUE(ew_step(lease, paths, 24, 0, 5, NULL, NULL) == 0);
    IS(EW_STATUS_EPISODE_OVER, ew_step(lease, paths, 24, 0, 5, &a, &error));
    IS(0, ew_recall(lease, 1, 0, 5, &a, &error));
    TRUE(a->worlds[0].step == 1);
    IS(0, ew_leave_belief(lease, 5, "of the present step", paths, 1, 5, &error));
    IS(EW_STATUS_NOT_KEPT, ew_recall(lease, 9, 0, 5, &a, &error));
}

static void requests(void) {
    const char *reply;
    IS(0, ew_control(server, "{\"op\":\"status\"}", 5, &reply, &error));
    TRUE(strstr(reply, "\"n_clients\":1"));
    IS(EW_STATUS_MALFORMED, ew_control(server, "{}", 5, &reply, &error));
    const ew_world_report *worlds;
    IS(0, ew_status_of(server, 5, &worlds, &error));
    TRUE(worlds[2].step == 2 && worlds[2].n_held == 2 && !worlds[2].resetting);
    const ew_answer *a;
    IS(0, ew_observe(lease, 0, 5, &a, &error));
    char request[128];
    snprintf(request, sizeof request, "{\"op\":\"fork\",\"lease\":%llu,\"from\":0,\"to\":2}",
             (unsigned long long)a->lease);
    IS(0, ew_control(server, request, 5, &reply, &error));
    IS(0, ew_observe(lease, 0, 5, &a, &error));
    TRUE(a->worlds[2].seed == 1);
    float belief[3 * 42] = {1};
    IS(0, ew_publish_belief(lease, 0, 2, belief, 3, NULL, &error)); // Nobody can watch.
    IS(EW_FAILURE_INVALID, ew_publish_belief(lease, 0, 3, belief, 3, NULL, &error));
    IS(EW_FAILURE_INVALID, ew_publish_belief(lease, 0, 1, belief, 0, NULL, &error));
    const ew_left *left;
    IS(0, ew_leave_belief(lease, 1, "test", (const uint8_t *)"eighteen bytes...", 18, 5, &error));
    IS(0, ew_left_belief(server, 1, 5, &left, &error));
    TRUE(left->n_bytes == 18 && !memcmp(left->bytes, "eighteen bytes...", 18));
    TRUE(!strcmp(left->kind, "test") && left->step == 2 && left->seed == 1);
    IS(EW_STATUS_NOT_KEPT, ew_left_belief(server, 0, 5, &left, &error));
}

static bool child_makes_its_own(void) {
    ew_server *own;
    bool is_refused = ew_step(lease, paths, 24, 0, 5, NULL, &error) == EW_FAILURE_FORKED;
    ew_free(lease);
    ew_free(server);
    bool works = ew_embed("threads = 1", &own, &error) == 0;
    ew_free(own);
    return is_refused && works;
}

static void ends(void) {
    const ew_answer *a;
    IS(0, ew_renew(lease, 5, &error));
    IS(0, ew_release(lease, 5, &error));
    IS(EW_STATUS_LEASE_LOST, ew_renew(lease, 5, &error));
    ew_free(server); // Leases keep the worlds.
    IS(EW_STATUS_LEASE_LOST, ew_step(lease, paths, 24, 0, 5, &a, &error));
    ew_free(lease);
    ew_free(NULL);
    IS(0, ew_embed("burn_in = 100000000", &server, &error));
    FAILS("timeout of a burn-in", EW_FAILURE_TIMEOUT, ew_acquire(server, 0, 1, false, 0, 0.2, &lease, &error));
    alarm(1);
    FAILS("interrupt by a signal", EW_FAILURE_INTERRUPTED, ew_acquire(server, 0, 1, false, 0, 30, &lease, &error));
    interrupted = false;
    ew_free(server);
}

int main(void) {
    TRUE(ew_abi() == EW_ABI);
    arguments();
    pipe_as_model();
    flights();
    requests();
    in_child(child_makes_its_own);
    ends();
    return 0;
}
