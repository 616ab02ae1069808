"""SwitchMT in one file, top to bottom: torch, snnTorch, Gymnasium, NumPy, and nothing of this repository.

One spiking Q-network learns two games and decides by itself when to switch between them (Putra, Devkota, Shafique:
SwitchMT, DAC 2026). Read it beside the paper: the comments name its equations and the lines of its Algorithm 1.

    python examples/switchmt_in_one_file.py                 # about a minute on one core
    python examples/switchmt_in_one_file.py --steps 500     # a glance

The two games, Catch and Dodge, show the same images and want opposite actions. Without dendrites a network cannot solve
both (try --no-dendrites). tests/examples/test_one_file.py holds the package's network, target and switching
decisions against this file.

Shapes: T simulation steps, B batch, C channels, N neurons, S dendritic segments, K tasks, A actions.
"""

from __future__ import annotations

import argparse
import copy

import gymnasium
import numpy as np
import snntorch
import torch
import torch.nn.functional as F
from torch import Tensor, nn

# ---------------------------------------------------------------------------------------------------------- the tasks


class Catch(gymnasium.Env):
    """A ball falls 5 rows; the player in the last row moves left, stays, or moves right. +1 for the ball, else -1."""

    observation_space = gymnasium.spaces.Box(0, 255, (6, 5, 1), np.uint8)
    action_space = gymnasium.spaces.Discrete(3)
    reward_for_the_ball = 1.0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.row, self.column, self.player = 0, int(self.np_random.integers(5)), int(self.np_random.integers(5))
        return self._image(), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.player = min(4, max(0, self.player + int(action) - 1))
        self.row += 1
        over = self.row == 5
        caught = self.player == self.column
        reward = (self.reward_for_the_ball if caught else -self.reward_for_the_ball) if over else 0.0
        return self._image(), reward, over, False, {}

    def _image(self) -> np.ndarray:
        image = np.zeros((6, 5, 1), np.uint8)
        image[self.row, self.column] = image[5, self.player] = 255
        return image


class Dodge(Catch):
    """The same images; the ball must be missed."""

    reward_for_the_ball = -1.0


# -------------------------------------------------------------------------------------------------------- the network


class TaskBatchNorm(nn.Module):
    """BatchNorm with one set of running statistics per task: a batch comes from one task. Weights are shared."""

    def __init__(self, channels: int, num_tasks: int) -> None:
        super().__init__()
        self.weight, self.bias = nn.Parameter(torch.ones(channels)), nn.Parameter(torch.zeros(channels))
        self.register_buffer("mean_KC", torch.zeros(num_tasks, channels))
        self.register_buffer("var_KC", torch.ones(num_tasks, channels))

    def forward(self, x: Tensor, task: int) -> Tensor:
        return F.batch_norm(x, self.mean_KC[task], self.var_KC[task], self.weight, self.bias, self.training, 0.1, 1e-5)


class Stream(nn.Module):
    """Linear -> gain of the active dendrites -> spiking neurons -> linear head."""

    def __init__(self, features: int, hidden: int, outputs: int, num_tasks: int, segments: int, spiking: type) -> None:
        super().__init__()
        self.synapses = nn.Linear(features, hidden)
        self.segments_SK = nn.Parameter(torch.randn(segments, num_tasks)) if segments else None
        self.neurons = spiking()
        self.head = nn.Linear(hidden, outputs)

    def gain(self, task: int) -> Tensor:
        """sigmoid(max_j d_j^T c) with the one-hot context c: the strongest segment's column of the task."""
        if self.segments_SK is None:
            return torch.ones(())
        context_K = F.one_hot(torch.tensor(task), self.segments_SK.shape[1]).float()
        return torch.sigmoid((self.segments_SK @ context_K).max())


class IntegrateAndFire(snntorch.Leaky):
    """V(t) = V(t-1) + I(t); a spike where V > 1, and V back to zero. The gradient of a spike is arctan's."""

    def __init__(self) -> None:
        super().__init__(beta=1.0, threshold=1.0, reset_mechanism="zero", spike_grad=snntorch.surrogate.atan())


