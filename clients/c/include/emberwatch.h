// Emberwatch for C: attach to an emberwatch-server, or step worlds inside this process.

#ifndef EMBERWATCH_H
#define EMBERWATCH_H

// Generated from clients/c/src by clients/c/tests/header.rs. Do not edit.

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

// Rules
//
// - Functions that can fail return 0, or a refusal of the server (an ew_status, positive; nothing changed), or a failure
//   (an ew_failure, negative). They describe it in the ew_error of their last argument. It may be NULL, and so may
//   every other pointer for a result, except for a new handle.
// - Handles (ew_server, ew_lease, ew_frames, ew_truths, ew_beliefs, ew_recording) are freed by ew_free. Nothing else is:
//   all other pointers that a function returns belong to a handle, and live until the call that the function names.
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
// - The library installs no signal handlers, prints nothing, and never ends the process. No call may be made from a
//   signal handler.
// - Structs that the library returns by pointer may get fields at their end in later releases of the same EW_ABI: never
//   copy them by size. ew_error and ew_intent do not change.

// Version of this header's binary interface. Compare it with ew_abi() once at the start.
#define EW_ABI 1


// Bytes of the message of an ew_error, including its final 0.
#define EW_MESSAGE_BYTES 496

// Frames show every cell, if the server's coverage allows it.
#define EW_FULL_COVERAGE 1

// One frame per world, of what all its robots saw, instead of one per robot.
#define EW_TEAM_FRAMES 2

// If a world moved without these paths, returns what it shows now instead of EW_STATUS_LATE.
#define EW_ACCEPT_LATE (1 << 16)

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

// Failures of a call. Refusals of the server are positive: see ew_status.
enum ew_failure
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // An argument is wrong, or the worlds cannot do this; nothing changed.
  EW_FAILURE_INVALID = -1,
  // No server runs on the instance.
  EW_FAILURE_NO_SERVER = -2,
  // The server has ended. Free all handles of the server, then attach again.
  EW_FAILURE_SERVER_GONE = -3,
  // There was no answer, or no sample, in time.
  EW_FAILURE_TIMEOUT = -4,
  // The check set by ew_interrupt_when ended the wait.
  EW_FAILURE_INTERRUPTED = -5,
  // The handle belongs to the process that forked this one.
  EW_FAILURE_FORKED = -6,
  // The channels in shared memory cannot be used.
  EW_FAILURE_CHANNEL = -7,
  // There is too little memory, or the system starts no thread.
  EW_FAILURE_NO_MEMORY = -8,
  // An answer or a sample is not valid, because it comes from another release; or a recording is damaged.
  EW_FAILURE_BAD_ANSWER = -9,
  // The server speaks another version of the protocol; detail: its version.
  EW_FAILURE_OTHER_VERSION = -10,
  // Another thread is using this handle.
  EW_FAILURE_IN_USE = -11,
  // The server runs in another PID namespace (another container).
  EW_FAILURE_OTHER_PID_NAMESPACE = -12,
  // A bug in this library. Free the handle.
  EW_FAILURE_BUG = -13,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum ew_failure ew_failure;
#else
typedef int32_t ew_failure;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// The values of a move in a path.
typedef enum ew_move {
  // Row - 1.
  EW_MOVE_UP = 0,
  // Row + 1.
  EW_MOVE_DOWN = 1,
  // Column - 1.
  EW_MOVE_LEFT = 2,
  // Column + 1.
  EW_MOVE_RIGHT = 3,
} ew_move;

// An observer of beliefs. One thread at a time may use it.
typedef struct ew_beliefs ew_beliefs;

// An observer of frames. One thread at a time may use it.
typedef struct ew_frames ew_frames;

// A lease. One thread at a time may use it; threads may use different leases of one server.
typedef struct ew_lease ew_lease;

// A recording that is being read. One thread at a time may use it.
typedef struct ew_recording ew_recording;

// A connection to a server, or worlds in this process. Threads may share it; requests run one after another.
typedef struct ew_server ew_server;

// An observer of hidden states. One thread at a time may use it.
typedef struct ew_truths ew_truths;

// What went wrong. Pass a pointer to one, or NULL. A call that succeeds does not write it.
typedef struct ew_error {
  // The returned code.
  int32_t code;
  // Always 0.
  uint32_t reserved;
  // The detail of an ew_status, otherwise 0.
  uint64_t detail;
  // A sentence in UTF-8, ended by 0 and cut if it is too long.
  char message[EW_MESSAGE_BYTES];
} ew_error;

