"""Health warnings and the memory check: numbers in, words out."""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console
from torch import Tensor

from switchmt_snn.config import ExperimentConfig, NetworkConfig, from_dict, resolve
from switchmt_snn.config.methods import METHOD_TRAITS, METHODS
from switchmt_snn.config.yaml_io import load_config, presets
from switchmt_snn.learning.events import LayerHealth, Measured, Stepped
from switchmt_snn.learning.training import Training
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.runs.run import train
from switchmt_snn.spiking.network import ObservationSpec, build_network
from switchmt_snn.viewing.health import EARLY_UPDATES, Remedy, ReturnsSeen, Warned, health_warnings
from switchmt_snn.viewing.progress import Progress
from tests.conftest import SameObservationEnvironment, small_config, vector_suite


def measured(
    q: float = 1.0, layer: str = "conv1", dead: float = 0.1, saturated: float = 0.1, n: int = 5_000
) -> Measured:
    return Measured(100, 0, n, 0.1, q, (100,), {layer: LayerHealth(0.2, dead, saturated)})


def ended(*returns: float) -> ReturnsSeen:
    seen = ReturnsSeen()
    for one in returns:
        seen.add(one)
    return seen


def warned(seen: Measured, config: ExperimentConfig, returns: ReturnsSeen) -> list[Warned]:
    return list(health_warnings(seen, config, returns).values())


def warnings(seen: Measured, largest_return: float = 100.0, **changes: Any) -> list[str]:
    return [str(one) for one in warned(seen, resolve(from_dict(changes)), ended(largest_return))]


def test_a_healthy_run_says_nothing() -> None:
    assert warnings(measured()) == []


@pytest.mark.parametrize(
    ("trouble", "words"),
    [
        (
            measured(dead=0.99),
            ["layer conv1", "99%", "fire in none of 64 observations", "lower network.threshold (now 1)"],
        ),
        (measured(saturated=0.8), ["layer conv1", "80%", "every step", "raise network.threshold (now 1)"]),
        (measured(q=-1e6), ["expected at most about 100", "values explode", "learning.learning_rate (now 0.0001)"]),
    ],
)
def test_trouble_is_named_with_a_remedy(trouble: Measured, words: list[str]) -> None:
    (warning,) = warnings(trouble)
    for word in words:
        assert word in warning


def test_the_first_updates_of_a_run_say_nothing_of_silent_neurons() -> None:
    assert warnings(measured(dead=1.0, n=1_999)) == []
    assert len(warnings(measured(dead=1.0, n=2_000))) == 1


def test_large_values_are_told_how_targets_become_slower() -> None:
    (warning,) = warnings(measured(q=1e6))
    assert warning.endswith(
        "explode; lower learning.learning_rate (now 0.0001) or raise learning.target_update_every_steps (now 10000)"
    )
    (warning,) = warnings(measured(q=1e6), learning={"target_update_every_updates": 8})
    assert warning.endswith("or raise learning.target_update_every_updates (now 8)")


@pytest.mark.slow
def test_values_that_explode_grow_far_less_with_each_remedy(tmp_path: Path) -> None:
    """A training whose target network is copied every fourth update; every remedy is followed alone."""
    config = from_dict(EXPLODES)

    def last_q(name: str, changed_config: ExperimentConfig) -> float:
        train(changed_config, run=tmp_path / name)
        return abs(float(json.loads((tmp_path / name / "metrics.jsonl").read_text().splitlines()[-1])["q"]))

    exploded = last_q("exploded", config)
    assert exploded > 1000.0
    (warning,) = warned(measured(q=exploded), resolve(config), ended(10.0))
    keys = [remedy.key for remedy in warning.remedies]
    assert keys == ["learning.learning_rate", "learning.target_update_every_steps"]
    for remedy in warning.remedies:
        assert last_q(remedy.key, changed(config, remedy)) < exploded / 2, remedy


def test_values_explode_beyond_what_returns_allow() -> None:
    """With raw rewards that are returns of this size; with clipped ones the discount's bound."""
    raw = {"learning": {"clip_rewards": False}}
    assert warnings(measured(q=40_000.0), largest_return=20_000.0, **raw) == []
    assert len(warnings(measured(q=40_000.0), largest_return=20.0, **raw)) == 1
    assert warnings(measured(q=5_000.0), learning={"discount": 0.999}) == []
    assert len(warnings(measured(q=5_000.0), learning={"discount": 0.99})) == 1
    assert warnings(measured(q=1e9), learning={"discount": 1.0}) == []
    config = resolve(from_dict(raw))
    assert warned(measured(q=1e9), config, ended()) == [], "no episode has ended: returns of any size may come"
    assert len(warned(measured(q=1e9), config, ended(0.0))) == 1


