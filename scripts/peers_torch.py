"""Measures PyTorch on the same CPU and in the same run, to compare it with `agent/network/benches/network.rs`.

Measures three networks built from torch's layers: the dynamic autoencoder of `agent/network/src/autoencoder.rs` (hidden
size 16, windows of 1,000 frames of 64 x 64 cells), a DQN, and the neural belief's network (updates on 16 grids). Uses
two threads; single inputs and the neural belief are also measured with one thread. Everything is measured twice: with
glibc's default allocator, and with an allocator that keeps its memory and uses huge pages.

Prints medians with minimum and maximum over rounds, and the mean processor time, which is more reliable on a busy
machine. Needs torch. If arguments are given, runs only the measurements whose name contains one of them.
"""

import os
import statistics
import subprocess
import sys
import time
from functools import partial

import torch
from torch import nn
from torch.nn import functional

N_FRAMES, SIDE, N_STATES, HIDDEN = 1000, 64, 3, 16
N_VISITED = 33
N_THREADS = 2
DQN_INPUTS, DQN_ACTIONS, DQN_BATCH, DQN_REPLAY = 16, 4, 64, 1000

# glibc reads these variables only at start, so the measurements run in one process for each of the two settings.
AS_IS = {}
TUNED = {
    "GLIBC_TUNABLES": "glibc.malloc.hugetlb=1",
    "MALLOC_MMAP_THRESHOLD_": str(1 << 32),
    "MALLOC_TRIM_THRESHOLD_": str(1 << 34),
    "MALLOC_TOP_PAD_": str(1 << 28),
    "THP_MEM_ALLOC_ENABLE": "1",
}


def conv(before, after, stride=1, dilation=1):
    return nn.Sequential(nn.Conv2d(before, after, 3, stride, dilation, dilation), nn.ReLU())


class UNet(nn.Module):
    """Maps features of cells to the logits of the cells' next observations."""

    def __init__(self):
        super().__init__()
        self.full = conv(4 * N_STATES + 4, 16)
        self.to_half, self.down_half = conv(16, 24, stride=2), conv(24, 24)
        self.to_quarter, self.down_quarter = conv(24, 32, stride=2), conv(32, 32)
        self.wide = conv(32, 32, dilation=2)
        self.from_quarter, self.at_half = nn.Conv2d(32, 24, 1), conv(24, 24)
        self.from_half, self.at_full = nn.Conv2d(24, 16, 1), conv(16, 16)
        self.head = nn.Conv2d(16, N_STATES, 1)

    def forward(self, features):
        full = self.full(features)
        half = self.residual(self.down_half, self.to_half(full))
        quarter = self.residual(self.down_quarter, self.to_quarter(half))
        quarter = self.from_quarter(self.residual(self.wide, quarter))
        half = self.residual(self.at_half, functional.relu(half + self.doubled(quarter)))
        full = functional.relu(full + self.doubled(self.from_half(half)))
        return self.head(self.residual(self.at_full, full))

    @staticmethod
    def residual(layer, images):
        return images + layer(images)

    @staticmethod
    def doubled(images):
        return functional.interpolate(images, scale_factor=2)


class Autoencoder(nn.Module):
    """Maps frames to predictors of the next frames: an encoder, a recurrence, a decoder and an observation matrix."""

    def __init__(self):
        super().__init__()
        channels, kernels = [N_STATES, 32, 16, 8], [(8, 4), (4, 2), (3, 1)]
        encoder = []
        for before, after, (side, stride) in zip(channels, channels[1:], kernels, strict=False):
            encoder += [nn.Conv2d(before, after, side, stride), nn.Dropout2d(), nn.ReLU()]
            encoder += [nn.BatchNorm2d(after)]
        self.encoder = nn.Sequential(*encoder, nn.Flatten(), nn.Linear(128, HIDDEN))
        self.recurrence = nn.GRU(HIDDEN, HIDDEN)
        channels = [HIDDEN, 128, 64, 32, 16]
        decoder = []
        for before, after in zip(channels, channels[1:], strict=False):
            stride, padding = (1, 0) if before == HIDDEN else (2, 1)
            decoder += [nn.ConvTranspose2d(before, after, 4, stride, padding, bias=False)]
            decoder += [nn.Dropout2d(), nn.BatchNorm2d(after), nn.ReLU()]
        last = nn.ConvTranspose2d(channels[-1], N_STATES, 4, 2, 1, bias=False)
        self.decoder = nn.Sequential(*decoder, last, nn.Softmax(1))
        self.observation = nn.Parameter(torch.randn(N_STATES, N_STATES))

    def forward(self, frames, hidden):
        """Returns the predictor after each of consecutive frames, and the last hidden vector."""
        track, hidden = self.recurrence(self.encoder(frames), hidden)
        return self.decoder(track[..., None, None]), hidden

    def observed(self, predictors):
        """Returns the predicted observation probabilities of each cell."""
        return torch.einsum("os,tshw->tohw", self.observation.softmax(0), predictors)


def frames(share):
    """Returns one-hot frames in which a share of the cells is visited, and the mask of visited cells."""
    values = torch.randint(N_STATES, (N_FRAMES, SIDE, SIDE))
    visited = torch.rand(N_FRAMES, SIDE, SIDE) < share
    one_hot = functional.one_hot(values, N_STATES).permute(0, 3, 1, 2).float()
    return one_hot.contiguous() * visited[:, None], visited


