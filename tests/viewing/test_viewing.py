"""Health warnings and the memory check: numbers in, words out."""

from __future__ import annotations

import pytest

from switchmt_snn.config import NetworkConfig, resolve
from switchmt_snn.config.yaml_io import load_config
from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.events import LayerHealth, Measured
from switchmt_snn.machine.memory import GIB
from switchmt_snn.runs.memory import MemoryEstimate, require_memory
from switchmt_snn.viewing.health import health_warnings


def measured(q: float = 1.0, dead: float = 0.1, saturated: float = 0.1) -> Measured:
    return Measured(100, 0, 10, 0.1, q, (100,), {"conv1": LayerHealth(0.2, dead, saturated)})


def test_a_healthy_run_says_nothing() -> None:
    assert health_warnings(measured(), NetworkConfig()) == []


@pytest.mark.parametrize(
    ("trouble", "words"),
    [
        (measured(dead=0.99), ["layer conv1", "99%", "never fire", "lower network.threshold"]),
        (measured(saturated=0.8), ["layer conv1", "80%", "every step", "raise network.threshold"]),
        (measured(q=-1e6), ["values explode", "lower learning.learning_rate"]),
    ],
)
def test_trouble_is_named_with_a_remedy(trouble: Measured, words: list[str]) -> None:
    (warning,) = health_warnings(trouble, NetworkConfig())
    for word in words:
        assert word in warning


@pytest.mark.parametrize("stream", ["q", "value", "advantage"])
def test_silent_streams_are_told_the_setting_that_helps_them(stream: str) -> None:
    silent = Measured(100, 0, 10, 0.1, 1.0, (100,), {stream: LayerHealth(0.0, 1.0, 0.0)})
    (warning,) = health_warnings(silent, NetworkConfig())
    assert warning == f"layer {stream}: 100% of the neurons never fire; use network.stream_normalization=batch"
    (warning,) = health_warnings(silent, NetworkConfig(stream_normalization="batch", stream_current_thresholds=0.5))
    assert warning.endswith("never fire; raise network.stream_current_thresholds (now 0.5)")


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
