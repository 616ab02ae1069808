"""Names trouble in a running training, with remedies that this run can take and has not taken yet."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from switchmt_snn.config import ExperimentConfig, NetworkConfig, clips_rewards
from switchmt_snn.config.bounds import LARGEST
from switchmt_snn.config.methods import METHOD_TRAITS
from switchmt_snn.config.plugins import is_plugin
from switchmt_snn.config.tasks import resolved_frame_stack
from switchmt_snn.learning.events import LayerHealth, Measured
from switchmt_snn.learning.measuring import HEALTH_BATCH
from switchmt_snn.spiking.encodings import encoding_class

DEAD_SHARE = 0.95
SATURATED_SHARE = 0.5
LARGE_FACTOR = 10.0
"""Q-values that are this many times as large as they can rightly be explode."""
EARLY_UPDATES = 2_000
"""Before so many updates, silent neurons say little of those that training ends with."""
STREAMS = ("q", "value", "advantage")


class ReturnsSeen:
    """What the training episodes so far say about returns.

    Attributes:
        largest_return: in absolute value; None before an episode ended.
    """

    def __init__(self) -> None:
        self.largest_return: float | None = None

    def add(self, episode_return: float) -> None:
        """Take in an episode that ended."""
        self.largest_return = max(self.largest_return or 0.0, abs(episode_return))


@dataclass(frozen=True)
class Remedy:
    """A setting to change.

    Attributes:
        key: as in a config.
        value: one that helps; others in the same direction may help more.
        text: what to do, with the present value.
    """

    key: str
    value: Any
    text: str


@dataclass(frozen=True)
class Warned:
    """What looks wrong, and what to try; one of the remedies will do."""

    seen: str
    remedies: tuple[Remedy, ...]

    def __str__(self) -> str:
        *others, last = [remedy.text for remedy in self.remedies]
        return f"{self.seen}; " + (f"{', '.join(others)} or {last}" if others else last)


def health_warnings(measured: Measured, config: ExperimentConfig, returns: ReturnsSeen) -> dict[str, Warned]:
    """What looks wrong: what was seen and what to try, by a name that stays while the numbers change.

    Args:
        measured: of the network now.
        config: the run's, resolved; only remedies are named that it can take and has not taken.
        returns: of the training episodes so far.
    """
    warnings: dict[str, Warned] = {}
    for name, layer in measured.layers.items() if measured.updates >= EARLY_UPDATES else ():
        warnings |= _of_layer(name, layer, config)
    bound = largest_q(config, returns)
    if measured.q is not None and math.isfinite(measured.q) and abs(measured.q) > LARGE_FACTOR * bound:
        warnings["large Q"] = Warned(
            f"mean Q is {measured.q:.3g}, expected at most about {bound:.3g}: values explode",
            _for_large_values(config),
        )
    return warnings


def largest_q(config: ExperimentConfig, returns: ReturnsSeen) -> float:
    """About the largest |Q| that returns allow: 1 / (1 - discount) with clipped rewards, else the largest return.

    Infinite where nothing is known of it.
    """
    discount = config.learning.discount
    if not clips_rewards(config):
        return math.inf if returns.largest_return is None else max(1.0, returns.largest_return)
    return 1.0 / (1.0 - discount) if discount < 1.0 else math.inf


def _of_layer(name: str, layer: LayerHealth, config: ExperimentConfig) -> dict[str, Warned]:
    if not METHOD_TRAITS[config.network.method].spiking:  # an activation has no highest value to stay at
        seen = f"layer {name}: {layer.dead:.0%} of the units are above zero in none of {HEALTH_BATCH} observations"
        return {f"silent {name}": Warned(seen, _for_zeros(name, config))} if layer.dead > DEAD_SHARE else {}
    warnings = {}
    if layer.dead > DEAD_SHARE:
        seen = f"layer {name}: {layer.dead:.0%} of the neurons fire in none of {HEALTH_BATCH} observations"
        warnings[f"silent {name}"] = Warned(seen, _for_silence(name, config))
    if layer.saturated > SATURATED_SHARE:
        seen = f"layer {name}: {layer.saturated:.0%} of the neurons fire at every step"
        warnings[f"saturated {name}"] = Warned(seen, _for_saturation(name, config))
    return warnings


def _for_zeros(layer: str, config: ExperimentConfig) -> tuple[Remedy, ...]:
    """For the units of an ANN."""
    return tuple(_normalization(layer, config.network)) or (_lower_learning_rate(config),)


def _for_silence(layer: str, config: ExperimentConfig) -> tuple[Remedy, ...]:
    network, normalization = config.network, _normalization(layer, config.network)
    if layer in STREAMS and network.k_winners is not None:
        more = 2 * network.k_winners
        value = None if network.hidden_units is None or more >= network.hidden_units else more
        return (Remedy("network.k_winners", value, f"raise network.k_winners (now {network.k_winners})"),)
    if normalization:
        return tuple(normalization)
    if layer in STREAMS:
        return (_change("raise", "stream_current_thresholds", 2.0, network),)
    remedies = [] if is_plugin(network.neuron) else [_change("lower", "threshold", 0.5, network)]
    if _more_timesteps_help(config):
        remedies.append(_change("raise", "timesteps", 2, network))
    return tuple(remedies) or (_lower_learning_rate(config),)


def _more_timesteps_help(config: ExperimentConfig) -> bool:
    """Whether membranes add up over more steps, and the config can have more: some encodings fix their number."""
    network = config.network
    if is_plugin(network.encoding) or encoding_class(network.encoding).steps(resolved_frame_stack(config.tasks)):
        return False
    return (network.neuron == "IF" or network.beta > 0.0) and 2 * network.timesteps <= LARGEST["network.timesteps"]


def _for_saturation(layer: str, config: ExperimentConfig) -> tuple[Remedy, ...]:
    network = config.network
    if layer in STREAMS and network.stream_normalization == "batch":  # its currents are in thresholds
        return (_change("lower", "stream_current_thresholds", 0.5, network),)
    if not is_plugin(network.neuron):
        return (_change("raise", "threshold", 2.0, network),)
    return tuple(_normalization(layer, network)) or (_lower_learning_rate(config),)


def _normalization(layer: str, network: NetworkConfig) -> list[Remedy]:
    """BatchNorm of the layer's currents, if it has none. The layers of other trunks always have it."""
    if layer in STREAMS:
        key, has = "stream_normalization", network.stream_normalization == "batch"
    else:
        key, has = "mlp_normalization", network.trunk != "mlp" or network.mlp_normalization == "batch"
    return [] if has else [Remedy(f"network.{key}", "batch", f"use network.{key}=batch")]


def _for_large_values(config: ExperimentConfig) -> tuple[Remedy, ...]:
    """What slows the targets. Smaller gradients (Huber's loss, clipping) do not: Adam divides them by their size."""
    learning = config.learning
    counted = "updates" if learning.target_update_every_updates is not None else "steps"
    key = f"learning.target_update_every_{counted}"
    now = learning.target_update_every_updates or learning.target_update_every_steps
    return _lower_learning_rate(config), Remedy(key, 4 * now, f"raise {key} (now {now})")


def _lower_learning_rate(config: ExperimentConfig) -> Remedy:
    rate = config.learning.learning_rate
    return Remedy("learning.learning_rate", rate / 2, f"lower learning.learning_rate (now {rate:g})")


def _change(word: str, key: str, factor: float, network: NetworkConfig) -> Remedy:
    now = getattr(network, key)
    return Remedy(f"network.{key}", now * factor, f"{word} network.{key} (now {now:g})")
