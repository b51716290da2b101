// Flies 100 random paths, in C++17 with handles that free themselves: ./random_cpp [INSTANCE]
#include <emberwatch.h>
#include <iostream>
#include <memory>
#include <random>
#include <stdexcept>
#include <string>
#include <vector>

struct Error : std::runtime_error {
    explicit Error(const ew_error &error) : std::runtime_error(error.message), code(error.code) {}
    int32_t code;
};

// Calls a function of emberwatch.h with its last argument, and throws its error.
template <class... Parameters, class... Arguments>
void call(int32_t (*function)(Parameters...), Arguments... arguments) {
    ew_error error;
    if (function(arguments..., &error) != 0) throw Error(error);
}

struct Free {
    void operator()(void *handle) const { ew_free(handle); }
};
using Server = std::unique_ptr<ew_server, Free>;
using Lease = std::unique_ptr<ew_lease, Free>;

Server open(const char *instance) {
    ew_server *server;
    if (instance) call(ew_attach, instance, "random.cpp", 10, 5, &server);
    else call(ew_embed, "seed = 7", &server);
    return Server(server);
}

Lease acquire(const Server &server, uint32_t first_robot, uint32_t n_robots) {
    ew_lease *lease;
    call(ew_acquire, server.get(), first_robot, n_robots, false, 0, 600, &lease);
    return Lease(lease);
}

int main(int argc, char **argv) try {
    Server server = open(argc > 1 ? argv[1] : nullptr);
    Lease lease = acquire(server, 0, 1);
    const ew_answer *answer;
    const uint64_t seed = 7;
    call(ew_reset, lease.get(), &seed, 1, 600, &answer);
    std::mt19937 random(7);
    std::vector<uint8_t> path(ew_info_of(server.get())->n_moves);
    double reward = 0;
    for (int step = 0; step < 100; step++) {
        for (uint8_t &move : path) move = random() & 3;
        call(ew_step, lease.get(), path.data(), path.size(), 0, 5, &answer);
        reward += answer->robots[0].reward;
    }
    std::cout << "mean reward " << reward / 100 << '\n';
} catch (const Error &error) {
    std::cerr << "error " << error.code << ": " << error.what() << '\n';
    return 1;
}
