"""Names trouble in a running training, with a remedy."""

from __future__ import annotations

import math

from switchmt_snn.config import NetworkConfig
from switchmt_snn.learning.events import Measured

DEAD_SHARE = 0.95
SATURATED_SHARE = 0.5
LARGE_Q = 1_000.0
STREAMS = ("q", "value", "advantage")


def health_warnings(measured: Measured, network: NetworkConfig) -> list[str]:
    """What looks wrong, one line each: seen, and what to try.

    Rewards are clipped to [-1, 1] by default, so |Q| cannot rightly exceed 1 / (1 - discount) = 100.
    """
    warnings = []
    for name, layer in measured.layers.items():
        if layer.dead > DEAD_SHARE:
            warnings.append(
                f"layer {name}: {layer.dead:.0%} of the neurons never fire; {_remedy_for_silence(name, network)}"
            )
        if layer.saturated > SATURATED_SHARE:
            warnings.append(
                f"layer {name}: {layer.saturated:.0%} of the neurons fire at every step; raise network.threshold"
            )
    if measured.q is not None and math.isfinite(measured.q) and abs(measured.q) > LARGE_Q:
        warnings.append(
            f"mean Q is {measured.q:.3g}: values explode; lower learning.learning_rate, use learning.loss=huber or "
            "learning.clip_rewards=true"
        )
    return warnings


def _remedy_for_silence(layer: str, network: NetworkConfig) -> str:
    if layer not in STREAMS:
        return "lower network.threshold, raise network.timesteps or widen the surrogate (network.surrogate_slope)"
    if network.stream_normalization == "none":
        return "use network.stream_normalization=batch"
    return f"raise network.stream_current_thresholds (now {network.stream_current_thresholds:g})"
