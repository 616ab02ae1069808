"""Gymnasium environments that people write: right ones of unusual form, and wrong ones."""

from __future__ import annotations

import random
import warnings
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete, Tuple


class Plain(gymnasium.Env):  # type: ignore[type-arg]
    """Four equal numbers that count steps; action 1 of three is rewarded; episodes of 30 steps."""

    observation_space: gymnasium.Space[Any] = Box(-10.0, 10.0, (4,), np.float32)
    action_space: gymnasium.Space[Any] = Discrete(3)
    length = 30

    def reset(self, *, seed=None, options=None):  # type: ignore[no-untyped-def]
        super().reset(seed=seed)
        self.steps = 0
        return self.observe(), {}

    def step(self, action):  # type: ignore[no-untyped-def]
        self.steps += 1
        return self.observe(), self.reward(action), self.steps >= self.length, False, {}

    def observe(self) -> Any:
        return np.full(4, self.steps / 10, np.float32)

    def reward(self, action: Any) -> Any:
        return float(action == 1)


def later(right: Any, wrong: Any, env: Plain) -> Any:
    """Right for 25 steps: longer than a run's first check plays."""
    return wrong if env.steps > 25 else right


class TooWide(Plain):
    """More numbers than the network of the quickstart has weights for."""

    observation_space = Box(0.0, 10.0, (300_000,), np.float32)

    def observe(self) -> Any:
        return np.full(300_000, self.steps / 10, np.float32)


class ShortObservation(Plain):
    def observe(self) -> Any:
        return later(super().observe(), np.zeros(2, np.float32), self)


class LongObservation(Plain):
    def observe(self) -> Any:
        return later(super().observe(), np.zeros(9, np.float32), self)


class DictObservation(Plain):
    """Declares four numbers, and gives them by name."""

    def observe(self) -> Any:
        return later(super().observe(), {"a": 0.5, "b": np.zeros(3)}, self)


class TupleObservation(Plain):
    def observe(self) -> Any:
        return later(super().observe(), (np.zeros(2), np.zeros(3)), self)


class UnequalObservation(Plain):
    def observe(self) -> Any:
        return later(super().observe(), [[0.0], [1.0, 2.0], 0.0, 0.0], self)


class NoObservation(Plain):
    def observe(self) -> Any:
        return later(super().observe(), None, self)


class OneNumber(Plain):
    def observe(self) -> Any:
        return later(super().observe(), 3, self)


class GrowingDouble(Plain):
    observation_space = Box(-np.inf, np.inf, (4,), np.float64)

    def observe(self) -> Any:
        return later(np.zeros(4), np.full(4, 2.0**24 + 3), self)


class MaskedObservation(Plain):
    """Plain numbers at first; then the mask hides one."""

    def observe(self) -> Any:
        return later(
            np.ma.MaskedArray(np.ones(4, np.float32)), np.ma.MaskedArray(np.ones(4, np.float32), [0, 1, 0, 0]), self
        )


class ResetWithoutOptions(Plain):
    def reset(self, seed=None):  # type: ignore[no-untyped-def]
        return super().reset(seed=seed)


class CannotClose(Plain):
    def close(self) -> None:
        raise RuntimeError("still open")


class ResetWithoutInfo(Plain):
    """As environments before Gymnasium; two numbers, so that they could be unpacked."""

    observation_space = Box(-10.0, 10.0, (2,), np.float32)

    def reset(self, *, seed=None, options=None):  # type: ignore[no-untyped-def]
        super().reset(seed=seed)
        return np.zeros(2, np.float32)


class TextObservation(Plain):
    def observe(self) -> Any:
        return later(super().observe(), np.asarray(["a"] * 4), self)


class NanObservation(Plain):
    def observe(self) -> Any:
        return later(super().observe(), np.asarray([0, np.nan, 0, 0], np.float32), self)


class HugeObservation(Plain):
    """Finite in float64, infinite in float32."""

    def observe(self) -> Any:
        return later(super().observe(), np.full(4, 1e300), self)


class NanReward(Plain):
    def reward(self, action: Any) -> Any:
        return later(0.0, float("nan"), self)


class InfiniteReward(Plain):
    def reward(self, action: Any) -> Any:
        return later(0.0, float("inf"), self)


class HugeReward(Plain):
    def reward(self, action: Any) -> Any:
        return later(0.0, -1e39, self)


class TextReward(Plain):
    def reward(self, action: Any) -> Any:
        return later(0.0, "1", self)


class ListReward(Plain):
    def reward(self, action: Any) -> Any:
        return later(0.0, [1.0], self)


class TwoRewards(Plain):
    """Two aims, as mo-gymnasium gives them."""

    def reward(self, action: Any) -> Any:
        return later(0.0, np.asarray([0.0, -1.0]), self)


class Raises(Plain):
    def reward(self, action: Any) -> Any:
        return later(0, 1, self) and 1 / 0


class Exits(Plain):
    def reward(self, action: Any) -> Any:
        raise SystemExit(3)


class DoubleObservation(Plain):
    """float64 and whole numbers for a float32 space: every value has its float32."""

    def observe(self) -> Any:
        return [self.steps, 0.5, 1, 2]


