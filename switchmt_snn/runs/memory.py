"""Memory that a run will need, and the refusal of one that does not fit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from switchmt_snn.config import ExperimentConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.switching import make_criterion
from switchmt_snn.machine.devices import select_device
from switchmt_snn.machine.memory import GIB, available_bytes
from switchmt_snn.replay.size import compresses_replay, plain_frame_bytes
from switchmt_snn.spiking.network import QNetwork, trainable_parameters
from switchmt_snn.tasks.suite import TaskSuite

PROCESS_BYTES = 700 * 1024**2
"""Python, torch, its kernels' scratch and the emulators (measured: 0.42 GiB before emulators and replay)."""

COMPRESSION = 10
"""Plain size of frames divided by their compressed size, for estimates (measured: 15 to 137; docs/performance.md)."""


@dataclass(frozen=True)
class MemoryEstimate:
    """Bytes by part; ``total_bytes`` adds the process itself."""

    replay_bytes: int
    network_bytes: int
    switching_bytes: int
    activations_bytes: int

    @property
    def total_bytes(self) -> int:
        """All parts and the process."""
        parts = self.replay_bytes + self.network_bytes + self.switching_bytes + self.activations_bytes
        return parts + PROCESS_BYTES


def estimate_memory(config: ExperimentConfig, suite: TaskSuite, network: QNetwork, neurons: int) -> MemoryEstimate:
    """Estimate a run's memory.

    Args:
        config: resolved.
        suite: for the size of a frame.
        network: for its parameters.
        neurons: number of neurons of the network.
    """
    slots = config.learning.replay_capacity_steps * len(suite.names)
    frames = plain_frame_bytes(config, suite)
    if is_on_gpu(config):
        frames = 0
    elif compresses_replay(config, suite):
        frames = int(min(frames / COMPRESSION, config.learning.replay_max_gib * GIB))
    parameters = trainable_parameters(network) * 4
    snapshots = make_criterion(config.switching).snapshots(config.switching)
    # Activations: about 8 floats per neuron and step (measured 7.1 at batch 64 and 256 before the in-place backward,
    # which needs less), plus the inputs as floats.
    batch = config.learning.batch_size
    steps = config.network.timesteps
    activations = batch * 4 * (8 * neurons * steps + 4 * math.prod(suite.observation_shape))
    return MemoryEstimate(
        replay_bytes=frames + slots * (4 + 4 + 1 + 1 + 1),  # action, reward, three flags
        network_bytes=5 * parameters,  # weights, gradients, two Adam moments, target network
        switching_bytes=snapshots * parameters,
        activations_bytes=activations,
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


def require_memory(estimate: MemoryEstimate, config: ExperimentConfig, available: int | None = None) -> None:
    """Refuse a run that cannot fit.

    Raises:
        ConfigError: with the numbers and what to lower.
    """
    available = available_bytes() if available is None else available
    if estimate.total_bytes <= available:
        return
    rest = estimate.total_bytes - estimate.replay_bytes
    fitting = int((available - rest) / (estimate.replay_bytes / config.learning.replay_capacity_steps))
    remedy = (
        f"lower learning.replay_capacity_steps to at most {fitting:,}"
        if fitting > config.learning.batch_size
        else "lower learning.batch_size and learning.replay_capacity_steps"
    )
    if config.learning.replay_on_device:
        remedy += ", or use learning.replay_on_device=false, which lets frames be compressed"
    raise ConfigError(
        f"the run needs {estimate.total_bytes / GIB:.1f} GiB (replay {estimate.replay_bytes / GIB:.1f}, activations "
        f"{estimate.activations_bytes / GIB:.1f}, networks and snapshots "
        f"{(estimate.network_bytes + estimate.switching_bytes) / GIB:.1f}), expected at most the "
        f"{available / GIB:.1f} GiB that are available; {remedy}"
    )
