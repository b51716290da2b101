// Loads a second copy of the library beside this program's own: ./second_copy INSTANCE COPY
#include "check.h"
#include <dlfcn.h>

int main(int argc, char **argv) {
    TRUE(argc == 3);
    void *copy = dlopen(argv[2], RTLD_NOW | RTLD_LOCAL);
    TRUE(copy);
    int32_t (*attach)(const char *, const char *, double, double, ew_server **, ew_error *);
    *(void **)&attach = dlsym(copy, "ew_attach");
    ew_server *first, *second;
    ew_lease *lease;
    IS(0, ew_attach(argv[1], "first", 20, 5, &first, &error));
    TRUE(attach != ew_attach);
    FAILS("second copy of the library", EW_FAILURE_CHANNEL, attach(argv[1], "second", 0, 5, &second, &error));
    TRUE(strstr(error.message, "found another one"));
    IS(0, ew_acquire(first, 0, 1, false, 0, 60, &lease, &error)); // The first copy still works.
    ew_free(lease);
    ew_free(first);
    return 0;
}