class SpikingQNetwork(nn.Module):
    """Conv + BatchNorm + neurons, then a value and an advantage stream: Q = V + A - mean_a(A)."""

    def __init__(self, shape: tuple[int, int, int], num_actions: int, num_tasks: int, hidden: int, segments: int):
        super().__init__()
        self.timesteps = 4
        self.convolution = nn.Conv2d(shape[0], 16, 3)
        self.normalization = TaskBatchNorm(16, num_tasks)
        self.neurons = IntegrateAndFire()
        features = 16 * (shape[1] - 2) * (shape[2] - 2)
        self.value = Stream(features, hidden, 1, num_tasks, segments, IntegrateAndFire)
        self.advantage = Stream(features, hidden, num_actions, num_tasks, segments, IntegrateAndFire)

    def forward(self, image: Tensor, task: int, spikes: dict[str, list[Tensor]] | None = None) -> Tensor:
        """Q-values [B, A] of raw images [B, C, H, W]. `spikes`, if given, collects every layer's spikes by step."""
        image_current = self.normalization(
            self.convolution(image / 255.0), task
        )  # direct encoding: the same every step
        v_trunk = torch.zeros_like(image_current)  # every decision starts from rest
        v_value = v_advantage = torch.zeros(len(image), self.value.synapses.out_features)
        value_gain, advantage_gain = self.value.gain(task), self.advantage.gain(task)
        values, advantages = [], []
        for _ in range(self.timesteps):
            s_trunk, v_trunk = self.neurons(image_current, v_trunk)
            features = s_trunk.flatten(1)
            # Eq. 1: V(t) = V(t-1) + f(sum_i s_i(t), max_j d_j^T c), with f(I, d) = I * sigmoid(d)
            s_value, v_value = self.value.neurons(self.value.synapses(features) * value_gain, v_value)
            s_advantage, v_advantage = self.advantage.neurons(
                self.advantage.synapses(features) * advantage_gain, v_advantage
            )
            values.append(self.value.head(s_value))
            advantages.append(self.advantage.head(s_advantage))
            if spikes is not None:
                for name, s in (("trunk", s_trunk), ("value", s_value), ("advantage", s_advantage)):
                    spikes.setdefault(name, []).append(s)
        value, advantage = torch.stack(values).mean(0), torch.stack(advantages).mean(0)
        return value + advantage - advantage.mean(1, keepdim=True)


# ------------------------------------------------------------------------------------------------ learning, switching


def td_target(rewards: Tensor, terminal: Tensor, q_star_next: Tensor, q_next: Tensor, discount: float) -> Tensor:
    """Eq. 2: y = r at a terminal state, else y = r + discount * Q*(s', argmax_a Q(s', a)) (double DQN)."""
    chosen = q_next.argmax(dim=1)
    bootstrap = q_star_next[torch.arange(len(chosen)), chosen]
    return rewards + discount * torch.where(terminal, 0.0, bootstrap)


class Replay:
    """D_i: a ring of one task's newest transitions."""

    def __init__(self, capacity: int, shape: tuple[int, int, int]) -> None:
        self.states, self.next_states = np.zeros((2, capacity, *shape), np.uint8)
        self.actions, self.rewards = np.zeros(capacity, np.int64), np.zeros(capacity, np.float32)
        self.terminal = np.zeros(capacity, np.bool_)
        self.added = 0

    def add(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminal: bool) -> None:
        i = self.added % len(self.actions)
        self.states[i], self.actions[i], self.rewards[i] = state, action, reward
        self.next_states[i], self.terminal[i] = next_state, terminal
        self.added += 1

    def sample(self, size: int, rng: np.random.Generator) -> tuple[Tensor, ...]:
        i = rng.integers(0, min(self.added, len(self.actions)), size)
        parts = (self.states[i], self.actions[i], self.rewards[i], self.next_states[i], self.terminal[i])
        return tuple(torch.from_numpy(part) for part in parts)


def loss_on(
    batch: tuple[Tensor, ...], q: SpikingQNetwork, q_star: SpikingQNetwork, task: int, discount: float
) -> Tensor:
    """(y - Q(s, a))^2 of a batch of one task. Only Q(s, a) normalises by the batch; y uses the running statistics."""
    states, actions, rewards, next_states, terminal = batch
    q.eval()
    with torch.no_grad():
        y = td_target(rewards, terminal, q_star(next_states, task), q(next_states, task), discount)
    q.train()
    return F.mse_loss(q(states, task).gather(1, actions[:, None]).squeeze(1), y)


class ParameterChange:
    """Eq. 3: leave the task when the parameters moved by less than `threshold` over the last K episodes."""

    def __init__(self, window: int, threshold: float = 0.10) -> None:
        self.window, self.threshold = window, threshold
        self.history: list[Tensor] = []  # H_i; theta_t and theta_(t-K) are K episodes apart: K + 1 snapshots

    def says_leave(self, theta: Tensor) -> bool:
        self.history = [*self.history, theta][-self.window - 1 :]
        if len(self.history) <= self.window:
            return False
        old, new = self.history[0].double(), self.history[-1].double()
        return bool((new - old).norm() / old.norm() < self.threshold)


