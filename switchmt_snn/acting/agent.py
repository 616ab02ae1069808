"""A trained network ready to act: observations in, actions out."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from switchmt_snn.config import ExperimentConfig
from switchmt_snn.errors import TaskError
from switchmt_snn.spiking.encodings import encoding_class
from switchmt_snn.spiking.network import QNetwork
from switchmt_snn.tasks.as_trained import TaskAsTrained
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

    @property
    def draws(self) -> bool:
        """Whether a greedy decision draws random numbers: of a random encoding."""
        return encoding_class(self.config.network.encoding).is_random

    def reseed(self, seed: int) -> None:
        """Restart the random numbers of the ``rate`` encoding, the only randomness of a greedy decision."""
        self._generator.manual_seed(seed)

    def q_values(self, observation: npt.NDArray[Any], task: str | int) -> npt.NDArray[np.float32]:
        """Q-values ``[A]`` of one stacked observation, or ``[B, A]`` of a batch; -inf where an action does not exist.

        Args:
            observation: raw, ``suite.observation_shape`` (Atari: uint8 ``[4, 84, 84]``, oldest frame first) or a batch.
                Without stacked frames also one image as its environment gives it: ``[H, W]`` or ``[H, W, c]``.
            task: name or index.

        Raises:
            TaskError: unknown task, or an observation of another shape.
        """
        index = self.suite.index(task)
        expected = self.suite.observation_shape
        observation = self._channels_first(observation)
        batch = observation[None] if observation.shape == expected else observation
        if batch.shape[1:] != expected:
            raise TaskError(
                f"the observation has shape {observation.shape}, expected {expected} or (batch, "
                f"{', '.join(map(str, expected))}): stacked frames, channels first, raw values"
            )
        self.network.eval()
        with torch.inference_mode():
            q_BA = self.network(
                torch.from_numpy(np.ascontiguousarray(batch)).to(self.device), index, generator=self._generator
            )
            q_BA = q_BA.masked_fill(self._invalid_KA[index], -torch.inf)
        values: npt.NDArray[np.float32] = q_BA.cpu().numpy()
        return values[0] if observation.shape == expected else values

    def _channels_first(self, observation: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """One image whose shape says that its channels are last, or left out, with its channels first."""
        channels, *image = self.suite.observation_shape
        if len(image) != 2 or self.suite.frame_stack != 1 or observation.shape == self.suite.observation_shape:
            return observation
        if channels == 1 and observation.shape == tuple(image):
            return observation[None]
        return np.moveaxis(observation, -1, 0) if observation.shape == (*image, channels) else observation

    def act(self, observation: npt.NDArray[Any], task: str | int) -> Any:
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
