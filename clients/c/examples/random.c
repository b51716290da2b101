// Flies 100 random paths and prints the mean reward. Without an argument, the world runs inside this process; with one,
// the program attaches to the server of that instance: ./random [INSTANCE]
#include <emberwatch.h>
#include <stdio.h>
#include <stdlib.h>

static ew_error error;

static void check(int32_t code) {
    if (code != 0) {
        fprintf(stderr, "error %d: %s\n", (int)code, error.message);
        exit(1);
    }
}

int main(int argc, char **argv) {
    if (ew_abi() != EW_ABI) {
        fprintf(stderr, "libemberwatch %s does not fit this program\n", ew_version());
        return 1;
    }
    ew_server *server;
    if (argc > 1) {
        check(ew_attach(argv[1], "random.c", 10, 5, &server, &error));
    } else {
        check(ew_embed("seed = 7", &server, &error));
    }
    const ew_info *info = ew_info_of(server);
    printf("%u x %u cells, %u moves, states", info->height, info->width, info->n_moves);
    for (uint32_t state = 0; state < info->n_states; state++) {
        printf(" %s", info->states[state]);
    }

    ew_lease *lease;
    const ew_answer *answer;
    const uint64_t seed = 7;
    check(ew_acquire(server, 0, 1, false, 0, 600, &lease, &error));
    check(ew_reset(lease, &seed, 1, 600, &answer, &error));
    printf("\nbegins in cell (%u, %u)\n", answer->robots[0].row, answer->robots[0].col);

    uint8_t *path = malloc(info->n_moves);
    double reward = 0;
    srand(7);
    for (int step = 0; step < 100; step++) {
        for (uint32_t move = 0; move < info->n_moves; move++) {
            path[move] = (uint8_t)(rand() >> 8 & 3);
        }
        check(ew_step(lease, path, info->n_moves, 0, 5, &answer, &error));
        reward += answer->robots[0].reward;
    }
    int seen = 0;
    for (uint32_t cell = 0; cell < answer->height * answer->width; cell++) {
        seen += answer->frames[cell] != 255;
    }
    printf("mean reward %.3f; k = %llu; the last frame shows %d cells\n", reward / 100,
           (unsigned long long)answer->worlds[0].step, seen);
    free(path);
    ew_free(lease);
    ew_free(server);
    return 0;
}