def autoencoder_update(share):
    network, (seen, visited) = Autoencoder(), frames(share)
    optimiser = torch.optim.Adam(network.parameters(), 1e-3, betas=(0.5, 0.9))
    # Computes the loss only in visited cells, as optimised torch code would.
    step, row, col = visited[1:].nonzero(as_tuple=True)
    goal = seen[1:][step, :, row, col]

    def update():
        predictors, _ = network(seen[:-1], torch.randn(1, HIDDEN))
        at_visits = predictors[step, :, row, col] @ network.observation.softmax(0).T
        loss = functional.binary_cross_entropy(at_visits, goal, reduction="sum") / len(step)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()

    return update


def inference_step():
    network, (seen, visited) = Autoencoder().eval(), frames(N_VISITED / SIDE**2)
    frame, (row, col) = seen[:1], visited[0].nonzero(as_tuple=True)
    state = {"hidden": torch.randn(1, HIDDEN), "prior": torch.full((N_STATES, SIDE, SIDE), 1 / 3)}

    @torch.no_grad()
    def step():
        posterior = state["prior"].clone()
        likelihood = frame[0, :, row, col].T @ network.observation.softmax(0)
        joint = posterior[:, row, col] * likelihood.T
        posterior[:, row, col] = joint / joint.sum(0)
        predictors, state["hidden"] = network(frame, state["hidden"])
        state["prior"] = predictors[0]
        return posterior

    return step


def neural_update():
    network, n_grids = UNet(), 16
    optimiser = torch.optim.Adam(network.parameters(), 2e-3)
    features = torch.rand(n_grids, 4 * N_STATES + 4, SIDE, SIDE)
    grid = torch.arange(n_grids).repeat_interleave(N_VISITED)
    row, col = torch.randint(SIDE, (2, n_grids * N_VISITED))
    goal = torch.randint(N_STATES, (n_grids * N_VISITED,))

    def update():
        loss = functional.cross_entropy(network(features)[grid, :, row, col], goal)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()

    return update


def neural_prediction(n_grids=1):
    network, features = UNet(), torch.rand(n_grids, 4 * N_STATES + 4, SIDE, SIDE)

    @torch.no_grad()
    def predict():
        return network(features).softmax(1)

    return predict


def perceptron():
    layers = [nn.Linear(DQN_INPUTS, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(128, DQN_ACTIONS))


def dqn_update():
    network, target = perceptron(), perceptron()
    target.load_state_dict(network.state_dict())
    optimiser = torch.optim.Adam(network.parameters(), 0.01)
    before, after = torch.rand(2, DQN_REPLAY, DQN_INPUTS)
    action = torch.randint(DQN_ACTIONS, (DQN_REPLAY, 1))
    reward = torch.rand(DQN_REPLAY, 1)
    ours, theirs = list(network.parameters()), list(target.parameters())

    def update():
        batch = torch.randint(DQN_REPLAY, (DQN_BATCH,))
        with torch.no_grad():
            goal = reward[batch] + 0.99 * target(after[batch]).amax(1, keepdim=True)
        loss = functional.mse_loss(network(before[batch]).gather(1, action[batch]), goal)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        with torch.no_grad():
            torch._foreach_lerp_(theirs, ours, 0.01)

    return update


def dqn_act():
    network, state = perceptron(), torch.rand(1, DQN_INPUTS)

    @torch.no_grad()
    def act():
        return int(network(state).argmax())

    return act


def report(what, make, rounds, inner=1, threads=N_THREADS):
    """Times the function that `make` returns, over `rounds` rounds of `inner` calls each."""
    words = [word for word in sys.argv[1:] if not word.startswith("--")]
    if words and not any(word in what for word in words):
        return
    torch.set_num_threads(threads)
    function = make()
    for _ in range(inner + 1):
        function()
    micros, busy = [], time.process_time()
    for _ in range(rounds):
        start = time.perf_counter()
        for _ in range(inner):
            function()
        micros.append((time.perf_counter() - start) * 1e6 / inner)
    busy = (time.process_time() - busy) * 1e6 / inner / rounds
    median, spread = statistics.median(micros), f"({min(micros):.1f} to {max(micros):.1f})"
    who = f"torch, {threads} thread{'s' * (threads > 1)}"
    print(
        f"{who:<16} {what:<34} {median:11.1f} us  {spread:<26} processor {busy:11.1f} us",
        flush=True,
    )


def measure(quick):
    torch.manual_seed(0)
    rounds, some = 3 if quick else 9, N_VISITED / SIDE**2
    report("autoencoder: update on paths", lambda: autoencoder_update(some), rounds)
    report("autoencoder: update on full frames", lambda: autoencoder_update(1.1), rounds)
    for threads in (N_THREADS, 1):
        report("autoencoder: inference step", inference_step, 9, 20, threads)
        report("dqn: update", dqn_update, 9, 50, threads)
        report("dqn: act", dqn_act, 9, 500, threads)
        report("neural belief: update", neural_update, 9, 5, threads)
        for n_grids in (1, 16, 64):
            prediction = partial(neural_prediction, n_grids)
            report(f"neural belief: prediction of {n_grids}", prediction, 9, 50 // n_grids + 1, threads)


def main():
    if "--here" in sys.argv:
        measure("--quick" in sys.argv)
        return
    print(f"torch {torch.__version__}", flush=True)
    for words, environment in (("as it is", AS_IS), ("keeping memory, huge pages", TUNED)):
        print(f"-- allocator: {words}", flush=True)
        command = [sys.executable, __file__, "--here", *sys.argv[1:]]
        subprocess.run(command, env=os.environ | environment, check=True)


if __name__ == "__main__":
    main()