// The settings of a server.
typedef struct ew_info {
  // Version of the protocol.
  uint32_t protocol;
  // The server's process.
  uint32_t pid;
  // Rows of the grid, H.
  uint32_t height;
  // Columns of the grid, W.
  uint32_t width;
  // Moves of a path, T.
  uint32_t n_moves;
  // Worlds.
  uint32_t n_worlds;
  // Robots of each world, R. Robot r of world w has the number w R + r.
  uint32_t n_robots;
  // Values in frames are below this number, or 255 where nothing was observed.
  uint32_t n_observations;
  // Names of the observations.
  const char *const *observations;
  // States of the model, S; 0 if the server hides it.
  uint32_t n_states;
  // Rows and columns that robots see beyond the cells of their path.
  uint32_t radius;
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
  // Steps simulated before k = 0.
  uint64_t burn_in;
  // Length of an episode; 0: never truncated.
  uint64_t max_steps;
  // Default life of an unused lease, milliseconds.
  uint64_t lease_millis;
  // Time that a world waits for late paths, milliseconds; 0: no deadline.
  uint64_t deadline_millis;
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
  // Always 0.
  uint32_t reserved;
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
  // Robots that have a path for the next step.
  uint32_t n_paths;
  // The world is being reset.
  bool resetting;
} ew_world_report;

// The state of a server.
typedef struct ew_report {
  // Time since the server started.
  uint64_t uptime_millis;
  // Steps of all worlds since then.
  uint64_t n_steps;
  // Steps per second, over about the last second.
  double steps_per_second;
  // Refused requests.
  uint64_t n_refused;
  // Clients.
  uint32_t n_clients;
  // Observers.
  uint32_t n_observers;
  // Number of worlds.
  uint32_t n_worlds;
  // Number of robots of all worlds.
  uint32_t n_robots;
  // The worlds.
  const struct ew_world_report *worlds;
  // The process that holds each robot; 0: none.
  const uint32_t *holders;
  // Row and column of each robot.
  const uint32_t (*cells)[2];
} ew_report;

// One step of one world, as the server published it.
typedef struct ew_frame {
  // The world.
  uint32_t world;
  // Number of its first robot.
  uint32_t first_robot;
  // Robots of the world.
  uint32_t n_robots;
  // Rows of the grid, H.
  uint32_t height;
  // Columns of the grid, W.
  uint32_t width;
  // Process of the server; 0 if it is unknown.
  uint32_t pid;
  // Samples that were lost right before this one, because the observer was too slow.
  uint64_t n_lost;
  // The result of the world.
  struct ew_world_result result;
  // The result of each robot.
  const struct ew_robot_result *robots;
  // n_robots * H * W bytes.
  const uint8_t *frames;
  // The path of each robot, robots[i].n_moves bytes each, one after another.
  const uint8_t *paths;
} ew_frame;

// The hidden states of one world.
typedef struct ew_truth {
  // The world.
  uint32_t world;
  // Rows of the grid, H.
  uint32_t height;
  // Columns of the grid, W.
  uint32_t width;
  // Always 0.
  uint32_t reserved;
  // The step k.
  uint64_t step;
  // Seed of the episode.
  uint64_t seed;
  // Resets since the server started.
  uint64_t episode;
  // Samples that were lost right before this one.
  uint64_t n_lost;
  // H * W states.
  const uint8_t *states;
} ew_truth;

// A belief that an agent published.
typedef struct ew_belief {
  // The world.
  uint32_t world;
  // Number of the first robot that flies by the belief.
  uint32_t first_robot;
  // Robots that fly by it.
  uint32_t n_robots;
  // Rows of the grid, H.
  uint32_t height;
  // Columns of the grid, W.
  uint32_t width;
  // States of the belief, S.
  uint32_t n_states;
  // Number of names in `states`.
  uint32_t n_names;
  // The agent's process.
  uint32_t pid;
  // The step k that the belief is about.
  uint64_t step;
  // Seed of the episode.
  uint64_t seed;
  // Resets since the server started.
  uint64_t episode;
  // Samples that were lost right before this one.
  uint64_t n_lost;
  // S * H * W probabilities, state by state.
  const float *belief;
  // Names of the states.
  const char *const *states;
  // Name of the policy; "" if unknown, as the two below.
  const char *policy;
  // What computed the belief.
  const char *belief_from;
  // What the last path was planned for.
  const char *objective;
  // Time taken to plan it.
  double plan_millis;
} ew_belief;

// A record of a recording: exactly one of `server`, `frame` and `truth` is not NULL, except at the end.
typedef struct ew_record {
  // Nanoseconds since the recording began.
  uint64_t nanos;
  // The server of the next records.
  const struct ew_info *server;
  // One step of one world.
  const struct ew_frame *frame;
  // Hidden states.
  const struct ew_truth *truth;
} ew_record;

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

// Sends a control request as JSON (PROTOCOL.md section 6), for requests that have no function here, such as snapshots
// and shutdown. The reply lives until the next ew_control of this server.
int32_t ew_control(struct ew_server *server,
                   const char *request,
                   double timeout,
                   const char **reply,
                   struct ew_error *error);

// Copies the hidden states of a world in this process, row by row, to `states`. The setting `publish_truth` must be
// true. For evaluation and pictures, never for learners.
int32_t ew_states(struct ew_server *server,
                  uint32_t world,
                  uint8_t *states,
                  size_t n_states,
                  struct ew_error *error);