def test_the_default_run_is_too_short_for_warnings_of_its_own_network() -> None:
    config = load_config("quickstart")
    assert config.total_steps // config.learning.update_every_steps < EARLY_UPDATES


def test_a_plain_log_says_a_warning_once_while_its_numbers_change(tmp_path: Path) -> None:
    suite = vector_suite(SameObservationEnvironment, 3)  # type: ignore[arg-type]
    training = Training(small_config(), suite, torch.device("cpu"))
    progress = Progress(Console(file=(stream := io.StringIO()), width=200))
    progress.start(training, RunFolder(tmp_path), None)
    for dead in (0.96, 0.97, 0.1, 0.98):
        progress(measured(dead=dead))
        progress.stop()  # prints a line
    assert stream.getvalue().count("fire in none of") == 1
    assert "96%" in stream.getvalue()


def test_a_plain_log_says_that_a_replay_fills_before_its_first_step(tmp_path: Path) -> None:
    suite = vector_suite(SameObservationEnvironment, 3)  # type: ignore[arg-type]
    progress = Progress(Console(file=(stream := io.StringIO()), width=200))
    progress.start(Training(small_config(), suite, torch.device("cpu")), RunFolder(tmp_path), None)
    progress(Stepped(step=1, task=0, epsilon=1.0, warming_up=True))
    greeting, filling, step = stream.getvalue().splitlines()
    assert greeting.startswith("run ")
    assert filling.startswith(f"  filling the replay of {suite.names[0]}: random actions until ")
    assert step.startswith("step ")


GYM = {"suite": "gym", "names": ["CartPole-v1"]}


def activity(network: NetworkConfig) -> dict[str, tuple[float, float, float]]:
    """Shares of silent and of saturated neurons and the mean rate of a fresh network whose statistics have settled."""
    spec = ObservationSpec((4,), frame_stack=1, scale=1.0, in_unit_range=False, num_actions=2, num_tasks=1)
    made, seen = build_network(network, spec, 1), torch.randn(64, 4, generator=torch.Generator().manual_seed(0)) * 0.2
    spikes: dict[str, Tensor] = {}
    with torch.no_grad():
        for _ in range(60):
            made.train()(seen, 0)
        made.eval()(seen, 0, activity=spikes)
    rates = {name: each.flatten(2).mean((0, 1)) for name, each in spikes.items()}
    return {
        name: (float((rate == 0).float().mean()), float((rate >= 1).float().mean()), float(rate.mean()))
        for name, rate in rates.items()
    }


def changed(config: ExperimentConfig, remedy: Remedy) -> ExperimentConfig:
    section, name = remedy.key.split(".")
    changes: dict[str, Any] = {section: replace(getattr(config, section), **{name: remedy.value})}
    return resolve(replace(config, **changes))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["SwitchMT", "DSQN_D", "DQN_D", "DQN"])
@pytest.mark.parametrize(
    "network", [{}, {"stream_normalization": "batch"}, {"mlp_normalization": "batch"}, {"k_winners": 16}]
)
@pytest.mark.parametrize(("trouble", "index"), [("dead", 0), ("saturated", 1)])
def test_every_remedy_for_silence_and_saturation_helps(
    method: Any, network: dict[str, Any], trouble: str, index: int
) -> None:
    """Each remedy that the line names is tried on the layer that it names: the rate goes the right way."""
    traits = METHOD_TRAITS[method]
    if ("k_winners" in network and not traits.dendrites) or (trouble == "saturated" and not traits.spiking):
        pytest.skip("there is no such network, or no such warning")
    config = resolve(from_dict({"tasks": GYM, "network": {"method": method, **network}}))
    before = activity(config.network)
    for layer in ("linear1", *(("value", "advantage") if traits.dueling else ("q",))):
        (warning,) = warned(measured(layer=layer, **{trouble: 1.0}), config, ended(1.0))
        for remedy in warning.remedies:
            if remedy.key == "learning.learning_rate":
                continue
            after = activity(changed(config, remedy).network)[layer]
            low, high = (before[layer], after) if trouble == "dead" else (after, before[layer])
            assert low[2] < high[2] or before[layer][2] == 0.0 or not traits.spiking, remedy
            assert after[index] <= before[layer][index], remedy


