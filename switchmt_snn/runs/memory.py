"""Memory that a run will need, and the refusal of one that does not fit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from switchmt_snn.config import ExperimentConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.switching import make_criterion
from switchmt_snn.machine.devices import select_device
from switchmt_snn.machine.memory import GIB, available_bytes
from switchmt_snn.replay.ring import BLOCK_SLOTS
from switchmt_snn.replay.size import compresses_replay, plain_frame_bytes
from switchmt_snn.spiking.network import QNetwork, trainable_parameters
from switchmt_snn.tasks.registry import find_suite
from switchmt_snn.tasks.suite import TaskSuite

MIB = 1024**2
PROCESS_BYTES = 400 * MIB
"""Python, PyTorch (229 MiB), and the compiler's front end (146) that PyTorch's optimizers import. Measured, as what
follows, on Linux with torch 2.13 without CUDA."""
ENGINE_BYTES = {"compiled": 110 * MIB}
"""What an update engine takes beside that: torch.compile's own code and what it keeps of the graphs."""
CUDA_BYTES = 300 * MIB
"""Of the driver and PyTorch's libraries for CUDA. A guess: not measured on this code."""

COMPRESSION = 15
"""Plain size of images divided by their compressed size: the least of what was measured (15 to 137). Vectors of floats
hardly compress and count as they are."""
BYTES_PER_SLOT = 4 + 4 + 1 + 1 + 1
"""Of a replay beside frames: action, reward, three flags."""
BYTES_PER_BLOCK = 3 * 8
"""Where a compressed block of frames lies."""


@dataclass(frozen=True)
class MemoryEstimate:
    """Bytes by part, at the end of a run.

    Attributes:
        process_bytes: Python, PyTorch, the suite's modules, the update engine.
        replay_bytes: all replays, as far as the run's steps fill them.
        network_bytes: networks, gradients, optimizer.
        switching_bytes: parameter vectors that the criterion keeps.
        activations_bytes: what an update holds at once.
        checkpoint_bytes: what writing a checkpoint holds at once.
    """

    process_bytes: int
    replay_bytes: int
    network_bytes: int
    switching_bytes: int
    activations_bytes: int
    checkpoint_bytes: int

    @property
    def total_bytes(self) -> int:
        """All parts."""
        networks = self.network_bytes + self.switching_bytes + self.checkpoint_bytes
        return self.process_bytes + self.replay_bytes + networks + self.activations_bytes


def estimate_memory(config: ExperimentConfig, suite: TaskSuite, network: QNetwork, neurons: int) -> MemoryEstimate:
    """Estimate a run's memory on the host.

    Args:
        config: resolved.
        suite: for the size of a frame.
        network: for its parameters.
        neurons: number of neurons of the network.
    """
    parameters = trainable_parameters(network) * 4
    snapshots = make_criterion(config.switching).snapshots(config.switching)
    # Activations: about 8 floats per neuron and step (measured 7.1 at batch 64 and 256 before the in-place backward,
    # which needs less), plus the inputs as floats.
    batch = config.learning.batch_size
    steps = config.network.timesteps
    activations = batch * 4 * (8 * neurons * steps + 4 * math.prod(suite.observation_shape))
    return MemoryEstimate(
        process_bytes=process_bytes(config),
        replay_bytes=replay_bytes(config, suite),
        network_bytes=5 * parameters,  # weights, gradients, two Adam moments, target network
        switching_bytes=snapshots * parameters,
        activations_bytes=activations,
        checkpoint_bytes=2 * (4 + snapshots) * parameters,  # weights, target, moments: each as bytes, then in one file
    )


def process_bytes(config: ExperimentConfig) -> int:
    """What a run of a resolved config takes before its replays, networks and activations."""
    on_cuda = select_device(config.device).type == "cuda"
    return (
        PROCESS_BYTES
        + find_suite(config.tasks.suite).process_bytes
        + ENGINE_BYTES.get(config.learning.engine, 0)
        + on_cuda * CUDA_BYTES
    )


