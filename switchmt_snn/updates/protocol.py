"""What an update engine is: the forward passes of an update, its optimizer, and how its step is executed.

All engines compute the same function with other roundings (tests compare them). A membrane that lies within rounding of
the threshold may fire in one engine and not in another, as between any two orders of a sum.

Shapes: B batch, A actions, M quantiles.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from switchmt_snn.config import ExperimentConfig, LearningConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.spiking.network import QNetwork


class Values(NamedTuple):
    """What Eq. 2 needs. Values are ``[B, A]``, or with several quantiles ``[B, M, A]``."""

    online: Tensor
    """Values of the observations by Q, in training mode, with a gradient."""
    target: Tensor
    """Values of the next observations by Q*, normalized as ``learning.next_statistics`` says."""
    choice_BA: Tensor
    """Q-values of the next observations by Q, normalized likewise; by Q* without double Q-learning."""


class DeviceBatch(NamedTuple):
    """A batch of one task on the learner's device."""

    observations: Tensor
    """``[B, *shape]``, raw."""
    actions_B: Tensor
    rewards_B: Tensor
    """Discounted sums over the transition's steps."""
    next_observations: Tensor
    terminated_B: Tensor
    discounts_B: Tensor
    """gamma^n of a transition of n steps."""


Step = Callable[[DeviceBatch, int], None]
"""All of an update that happens on the device, for a batch of a task."""


class Engine(ABC):
    """How one learner's updates are executed.

    The class says whether a run can have the engine; an object belongs to one learner.

    Attributes:
        name: its name in ``learning.engine``.
        acts: whether it has ``decisions``, so that ``learning.acting`` can be its name.
        needs: what it needs, as in "expected ..." of an error message.
        note: what the user should know if ``auto`` takes it; empty for nothing.
        torchrun: whether several processes can divide its updates.
        network: Q, on the learner's device; its parameters are read at every update.
        target: Q*; likewise.
        config: the learner's settings.
        precision: dtype of the synaptic products; None for float32 (see
            ``synaptic_products``).
    """

    name: ClassVar[str]
    needs: ClassVar[str]
    note: ClassVar[str] = ""
    torchrun: ClassVar[bool] = False
    acts: ClassVar[bool] = False

    def __init__(self, network: QNetwork, target: QNetwork, config: LearningConfig) -> None:
        self.network, self.target, self.config = network, target, config
        self.precision = product_dtype(config.precision)

    @classmethod
    def unavailable(cls, config: ExperimentConfig, device: torch.device, processes: int = 1) -> str | None:
        """Why a run cannot have this engine, as in "but ..." of an error message; None if it can.

        Args:
            config: resolved.
            device: where the network will be.
            processes: number of processes that divide each update.
        """
        if processes > 1 and not cls.torchrun:
            return f"torchrun started {processes} processes, which it cannot divide an update among"
        return None

    @classmethod
    def pays(cls, config: ExperimentConfig, device: torch.device, precision: str) -> bool:
        """Whether ``auto`` should take this engine if it is available; ``precision`` is not ``auto`` any more."""
        return False

    @classmethod
    def status(cls) -> str:
        """Whether it works on this machine, for ``switchmt-snn doctor``: "works", or what goes wrong."""
        return "works"

    @abstractmethod
    def values(self, observations: Tensor, next_observations: Tensor, task: int, generator: torch.Generator) -> Values:
        """The forward passes of an update, of raw observations ``[B, *shape]``.

        Args:
            observations: s_n.
            next_observations: s_n'.
            task: index of the batch's task.
            generator: source of the encoding's random numbers.
        """

    def decisions(self, observations: Tensor, task: int, generator: torch.Generator) -> Tensor:
        """Q-values ``[B, A]`` of raw observations ``[B, *shape]`` in eval mode, by which training acts."""
        raise NotImplementedError(f"the {self.name} engine does not act, expected learning.acting=eager with it")

    def optimizer(self) -> torch.optim.Optimizer:
        """Adam over the parameters of ``network``."""
        return adam(self.network, self.config)

    def executed(self, step: Step, optimizer: torch.optim.Optimizer, generator: torch.Generator) -> Step:
        """A device step as this engine executes it. Made again whenever the optimizer's state was replaced.

        Args:
            step: changes tensors in place only, and never waits for the device.
            optimizer: of ``optimizer``; the step calls it.
            generator: whose random numbers the step draws.
        """
        return step

    def over_processes(self, mean: Tensor) -> Tensor:
        """The mean over all processes of an update, for means of their parts of the batch."""
        return mean


EngineFactory = Callable[[QNetwork, QNetwork, LearningConfig], Engine]
"""Makes a learner's engine for Q, Q* and its settings: an engine's class, for example."""


def adam(network: QNetwork, config: LearningConfig, capturable: bool = False) -> torch.optim.Adam:
    """PyTorch's fused Adam with a learner's settings; ``capturable``: in a CUDA graph."""
    return torch.optim.Adam(
        network.parameters(), lr=config.learning_rate, eps=config.adam_epsilon, fused=True, capturable=capturable
    )


def product_dtype(precision: str) -> torch.dtype | None:
    """The dtype to which ``learning.precision`` rounds synaptic products; None does not round.

    A learner that is made without a run, and so without a plan, takes ``auto`` as float32.

    Raises:
        ConfigError: unknown precision.
    """
    dtypes = {"auto": None, "float32": None, "bfloat16": torch.bfloat16}
    if precision not in dtypes:
        raise ConfigError(f"learning.precision is {precision!r}, expected one of: {', '.join(dtypes)}")
    return dtypes[precision]
