"""The parts of a run, made from its config and its tasks: the learner with its network, and the replay memories."""

from __future__ import annotations

import numpy as np
import torch

from switchmt_snn.config import ExperimentConfig
from switchmt_snn.learning.learner import Learner
from switchmt_snn.learning.shared_learner import SharedLearner
from switchmt_snn.machine.memory import GIB
from switchmt_snn.replay.ring import FrameReplay
from switchmt_snn.replay.size import compresses_replay
from switchmt_snn.spiking.network import ObservationSpec, build_network
from switchmt_snn.tasks.suite import TaskSuite
from switchmt_snn.updates.processes import ProcessGroup


def observation_spec(suite: TaskSuite) -> ObservationSpec:
    """What the network must know of a suite."""
    return ObservationSpec(
        shape=suite.observation_shape,
        frame_stack=suite.frame_stack,
        scale=suite.scale,
        in_unit_range=suite.in_unit_range,
        num_actions=suite.num_actions,
        num_tasks=len(suite.names),
    )


def make_learner(
    config: ExperimentConfig, suite: TaskSuite, device: torch.device, group: ProcessGroup | None = None
) -> Learner:
    """A run's learner with a fresh network.

    It is the same in every process of a group, except for the random numbers of the encoding.
    """
    network_seed, _, _, encode_seed = np.random.SeedSequence(config.seed).spawn(4)
    network = build_network(config.network, observation_spec(suite), int(network_seed.generate_state(1)[0]))
    encode = int(encode_seed.generate_state(1)[0]) + (0 if group is None else group.rank)
    if group is None:
        return Learner(network, config.learning, suite.valid_actions_KA, device, encode)
    return SharedLearner(network, config.learning, suite.valid_actions_KA, device, encode, group)


def make_replay(config: ExperimentConfig, suite: TaskSuite, device: torch.device) -> FrameReplay:
    """The empty replay memory D of one task."""
    learning = config.learning
    return FrameReplay(
        learning.replay_capacity_steps,
        config.tasks.num_envs,
        suite.frame_shape,
        suite.frame_dtype,
        suite.frame_stack,
        compresses_replay(config, suite),
        int(learning.replay_max_gib * GIB / len(suite.names)),
        device if learning.replay_on_device else None,
    )
