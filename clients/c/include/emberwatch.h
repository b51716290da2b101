// Emberwatch for C: attach to an emberwatch-server, or step worlds inside this process.

#ifndef EMBERWATCH_H
#define EMBERWATCH_H

// Generated from clients/c/src by clients/c/tests/header.rs. Do not edit.

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

// Rules
//
// - Functions that can fail return 0, or a refusal of the server (an ew_status, positive; nothing changed), or a
//   failure (an ew_failure, negative). They describe it in the ew_error of their last argument. It may be NULL, and so
//   may every other pointer for a result, except for a new handle.
// - Handles (ew_server, ew_lease, ew_samples) are freed by ew_free. Nothing else is: all other pointers that a function
//   returns belong to a handle, and live until the call that the function names.
// - Threads may share an ew_server; its requests run one after another. Each other handle is for one thread at a time:
//   a second one gets EW_FAILURE_IN_USE. Threads with a lease each may step at the same time only over connections of
//   their own (ew_attach each), because a step keeps its connection until the world has moved.
// - Timeouts are in seconds. If the server does not answer, a call takes up to 0.2 s longer, and ew_step up to twice its
//   timeout and the server's deadline, because it asks whether the paths were flown.
// - After EW_STATUS_LATE and EW_FAILURE_TIMEOUT, call ew_observe: the next paths then start from the present step.
// - When the server has died, every call returns EW_FAILURE_SERVER_GONE: free the handles, then ew_attach again with a
//   wait. Observers need nothing: they show the next server.
// - After a fork, the child must not use the handles of its parent, which answer EW_FAILURE_FORKED: it attaches anew.
// - One copy of this library per process: a second one (or Python's module emberwatch) gets EW_FAILURE_CHANNEL.
// - The library installs no signal handlers, prints nothing (except at EW_FAILURE_BUG), and never ends the process. No
//   call may be made from a signal handler.
// - Structs that the library returns by pointer may get fields at their end in later releases of the same EW_ABI: never
//   copy them by size. ew_error and ew_intent do not change.

// Version of this header's binary interface. Compare it with ew_abi() once at the start.
#define EW_ABI 1


// Maximum number of moves in a path: 4096.
#define EW_MAX_MOVES 4096

// Failure: the handle belongs to the process that forked this one.
#define EW_FAILURE_FORKED -12

// Failure: another thread is using this handle.
#define EW_FAILURE_IN_USE -13

// Failure: a bug in this library. Free the handle.
#define EW_FAILURE_BUG -14

// Bytes of the message of an ew_error, including its final 0.
#define EW_MESSAGE_BYTES 496

// Frames show every cell, if the server's coverage allows it.
#define EW_FULL_COVERAGE 1

// One frame per world, of what all its robots saw, instead of one per robot.
#define EW_TEAM_FRAMES 2

// If a world moved without these paths, returns what it shows now instead of EW_STATUS_LATE.
#define EW_ACCEPT_LATE (1 << 16)

// What an observer reads: the steps of all worlds.
#define EW_FRAMES 1

// What an observer reads: hidden states, which only a server with --publish-truth publishes.
#define EW_TRUTHS 2

// What an observer reads: the beliefs that agents publish.
#define EW_BELIEFS 3

