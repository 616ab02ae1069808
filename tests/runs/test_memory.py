"""The memory that a run is said to need: its parts, the refusal, and what the refusal advises."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from switchmt_snn.cli.entry import main
from switchmt_snn.config import ExperimentConfig, from_dict, load_config, resolve, to_yaml
from switchmt_snn.errors import ConfigError
from switchmt_snn.machine.memory import GIB, peak_bytes
from switchmt_snn.runs.description import describe_method
from switchmt_snn.runs.memory import (
    BYTES_PER_SLOT,
    COMPRESSION,
    ENGINE_BYTES,
    PROCESS_BYTES,
    MemoryEstimate,
    replay_bytes,
    require_memory,
)
from switchmt_snn.tasks.registry import SUITES, make_suite
from switchmt_snn.tasks.suite import TaskSuite

GYM = {"suite": "gym", "names": ["CartPole-v1"]}
FRAME = 84 * 84


def planned(**changes: Any) -> tuple[ExperimentConfig, TaskSuite, MemoryEstimate]:
    config = resolve(from_dict(changes))
    suite = make_suite(config.tasks)
    return config, suite, describe_method(config, suite).memory


@pytest.mark.slow
def test_a_replay_takes_no_more_than_the_steps_of_the_run_fill() -> None:
    learning = {"replay_capacity_steps": 6_000, "learning_starts_steps": 600}
    for total, slots in ((6_000, 6_000), (9_000, 9_000), (18_000, 18_000), (10**6, 18_000)):
        config, suite, memory = planned(total_steps=total, learning=learning)
        assert len(suite.names) == 3
        assert memory.replay_bytes == replay_bytes(config, suite) == slots * FRAME + 18_000 * BYTES_PER_SLOT


def test_compressed_frames_are_estimated_by_the_least_compression_and_end_at_the_limit() -> None:
    learning = {"replay_capacity_steps": 300_000, "replay_compression": "zstd"}
    memory = planned(total_steps=300_000, learning=learning)[2]
    assert memory.replay_bytes == int(300_000 * FRAME / COMPRESSION + 900_000 * 1.5) + 900_000 * BYTES_PER_SLOT
    memory = planned(total_steps=300_000, learning={**learning, "replay_max_gib": 0.05})[2]
    assert memory.replay_bytes == int(0.05 * GIB + 900_000 * 1.5) + 900_000 * BYTES_PER_SLOT


def test_a_process_takes_what_its_suite_and_its_engine_import() -> None:
    assert planned(tasks=GYM)[2].process_bytes == PROCESS_BYTES
    minatar = {"suite": "minatar", "names": ["breakout"]}
    assert planned(tasks=minatar)[2].process_bytes == PROCESS_BYTES + SUITES["minatar"].process_bytes
    compiled = planned(tasks=GYM, learning={"engine": "compiled"})[2]
    assert compiled.process_bytes == PROCESS_BYTES + ENGINE_BYTES["compiled"]
    assert compiled.total_bytes - planned(tasks=GYM)[2].total_bytes == ENGINE_BYTES["compiled"]


def test_a_run_that_does_not_fit_is_refused_with_numbers() -> None:
    config, suite, estimate = planned(total_steps=10**7, learning={"replay_compression": "none"})
    require_memory(estimate, config, suite, available=estimate.total_bytes)
    with pytest.raises(ConfigError) as refused:
        require_memory(estimate, config, suite, available=estimate.total_bytes - 1)
    parts = (f"replay {estimate.replay_bytes / GIB:.1f}", "the process itself 0.4", "GiB that are available")
    for part in (f"needs {estimate.total_bytes / GIB:.1f} GiB", *parts):
        assert part in str(refused.value)
    with pytest.raises(ConfigError, match=r"lower learning\.batch_size and"):
        require_memory(estimate, config, suite, available=GIB // 4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("learning", "total_steps", "room"),
    [
        ({"replay_compression": "none"}, 50_000, 0.3),
        ({"replay_compression": "none"}, 10**7, 0.999),
        ({"replay_compression": "zstd"}, 50_000, 0.999),
        ({"replay_compression": "zstd"}, 10**7, 0.01),
        ({}, 50_000, 0.01),
        ({}, 10**7, 0.3),
    ],
)
def test_the_capacity_that_a_refusal_names_fits_and_one_more_does_not(
    learning: dict[str, Any], total_steps: int, room: float
) -> None:
    """Also where a replay's limit or the run's steps, not the capacity, decide how much it takes."""
    learning = {"replay_max_gib": 1.0, "replay_capacity_steps": 400_000, "batch_size": 32, **learning}
    config, suite, estimate = planned(total_steps=total_steps, learning=learning)
    slots = config.learning.replay_capacity_steps * len(suite.names)
    plain = config.learning.replay_compression == "none"  # reserved whole
    replay = slots * (FRAME + BYTES_PER_SLOT) if plain else estimate.replay_bytes
    available = int(estimate.total_bytes - estimate.replay_bytes + room * replay)
    with pytest.raises(ConfigError) as refused:
        require_memory(estimate, config, suite, available)
    found = re.search(r"lower (learning\S+)( and learning\S+)? to at most ([\d,]+)", str(refused.value))
    assert found is not None, str(refused.value)
    fitting = int(found[3].replace(",", ""))
    for capacity in (fitting, fitting + 1):
        changed = {**learning, "replay_capacity_steps": capacity}
        if "with learning.replay_compression=zstd" in str(refused.value):
            changed["replay_compression"] = "zstd"
        if found[2]:
            changed["learning_starts_steps"] = capacity
        config, suite, lower = planned(total_steps=total_steps, learning=changed)
        if capacity == fitting:
            require_memory(lower, config, suite, available)
        else:
            with pytest.raises(ConfigError, match="the run needs"):
                require_memory(lower, config, suite, available)


_RUN = """
import sys
from switchmt_snn import load_config, train
from switchmt_snn.machine.memory import peak_bytes
from switchmt_snn.runs.plan import plan

