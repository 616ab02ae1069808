"""What ours is compared with: networks of the same layers as snnTorch's tutorials and SpikingJelly write them, and
replay memories that keep whole stacks."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import snntorch
import torch
from snntorch import surrogate
from torch import Tensor, nn

ACTIONS = 18


class PlainLoop(nn.Module):
    """How snnTorch's tutorials write it: every layer at every step, ``snn.Leaky`` with its own state, Q from the mean
    of the heads' outputs."""

    def __init__(self, timesteps: int) -> None:
        super().__init__()
        self.timesteps = timesteps
        self.convolutions = nn.ModuleList([nn.Conv2d(4, 32, 8, 4), nn.Conv2d(32, 64, 4, 2), nn.Conv2d(64, 64, 3, 1)])
        self.norms = nn.ModuleList([nn.BatchNorm2d(32), nn.BatchNorm2d(64), nn.BatchNorm2d(64)])
        self.hidden = nn.ModuleList([nn.Linear(3136, 512), nn.Linear(3136, 512)])
        self.gains = nn.ParameterList([nn.Parameter(torch.zeros(3)) for _ in range(2)])
        self.heads = nn.ModuleList([nn.Linear(512, 1), nn.Linear(512, ACTIONS)])
        leaky = {"beta": 1.0, "spike_grad": surrogate.atan(), "reset_mechanism": "zero", "reset_delay": True}
        self.leaky = nn.ModuleList([snntorch.Leaky(**leaky) for _ in range(5)])

    def forward(self, x: Tensor) -> Tensor:
        """Q-values ``[B, A]``, the mean over T steps."""
        membranes = [neuron.init_leaky() for neuron in self.leaky]  # type: ignore[operator]
        total: Tensor | float = 0.0
        for _ in range(self.timesteps):
            s = x
            for i, (convolution, norm) in enumerate(zip(self.convolutions, self.norms, strict=True)):
                s, membranes[i] = self.leaky[i](norm(convolution(s)), membranes[i])
            flat, outputs = s.flatten(1), []
            for j in range(2):
                gated = self.hidden[j](flat) * torch.sigmoid(self.gains[j].max())
                spikes, membranes[3 + j] = self.leaky[3 + j](gated, membranes[3 + j])
                outputs.append(self.heads[j](spikes))
            value, advantage = outputs
            total = total + value + advantage - advantage.mean(1, keepdim=True)
        return total / self.timesteps  # type: ignore[return-value]


def spikingjelly_network(timesteps: int) -> nn.Module:
    """SpikingJelly's multi-step mode: stateless layers see time folded, neurons walk over it."""
    from spikingjelly.activation_based import functional, layer, neuron
    from spikingjelly.activation_based import surrogate as sj_surrogate

    class MultiStep(nn.Module):
        def __init__(self) -> None:
            super().__init__()

            def fires() -> nn.Module:
                return neuron.IFNode(  # type: ignore[no-any-return]
                    v_reset=0.0, surrogate_function=sj_surrogate.ATan(), detach_reset=True, step_mode="m"
                )

            convolutions = []
            for before, after, kernel, stride in ((4, 32, 8, 4), (32, 64, 4, 2), (64, 64, 3, 1)):
                convolutions += [layer.Conv2d(before, after, kernel, stride), layer.BatchNorm2d(after), fires()]
            self.trunk = nn.Sequential(*convolutions, layer.Flatten())
            self.hidden = nn.ModuleList([layer.Linear(3136, 512) for _ in range(2)])
            self.gains = nn.ParameterList([nn.Parameter(torch.zeros(3)) for _ in range(2)])
            self.fires = nn.ModuleList([fires() for _ in range(2)])
            self.heads = nn.ModuleList([layer.Linear(512, n) for n in (1, ACTIONS)])
            functional.set_step_mode(self, "m")

        def forward(self, x: Tensor) -> Tensor:
            functional.reset_net(self)
            features = self.trunk(x.expand(timesteps, *x.shape))
            value, advantage = (
                self.heads[j](self.fires[j](self.hidden[j](features) * torch.sigmoid(self.gains[j].max()))).mean(0)
                for j in range(2)
            )
            return value + advantage - advantage.mean(1, keepdim=True)  # type: ignore[no-any-return]

    return MultiStep()


class StackReplay:
    """Whole observations in arrays, as SB3 and CleanRL keep them; uniform sampling.

    ``twice`` keeps the next observation, too; else it is the observation of the next slot (SB3's
    ``optimize_memory_usage``), which is wrong at truncations.
    """

    def __init__(self, capacity: int, shape: tuple[int, ...], twice: bool) -> None:
        self.observations = np.zeros((capacity, *shape), np.uint8)
        self.next_observations = np.zeros((capacity, *shape), np.uint8) if twice else None
        self.actions = np.zeros(capacity, np.int64)
        self.rewards = np.zeros(capacity, np.float32)
        self.dones = np.zeros(capacity, np.float32)
        self.held = 0

    @property
    def nbytes(self) -> int:
        """Of everything that is held."""
        arrays = (self.observations, self.next_observations, self.actions, self.rewards, self.dones)
        return sum(array[: self.held].nbytes for array in arrays if array is not None)

    def add(self, observation: Any, action: int, reward: float, done: bool, following: Any) -> None:
        """Store a transition."""
        slot = self.held
        self.observations[slot] = observation
        if self.next_observations is not None:
            self.next_observations[slot] = following
        self.actions[slot], self.rewards[slot], self.dones[slot] = action, reward, done
        self.held += 1

    def sample(self, batch_size: int, rng: np.random.Generator) -> tuple[npt.NDArray[Any], ...]:
        """A batch."""
        chosen = rng.integers(0, self.held - 1, batch_size)
        source, index = (
            (self.observations, chosen + 1)
            if self.next_observations is None
            else (
                self.next_observations,
                chosen,
            )
        )
        return self.observations[chosen], self.actions[chosen], self.rewards[chosen], source[index], self.dones[chosen]
