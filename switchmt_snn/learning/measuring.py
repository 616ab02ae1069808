"""What the loop reports of the network: the activity of each neuron layer."""

from __future__ import annotations

import math

import numpy as np

from switchmt_snn.learning.events import LayerHealth
from switchmt_snn.learning.learner import Learner
from switchmt_snn.replay.ring import FrameReplay, Returns
from switchmt_snn.spiking.network import QNetwork
from switchmt_snn.spiking.normalization import TaskBatchNorm

HEALTH_BATCH = 64
"""Observations in which a layer's activity is measured: few, so that measuring takes no time."""
INITIAL_SHARE = 0.01
"""How much of the running statistics may still be their initial values when health is measured."""


def layer_health(learner: Learner, replay: FrameReplay, task: int, step: int) -> dict[str, LayerHealth]:
    """Activity of every neuron layer, by name, over transitions from the whole replay of a task.

    The step seeds the draw, so that measuring takes none of training's random numbers.
    """
    drawn = replay.sample(HEALTH_BATCH, np.random.default_rng(step), Returns())
    layers = {}
    for name, rate in learner.firing_rates(drawn.observations, task).items():
        dead, saturated = float((rate == 0).float().mean()), float((rate >= 1).float().mean())
        layers[name] = LayerHealth(float(rate.mean()), dead, saturated if learner.network.spiking else 0.0)
    return layers


def updates_to_settle(network: QNetwork) -> int:
    """Updates of a task after which at most ``INITIAL_SHARE`` of its running statistics is their initial values.

    Before that, BatchNorm in eval mode scales by values that say nothing of the task, and most neurons seem silent.
    An update keeps ``1 - momentum`` of the statistics. A network without BatchNorm needs no update.
    """
    momenta = [module.momentum for module in network.modules() if isinstance(module, TaskBatchNorm)]
    kept = 1.0 - min(momenta, default=1.0)
    return math.ceil(math.log(INITIAL_SHARE) / math.log(kept)) if kept > 0.0 else int(bool(momenta))