config = load_config(sys.argv[1])
train(config, sys.argv[2])
print(peak_bytes() / plan(config).memory.total_bytes)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="measured on Linux")
@pytest.mark.parametrize(
    ("preset", "steps", "learning"),
    [
        ("cartpole", 1_500, {}),
        ("quickstart", 150, {"learning_starts_steps": 100}),
        ("pong", 400, {"learning_starts_steps": 100, "engine": "eager"}),
        ("minatar", 1_500, {}),
    ],
)
def test_a_run_takes_no_more_than_its_estimate_says_and_not_much_less(
    preset: str, steps: int, learning: dict[str, Any], tmp_path: Path
) -> None:
    """With its checkpoint, which took 125 MiB of quickstart's 680, and its evaluation."""
    config = load_config(preset)
    short = replace(
        config,
        total_steps=steps,
        device="cpu",
        threads=1,
        learning=replace(config.learning, **learning),
        evaluation=replace(config.evaluation, episodes=8, max_episode_steps=50, every_steps=None, stop_at_returns=()),
    )
    path = tmp_path / "short.yaml"
    path.write_text(to_yaml(short))
    words = [sys.executable, "-c", _RUN, str(path), str(tmp_path / "run")]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert 0.7 < float(done.stdout.split()[-1]) <= 1.0


@pytest.mark.slow
def test_the_peak_is_of_this_program_and_not_of_the_one_that_started_it() -> None:
    held = np.ones(GIB // 8)  # a gibibyte
    program = "from switchmt_snn.machine.memory import peak_bytes; print(peak_bytes())"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert int(done.stdout) < held.nbytes < peak_bytes()


@pytest.mark.slow
def test_a_replay_that_cannot_fit_is_refused_before_it_is_made(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr("switchmt_snn.runs.memory.available_bytes", lambda: 4 * GIB)
    made = []
    monkeypatch.setattr("switchmt_snn.learning.training.make_replay", lambda *_: made.append(1))
    words = ["--learning.replay-capacity-steps", "999999999", "--run", str(tmp_path / "run")]
    with pytest.raises(SystemExit) as done:
        main(["train", "cartpole", *words])
    assert done.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert re.search(r"the run needs 1[12]\.\d GiB \(replay 1[12].*to at most [\d,]+", error), error
    assert made == []
    assert not (tmp_path / "run").exists()
