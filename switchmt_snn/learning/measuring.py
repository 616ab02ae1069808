"""What the loop reports of the network: the activity of each neuron layer."""

from __future__ import annotations

from switchmt_snn.learning.events import LayerHealth
from switchmt_snn.learning.learner import Learner
from switchmt_snn.replay.ring import FrameReplay, Returns

HEALTH_BATCH = 32


def layer_health(learner: Learner, replay: FrameReplay, task: int) -> dict[str, LayerHealth]:
    """Activity of every neuron layer, by name, over the newest transitions of a task."""
    newest = replay.valid_slots()[-HEALTH_BATCH:]
    layers = {}
    for name, rate in learner.firing_rates(replay.gather(newest, Returns()).observations, task).items():
        dead, saturated = float((rate == 0).float().mean()), float((rate >= 1).float().mean())
        layers[name] = LayerHealth(float(rate.mean()), dead, saturated if learner.network.spiking else 0.0)
    return layers
