"""Settings of the Q-network."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from switchmt_snn.config.checks import check_fields, require
from switchmt_snn.config.methods import METHOD_TRAITS, Method
from switchmt_snn.config.plugins import PluginName

EncodingName = Literal["direct", "rate", "latency", "frames", "events"]
ENCODING_NAMES: tuple[str, ...] = get_args(EncodingName)

SURROGATES_WITHOUT_SLOPE = ("straight_through_estimator", "SSO", "heaviside")
"""Values of ``network.surrogate`` whose gradient has no parameter."""


@dataclass(frozen=True)
class NetworkConfig:
    """The spiking Q-network (or its ANN twin): method, trunk, neurons, time, encoding, dendrites, normalisation."""

    method: Method = "SwitchMT"
    """DQN, DSQN, DQN_D, DSQN_D, MTSpark_AD, MTSpark_ADD or SwitchMT: fixes neurons, dueling structure and dendrites."""
    trunk: Literal["auto", "nature", "nature_half", "minatar", "mlp"] = "auto"
    """Feature layers: three convolutions (84x84; nature_half has half as many channels), one (10x10), or one linear
    layer; auto follows tasks.suite."""
    hidden_units: int | None = None
    """Units of each stream's hidden layer; null takes 512 for nature, 256 for nature_half and 128 otherwise."""
    heads: Literal["shared", "per_task"] = "shared"
    """The last linear layer of each stream: one for all tasks (paper), or one for each task. An export for a task holds
    that task's only."""
    timesteps: int = 4
    """Simulation steps T per decision; ANN methods have none and resolve to 1."""
    encoding: EncodingName | PluginName = "direct"
    """How an observation becomes T inputs: direct, rate, latency, frames, events (docs/algorithm.md, Encodings), or a
    class from outside the package, package.module:Class (docs/extending.md)."""
    event_threshold: float = 0.02
    """encoding=events: an ON or OFF spike where the scaled pixel moved by more than this between frames."""
    readout: Literal["mean", "last_membrane", "max_membrane"] = "mean"
    """Q from the head's output over time: its mean, or the last or largest membrane of a non-spiking integrator."""
    readout_beta: float = 1.0
    """Decay per step of the non-spiking integrator that the two membrane readouts use."""
    quantiles: int = 1
    """Quantiles of the return that training learns per action; Q is their mean (QR-DQN, Dabney et al. 2018). Above 1,
    learning.loss must be huber. Exports hold the mean's weights. 1 learns Q itself (paper)."""
    neuron: Literal["IF", "LIF", "Synaptic", "ALIF"] | PluginName = "IF"
    """IF, LIF (IF with the decay `beta`), Synaptic (LIF fed by a decaying current), ALIF (LIF whose threshold rises
    with its spikes), or a class from outside the package, package.module:Class (docs/algorithm.md, Neurons)."""
    beta: float = 0.5
    """Membrane decay per simulation step (0.5 is the released script's tau of 2). neuron=IF does not use it."""
    alpha: float = 0.5
    """neuron=Synaptic: decay of the synaptic current per simulation step. IF, LIF and ALIF do not use it."""
    adaptation_decay: float = 0.9
    """neuron=ALIF: decay of the threshold's rise per simulation step. IF, LIF and Synaptic do not use it."""
    adaptation_strength: float = 0.2
    """neuron=ALIF: rise of the threshold by one spike. IF, LIF and Synaptic do not use it."""
    learn_beta: bool = False
    """Train one decay per layer."""
    threshold: float = 1.0
    """Firing threshold; a neuron fires when its membrane is strictly above it."""
    learn_threshold: bool = False
    """Train one threshold per layer."""
    reset: Literal["zero", "subtract"] = "zero"
    """What a spike does to the membrane: set it to zero, or subtract the threshold (docs/algorithm.md, Neurons)."""
    surrogate: Literal[
        "atan",
        "sigmoid",
        "fast_sigmoid",
        "triangular",
        "straight_through_estimator",
        "spike_rate_escape",
        "SFS",
        "SSO",
        "heaviside",
    ] = "atan"
    """Surrogate gradient: a function of snntorch.surrogate (its LSO cannot be called in snnTorch 1.0.0)."""
    surrogate_slope: float | None = None
    """Slope (alpha) of the surrogate; null takes snnTorch's default. straight_through_estimator, SSO and heaviside have
    none."""
    dendrites: Literal["auto", "none", "shared", "per_neuron"] = "auto"
    """Segments shared by a stream (the paper's 18 weights), or own ones per neuron; auto follows the method."""
    dendritic_segments: int = 3
    """Segments per neuron (or per stream, when shared)."""
    dendritic_gating: Literal["max", "absolute_max"] = "max"
    """Which segment speaks: the largest response, or the one largest in absolute value (sign kept)."""
    k_winners: int | None = None
    """Keep only the k largest gated input currents per simulation step in each stream (of equals the lower index); null
    keeps all."""
    normalization: Literal["per_task", "shared"] = "per_task"
    """BatchNorm running statistics for each task, or one set for all (affine weights are always shared)."""
    mlp_normalization: Literal["none", "batch"] = "none"
    """BatchNorm of the mlp trunk's currents. Vector observations whose features are small against the threshold hardly
    make a neuron fire without it. Trunks of images always have BatchNorm."""
    stream_normalization: Literal["none", "batch"] = "none"
    """BatchNorm of each stream's input currents before the dendritic gain, with a fixed weight and bias
    (stream_current_thresholds), so that fewer neurons are silent. It adds no parameter. none: the paper's network."""
    stream_current_thresholds: float = 0.5
    """With stream_normalization: mean and standard deviation of the normalized currents, in thresholds, before the gain
    (0.5 on average at first). Few timesteps need more: a neuron fires if its current adds up to one threshold."""
    normalization_momentum: float = 0.1
    """BatchNorm momentum of the running statistics."""
    neuron_engine: Literal["fused", "snntorch"] = "fused"
    """fused: this package's code (IF and LIF: one autograd function, the same arithmetic as snn.Leaky). snntorch: calls
    snnTorch's neuron step by step (IF, LIF, Synaptic)."""

    def __post_init__(self) -> None:
        check_fields(self, "network")
        require(
            self.hidden_units is None or self.hidden_units >= 1,
            "network.hidden_units",
            self.hidden_units,
            "at least 1 or null",
        )
        require(self.timesteps >= 1, "network.timesteps", self.timesteps, "at least 1")
        for key in ("beta", "alpha", "adaptation_decay"):
            require(0.0 <= getattr(self, key) <= 1.0, f"network.{key}", getattr(self, key), "a decay in [0, 1]")
        require(self.adaptation_strength >= 0.0, "network.adaptation_strength", self.adaptation_strength, "at least 0")
        require(0.0 <= self.readout_beta <= 1.0, "network.readout_beta", self.readout_beta, "a decay in [0, 1]")
        require(self.quantiles >= 1, "network.quantiles", self.quantiles, "at least 1")
        require(
            self.quantiles == 1 or self.readout != "max_membrane",
            "network.readout",
            self.readout,
            f"mean or last_membrane with network.quantiles={self.quantiles}",
            "the mean over quantiles of largest membranes is not linear in the head",
        )
        require(self.threshold > 0.0, "network.threshold", self.threshold, "above 0")
        slope = self.surrogate_slope
        require(slope is None or slope > 0.0, "network.surrogate_slope", slope, "above 0, or null")
        require(
            slope is None or self.surrogate not in SURROGATES_WITHOUT_SLOPE,
            "network.surrogate_slope",
            slope,
            f"null with network.surrogate={self.surrogate}, which has no slope",
        )
        current = self.stream_current_thresholds
        require(current > 0.0, "network.stream_current_thresholds", current, "above 0")
        require(0.0 < self.event_threshold < 1.0, "network.event_threshold", self.event_threshold, "within (0, 1)")
        require(self.dendritic_segments >= 1, "network.dendritic_segments", self.dendritic_segments, "at least 1")
        require(
            self.k_winners is None or self.k_winners >= 1, "network.k_winners", self.k_winners, "at least 1 or null"
        )
        m = self.normalization_momentum
        require(0.0 < m <= 1.0, "network.normalization_momentum", m, "within (0, 1]")
        traits = METHOD_TRAITS[self.method]
        if not traits.dendrites:
            require(
                self.dendrites in ("auto", "none"),
                "network.dendrites",
                self.dendrites,
                f"none for method {self.method}",
                "MTSpark_AD and SwitchMT are the methods with active dendrites",
            )
        if not traits.spiking:
            require(
                self.encoding == "direct",
                "network.encoding",
                self.encoding,
                f"direct for the ANN method {self.method}",
                "an ANN has no simulation steps to encode over",
            )
            require(self.readout == "mean", "network.readout", self.readout, f"mean for the ANN method {self.method}")
            require(self.k_winners is None, "network.k_winners", self.k_winners, "null for a method without dendrites")