class WideByte(Plain):
    """int64 for a uint8 space."""

    observation_space = Box(0, 255, (8, 8, 3), np.uint8)

    def observe(self) -> Any:
        return later(np.zeros((8, 8, 3), np.uint8), np.full((8, 8, 3), 300), self)


class WideUnsignedByte(WideByte):
    """uint16 for a uint8 space, whose 300 would be 44."""

    def observe(self) -> Any:
        return later(np.zeros((8, 8, 3), np.uint8), np.full((8, 8, 3), 300, np.uint16), self)


class GradientReward(Plain):
    def reward(self, action: Any) -> Any:
        return later(0.0, torch.ones((), requires_grad=True), self)


class WholeReward(Plain):
    """Of more digits than a float has room for."""

    def reward(self, action: Any) -> Any:
        return later(0.0, 10**400, self)


class FloatPicture(Plain):
    """Colours from 0 to 255 as floating-point numbers."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 30}

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode

    def render(self) -> Any:
        return np.full((8, 8, 3), 200.0)


class Offset(Plain):
    """Actions -1, 0 and 1."""

    action_space = Discrete(3, start=-1)

    def step(self, action):  # type: ignore[no-untyped-def]
        assert action in (-1, 0, 1)
        return super().step(action)


class OffsetShown(Plain):
    """Actions -1, 0 and 1; the return tells which were played and when, and the observation holds the last one."""

    action_space = Discrete(3, start=-1)
    render_mode = "rgb_array"
    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.last = 0

    def reset(self, *, seed=None, options=None):  # type: ignore[no-untyped-def]
        self.last = 0
        return super().reset(seed=seed)

    def step(self, action):  # type: ignore[no-untyped-def]
        self.last = int(action)
        return super().step(action)

    def reward(self, action: Any) -> Any:
        return float(action) * (-1.5) ** self.steps

    def observe(self) -> Any:
        return 3 * np.asarray([np.sin(self.steps), np.cos(3 * self.steps), self.last, -self.last], np.float32)

    def render(self) -> Any:
        return np.full((32, 32, 3), 80 * (self.last + 1), np.uint8)


class ManyActions(Plain):
    action_space = Discrete(40_000)

    def reward(self, action: Any) -> Any:
        return float(action)


class ChannelsFirst(Plain):
    """Channel c holds c, row h holds 10 h."""

    observation_space = Box(0, 255, (4, 10, 10), np.uint8)

    def observe(self) -> Any:
        return (np.arange(4)[:, None, None] + 10 * np.arange(10)[None, :, None] + np.zeros((1, 1, 10))).astype(np.uint8)


class ChannelsLast(ChannelsFirst):
    observation_space = Box(0, 255, (10, 10, 4), np.uint8)

    def observe(self) -> Any:
        return np.moveaxis(super().observe(), 0, -1)


class AnyAxis(Plain):
    """Ten channels of 10 by 10: only its author knows which axis they are."""

    observation_space = Box(0, 255, (10, 10, 10), np.uint8)

    def observe(self) -> Any:
        return np.broadcast_to(np.arange(10, dtype=np.uint8), (10, 10, 10))


class Grey(Plain):
    """Images without an axis of channels."""

    observation_space = Box(0, 255, (10, 10), np.uint8)

    def observe(self) -> Any:
        return np.arange(100, dtype=np.uint8).reshape(10, 10)


class Planes(Plain):
    """Truth values, as MinAtar's own ids give them."""

    observation_space = Box(0, 1, (10, 10, 4), np.bool_)

    def observe(self) -> Any:
        return np.ones((10, 10, 4), np.bool_)


class FloatGrid(Plain):
    observation_space = Box(0.0, 1.0, (5, 5), np.float32)

    def observe(self) -> Any:
        return np.full((5, 5), 0.5, np.float32)


class Composed(Plain):
    """A dict of an image, a state and a pair."""

    observation_space = Dict(
        {"image": Box(0, 255, (3, 3), np.uint8), "state": Discrete(3), "pair": Tuple((Discrete(2), Discrete(2)))}
    )

    def observe(self) -> Any:
        return {"image": np.full((3, 3), 7, np.uint8), "state": 2, "pair": (1, 0)}


class OwnSpace(gymnasium.Space[str]):
    """A space of a package's own, as MiniGrid has one for a mission's text."""

    def sample(self, mask=None, probability=None):  # type: ignore[no-untyped-def]
        return "go"

    def contains(self, x: Any) -> bool:
        return isinstance(x, str)


class Mission(Plain):
    observation_space = Dict({"numbers": Box(-10.0, 10.0, (4,), np.float32), "mission": OwnSpace()})

    def observe(self) -> Any:
        return {"numbers": super().observe(), "mission": "go"}


class Outdated(Plain):
    """Tells its author something at every step."""

    def observe(self) -> Any:
        warnings.warn("builtin type without __module__", DeprecationWarning, stacklevel=2)
        return super().observe()


class Combined(Plain):
    """Two components, rewarded as 10 first + second; the second begins at 1."""

    action_space = MultiDiscrete([2, 3], start=[0, 1])

    def reward(self, action: Any) -> Any:
        return float(10 * action[0] + action[1])