// Returns the state of all worlds in this process as bytes, for ew_restore_state. They live until the next call of
// this function with this server.
int32_t ew_clone_state(struct ew_server *server,
                       const uint8_t **bytes,
                       size_t *n_bytes,
                       struct ew_error *error);

// Replaces all worlds in this process with the worlds of ew_clone_state. They continue exactly as those would have.
// Call ew_observe with each lease before its next ew_step.
int32_t ew_restore_state(struct ew_server *server,
                         const uint8_t *bytes,
                         size_t n_bytes,
                         struct ew_error *error);

// Acquires the right to fly consecutive robots, and waits for the burn-in of their worlds. Robots of other clients are
// refused with EW_STATUS_BUSY, or taken over if `takeover` is set. The lease ends `seconds_to_live` after its last use;
// 0: the server's default. To continue an episode, call ew_observe; to begin one, ew_reset.
int32_t ew_acquire(struct ew_server *server,
                   uint32_t first_robot,
                   uint32_t n_robots,
                   bool takeover,
                   double seconds_to_live,
                   double timeout,
                   struct ew_lease **out,
                   struct ew_error *error);

// Starts a new episode in each world of the lease. `seeds` has one seed per world, or is NULL: then the server derives
// them. Waits for the burn-in, which can take a while: use a timeout of minutes. The answer shows the robots' cells and
// empty frames. This answer, and those of the functions below, live until the next call with the lease.
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

// Replaces all worlds of the lease with worlds of a snapshot file on the server's host, from index `from` of the file
// on. `path` must be absolute. The request `snapshot` of ew_control writes such files.
int32_t ew_restore(struct ew_lease *lease,
                   const char *path,
                   uint32_t from,
                   double timeout,
                   const struct ew_answer **out,
                   struct ew_error *error);

// Replaces the world `to` of the lease with a copy of the world `from`. With the same paths, both have the same future.
int32_t ew_copy_world(struct ew_lease *lease,
                      uint32_t from,
                      uint32_t to,
                      double timeout,
                      const struct ew_answer **out,
                      struct ew_error *error);

// Restarts the time until the lease ends, without flying.
int32_t ew_renew(struct ew_lease *lease, double timeout, struct ew_error *error);

// Returns the robots to the server. The handle must still be freed.
int32_t ew_release(struct ew_lease *lease, double timeout, struct ew_error *error);

// Asks for the state of the server and its worlds. The report lives until the next ew_status_of of this server.
int32_t ew_status_of(struct ew_server *server,
                     double timeout,
                     const struct ew_report **out,
                     struct ew_error *error);

// Opens the frames of an instance, whose server may start later. The server never waits for observers, and an observer
// survives its server: it shows the next one of the instance.
int32_t ew_observe_frames(const char *instance,
                          struct ew_frames **out,
                          struct ew_error *error);

// Waits for the next frame of a world, or of any world if `world` is negative. It lives until the next call with this
// observer. EW_FAILURE_TIMEOUT: none came.
int32_t ew_next_frame(struct ew_frames *frames,
                      int64_t world,
                      double timeout,
                      const struct ew_frame **out,
                      struct ew_error *error);

// Opens the hidden states of an instance, which only a server with --publish-truth publishes.
int32_t ew_observe_truths(const char *instance, struct ew_truths **out, struct ew_error *error);

// Waits for the next hidden states, as ew_next_frame does for frames.
int32_t ew_next_truth(struct ew_truths *truths,
                      int64_t world,
                      double timeout,
                      const struct ew_truth **out,
                      struct ew_error *error);

// Opens the beliefs that the agents of an instance publish.
int32_t ew_observe_beliefs(const char *instance, struct ew_beliefs **out, struct ew_error *error);

// Waits for the next belief about a world, as ew_next_frame does for frames.
int32_t ew_next_belief(struct ew_beliefs *beliefs,
                       int64_t world,
                       double timeout,
                       const struct ew_belief **out,
                       struct ew_error *error);

// Opens a recording. Needs no server.
int32_t ew_open_recording(const char *path, struct ew_recording **out, struct ew_error *error);

// Reads the next record, which lives until the next call with this recording. At the end, all its pointers are NULL.
// EW_FAILURE_BAD_ANSWER: the file is damaged or cut short here; the records before are good.
int32_t ew_next_record(struct ew_recording *recording,
                       const struct ew_record **out,
                       struct ew_error *error);

// Publishes a belief about a world after its last answer, for dashboards: n_states * H * W probabilities, state by
// state. The robots of the world from `first_robot` on fly by it. The call does nothing without readers, within 20 ms
// of the last belief about `first_robot`, and for worlds in this process. `intent` may be NULL.
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
// server and all its leases are freed. Freeing a lease releases its robots, which takes up to a second if the server is
// stopped. In the child of a fork, it only forgets the handle. No other thread may be using the handle.
void ew_free(void *handle);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* EMBERWATCH_H */
