"""A trained network ready to act: observations in, actions out."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from switchmt_snn.config import ExperimentConfig
from switchmt_snn.machine.torch_settings import as_when_started
from switchmt_snn.spiking.encodings import encoding_class
from switchmt_snn.spiking.network import ObservationSpec, QNetwork, build_network
from switchmt_snn.tasks.as_trained import TaskAsTrained
from switchmt_snn.tasks.observations import raw_batch
from switchmt_snn.tasks.registry import make_suite
from switchmt_snn.tasks.suite import TaskSuite


class Agent:
    """The Q-network of a run together with the tasks that it was trained on.

    Attributes:
        network: in eval mode.
        suite: names, action names and observation shape of its tasks.
        config: the run's config.
        step: training step of the weights.
    """

    def __init__(
        self, network: QNetwork, suite: TaskSuite, config: ExperimentConfig, device: torch.device, step: int
    ) -> None:
        self.network = network.to(device).eval()
        self.suite = suite
        self.config = config
        self.device = device
        self.step = step
        self._generator = torch.Generator(device).manual_seed(config.seed)
        self._invalid_KA = torch.as_tensor(~suite.valid_actions_KA, device=device)

    def independent(self) -> Agent:
        """The same agent for another thread (snnTorch's neurons write into themselves, a generator moves on)."""
        return Agent(copy.deepcopy(self.network), self.suite, self.config, self.device, self.step)

    def __reduce__(self) -> tuple[Any, ...]:
        """For pickle: to processes of one's own. The tasks and the network are made anew there, from the config."""
        weights = {name: value.cpu() for name, value in self.network.state_dict().items()}
        stored = self.config, self.network.observation, weights, self.device, self.step, self._generator.get_state()
        return _unpickled, stored

    @property
    def draws(self) -> bool:
        """Whether a greedy decision draws random numbers: of a random encoding."""
        return encoding_class(self.config.network.encoding).is_random

    def reseed(self, seed: int) -> None:
        """Restart the random numbers of the ``rate`` encoding, the only randomness of a greedy decision."""
        self._generator.manual_seed(seed)

    def q_values(self, observation: Any, task: str | int) -> npt.NDArray[np.float32]:
        """Q-values ``[A]`` of one stacked observation, or ``[B, A]`` of a batch; -inf where an action does not exist.

        Args:
            observation: raw, ``suite.observation_shape`` (Atari: uint8 ``[4, 84, 84]``, oldest frame first) or a batch;
                an array, a tensor or a list. Without stacked frames also one image as its environment gives it:
                ``[H, W]`` or ``[H, W, c]``.
            task: name or index.

        Raises:
            TaskError: unknown task, an observation of another shape, or numbers that the task cannot have given.
        """
        index = self.suite.index(task)
        batch, single = raw_batch(self.suite, observation)
        self.network.eval()
        with as_when_started(), torch.inference_mode():
            q_BA = self.network(
                torch.from_numpy(np.ascontiguousarray(batch)).to(self.device), index, generator=self._generator
            )
            q_BA = q_BA.masked_fill(self._invalid_KA[index], -torch.inf)
        values: npt.NDArray[np.float32] = q_BA.cpu().numpy()
        return values[0] if single else values

    def act(self, observation: Any, task: str | int) -> Any:
        """The greedy action (an int) for one observation, or ``[B]`` for a batch, as the environment takes it.

        That is the index of the largest Q-value (see ``q_values``), plus the ``start`` of the environment's
        ``Discrete`` space (``suite.first_actions``).

        Examples:
            >>> import numpy as np
            >>> from switchmt_snn import load_agent
            >>> agent = load_agent("runs/mine")  # the run of train's example
            >>> observation = np.zeros(agent.suite.observation_shape, np.float32)
            >>> agent.act(observation, task="CartPole-v1") in (0, 1)
            True
        """
        action = self.q_values(observation, task).argmax(axis=-1) + self.suite.first_action(self.suite.index(task))
        return int(action) if np.ndim(action) == 0 else action

    def environment(self, task: str | int) -> TaskAsTrained:
        """A task as training plays it: a Gymnasium environment for a loop of one's own, with what ``act`` takes.

        Args:
            task: name or index.

        Raises:
            TaskError: unknown task, or it cannot be made here.
        """
        return TaskAsTrained(self.suite, task)


def _unpickled(
    config: ExperimentConfig,
    observation: ObservationSpec,
    weights: dict[str, torch.Tensor],
    device: torch.device,
    step: int,
    generator_state: torch.Tensor,
) -> Agent:
    with as_when_started():
        network = build_network(config.network, observation, config.seed)
        network.load_state_dict(weights)
        agent = Agent(network, make_suite(config.tasks).at(step), config, device, step)
        agent._generator.set_state(generator_state)
        return agent