class ComposedAndCombined(Composed):
    action_space = MultiDiscrete([2, 3])


class TooManyCombinations(Plain):
    action_space = MultiDiscrete([30, 30])


class GlobalRandom(Plain):
    """Draws from the process-wide generators, which reset's seed does not reach."""

    def reward(self, action: Any) -> Any:
        return random.random() + np.random.rand() + float(np.random.randn())


class TorchRandom(Plain):
    """Draws from torch's process-wide generator."""

    def reward(self, action: Any) -> Any:
        return float(torch.rand(()))


class DrawnWhenMade(Plain):
    """A level that the constructor draws."""

    def __init__(self) -> None:
        self.level = random.random() + float(torch.rand(()))

    def reward(self, action: Any) -> Any:
        return self.level


class SampledActions(Plain):
    """Draws from its spaces, which reset's seed does not reach either."""

    def reward(self, action: Any) -> Any:
        return float(self.action_space.sample()) + float(self.observation_space.sample()[0])


class SampledGoal(Plain):
    """Draws from a space that is neither of actions nor of observations."""

    goals = Box(-1.0, 1.0, (2,), np.float32)

    def reward(self, action: Any) -> Any:
        return float(self.goals.sample()[0])


class Sampling(gymnasium.Wrapper):  # type: ignore[type-arg]
    """A wrapper that draws from an action space of its own."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.action_space = Discrete(9)

    def step(self, action: Any) -> Any:
        observation, _, ended, cut, info = self.env.step(action)
        return observation, float(self.action_space.sample()), ended, cut, info


class SeededWhenMade(Plain):
    """A generator of its own that the constructor seeds, so that reset's seed does not reach it."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(0)

    def reward(self, action: Any) -> Any:
        return self.rng.random()


class FromItsSeed(Plain):
    """What the warnings about random numbers ask for."""

    def reward(self, action: Any) -> Any:
        return self.np_random.random()


class OwnUnseeded(Plain):
    """A generator of its own, which nothing seeds."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng()

    def reward(self, action: Any) -> Any:
        return self.rng.random()


class SharedState(Plain):
    """Counts the steps of all copies together."""

    count = 0

    def reward(self, action: Any) -> Any:
        type(self).count += 1
        return float(type(self).count % 7)


class KeepsState(Plain):
    """Remembers its last action beyond reset."""

    last = 0

    def reward(self, action: Any) -> Any:
        before, self.last = self.last, int(action) + self.last
        return float(before % 5)


class Large(Plain):
    observation_space = Box(-1e4, 1e4, (4,), np.float32)

    def observe(self) -> Any:
        return np.full(4, 100.0 * self.steps, np.float32)


class Timestamps(Plain):
    """Whole numbers that float32 rounds."""

    observation_space = Box(0, 2**31 - 1, (4,), np.int64)

    def observe(self) -> Any:
        return np.full(4, 1_700_000_001 + self.steps)


class DoubleTimestamps(Plain):
    observation_space = Box(-np.inf, np.inf, (4,), np.float64)

    def observe(self) -> Any:
        return np.full(4, 2.0**24 + self.steps)


class ManyBounds(Plain):
    observation_space = Box(np.zeros(300, np.float32), np.arange(1, 301, dtype=np.float32))

    def observe(self) -> Any:
        return np.zeros(300, np.float32)


class FaintImage(Plain):
    """Small whole numbers as pixels, as grid worlds give them."""

    observation_space = Box(0, 255, (7, 7, 3), np.uint8)

    def observe(self) -> Any:
        return np.full((7, 7, 3), self.steps % 11, np.uint8)


class LargeRewards(Plain):
    def reward(self, action: Any) -> Any:
        return -100.0 if action == 2 else 1.0


class Endless(Plain):
    length = 10**12


class Halves(gymnasium.ObservationWrapper):  # type: ignore[type-arg]
    """A wrapper of one's own."""

    def observation(self, observation: Any) -> Any:
        return observation / 2


def noisy(env: gymnasium.Env) -> gymnasium.Env:  # type: ignore[type-arg]
    """Gymnasium's wrapper, and a function of one's own."""
    return gymnasium.wrappers.TransformReward(env, lambda reward: reward + np.random.normal())


def noisy_cartpole(**arguments: Any) -> gymnasium.Env:  # type: ignore[type-arg]
    """Gymnasium's environment and wrapper, made by a function of one's own."""
    return noisy(gymnasium.make("CartPole-v1", **arguments))


def register() -> None:
    """Make every class known to Gymnasium as ``Name-v0``."""
    for value in list(globals().values()):
        if isinstance(value, type) and issubclass(value, Plain):
            gymnasium.register(f"{value.__name__}-v0", value, max_episode_steps=None)
    gymnasium.register("NoisyCartPole-v0", noisy_cartpole)
    gymnasium.register("OwnCartPole-v0", "gymnasium.envs.classic_control:CartPoleEnv", kwargs={"own": print})
    gymnasium.register("ShortCartPole-v0", "gymnasium.envs.classic_control:CartPoleEnv", max_episode_steps=7)


register()
