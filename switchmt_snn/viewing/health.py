"""Names trouble in a running training, with remedies that this run has not taken yet."""

from __future__ import annotations

import math

from switchmt_snn.config import ExperimentConfig, NetworkConfig, clips_rewards
from switchmt_snn.learning.events import Measured

DEAD_SHARE = 0.95
SATURATED_SHARE = 0.5
LARGE_FACTOR = 10.0
"""Q-values that are this many times as large as they can rightly be explode."""
EARLY_UPDATES = 2_000
"""Before so many updates, silent neurons say little of those that training ends with."""
STREAMS = ("q", "value", "advantage")


def health_warnings(measured: Measured, config: ExperimentConfig, largest_return: float) -> dict[str, str]:
    """What looks wrong: a line with what was seen and what to try, by a name that stays while the numbers change.

    Args:
        measured: of the network now.
        config: the run's; a remedy that it has already is not named.
        largest_return: of the training episodes so far, in absolute value.
    """
    warnings = {}
    for name, layer in measured.layers.items():
        if measured.updates >= EARLY_UPDATES and layer.dead > DEAD_SHARE:
            remedy = _remedy_for_silence(name, config.network)
            warnings[f"silent {name}"] = f"layer {name}: {layer.dead:.0%} of the neurons never fire; {remedy}"
        if measured.updates >= EARLY_UPDATES and layer.saturated > SATURATED_SHARE:
            remedy = _remedy_for_saturation(name, config.network)
            warnings[f"saturated {name}"] = (
                f"layer {name}: {layer.saturated:.0%} of the neurons fire at every step; {remedy}"
            )
    bound = largest_q(config, largest_return)
    if measured.q is not None and math.isfinite(measured.q) and abs(measured.q) > LARGE_FACTOR * bound:
        warnings["large Q"] = (
            f"mean Q is {measured.q:.3g}, expected at most about {bound:.3g}: values explode; "
            f"{_remedy_for_large_values(config)}"
        )
    return warnings


def largest_q(config: ExperimentConfig, largest_return: float) -> float:
    """About the largest |Q| that returns allow: 1 / (1 - discount) with clipped rewards, else the largest return."""
    discount = config.learning.discount
    if not clips_rewards(config):
        return max(1.0, largest_return)
    return 1.0 / (1.0 - discount) if discount < 1.0 else math.inf


def _remedy_for_silence(layer: str, network: NetworkConfig) -> str:
    if layer in STREAMS:
        if network.stream_normalization == "none":
            return "use network.stream_normalization=batch"
        return f"raise network.stream_current_thresholds (now {network.stream_current_thresholds:g})"
    if network.trunk == "mlp" and network.mlp_normalization == "none":
        return "use network.mlp_normalization=batch"
    return f"lower network.threshold (now {network.threshold:g}) or raise network.timesteps (now {network.timesteps})"


def _remedy_for_saturation(layer: str, network: NetworkConfig) -> str:
    if layer in STREAMS and network.stream_normalization == "batch":  # its currents are in thresholds
        return f"lower network.stream_current_thresholds (now {network.stream_current_thresholds:g})"
    return f"raise network.threshold (now {network.threshold:g})"


def _remedy_for_large_values(config: ExperimentConfig) -> str:
    learning = config.learning
    remedies = [f"lower learning.learning_rate (now {learning.learning_rate:g})"]
    if learning.loss == "mse":
        remedies.append("use learning.loss=huber")
    if learning.gradient_clip == "none":
        remedies.append("use learning.gradient_clip=norm")
    if not clips_rewards(config):
        remedies.append("use learning.clip_rewards=true")
    return ", ".join(remedies[:-1]) + " or " + remedies[-1] if len(remedies) > 1 else remedies[0]