def parameters(network: nn.Module) -> Tensor:
    """theta_t as one vector: a copy. (A view would change with the network, and Eq. 3 would always measure 0.)"""
    return torch.cat([p.detach().flatten() for p in network.parameters()])


# -------------------------------------------------------------------------------------------------------- Algorithm 1


def channels_first(image: np.ndarray) -> np.ndarray:
    """[H, W, C] -> [C, H, W]."""
    return np.moveaxis(image, -1, 0)


def greedy(network: SpikingQNetwork, state: np.ndarray, task: int) -> int:
    network.eval()
    with torch.no_grad():
        return int(network(torch.from_numpy(state[None].copy()), task).argmax())


def train(args: argparse.Namespace, environments: list[gymnasium.Env]) -> SpikingQNetwork:
    """Algorithm 1; the numbers in the comments are its lines."""
    torch.manual_seed(args.seed)
    rng = np.random.default_rng(args.seed)
    shape, num_tasks = (1, 6, 5), len(environments)
    q = SpikingQNetwork(shape, 3, num_tasks, args.hidden, 3 if args.dendrites else 0)  # 2: Q
    q_star = copy.deepcopy(q).eval()  # 2: Q*
    optimizer = torch.optim.Adam(q.parameters(), lr=3e-3)
    replays = [Replay(10_000, shape) for _ in environments]  # 3: D_j
    i, policy = 0, ParameterChange(args.window)  # 4
    for environment in environments:
        environment.reset(seed=args.seed)
    state, steps_in_visit, returns = channels_first(environments[i].reset()[0]), 0, []
    for t in range(1, args.steps + 1):  # 6
        epsilon = max(0.05, 1.0 - t / (0.5 * args.steps))
        explore = rng.random() < epsilon or replays[i].added < args.batch_size
        action = int(rng.integers(3)) if explore else greedy(q, state, i)  # 7
        image, reward, terminal, _, _ = environments[i].step(action)  # 8
        next_state = channels_first(image)
        replays[i].add(state, action, reward, next_state, terminal)  # 9
        for k in [i] if args.current_only else range(num_tasks):  # the paper samples D_i, its authors' script every D_j
            if t % 4 == 0 and replays[k].added >= args.batch_size:
                loss = loss_on(replays[k].sample(args.batch_size, rng), q, q_star, k, discount=0.9)  # 10, 11
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()  # 12
        state, steps_in_visit = next_state, steps_in_visit + 1
        if terminal:  # 13
            returns = [*returns, reward]
            if policy.says_leave(parameters(q)) and steps_in_visit >= args.min_stay:  # 14-19
                name = type(environments[i]).__name__
                print(f"step {t:6}  leaves {name:5}  mean return of the visit {np.mean(returns):+.2f}")
                i, policy, steps_in_visit, returns = (i + 1) % num_tasks, ParameterChange(args.window), 0, []  # 20
            state = channels_first(environments[i].reset()[0])
        if t % 100 == 0:  # 23
            q_star.load_state_dict(q.state_dict())  # 24
    return q


def play(network: SpikingQNetwork, environment: gymnasium.Env, task: int, episodes: int) -> float:
    """Mean return of the greedy policy."""
    total = 0.0
    for episode in range(episodes):
        state, terminal = channels_first(environment.reset(seed=10_000 + episode)[0]), False
        while not terminal:
            image, reward, terminal, _, _ = environment.step(greedy(network, state, task))
            state, total = channels_first(image), total + reward
    return total / episodes


def arguments(words: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="SwitchMT on Catch and Dodge.")
    parser.add_argument("--steps", type=int, default=8_000, help="agent steps over both tasks")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--hidden", type=int, default=64, help="units of each stream")
    parser.add_argument("--batch-size", type=int, default=32)
    parser.add_argument("--window", type=int, default=5, help="K of Eq. 3, in episodes")
    parser.add_argument("--min-stay", type=int, default=100, help="shortest visit, in steps")
    parser.add_argument("--current-only", action="store_true", help="learn from the current task's buffer only")
    parser.add_argument("--dendrites", action=argparse.BooleanOptionalAction, default=True)
    return parser.parse_args(words)


def main(words: list[str] | None = None) -> dict[str, float]:
    args = arguments(words)
    torch.set_num_threads(1)
    environments = [Catch(), Dodge()]
    network = train(args, environments)
    scores = {type(env).__name__: play(network, env, task, 100) for task, env in enumerate(environments)}
    print("mean return of 100 greedy episodes:", ", ".join(f"{name} {score:+.2f}" for name, score in scores.items()))
    return scores


if __name__ == "__main__":
    main()
