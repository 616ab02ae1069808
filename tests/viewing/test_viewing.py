"""Health warnings and the memory check: numbers in, words out."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console
from torch import Tensor

from switchmt_snn.config import NetworkConfig, from_dict, resolve
from switchmt_snn.config.yaml_io import load_config
from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.events import LayerHealth, Measured, Stepped
from switchmt_snn.learning.training import Training
from switchmt_snn.machine.memory import GIB
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.runs.memory import MemoryEstimate, require_memory
from switchmt_snn.spiking.network import ObservationSpec, build_network
from switchmt_snn.viewing.health import EARLY_UPDATES, health_warnings
from switchmt_snn.viewing.progress import Progress
from tests.conftest import SameObservationEnvironment, small_config, vector_suite

LAYERS = ("linear1", "value", "advantage")


def measured(
    q: float = 1.0, layer: str = "conv1", dead: float = 0.1, saturated: float = 0.1, n: int = 5_000
) -> Measured:
    return Measured(100, 0, n, 0.1, q, (100,), {layer: LayerHealth(0.2, dead, saturated)})


def warnings(seen: Measured, largest_return: float = 100.0, **changes: Any) -> list[str]:
    return list(health_warnings(seen, resolve(from_dict(changes)), largest_return).values())


def test_a_healthy_run_says_nothing() -> None:
    assert warnings(measured()) == []


@pytest.mark.parametrize(
    ("trouble", "words"),
    [
        (measured(dead=0.99), ["layer conv1", "99%", "never fire", "lower network.threshold (now 1)"]),
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


def test_no_remedy_is_named_that_the_run_has_already() -> None:
    learning = {"loss": "huber", "gradient_clip": "norm", "clip_rewards": True}
    (warning,) = warnings(measured(q=1e6), learning=learning)
    assert warning.endswith("values explode; lower learning.learning_rate (now 0.0001)")
    (warning,) = warnings(measured(q=1e6), learning={"clip_rewards": False})
    for words in ("learning.loss=huber", "learning.gradient_clip=norm", "learning.clip_rewards=true"):
        assert words in warning


def test_values_explode_beyond_what_returns_allow() -> None:
    """With raw rewards that are returns of this size; with clipped ones the discount's bound."""
    raw = {"learning": {"clip_rewards": False}}
    assert warnings(measured(q=40_000.0), largest_return=20_000.0, **raw) == []
    assert len(warnings(measured(q=40_000.0), largest_return=20.0, **raw)) == 1
    assert warnings(measured(q=5_000.0), learning={"discount": 0.999}) == []
    assert len(warnings(measured(q=5_000.0), learning={"discount": 0.99})) == 1
    assert warnings(measured(q=1e9), learning={"discount": 1.0}) == []


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
    assert stream.getvalue().count("never fire") == 1
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


def activity(**network: Any) -> dict[str, tuple[float, float, float]]:
    """Shares of silent and of saturated neurons and the mean rate of a fresh network whose statistics have settled."""
    config = resolve(from_dict({"tasks": GYM, "network": network})).network
    spec = ObservationSpec((4,), frame_stack=1, scale=1.0, in_unit_range=False, num_actions=2, num_tasks=1)
    made, seen = build_network(config, spec, 1), torch.randn(64, 4, generator=torch.Generator().manual_seed(0)) * 0.2
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


@pytest.mark.parametrize("layer", LAYERS)
@pytest.mark.parametrize("network", [{}, {"stream_normalization": "batch"}, {"mlp_normalization": "batch"}])
@pytest.mark.parametrize(("trouble", "index"), [("dead", 0), ("saturated", 1)])
def test_every_remedy_for_silence_and_saturation_helps(
    layer: str, network: dict[str, Any], trouble: str, index: int
) -> None:
    """Each remedy that the line names is tried on the layer that it names: the rate goes the right way."""
    (warning,) = warnings(measured(layer=layer, **{trouble: 1.0}), tasks=GYM, network=network)
    before, tried = activity(**network)[layer], 0
    for key, change in REMEDIES.items():
        if key in warning:
            settings = resolve(from_dict({"tasks": GYM, "network": network})).network
            after = activity(**{**network, **change(settings)})[layer]
            assert (after[2] > before[2]) if trouble == "dead" else (after[2] < before[2] or before[2] == 0.0), key
            assert after[index] <= before[index]
            tried += 1
    assert tried >= 1, f"no known remedy in: {warning}"


REMEDIES: dict[str, Callable[[NetworkConfig], dict[str, Any]]] = {
    "use network.stream_normalization=batch": lambda _: {"stream_normalization": "batch"},
    "use network.mlp_normalization=batch": lambda _: {"mlp_normalization": "batch"},
    "raise network.stream_current_thresholds": lambda now: {
        "stream_current_thresholds": 2 * now.stream_current_thresholds
    },
    "lower network.stream_current_thresholds": lambda now: {
        "stream_current_thresholds": now.stream_current_thresholds / 2
    },
    "lower network.threshold": lambda now: {"threshold": now.threshold / 2},
    "raise network.threshold": lambda now: {"threshold": now.threshold * 2},
    "raise network.timesteps": lambda now: {"timesteps": now.timesteps * 2},
}


def test_a_run_that_does_not_fit_is_refused_with_numbers() -> None:
    config = resolve(load_config("paper"))
    estimate = MemoryEstimate(replay_bytes=20 * GIB, network_bytes=GIB, switching_bytes=GIB, activations_bytes=2 * GIB)
    require_memory(estimate, config, available=25 * GIB)
    with pytest.raises(ConfigError) as refused:
        require_memory(estimate, config, available=15 * GIB)
    for part in ("needs 24.7 GiB", "replay 20.0", "activations 2.0", "15.0 GiB that are available"):
        assert part in str(refused.value)
    # 15 - (24 - 20) - 0.68 of the process = 10.3 GiB for the replay, about half of what it has
    assert "lower learning.replay_capacity_steps to at most 540," in str(refused.value)
    with pytest.raises(ConfigError, match=r"lower learning\.batch_size and"):
        require_memory(estimate, config, available=GIB)