// The status of an answer. Every rejection has a separate code and changes nothing.
enum ew_status
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // Done.
  EW_STATUS_OK = 0,
  // The request's protocol version differs from the server's; detail: the server's version.
  EW_STATUS_VERSION_MISMATCH = 1,
  // No such operation; detail: the operation received.
  EW_STATUS_UNKNOWN_OPERATION = 2,
  // Not a well-formed control message.
  EW_STATUS_MALFORMED = 3,
  // The server has no such world; detail: number of worlds.
  EW_STATUS_NO_SUCH_WORLD = 4,
  // The length of the payload does not fit the header; detail: bytes expected.
  EW_STATUS_WRONG_LENGTH = 5,
  // The path does not have the server's number of moves; detail: moves expected.
  EW_STATUS_WRONG_PATH_LENGTH = 6,
  // A byte is not a move; detail: its position in the payload.
  EW_STATUS_BAD_MOVE = 7,
  // The lease does not cover these robots, or was never granted; detail: the first such robot.
  EW_STATUS_NO_LEASE = 8,
  // The lease was taken over, expired or released; detail: pid of the client that took over the robot or holds it
  // now, or 0 if there is no such client.
  EW_STATUS_LEASE_LOST = 9,
  // Another client holds a robot; detail: its pid. For a step: a path of the robot is already waiting; detail: the
  // client's own pid.
  EW_STATUS_BUSY = 10,
  // A world is being reset; detail: the world.
  EW_STATUS_RESETTING = 11,
  // The episode of a world was truncated, so the world must be reset first; detail: the world.
  EW_STATUS_EPISODE_OVER = 12,
  // The request asks for full frames from a server that does not provide them; detail: 0.
  EW_STATUS_NOT_PERMITTED = 13,
  // An unknown flag; detail: the flags received.
  EW_STATUS_UNKNOWN_FLAGS = 14,
  // The file cannot be read or written, or its contents are rejected; detail: 0.
  EW_STATUS_BAD_FILE = 17,
  // The server does not keep the frame or belief; detail: for a frame, the nearest step that is kept, and for a
  // belief, the current step.
  EW_STATUS_NOT_KEPT = 18,
  // A path is for a step k that its world has already passed; detail: the world's current step. `Observe` shows
  // whether the path was flown.
  EW_STATUS_LATE = 19,
  // A path is for a step k that its world has not reached yet; detail: the world's current step.
  EW_STATUS_EARLY = 20,
  // A step request omits a robot that the client holds in the same world, or covers several worlds although another
  // client holds a robot in one of them; detail: the first such robot.
  EW_STATUS_INCOMPLETE = 21,
  // The server has no such robot; detail: number of robots of all worlds.
  EW_STATUS_NO_SUCH_ROBOT = 22,
  // There is too little memory for the answer; detail: size of the step's answer in bytes, or 0 if shared memory is
  // short.
  EW_STATUS_NO_MEMORY = 23,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum ew_status ew_status;
#else
typedef uint32_t ew_status;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// A move of the robot to a neighbouring cell, an element of the paper's set `V`.
enum ew_move
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint8_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // Row - 1.
  EW_MOVE_UP = 0,
  // Row + 1.
  EW_MOVE_DOWN = 1,
  // Column - 1.
  EW_MOVE_LEFT = 2,
  // Column + 1.
  EW_MOVE_RIGHT = 3,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum ew_move ew_move;
#else
typedef uint8_t ew_move;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// What a caller can do about an error. Clients in other languages have one exception or code for each; the numbers are
// the codes of the C interface.
enum ew_failure
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // An argument is invalid, or the worlds cannot do this.
  EW_FAILURE_INVALID = -1,
  // No server runs on the instance. Waiting may help.
  EW_FAILURE_NO_SERVER = -2,
  // The server ended. Connect again.
  EW_FAILURE_SERVER_GONE = -3,
  // No answer or sample came in time.
  EW_FAILURE_TIMEOUT = -4,
  // The check for interrupts ended a wait.
  EW_FAILURE_INTERRUPTED = -5,
  // A channel in shared memory could not be opened or used.
  EW_FAILURE_CHANNEL = -6,
  // There is too little memory, or no thread could be started.
  EW_FAILURE_MEMORY = -7,
  // An answer or a sample is invalid.
  EW_FAILURE_BAD_ANSWER = -8,
  // The server speaks another version of the protocol.
  EW_FAILURE_OTHER_VERSION = -9,
  // The server is in another PID namespace.
  EW_FAILURE_OTHER_PID_NAMESPACE = -10,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum ew_failure ew_failure;
#else
typedef int32_t ew_failure;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// A lease. One thread at a time may use it; threads may use different leases of one server.
typedef struct ew_lease ew_lease;

// An observer or a recording. One thread at a time may use it.
typedef struct ew_samples ew_samples;

// A connection to a server, or worlds in this process. Threads may share it; requests run one after another.
typedef struct ew_server ew_server;

// What went wrong. Pass a pointer to one, or NULL. A call that succeeds does not write it.
typedef struct ew_error {
  // The returned code.
  int32_t code;
  // The detail of an ew_status; the server's version for EW_FAILURE_OTHER_VERSION; otherwise 0.
  uint64_t detail;
  // A sentence in UTF-8, ended by 0 and cut if it is too long.
  char message[EW_MESSAGE_BYTES];
} ew_error;

