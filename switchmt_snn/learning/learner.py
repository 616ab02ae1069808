"""The learner: double-DQN target, loss, Adam, target network (paper, Eq. 2; Algorithm 1, lines 10-12 and 21-22).

Shapes: B batch, A actions, M quantiles, K tasks.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar, cast

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.nn import Parameter

from switchmt_snn.config import LearningConfig
from switchmt_snn.errors import ConfigError, require_saved
from switchmt_snn.learning.clocks import linear_decay
from switchmt_snn.learning.first_layer import FirstLayerMeans
from switchmt_snn.learning.saved_values import require_like
from switchmt_snn.learning.state import Stateful
from switchmt_snn.replay.on_device import to_device
from switchmt_snn.replay.ring import Batch
from switchmt_snn.spiking.network import QNetwork
from switchmt_snn.updates.engine import engine_class
from switchmt_snn.updates.protocol import DeviceBatch, EngineFactory


def of_actions(values: Tensor, actions_B: Tensor) -> Tensor:
    """Values ``[B]`` or ``[B, M]`` of one action each, of values ``[B, A]`` or ``[B, M, A]``."""
    return values.take_along_dim(_below(actions_B, values), dim=-1).squeeze(-1)


def _below(values_B: Tensor, like: Tensor) -> Tensor:
    """Values ``[B]`` with as many dimensions as ``like``, whose first one is B."""
    return values_B.view(-1, *(1,) * (like.dim() - 1))


def td_target(
    rewards_B: Tensor, terminated_B: Tensor, next_values: Tensor, q_choice_BA: Tensor, discounts_B: Tensor
) -> Tensor:
    """Eq. 2: ``y_n = r_n`` if the next state is terminal, else ``r_n + gamma Q*(s', argmax_a Q(s', a))``.

    For transitions of n steps, ``r_n`` is the discounted sum of their rewards, ``s'`` the state after them, and
    ``gamma^n`` stands for gamma. Of quantiles, each one of the chosen action gives a target.

    Args:
        rewards_B: rewards r_n.
        terminated_B: whether the next state is terminal. A truncated episode's next state is not.
        next_values: target network's values of the next states, ``[B, A]`` or ``[B, M, A]``.
        q_choice_BA: values that choose the action; -inf where an action does not exist.
        discounts_B: gamma, or gamma^n.

    Returns:
        ``[B]``, or ``[B, M]``.
    """
    values = of_actions(next_values, q_choice_BA.argmax(dim=1))
    rewards, terminated, discounts = (_below(part, values) for part in (rewards_B, terminated_B, discounts_B))
    return rewards + discounts * values.masked_fill(terminated, 0.0)


def quantile_huber_loss(values_BM: Tensor, targets_BM: Tensor) -> Tensor:
    """QR-DQN's loss (Dabney et al. 2018, arXiv 1710.10044, Eq. 10) with kappa 1.

    ``|tau_i - 1{y_j < z_i}| Huber(y_j - z_i)`` with ``tau_i = (2i - 1) / (2M)``: the sum over the predicted quantiles
    z_i, the mean over the targets y_j and over the batch, as in Dopamine.
    """
    values_BM1, targets_B1M = values_BM[:, :, None], targets_BM[:, None, :]
    quantiles = values_BM.shape[1]
    tau_M1 = (torch.arange(quantiles, device=values_BM.device, dtype=values_BM.dtype)[:, None] + 0.5) / quantiles
    weights_BMM = (tau_M1 - (targets_B1M < values_BM1).to(values_BM.dtype)).abs()
    values_BMM, targets_BMM = torch.broadcast_tensors(values_BM1, targets_B1M)
    errors_BMM = F.huber_loss(values_BMM, targets_BMM, reduction="none")
    return (weights_BMM * errors_BMM).sum(dim=1).mean()


LOSSES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {"mse": F.mse_loss, "huber": F.huber_loss}
"""Of Q(s, a) and target, by the name in ``learning.loss``."""

QUANTILE_LOSSES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {"huber": quantile_huber_loss}
"""Of the quantiles of (s, a) and their targets, likewise."""

CLIPS: dict[str, Callable[[list[Parameter], float], object]] = {
    "none": lambda parameters, bound: None,
    "value": torch.nn.utils.clip_grad_value_,
    "norm": torch.nn.utils.clip_grad_norm_,
}
"""Change gradients in place, by the name in ``learning.gradient_clip``."""


class Learner(Stateful):
    """Owns the online network Q, the target network Q*, the optimizer and the engine.

    Q(s, a) is computed in training mode (batch statistics); the target and the choice of its action with what
    ``learning.next_statistics`` says: the running statistics of the batch's task, or the batch's own.

    Attributes:
        first_layer: sets the first layer's running means; None with ``learning.first_layer_mean=running``.
        updates: gradient steps made. ``engine`` executes them, and computes actions if ``learning.acting`` says so.
    """

    SAVED: ClassVar[tuple[str, ...]] = (
        "network",
        "target",
        "optimizer",
        "generator",
        "updates",
        "loss_sum",
        "q_sum",
        "summed",
    )
    DERIVED: ClassVar[tuple[str, ...]] = (
        "config",
        "device",
        "engine",
        "first_layer",
        "_clip",
        "_decisions",
        "_invalid_KA",
        "_loss",
        "_scale_K",
        "_step",
        "_trained",
    )

    def __init__(
        self,
        network: QNetwork,
        config: LearningConfig,
        valid_actions_KA: npt.NDArray[np.bool_],
        device: torch.device,
        seed: int,
        engine: EngineFactory | None = None,
    ) -> None:
        """Take a network over.

        Args:
            network: fresh or trained; moved to ``device``.
            config: resolved settings.
            valid_actions_KA: which actions exist in which task.
            device: where to learn.
            seed: of the encoding's random numbers.
            engine: makes the engine; None takes the one that ``config.engine`` names.

        Raises:
            ConfigError: unknown loss, gradient clipping, engine or precision, or a network that the engine refuses.
        """
        self.config = config
        self.device = device
        self._loss = _loss_of(config.loss, network.config.quantiles)
        self._clip = _named(CLIPS, "learning.gradient_clip", config.gradient_clip)
        self.network = network.to(device)
        self.target = copy.deepcopy(self.network).requires_grad_(False).eval()
        self._trained = list(self.network.parameters())
        self.engine = (engine or engine_class(config.engine))(self.network, self.target, config)
        self._decisions = self._acting(config.acting)
        self.optimizer = self.engine.optimizer()
        self.generator = torch.Generator(device).manual_seed(seed)
        self.first_layer = _first_layer(config.first_layer_mean, self.network)
        self._step = self.engine.executed(self._device_step, self.optimizer, self.generator)
        self.updates = 0
        self._invalid_KA = torch.as_tensor(~valid_actions_KA, device=device)
        self._scale_K = torch.ones(len(valid_actions_KA), device=device)  # of TD errors
        self.loss_sum = torch.zeros((), device=device)
        self.q_sum = torch.zeros((), device=device)
        self.summed = 0

    def _acting(self, acting: str) -> Callable[[Tensor, int, torch.Generator], Tensor]:
        """What computes the Q-values that training acts by. A learner made without a run takes ``auto`` as eager."""
        if acting in ("auto", "eager"):
            return self._eager_decisions
        if acting != self.engine.name or not self.engine.acts:
            raise ConfigError(
                f"learning.acting is {acting!r}, expected eager or an engine that acts, but learning.engine is "
                f"{self.engine.name!r}; use learning.acting=eager"
            )
        return self.engine.decisions

    @property
    def acting_network(self) -> QNetwork:
        """By whose Q-values training acts (``learning.acting_network``); it is evaluated, exported and kept as best."""
        return self.target if self.config.acting_network == "target" else self.network

    def _eager_decisions(self, observations: Tensor, task: int, generator: torch.Generator) -> Tensor:
        return cast(Tensor, self.acting_network.eval()(observations, task, generator=generator))

    def act(self, observations: npt.NDArray[np.generic], task: int) -> npt.NDArray[np.int64]:
        """Greedy actions ``[B]`` for raw stacked observations ``[B, ...]`` of a task (eval mode)."""
        with torch.inference_mode():
            q_BA = self._decisions(self._tensor(observations), task, self.generator)
            q_BA = q_BA.masked_fill(self._invalid_KA[task], -torch.inf)
            return q_BA.argmax(dim=1).cpu().numpy()

    def update(self, batch: Batch, task: int) -> None:
        """One gradient step on a batch of one task."""
        parts = DeviceBatch(
            observations=self._tensor(batch.observations),
            actions_B=self._tensor(batch.actions),
            rewards_B=self._tensor(batch.rewards),
            next_observations=self._tensor(batch.next_observations),
            terminated_B=self._tensor(batch.terminated),
            discounts_B=self._tensor(batch.discounts),
        )
        self._decay_learning_rate()
        self._step(parts, task)
        if self.first_layer is not None:
            self.first_layer.follow(parts.observations, task)
        self.updates += 1
        self.summed += 1

    def set_scale(self, task: int, scale: float) -> None:
        """Divide a task's TD errors by this from now on; 1 until then. It is no part of the saved state."""
        self._scale_K[task] = scale

    def _decay_learning_rate(self) -> None:
        decay_updates = self.config.learning_rate_decay_updates
        if decay_updates is not None:
            rate = linear_decay(self.config.learning_rate, 0.0, decay_updates, self.updates)
            for group in self.optimizer.param_groups:
                group["lr"] = rate

    def _device_step(self, batch: DeviceBatch, task: int) -> None:
        """All of an update that happens on the device; nothing here may read a number back to the host."""
        values = self.engine.values(batch.observations, batch.next_observations, task, self.generator)
        with torch.no_grad():
            q_choice_BA = values.choice_BA.masked_fill(self._invalid_KA[task], -torch.inf)
            targets = td_target(batch.rewards_B, batch.terminated_B, values.target, q_choice_BA, batch.discounts_B)
        predicted = of_actions(values.online, batch.actions_B)
        scale = self._scale_K[task]
        loss = self._loss(predicted / scale, targets / scale)
        for parameter in self._trained:
            parameter.grad = None
        loss.backward()
        self._clip(self._trained, self.config.gradient_clip_at)
        self.optimizer.step()
        with torch.no_grad():
            self.loss_sum += self.engine.over_processes(loss.detach())
            self.q_sum += self.engine.over_processes(predicted.mean())

    def copy_target(self) -> None:
        """Q* <- Q, running statistics included."""
        self.target.load_state_dict(self.network.state_dict())

    def parameters(self) -> Tensor:
        """theta as one vector: a copy, never a view of the live parameters (docs/algorithm.md)."""
        return torch.cat([parameter.detach().reshape(-1) for parameter in self.network.parameters()])

    def state_dict(self) -> dict[str, Any]:
        """As ``Stateful.state_dict``, and the first layer's part if there is one."""
        part = {} if self.first_layer is None else {"first_layer": self.first_layer.state_dict()}
        return {**super().state_dict(), **part}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Put a saved state back; JSON made the optimizer's parameter numbers text.

        Raises:
            CheckpointError: it is not whole, or of another network, optimizer or ``learning.first_layer_mean``.
        """
        first_layer = () if self.first_layer is None else ("first_layer",)
        require_saved(state, (*self.SAVED, *first_layer), type(self).__name__)
        optimizer = state["optimizer"]
        require_saved(optimizer, ("state", "param_groups"), f"the optimizer of {type(self).__name__}")
        require_like({}, optimizer["state"], f"state of the optimizer of {type(self).__name__}")
        numbered = {
            int(number) if len(str(number)) < 10 and str(number).isdecimal() else number: values
            for number, values in optimizer["state"].items()
        }
        state = {**state, "optimizer": {**optimizer, "state": numbered}}
        super().load_state_dict(state)
        if self.first_layer is not None:
            self.first_layer.load_state_dict(state["first_layer"])
        # The optimizer's tensors are others now.
        self._step = self.engine.executed(self._device_step, self.optimizer, self.generator)

    def close(self) -> None:
        """Let the engine go; no update can follow."""
        # DistributedDataParallel must go while its process group exists: later, PyTorch may abort the process.
        del self.engine

    def take_means(self) -> dict[str, float]:
        """Mean loss and mean Q(s, a) of the updates since the last call; empty if there were none."""
        if self.summed == 0:
            return {}
        means = {"loss": float(self.loss_sum) / self.summed, "q": float(self.q_sum) / self.summed}
        self.loss_sum.zero_()
        self.q_sum.zero_()
        self.summed = 0
        return means

    def is_finite(self) -> bool:
        """Whether every loss since ``take_means`` and every parameter is finite."""
        finite = torch.isfinite(self.loss_sum)
        for parameter in self.network.parameters():
            finite = finite & torch.isfinite(parameter).all()
        return bool(finite)

    def firing_rates(self, observations: npt.NDArray[np.generic] | Tensor, task: int) -> dict[str, Tensor]:
        """Mean activity of every neuron over T and batch, by layer ``[neurons]`` (spikes per step, or ReLU output).

        Draws its own random numbers, so looking does not change training.
        """
        activity: dict[str, Tensor] = {}
        self.network.eval()
        with torch.inference_mode():
            generator = torch.Generator(self.device).manual_seed(0)
            self.network(self._tensor(observations).to(self.device), task, activity=activity, generator=generator)
        return {name: spikes.mean(dim=(0, 1)).flatten() for name, spikes in activity.items()}

    def silent_shares(self, observations: npt.NDArray[np.generic] | Tensor, task: int) -> dict[str, float]:
        """Share of each layer's neurons that fire at none of these observations; see ``firing_rates``."""
        rates = self.firing_rates(observations, task)
        return {name: float((rate == 0).float().mean()) for name, rate in rates.items()}

    def q_values(self, observations: npt.NDArray[np.generic] | Tensor, task: int) -> Tensor:
        """Q-values ``[B, A]`` of the network that learns, for the task's valid actions, in eval mode; on the CPU.

        Draws its own random numbers, the same ones each time, so looking does not change training.
        """
        self.network.eval()
        with torch.inference_mode():
            generator = torch.Generator(self.device).manual_seed(0)
            q_BA = self.network(self._tensor(observations).to(self.device), task, generator=generator)
        return cast(Tensor, q_BA[:, ~self._invalid_KA[task]].to("cpu", torch.float32, copy=True))

    def _tensor(self, array: npt.NDArray[np.generic] | Tensor) -> Tensor:
        return array if isinstance(array, Tensor) else to_device(array, self.device)


def _first_layer(mean: str, network: QNetwork) -> FirstLayerMeans | None:
    if mean == "running":
        return None
    if mean == "input":
        return FirstLayerMeans(network)
    raise ConfigError(f"learning.first_layer_mean is {mean!r}, expected running or input")


def _loss_of(name: str, quantiles: int) -> Callable[[Tensor, Tensor], Tensor]:
    if quantiles == 1:
        return _named(LOSSES, "learning.loss", name)
    return _named(QUANTILE_LOSSES, f"with network.quantiles={quantiles}, learning.loss", name)


_T = TypeVar("_T")


def _named(table: dict[str, _T], key: str, name: str) -> _T:
    if name not in table:
        raise ConfigError(f"{key} is {name!r}, expected one of: {', '.join(table)}")
    return table[name]
