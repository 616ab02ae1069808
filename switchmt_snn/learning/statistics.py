"""BatchNorm's running statistics of a task, estimated anew from batches of its replay.

Running statistics follow the weights with a delay, and those of a task that is not trained do not follow at all, while
the shared weights move on. Then a task looks forgotten that is not. CaRe-BN (ICLR 2026) re-estimates them, too.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor

from switchmt_snn.replay.on_device import to_device
from switchmt_snn.replay.ring import FrameReplay, Returns
from switchmt_snn.spiking.network import QNetwork
from switchmt_snn.spiking.normalization import TaskBatchNorm


@torch.no_grad()
def reestimate_statistics(network: QNetwork, task: int, batches: Iterable[Tensor], generator: torch.Generator) -> None:
    """Replace a task's running mean and variance in every BatchNorm by their means over batches.

    Each batch goes through the network in training mode, in float32. Nothing but these statistics changes.

    Args:
        network: gets the statistics of its present weights.
        task: task index k.
        batches: raw observations ``[B, *shape]`` on the network's device.
        generator: source of the encoding's random numbers.
    """
    for count, observations in enumerate(batches, start=1):
        with _momentum(network, 1.0 / count):  # the mean over the batches so far
            network.values(network.encode(observations, generator), network.context(task), training=True)


def reestimate_from_replay(
    network: QNetwork, task: int, replay: FrameReplay, batches: int, batch_size: int, seed: tuple[int, ...]
) -> None:
    """As ``reestimate_statistics``, from observations drawn from the task's replay.

    Args:
        network: gets the statistics of its present weights.
        task: task index k.
        replay: the task's.
        batches: how many.
        batch_size: observations B of one.
        seed: of the draws and of the encoding's random numbers; the same seed draws the same.
    """
    device = next(network.parameters()).device
    rng = np.random.default_rng(seed)
    generator = torch.Generator(device).manual_seed(int(rng.integers(2**62)))
    drawn = (replay.sample(batch_size, rng, Returns()).observations for _ in range(batches))
    tensors = (x if isinstance(x, Tensor) else to_device(x, device) for x in drawn)
    reestimate_statistics(network, task, tensors, generator)


@contextmanager
def _momentum(network: QNetwork, momentum: float) -> Iterator[None]:
    layers = [module for module in network.modules() if isinstance(module, TaskBatchNorm)]
    before = [layer.momentum for layer in layers]
    for layer in layers:
        layer.momentum = momentum
    try:
        yield
    finally:
        for layer, kept in zip(layers, before, strict=True):
            layer.momentum = kept