// The settings of a server.
typedef struct ew_info {
  // The server's process.
  uint32_t pid;
  // Rows of the grid, H.
  uint32_t height;
  // Columns of the grid, W.
  uint32_t width;
  // Moves of a path.
  uint32_t n_moves;
  // Worlds.
  uint32_t n_worlds;
  // Robots of each world, R. Robot r of world w has the number w R + r.
  uint32_t n_robots;
  // Values in frames are below this number, or 255 where nothing was observed.
  uint32_t n_observations;
  // States of the model, S; 0 if the server hides it.
  uint32_t n_states;
  // Names of the observations.
  const char *const *observations;
  // Names of the states; NULL if hidden.
  const char *const *states;
  // Reward of a cell in each state; NULL if hidden.
  const double *rewards;
  // 1 for each cell closed to robots, H W bytes; NULL if there are none.
  const uint8_t *no_fly;
  // The model as TOML; NULL if hidden, or if the worlds are recorded.
  const char *model;
  // Release of the server.
  const char *build;
  // The task that defines the worlds; NULL without one.
  const char *task;
  // Identifies the worlds, 16 hexadecimal digits; NULL from old servers.
  const char *worlds_fingerprint;
  // Length of an episode; 0: never truncated.
  uint64_t max_steps;
  // Time that a world waits for late paths, milliseconds; 0: no deadline.
  uint64_t deadline_millis;
  // Rows and columns that robots see beyond the cells of their path.
  uint32_t radius;
  // Frames show 0: the path, 1: every cell, 2: the path, or every cell with EW_FULL_COVERAGE.
  uint32_t coverage;
  // Hidden states are published.
  bool publish_truth;
} ew_info;

// The state of a world after a step or a reset, and the combined results of its robots in the step.
typedef struct ew_world_result {
  // Step index k after the step; 0 after a reset.
  uint64_t step;
  // Seed of the episode.
  uint64_t seed;
  // Number of resets of this world since the server started.
  uint64_t episode;
  // Sum of the rewards of the distinct cells that any robot visited, each in its state in `X_{k+1}`.
  double reward;
  // Bit r is set if no client held robot r of the world. A robot that nobody holds stays in its cell and sees
  // nothing.
  uint64_t hovered;
  // Bit r is set if robot r was held, but its path was not received by the deadline. A late robot stays in its cell
  // and sees nothing.
  uint64_t late;
  // Number of cells of the whole grid in the state with the highest reward (burning cells).
  uint32_t n_target_cells;
  // Number of distinct cells that any robot visited.
  uint32_t n_visited;
  // Number of distinct rewarded cells in the state with the highest reward.
  uint32_t n_hits;
  // 1 if the episode ended by itself (never, in this model), otherwise 0.
  uint16_t terminated;
  // 1 if the episode reached the server's `max_steps` or the last recorded step, otherwise 0.
  uint16_t truncated;
} ew_world_result;

// The result of a step for one robot, or its position after a reset.
typedef struct ew_robot_result {
  // The robot's share of the team's reward: a cell that v robots visited pays 1/v of its reward to each.
  double reward;
  // The robot's marginal contribution: the team's reward minus the team's reward without this robot.
  double marginal;
  // Number of distinct cells that the robot visited.
  uint32_t n_visited;
  // Number of the robot's distinct rewarded cells in the state with the highest reward.
  uint32_t n_hits;
  // Row where the path began, or where the robot stays.
  uint32_t start_row;
  // Column where the path began, or where the robot stays.
  uint32_t start_col;
  // The robot's row.
  uint32_t row;
  // The robot's column.
  uint32_t col;
  // What the robot's frame shows: 0 nothing, 1 the path, 2 every cell (see Coverage).
  uint32_t coverage;
  // Number of moves flown; 0 after a reset, and in a step in which the robot hovered or was late.
  uint32_t n_moves;
} ew_robot_result;

// The results of worlds and robots, and the frames.
typedef struct ew_answer {
  // Number of the first robot.
  uint32_t first_robot;
  // Robots, in the order of their numbers.
  uint32_t n_robots;
  // Number of the first world.
  uint32_t first_world;
  // Worlds of these robots.
  uint32_t n_worlds;
  // Frames: one per robot, or one per world with EW_TEAM_FRAMES.
  uint32_t n_frames;
  // Rows of the grid, H.
  uint32_t height;
  // Columns of the grid, W.
  uint32_t width;
  // Number of the lease, for ew_control.
  uint64_t lease;
  // The result of each world.
  const struct ew_world_result *worlds;
  // The result of each robot.
  const struct ew_robot_result *robots;
  // n_frames * H * W bytes: an observation, or 255 where nothing was observed.
  const uint8_t *frames;
  // Steps before this one that were missed, with EW_ACCEPT_LATE; otherwise 0.
  uint64_t n_skipped;
  // Time that the server worked, nanoseconds.
  uint64_t simulation_nanos;
} ew_answer;

