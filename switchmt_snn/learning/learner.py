"""The learner: double-DQN target, loss, Adam, target network (paper, Eq. 2; Algorithm 1, lines 10-12 and 21-22).

Shapes: B batch, A actions, K tasks.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from switchmt_snn.config import LearningConfig
from switchmt_snn.learning.state import Stateful
from switchmt_snn.native.adam import NativeAdam
from switchmt_snn.replay.on_device import to_device
from switchmt_snn.replay.ring import Batch
from switchmt_snn.spiking.network import QNetwork
from switchmt_snn.updates.cuda_graph import DeviceBatch, GraphedStep, Step
from switchmt_snn.updates.engine import NativeEvaluate, make_evaluate
from switchmt_snn.updates.processes import COPY_TARGET, LOAD, STOP, UPDATE, ProcessGroup


def td_target(
    rewards_B: Tensor, terminated_B: Tensor, q_next_BA: Tensor, q_choice_BA: Tensor, discount: float
) -> Tensor:
    """Eq. 2: ``y_n = r_n`` if the next state is terminal, else ``r_n + gamma Q*(s', argmax_a Q(s', a))``.

    Args:
        rewards_B: rewards r_n.
        terminated_B: whether the next state is terminal. A truncated episode's next state is not.
        q_next_BA: target network's values Q* of the next states.
        q_choice_BA: values that choose the action; -inf where an action does not exist.
        discount: gamma.
    """
    action_B1 = q_choice_BA.argmax(dim=1, keepdim=True)
    value_B = q_next_BA.gather(1, action_B1).squeeze(1)
    return rewards_B + discount * value_B.masked_fill(terminated_B, 0.0)


class Learner(Stateful):
    """Owns the online network Q, the target network Q* and the optimiser.

    Q(s, a) is computed in training mode (batch statistics); the target and the choice of its action in eval mode, with
    the running statistics of the batch's task.

    Attributes:
        updates: gradient steps made. They run as ``config.engine`` and ``config.precision`` say; acting is always eager
            and in float32.
    """

    SAVED = ("network", "target", "optimizer", "generator", "updates", "loss_sum", "q_sum", "summed")
    DERIVED = ("config", "device", "_evaluate", "_group", "_invalid_KA", "_step", "_trained")

    def __init__(
        self,
        network: QNetwork,
        config: LearningConfig,
        valid_actions_KA: npt.NDArray[np.bool_],
        device: torch.device,
        seed: int,
        group: ProcessGroup | None = None,
    ) -> None:
        """Take a network over.

        Args:
            network: fresh or trained; moved to ``device``.
            config: resolved settings.
            valid_actions_KA: which actions exist in which task.
            device: where to learn.
            seed: of the encoding's random numbers.
            group: the processes among which updates are divided; None for one process.
        """
        self.config = config
        self.device = device
        self.network = network.to(device)
        self.target = copy.deepcopy(self.network).requires_grad_(False).eval()
        self._trained = list(self.network.parameters())
        precision = torch.bfloat16 if config.precision == "bfloat16" else None
        self._group = group
        self._evaluate = make_evaluate(self.network, self.target, config.engine, precision, config.double_q, group)
        self.optimizer = self._make_optimizer()
        self.generator = torch.Generator(device).manual_seed(seed)
        self._step = self._make_step()
        self.updates = 0
        self._invalid_KA = torch.as_tensor(~valid_actions_KA, device=device)
        self.loss_sum = torch.zeros((), device=device)
        self.q_sum = torch.zeros((), device=device)
        self.summed = 0

    def act(self, observations: npt.NDArray[np.generic], task: int) -> npt.NDArray[np.int64]:
        """Greedy actions ``[B]`` for raw stacked observations ``[B, ...]`` of a task (eval mode)."""
        self.network.eval()
        with torch.inference_mode():
            q_BA = self.network(self._tensor(observations), task, generator=self.generator)
            q_BA = q_BA.masked_fill(self._invalid_KA[task], -torch.inf)
            return q_BA.argmax(dim=1).cpu().numpy()  # type: ignore[no-any-return]

    def update(self, batch: Batch, task: int) -> None:
        """One gradient step on a batch of one task; on several processes, called in the first one."""
        if self._group is not None:
            self._group.announce(UPDATE, task)
            batch = self._group.deal(batch)
        self._gradient_step(batch, task)

    def _make_optimizer(self) -> torch.optim.Adam:
        config, parameters = self.config, self.network.parameters()
        if isinstance(self._evaluate, NativeEvaluate):
            return NativeAdam(parameters, config.learning_rate, config.adam_epsilon, self._evaluate.network)
        is_graph = config.engine == "graph"
        return torch.optim.Adam(
            parameters, lr=config.learning_rate, eps=config.adam_epsilon, fused=True, capturable=is_graph
        )

    def _make_step(self) -> Step:
        if self.config.engine == "graph":
            return GraphedStep(self._device_step, self.optimizer, self.generator)
        return self._device_step

    def _gradient_step(self, batch: Batch, task: int) -> None:
        parts = (batch.observations, batch.actions, batch.rewards, batch.next_observations, batch.terminated)
        self._step(DeviceBatch(*(self._tensor(part) for part in parts)), task)
        self.updates += 1
        self.summed += 1

    def _device_step(self, batch: DeviceBatch, task: int) -> None:
        """All of an update that happens on the device; nothing here may read a number back to the host."""
        config, rewards_B = self.config, batch.rewards_B
        if config.clip_rewards:
            rewards_B = rewards_B.clamp(-1.0, 1.0)
        q_BA, q_next_BA, q_choice_BA = self._evaluate(batch.observations, batch.next_observations, task, self.generator)
        with torch.no_grad():
            q_choice_BA = q_choice_BA.masked_fill(self._invalid_KA[task], -torch.inf)
            target_B = td_target(rewards_B, batch.terminated_B, q_next_BA, q_choice_BA, config.discount)
        q_B = q_BA.gather(1, batch.actions_B[:, None]).squeeze(1)
        loss = F.mse_loss(q_B, target_B) if config.loss == "mse" else F.huber_loss(q_B, target_B)
        for parameter in self._trained:
            parameter.grad = None
        loss.backward()
        if config.gradient_clip == "value":
            torch.nn.utils.clip_grad_value_(self._trained, config.gradient_clip_at)
        elif config.gradient_clip == "norm":
            torch.nn.utils.clip_grad_norm_(self._trained, config.gradient_clip_at)
        self.optimizer.step()
        with torch.no_grad():
            loss, q = loss.detach(), q_B.mean()
            if self._group is not None:
                loss, q = self._group.sum(torch.stack([loss, q])) / self._group.size
            self.loss_sum += loss
            self.q_sum += q

    def copy_target(self) -> None:
        """Q* <- Q, running statistics included."""
        if self._group is not None and self._group.rank == 0:
            self._group.announce(COPY_TARGET)
        self.target.load_state_dict(self.network.state_dict())

    def parameters(self) -> Tensor:
        """theta as one vector: a copy, never a view of the live parameters (ALGORITHM section 4)."""
        return torch.cat([parameter.detach().reshape(-1) for parameter in self.network.parameters()])

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Put a saved state back; JSON made the optimiser's parameter numbers text."""
        optimizer = state["optimizer"]
        numbered = {int(number): values for number, values in optimizer["state"].items()}
        state = {**state, "optimizer": {**optimizer, "state": numbered}}
        super().load_state_dict(state)
        self._step = self._make_step()  # the optimiser's tensors are others now
        if self._group is not None and self._group.rank == 0:
            self._group.announce(LOAD)
            self._group.share(state)

    def serve(self, like: Batch) -> None:
        """Another process's part in the updates, until the first one stops.

        Args:
            like: a batch of the shapes and dtypes that are dealt to this process.
        """
        assert self._group is not None
        while (message := self._group.heard())[0] != STOP:
            what, task = message
            if what == UPDATE:
                self._gradient_step(self._group.dealt(like), task)
            elif what == COPY_TARGET:
                self.copy_target()
            else:
                super().load_state_dict(self._group.share())
        self._release()

    def close(self) -> None:
        """Let the other processes go; no update can follow."""
        if self._group is not None:
            self._group.announce(STOP)
            self._release()

    def _release(self) -> None:
        """Let DistributedDataParallel go while its process group is there: later, PyTorch may abort the process."""
        del self._evaluate

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
        """Whether every loss since :meth:`take_means` and every parameter is finite."""
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
            self.network(self._tensor(observations), task, activity=activity, generator=generator)
        return {name: spikes.mean(dim=(0, 1)).flatten() for name, spikes in activity.items()}

    def _tensor(self, array: npt.NDArray[np.generic] | Tensor) -> Tensor:
        return array if isinstance(array, Tensor) else to_device(array, self.device)