EXPLODES: dict[str, Any] = {
    "seed": 1,
    "total_steps": 500,
    "threads": 1,
    "tasks": {"suite": "gym", "names": ["CartPole-v1"]},
    "network": {"method": "DQN", "hidden_units": 64},
    "learning": {
        "batch_size": 32,
        "learning_starts_steps": 100,
        "replay_capacity_steps": 2000,
        "learning_rate": 0.01,
        "loss": "huber",
        "target_update_every_steps": 4,
        "epsilon_decay_steps": 1000,
    },
    "evaluation": {"episodes": 1, "every_steps": None, "max_episode_steps": 60},
    "recording": {"checkpoint_every_steps": 500, "metrics_every_steps": 500},
}
VARIANTS: tuple[dict[str, dict[str, Any]], ...] = (
    {},
    {"network": {"stream_normalization": "batch", "mlp_normalization": "batch"}},
    {"network": {"neuron": "LIF", "beta": 0.0, "timesteps": 1}},
    {"network": {"neuron": "LIF", "timesteps": 4096}},
    {"network": {"neuron": "tests.spiking.test_own_neurons:Good"}},
    {"network": {"encoding": "frames"}},
    {"network": {"k_winners": 8}},
    {"network": {"k_winners": 127}},
    {"learning": {"target_update_every_updates": 100, "clip_rewards": False}},
)
OF_SPIKES = {f"network.{name}" for name in ("threshold", "timesteps", "beta", "k_winners", "stream_current_thresholds")}


@pytest.mark.slow
@pytest.mark.parametrize("preset", presets())
@pytest.mark.parametrize("method", METHODS)
def test_no_warning_of_any_run_names_what_it_cannot_do_or_has_done(preset: str, method: Any) -> None:
    """All warnings, of every preset and method: the settings exist, apply to the method, and are not set already."""
    original, traits, seen = load_config(preset), METHOD_TRAITS[method], set()
    for variant in VARIANTS:
        network = {"method": method, "dendrites": "auto", **variant.get("network", {})}
        if not traits.spiking:
            network |= {"encoding": "direct", "readout": "mean", "neuron": "IF"}
        if not traits.dendrites:
            network |= {"k_winners": None}
        config = resolve(
            replace(
                original,
                network=replace(original.network, **network),
                learning=replace(original.learning, **variant.get("learning", {})),
            )
        )
        trunk = "linear1" if config.network.trunk == "mlp" else "conv1"
        troubles = [measured(q=1e30)]
        for layer in (trunk, *(("value", "advantage") if traits.dueling else ("q",))):
            troubles += [measured(layer=layer, dead=1.0), measured(layer=layer, saturated=1.0)]
        for trouble in troubles:
            for returns in (ended(), ended(10.0), ended(1e6)):
                for name, warning in health_warnings(trouble, config, returns).items():
                    seen.add(name.split()[0])
                    assert len(warning.remedies) > 0
                    for remedy in warning.remedies:
                        check_is_open(remedy, config)
                        assert traits.spiking or remedy.key not in OF_SPIKES
                        assert remedy.text in str(warning)
                    assert traits.spiking or not re.search("fire|spik|neuron", str(warning))
    assert seen == ({"large", "silent", "saturated"} if traits.spiking else {"large", "silent"})


def check_is_open(remedy: Remedy, config: ExperimentConfig) -> None:
    section, name = remedy.key.split(".")
    now = getattr(getattr(config, section), name)
    after = getattr(getattr(changed(config, remedy), section), name)
    assert now != after == remedy.value, remedy
    written = {True: "true"}.get(remedy.value, remedy.value)
    if remedy.text.startswith("use "):
        assert remedy.text == f"use {remedy.key}={written}"
    else:
        word, key, present = remedy.text.replace("(now ", "").replace(")", "").split()
        assert (key, float(present)) == (remedy.key, pytest.approx(now, rel=1e-4))
        assert word == ("raise" if remedy.value is None or remedy.value > now else "lower")
    network, encoding = config.network, config.network.encoding
    if remedy.key == "network.timesteps":
        assert encoding not in ("frames", "events"), "their number of steps is the frame stack's"
        assert network.neuron == "IF" or network.beta > 0.0
    assert remedy.key != "network.threshold" or ":" not in network.neuron, "a neuron from outside may have none"
    assert remedy.key != "network.mlp_normalization" or network.trunk == "mlp"