// The state of one world.
typedef struct ew_world_report {
  // The step k.
  uint64_t step;
  // Seed of the episode.
  uint64_t seed;
  // Resets since the server started.
  uint64_t episode;
  // Robots that a client holds.
  uint32_t n_held;
  // Robots that have a path for the next step.
  uint32_t n_paths;
  // The world is being reset.
  bool resetting;
} ew_world_report;

// Header of a sample on `frames`: one step of one world. The payload is `n_robots` RobotResults, one frame of
// `height * width` bytes per robot, then each robot's path of n_moves bytes.
typedef struct ew_frame_header {
  // VERSION.
  uint32_t version;
  // The world.
  uint32_t world;
  // Number of earlier samples on this channel. A gap means lost samples.
  uint64_t sequence;
  // Number of the world's first robot.
  uint32_t first_robot;
  // Number of robots R of the world.
  uint32_t n_robots;
  // Grid height H.
  uint32_t height;
  // Grid width W.
  uint32_t width;
  // The world's result.
  struct ew_world_result result;
} ew_frame_header;

// One step of one world, as the server published it.
typedef struct ew_frame {
  // World, robots, grid and the world's result.
  struct ew_frame_header header;
  // The result of each robot.
  const struct ew_robot_result *robots;
  // n_robots * H * W bytes.
  const uint8_t *frames;
  // The path of each robot, robots[i].n_moves bytes each, one after another.
  const uint8_t *paths;
} ew_frame;

// Header of a sample on `truth`; the payload is the hidden state (`height * width` bytes).
typedef struct ew_truth_header {
  // VERSION.
  uint32_t version;
  // The world.
  uint32_t world;
  // Number of earlier samples on this channel. A gap means lost samples.
  uint64_t sequence;
  // Number of resets of this world since the server started.
  uint64_t episode;
  // Step index k of the state.
  uint64_t step;
  // Seed of the episode.
  uint64_t seed;
  // Grid height H.
  uint32_t height;
  // Grid width W.
  uint32_t width;
} ew_truth_header;

// The hidden states of one world. For evaluation and pictures, never for learners.
typedef struct ew_truth {
  // World, episode, step and grid.
  struct ew_truth_header header;
  // H * W states.
  const uint8_t *states;
} ew_truth;

// Header of a sample on `agent`; the payload is a belief (`n_states * height * width` floats), then
// JSON, an Intent.
typedef struct ew_belief_header {
  // VERSION.
  uint32_t version;
  // The world.
  uint32_t world;
  // Number of earlier samples of this agent. A gap means lost samples.
  uint64_t sequence;
  // Number of resets of this world since the server started.
  uint64_t episode;
  // Step index k of the state that the belief describes.
  uint64_t step;
  // Seed of the episode.
  uint64_t seed;
  // Grid height H.
  uint32_t height;
  // Grid width W.
  uint32_t width;
  // Number of states S of the belief.
  uint32_t n_states;
  // The agent's process id.
  uint32_t pid;
  // Number of the first robot that the agent flies.
  uint32_t first_robot;
  // Number of consecutive robots that the agent flies, at least 1.
  uint32_t n_robots;
} ew_belief_header;

// A belief that an agent published.
typedef struct ew_belief {
  // World, robots, episode, step, grid, and the agent's process.
  struct ew_belief_header header;
  // n_states * H * W probabilities, state by state.
  const float *belief;
  // Names of the states.
  const char *const *states;
  // Their number, which may differ from n_states.
  uint32_t n_names;
  // Name of the policy; "" if unknown, as the texts below.
  const char *policy;
  // What computed the belief.
  const char *belief_from;
  // What the last path was planned for.
  const char *objective;
  // Time taken to plan it.
  double plan_millis;
} ew_belief;