def replay_bytes(config: ExperimentConfig, suite: TaskSuite, capacity_steps: int | None = None) -> int:
    """What all replays take on the host at a run's end: the steps of a short run do not fill them.

    Args:
        config: resolved.
        suite: for the size of a frame.
        capacity_steps: in place of ``learning.replay_capacity_steps``; what is compressed stays so.
    """
    configured = config.learning.replay_capacity_steps
    tasks = len(suite.names)
    reserved = (configured if capacity_steps is None else capacity_steps) * tasks
    frames = plain_frame_bytes(config, suite) / (configured * tasks) * min(reserved, config.total_steps)
    if is_on_gpu(config):
        frames = 0
    elif compresses_replay(config, suite):
        of_images = COMPRESSION if np.dtype(suite.frame_dtype) == np.uint8 else 1
        frames = (
            min(frames / of_images, config.learning.replay_max_gib * GIB) + BYTES_PER_BLOCK / BLOCK_SLOTS * reserved
        )
    return int(frames) + BYTES_PER_SLOT * reserved


def _reserved_bytes(config: ExperimentConfig, suite: TaskSuite, capacity_steps: int) -> int:
    """As ``replay_bytes``, with all plain frames: their arrays are reserved whole, however few steps fill them."""
    filled = replay_bytes(config, suite, capacity_steps)
    if is_on_gpu(config) or compresses_replay(config, suite):
        return filled
    slots = capacity_steps * len(suite.names)
    return (
        plain_frame_bytes(config, suite) // config.learning.replay_capacity_steps * capacity_steps
        + BYTES_PER_SLOT * slots
    )


def is_on_gpu(config: ExperimentConfig) -> bool:
    """Whether the replay's frames are stored on a GPU, and so take no memory of the host."""
    return config.learning.replay_on_device and select_device(config.device).type == "cuda"


def require_gpu_memory(config: ExperimentConfig, suite: TaskSuite) -> None:
    """Refuse a run whose frames do not fit into the memory of its GPU.

    Raises:
        ConfigError: with the numbers and what to do.
    """
    if not is_on_gpu(config):
        return
    needed, available = plain_frame_bytes(config, suite), torch.cuda.mem_get_info()[0]
    if needed > available:
        raise ConfigError(
            f"the replay's frames need {needed / GIB:.1f} GiB on the GPU, expected at most the "
            f"{available / GIB:.1f} GiB that are free; lower learning.replay_capacity_steps, or use "
            "learning.replay_on_device=false"
        )


def require_memory(
    estimate: MemoryEstimate, config: ExperimentConfig, suite: TaskSuite, available: int | None = None
) -> None:
    """Refuse a run that cannot fit.

    Raises:
        ConfigError: with the numbers and what to lower.
    """
    available = available_bytes() if available is None else available
    reserved = _reserved_bytes(config, suite, config.learning.replay_capacity_steps)
    room = available - (estimate.total_bytes - estimate.replay_bytes)
    if reserved <= room:
        return
    fitting, learning = _fitting_capacity(config, suite, room), config.learning
    if fitting <= learning.batch_size:
        remedy = "lower learning.batch_size and learning.replay_capacity_steps"
    else:
        also = "" if fitting >= learning.learning_starts_steps else " and learning.learning_starts_steps"
        remedy = f"lower learning.replay_capacity_steps{also} to at most {fitting:,}"
        plain_bytes = plain_frame_bytes(config, suite) / learning.replay_capacity_steps * fitting
        if compresses_replay(config, suite) and plain_bytes <= GIB:  # where replay_compression=auto does not compress
            remedy += " with learning.replay_compression=zstd"
    if config.learning.replay_on_device:
        remedy += ", or use learning.replay_on_device=false, which lets frames be compressed"
    raise ConfigError(
        f"the run needs {(available - room + reserved) / GIB:.1f} GiB (replay {reserved / GIB:.1f}, activations "
        f"{estimate.activations_bytes / GIB:.1f}, networks and snapshots "
        f"{(estimate.network_bytes + estimate.switching_bytes) / GIB:.1f}, writing a checkpoint "
        f"{estimate.checkpoint_bytes / GIB:.1f}, the process itself "
        f"{estimate.process_bytes / GIB:.1f}), expected at most the {available / GIB:.1f} GiB that are available; "
        f"{remedy}"
    )


def _fitting_capacity(config: ExperimentConfig, suite: TaskSuite, room: int) -> int:
    """The largest ``replay_capacity_steps`` whose replays take no more than ``room`` bytes; 0 if there is none."""
    least, most = 0, config.learning.replay_capacity_steps
    while least < most:
        middle = (least + most + 1) // 2
        least, most = (middle, most) if _reserved_bytes(config, suite, middle) <= room else (least, middle - 1)
    return least
