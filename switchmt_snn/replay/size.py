"""How much memory a replay's frames take, and whether they are compressed."""

from __future__ import annotations

import math

import numpy as np

from switchmt_snn.config import ExperimentConfig
from switchmt_snn.machine.memory import GIB
from switchmt_snn.tasks.suite import TaskSuite


def plain_frame_bytes(config: ExperimentConfig, suite: TaskSuite) -> int:
    """Bytes of all replays' frames without compression."""
    frame = math.prod(suite.frame_shape) * np.dtype(suite.frame_dtype).itemsize
    return frame * config.learning.replay_capacity_steps * len(suite.names)


def compresses_replay(config: ExperimentConfig, suite: TaskSuite) -> bool:
    """Whether frames are kept compressed; ``auto`` if plain ones would take more than 1 GiB, and never on a device.

    A run's plan stores the answer in place of ``auto``.
    """
    asked = config.learning.replay_compression
    if asked == "auto":
        return not config.learning.replay_on_device and plain_frame_bytes(config, suite) > GIB
    return {"zstd": True, "none": False}[asked]