// A sample. One of the pointers is not NULL, except at the end of a recording.
typedef struct ew_sample {
  // Nanoseconds since a recording began; 0 from an observer.
  uint64_t nanos;
  // Samples that were lost right before this one.
  uint64_t n_lost;
  // Process that published it; 0 if it is unknown.
  uint32_t pid;
  // In recordings: the server of the next samples.
  const struct ew_info *server;
  // One step of one world.
  const struct ew_frame *frame;
  // Hidden states.
  const struct ew_truth *truth;
  // A belief.
  const struct ew_belief *belief;
} ew_sample;

// What a display shows about the agent behind a belief. Pointers may be NULL.
typedef struct ew_intent {
  // Name of the policy.
  const char *policy;
  // What computed the belief.
  const char *belief_from;
  // What the last path was planned for.
  const char *objective;
  // Names of the belief's states, as many as the belief has; NULL: the model's.
  const char *const *states;
  // Time taken to plan the path.
  double plan_millis;
} ew_intent;

// A belief that another agent left.
typedef struct ew_left {
  // What the bytes are.
  const char *kind;
  // The bytes.
  const uint8_t *bytes;
  // Their number.
  size_t n_bytes;
  // Seed of the episode.
  uint64_t seed;
  // The episode.
  uint64_t episode;
  // The step k that the belief is about.
  uint64_t step;
} ew_left;

// Returns true to end a wait.
typedef bool (*ew_interrupt_check)(void);

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

// Returns the version of the binary interface of this library. Compare it with EW_ABI once.
uint32_t ew_abi(void);

// Returns the release of this library, such as "0.2.0".
const char *ew_version(void);

// Attaches to the server of an instance ("default" if emberwatch-server got no name). `client` names this program in
// the server's log. Waits up to `wait` seconds for a server that is still starting (0: fails at once with
// EW_FAILURE_NO_SERVER), and up to `timeout` seconds for its answer.
int32_t ew_attach(const char *instance,
                  const char *client,
                  double wait,
                  double timeout,
                  struct ew_server **out,
                  struct ew_error *error);

// Starts worlds inside this process. `settings` is TOML with the keys of config/server.toml, one a line, such as
// "worlds = 4\nseed = 7"; "" gives the defaults. Starts threads, whose number the setting `threads` limits.
int32_t ew_embed(const char *settings,
                 struct ew_server **out,
                 struct ew_error *error);

// Returns the settings of the server: shapes, names, the model. They never change, and live as long as the handle.
// NULL if `server` is no server of this process.
const struct ew_info *ew_info_of(struct ew_server *server);

// Sends a control request as JSON (PROTOCOL.md section 6), for requests that have no function here: snapshot, shutdown,
// and restore and fork, with the `lease` of an ew_answer, after which you call ew_observe. The reply lives until the
// next ew_control of this server.
int32_t ew_control(struct ew_server *server,
                   const char *request,
                   double timeout,
                   const char **reply,
                   struct ew_error *error);

// Returns the hidden states of a world in this process, H * W bytes, if the setting `publish_truth` is true. They live
// until the next ew_states of this server. For evaluation and pictures, never for learners.
int32_t ew_states(struct ew_server *server,
                  uint32_t world,
                  const uint8_t **states,
                  struct ew_error *error);

// Acquires the right to fly consecutive robots, and waits for the burn-in of their worlds. Robots of other clients are
// refused with EW_STATUS_BUSY, or taken over if `takeover` is set. The lease ends `seconds_to_live` after its last
// use; 0: the server's default. To continue an episode, call ew_observe; to begin one, ew_reset.
int32_t ew_acquire(struct ew_server *server,
                   uint32_t first_robot,
                   uint32_t n_robots,
                   bool takeover,
                   double seconds_to_live,
                   double timeout,
                   struct ew_lease **out,
                   struct ew_error *error);

// Starts a new episode in each world of the lease. `seeds` has one seed per world, or is NULL: then the server derives
// them. Waits for the burn-in, which can take a while: use a timeout of minutes. The answer shows the robots' cells
// and empty frames. This answer, and those of the functions below, live until the next call with the lease.
int32_t ew_reset(struct ew_lease *lease,
                 const uint64_t *seeds,
                 size_t n_seeds,
                 double timeout,
                 const struct ew_answer **out,
                 struct ew_error *error);

