// Flies 100 random paths from Go, by cgo: CGO_CFLAGS=-IFOLDER/include CGO_LDFLAGS="-LFOLDER/lib -lemberwatch" go run
// random.go [INSTANCE]
package main

// #include <emberwatch.h>
// #include <stdlib.h>
import "C"

import (
	"fmt"
	"log"
	"math/rand"
	"os"
	"unsafe"
)

// check ends the program with the message of an error.
func check(code C.int32_t, failure *C.ew_error) {
	if code != 0 {
		log.Fatalf("error %d: %s", code, C.GoString(&failure.message[0]))
	}
}

func text(of string) *C.char { return C.CString(of) } // Never freed: the program is short.

func main() {
	var failure C.ew_error
	var server *C.ew_server
	var lease *C.ew_lease
	var answer *C.ew_answer
	if len(os.Args) > 1 {
		check(C.ew_attach(text(os.Args[1]), text("random.go"), 10, 5, &server, &failure), &failure)
	} else {
		check(C.ew_embed(text("seed = 7"), &server, &failure), &failure)
	}
	defer C.ew_free(unsafe.Pointer(server))
	check(C.ew_acquire(server, 0, 1, false, 0, 600, &lease, &failure), &failure)
	defer C.ew_free(unsafe.Pointer(lease))
	seed := C.uint64_t(7)
	check(C.ew_reset(lease, &seed, 1, 600, &answer, &failure), &failure)

	random := rand.New(rand.NewSource(7))
	path := make([]C.uint8_t, C.ew_info_of(server).n_moves)
	reward := 0.0
	for step := 0; step < 100; step++ {
		for move := range path {
			path[move] = C.uint8_t(random.Intn(4))
		}
		check(C.ew_step(lease, &path[0], C.size_t(len(path)), 0, 5, &answer, &failure), &failure)
		reward += float64(answer.robots.reward)
	}
	frame := unsafe.Slice((*byte)(unsafe.Pointer(answer.frames)), answer.height*answer.width)
	fmt.Printf("mean reward %.3f; k = %d; cell (0, 0) shows %d\n", reward/100, answer.worlds.step, frame[0])
}