// Flies one path with each robot of the lease. `paths` has `n_moves` moves (ew_move) for each robot, one byte each.
// `flags` is a sum of EW_FULL_COVERAGE, EW_TEAM_FRAMES and EW_ACCEPT_LATE, or 0. EW_FAILURE_TIMEOUT tells in its
// message whether the paths were withdrawn; if the server did not answer at all, ew_observe shows whether they were
// flown.
int32_t ew_step(struct ew_lease *lease,
                const uint8_t *paths,
                size_t n_bytes,
                uint32_t flags,
                double timeout,
                const struct ew_answer **out,
                struct ew_error *error);

// Returns the last results and frames of the lease's robots again. `flags` is EW_TEAM_FRAMES or 0.
int32_t ew_observe(struct ew_lease *lease,
                   uint32_t flags,
                   double timeout,
                   const struct ew_answer **out,
                   struct ew_error *error);

// Returns the results and frames of an earlier step k of the episode. EW_STATUS_NOT_KEPT has the nearest step that the
// server keeps as its detail.
int32_t ew_recall(struct ew_lease *lease,
                  uint64_t step,
                  uint32_t flags,
                  double timeout,
                  const struct ew_answer **out,
                  struct ew_error *error);

// Restarts the time until the lease ends, without flying.
int32_t ew_renew(struct ew_lease *lease, double timeout, struct ew_error *error);

// Returns the robots to the server. The handle must still be freed.
int32_t ew_release(struct ew_lease *lease, double timeout, struct ew_error *error);

// Asks for the state of all worlds, as many as `n_worlds` of ew_info. It lives until the next ew_status_of of this
// server. The request `status` of ew_control also tells clients, holders and speed.
int32_t ew_status_of(struct ew_server *server,
                     double timeout,
                     const struct ew_world_report **worlds,
                     struct ew_error *error);

// Opens an observer of EW_FRAMES, EW_TRUTHS or EW_BELIEFS. The server never waits for observers, may start later than
// they, and may be restarted: an observer shows the next server of the instance.
int32_t ew_watch(const char *instance,
                 uint32_t what,
                 struct ew_samples **out,
                 struct ew_error *error);

// Opens a recording, a file of `emberwatch-server record`. Needs no server.
int32_t ew_open_recording(const char *path, struct ew_samples **out, struct ew_error *error);

// Returns the next sample about a world, or about any world if `world` is negative. It lives until the next call with
// these samples. An observer waits for it: EW_FAILURE_TIMEOUT if none came. At the end of a recording, all pointers of
// the sample are NULL; EW_FAILURE_BAD_ANSWER: it is damaged or cut short here, and all before is good.
int32_t ew_next(struct ew_samples *samples,
                int32_t world,
                double timeout,
                const struct ew_sample **out,
                struct ew_error *error);

// Publishes a belief about a world after its last answer, for dashboards: n_states * H * W probabilities, state by
// state. The robots of the world from `first_robot` on fly by it. The call does nothing without readers, and for
// worlds in this process. `intent` may be NULL.
int32_t ew_publish_belief(struct ew_lease *lease,
                          uint32_t first_robot,
                          uint32_t n_robots,
                          const float *belief,
                          uint32_t n_states,
                          const struct ew_intent *intent,
                          struct ew_error *error);

// Leaves bytes with the server, such as a belief, for the next agent that flies this robot from its present step.
// `kind` describes them in at most 256 bytes.
int32_t ew_leave_belief(struct ew_lease *lease,
                        uint32_t robot,
                        const char *kind,
                        const uint8_t *bytes,
                        size_t n_bytes,
                        double timeout,
                        struct ew_error *error);

// Returns the belief that the last agent of a robot left for the world's present step; EW_STATUS_NOT_KEPT if there is
// none. It lives until the next ew_left_belief of this server.
int32_t ew_left_belief(struct ew_server *server,
                       uint32_t robot,
                       double timeout,
                       const struct ew_left **out,
                       struct ew_error *error);

// Sets a function that waits call about every 50 ms, and when a signal arrives: if it returns true, the wait ends with
// EW_FAILURE_INTERRUPTED. It can be set once per process, and must not throw, jump, or call this library. Without it,
// signals do what the program set.
void ew_interrupt_when(ew_interrupt_check check);

// Frees any handle of this library; NULL does nothing. Handles may be freed in any order: a connection closes when its
// server and all its leases are freed. Freeing a lease releases its robots, which takes up to a second if the server
// is stopped. In the child of a fork, it only forgets the handle. No other thread may be using the handle.
void ew_free(void *handle);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* EMBERWATCH_H */
