"""Exact resume and everything that can go wrong with a run folder, through the real command line."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch

from switchmt_snn.updates.compiled import compile_problem

pytestmark = pytest.mark.slow  # processes are started and killed

COMMAND = [sys.executable, "-m", "switchmt_snn"]
CONFIG = """
name: resume
seed: 3
total_steps: 1600
threads: 1
tasks: {suite: minatar, names: [breakout, asterix], num_envs: 2, sticky_action_probability: 0.1}
network: {hidden_units: 16, timesteps: 2, encoding: rate}
learning:
  batch_size: 8
  learning_starts_steps: 50
  replay_capacity_steps: 700
  replay_compression: zstd
  replay_max_gib: 0.00009
  update_every_steps: 4
  target_update_every_steps: 100
  epsilon_decay_steps: 800
switching: {window_episodes: 2, max_stay_steps: 300}
evaluation: {episodes: 1, num_envs: 1}
recording: {checkpoint_every_steps: 300, metrics_every_steps: 200, keep_checkpoints: 3}
"""


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("config") / "resume.yaml"
    path.write_text(CONFIG)
    return path


def run(*words: str | Path, check: int | None = 0, **options: Any) -> subprocess.CompletedProcess[str]:
    """A command to its end; one clear line on stderr if it fails on purpose."""
    result = subprocess.run(
        [*COMMAND, *map(str, words)], capture_output=True, text=True, timeout=240, check=False, **options
    )
    assert "Traceback" not in result.stderr, result.stderr
    if check is not None:
        assert result.returncode == check, result.stdout + result.stderr
        if check == 2:
            assert result.stderr.count("\n") == 1, result.stderr
    return result


def content(folder: Path) -> dict[str, Any]:
    """What two runs must have in common bitwise: weights, replay, optimiser, episode log without its clock column."""
    last = max(folder.glob("checkpoints/step-*"))
    manifest = json.loads((last / "manifest.json").read_text())
    logs = {}
    for name in ("episodes.csv", "switches.csv"):
        with (folder / name).open(newline="") as stream:
            logs[name] = [{k: v for k, v in row.items() if k != "wall_s"} for row in csv.DictReader(stream)]
    metrics = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return {
        "step": manifest["step"],
        "files": manifest["files"],
        "segments": manifest["segments"],
        "metrics": [{k: v for k, v in row.items() if k != "wall_s" and not k.startswith("peak_")} for row in metrics],
        **logs,
    }


@pytest.fixture(scope="module")
def whole(config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run without interruption."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    run("train", config, "--run", folder)
    return folder


def start(config: Path, folder: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*COMMAND, "train", str(config), "--run", str(folder)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def wait_for(condition: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    """Until something is there, or the process has ended."""
    while process.poll() is None and not condition():
        time.sleep(0.005)


def test_compression_changes_nothing(config: Path, tmp_path: Path) -> None:
    for kind in ("none", "zstd"):
        options = ("--learning.replay-compression", kind, "--learning.replay-max-gib", "1")
        run("train", config, "--run", tmp_path / kind, *options)
    assert content(tmp_path / "none") == content(tmp_path / "zstd")


def test_the_cap_of_the_replay_was_reached(whole: Path) -> None:
    """So that the other tests here continue a run whose oldest frames have left early."""
    last = max(whole.glob("checkpoints/step-*"))
    tensors = safetensors.torch.load_file(last / "training.safetensors")
    oldest = [value for name, value in tensors.items() if name.endswith("oldest")]
    written = [value for name, value in tensors.items() if name.endswith("written")]
    assert any((w - o < 300).any() for o, w in zip(oldest, written, strict=True)), "rings of 350 slots per lane"


def test_killed_at_random_moments_ends_bitwise_the_same(config: Path, whole: Path, tmp_path: Path) -> None:
    folder, dice, kills = tmp_path / "run", random.Random(os.environ.get("KILL_SEED", "7")), 0
    wanted = int(os.environ.get("KILLS", "4"))
    for _ in range(wanted):
        process = start(config, folder)
        wait_for(lambda: (folder / "episodes.csv").exists(), process)
        time.sleep(dice.uniform(0.0, 2.5))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        kills += process.returncode == -signal.SIGKILL
    assert kills, "no process lived long enough to be killed"
    run("train", config, "--run", folder)
    assert content(folder) == content(whole)


@pytest.mark.skipif(compile_problem() is not None, reason="nothing can be compiled here")
@pytest.mark.parametrize(
    ("engine", "more"),
    [
        ("compiled", ()),
        ("native", ("--network.quantiles", "4", "--learning.loss", "huber", "--network.heads", "per_task")),
    ],
)
def test_a_compiled_run_continues_exactly_in_another_process(
    config: Path, tmp_path: Path, engine: str, more: tuple[str, ...]
) -> None:
    options = (
        "--learning.engine",
        engine,
        "--learning.precision",
        "bfloat16",
        "--network.encoding",
        "direct",
        "--learning.overlap",
        *more,
    )
    run("train", config, "--run", tmp_path / "whole", *options)
    assert f"engine: {engine}" in (tmp_path / "whole" / "config.yaml").read_text()
    run("train", config, "--run", tmp_path / "parts", *options, "--total-steps", "700")
    run("train", config, "--run", tmp_path / "parts", *options)
    assert content(tmp_path / "parts") == content(tmp_path / "whole")


def test_logs_are_whole_lines_while_a_run_goes_on_and_when_it_is_killed(
    config: Path, whole: Path, tmp_path: Path
) -> None:
    """Before the first checkpoint, and long before a buffer of the system would be full."""
    folder, episodes = tmp_path / "run", tmp_path / "run" / "episodes.csv"
    options = ("--recording.checkpoint-every-steps", "1600", "--recording.metrics-every-steps", "20")
    process = subprocess.Popen([*COMMAND, "train", config, "--run", folder, *options], stdout=subprocess.DEVNULL)
    wait_for(lambda: episodes.exists() and episodes.read_bytes().count(b"\n") > 3, process)
    alive = process.poll() is None
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert alive, "lines came while it ran"
    assert not list(folder.glob("checkpoints/step-*"))
    assert episodes.stat().st_size < 4096
    killed = {name: (folder / name).read_text() for name in ("episodes.csv", "switches.csv", "metrics.jsonl")}
    assert all(text.endswith("\n") for text in killed.values())
    steps = [json.loads(line)["step"] for line in killed["metrics.jsonl"].splitlines()]
    assert steps == list(range(20, steps[-1] + 1, 20))
    assert int(killed["episodes.csv"].splitlines()[-1].split(",")[0]) - steps[-1] < 20
    first = [row for row in content(whole)["episodes.csv"] if int(row["step"]) <= steps[-1]]
    seen = [
        {k: v for k, v in row.items() if k != "wall_s"} for row in csv.DictReader(io.StringIO(killed["episodes.csv"]))
    ]
    assert seen[: len(first)] == first


def test_logs_that_lost_lines_are_refused_in_one_line(config: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    process = start(config, folder)
    wait_for(lambda: any(folder.glob("checkpoints/step-*")), process)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    path = folder / "switches.csv"
    kept = path.read_text().splitlines(keepends=True)
    path.write_text("".join(kept[:2]))
    result = run("train", config, "--run", folder, check=2)
    assert f"{path} has {path.stat().st_size:,} bytes, expected at least the" in result.stderr
    assert path.read_text() == "".join(kept[:2]), "never filled with zeros"


def test_killed_while_a_checkpoint_is_written(config: Path, whole: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    process = start(config, folder)
    wait_for(lambda: any(folder.glob("checkpoints/.step-*.tmp")), process)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    run("train", config, "--run", folder)
    assert content(folder) == content(whole)


def test_ctrl_c_stops_cleanly_and_continues_exactly(config: Path, whole: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    process = start(config, folder)
    wait_for(lambda: any(folder.glob("checkpoints/step-*")), process)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 130, output
    assert "Traceback" not in output
    assert re.search(rf"continue exactly here with: \S+ -m switchmt_snn train --run {folder}$", output, re.MULTILINE)
    run("train", "--run", folder)  # without a config: the stored one
    assert content(folder) == content(whole)


def test_a_finished_run_says_so_and_can_be_raised(whole: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(whole, folder)
    assert "already finished at step 1,600" in run("train", "--run", folder).stdout
    run("train", "--run", folder, "--total-steps", "1700")
    assert content(folder)["step"] == 1700


def test_another_config_is_refused_with_the_fields_named(config: Path, whole: Path) -> None:
    before = content(whole)
    result = run("train", config, "--run", whole, "--learning.batch-size", "9", "--total-steps", "1000", check=2)
    assert "learning.batch_size (8 -> 9)" in result.stderr
    assert "total_steps (1600 -> 1000)" in result.stderr
    assert content(whole) == before


def damage(path: Path, how: str) -> None:
    data = bytearray(path.read_bytes())
    if how == "truncated":
        path.write_bytes(data[: len(data) // 2])
    elif how == "bit flipped":
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
    else:
        path.unlink()


@pytest.mark.parametrize("how", ["truncated", "bit flipped", "missing"])
@pytest.mark.parametrize(
    "name", ["model.safetensors", "training.safetensors", "state.json", "manifest.json", "segment"]
)
def test_a_damaged_checkpoint_is_named_and_the_one_before_is_used(
    config: Path, whole: Path, tmp_path: Path, name: str, how: str
) -> None:
    """Tested on the store itself: reading must name the damage and fall back, never half-load."""
    from switchmt_snn.config import resolve
    from switchmt_snn.config.yaml_io import load_config
    from switchmt_snn.errors import CheckpointError
    from switchmt_snn.learning.training import Training
    from switchmt_snn.runs.checkpoint import CheckpointStore
    from switchmt_snn.tasks.registry import make_suite

    folder = tmp_path / "run"
    shutil.copytree(whole, folder)
    settings = resolve(load_config(folder / "config.yaml"))
    store = CheckpointStore(folder / "checkpoints")
    newest, before, *_ = store.paths()
    own = [e["sha256"] for e in json.loads((newest / "manifest.json").read_text())["segments"]]
    older = [e["sha256"] for e in json.loads((before / "manifest.json").read_text())["segments"]]
    target = newest / name
    if name == "segment":
        target = folder / "checkpoints" / "replay" / f"{next(s for s in own if s not in older)}.zst"
    damage(target, how)
    training = Training(settings, make_suite(settings.tasks), torch.device("cpu"))
    loaded = store.load(training.replays)
    assert loaded.step < 1600
    assert newest.name in loaded.damaged[0]
    # The run goes on from the older one, comes to the same step again, and saves it whole.
    training.load_state_dict(loaded.state)
    for _ in training.events():
        pass
    store.save(1600, training.state_dict(), training.replays, loaded.log_sizes)
    again = Training(settings, training.suite, torch.device("cpu"))
    assert CheckpointStore(folder / "checkpoints").load(again.replays).damaged == ()
    assert content(folder)["files"] == content(whole)["files"]
    for path in store.paths():
        damage(path / "state.json", "truncated")
    with pytest.raises(CheckpointError, match="no whole checkpoint"):
        store.load(training.replays)


def test_a_damaged_newer_checkpoint_does_not_count_as_kept(whole: Path, tmp_path: Path) -> None:
    """The run went on from the one before it, and was stopped before it came to that step again."""
    from switchmt_snn.config import resolve
    from switchmt_snn.config.yaml_io import load_config
    from switchmt_snn.learning.training import Training
    from switchmt_snn.runs.checkpoint import CheckpointStore
    from switchmt_snn.tasks.registry import make_suite

    shutil.copytree(whole / "checkpoints", tmp_path / "checkpoints")
    settings = resolve(load_config(whole / "config.yaml"))
    store = CheckpointStore(tmp_path / "checkpoints", keep=1)
    newest, before, *_ = store.paths()
    damage(newest / "state.json", "truncated")
    training = Training(settings, make_suite(settings.tasks), torch.device("cpu"))
    loaded = store.load(training.replays)
    training.load_state_dict(loaded.state)
    saved = store.save(loaded.step + 1, training.state_dict() | {"steps": loaded.step + 1}, training.replays, {})
    assert store.paths() == [newest, saved]
    assert before not in store.paths()
    assert store.load(training.replays).step == loaded.step + 1


def test_damage_through_the_command_line(config: Path, whole: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(whole, folder)
    newest, *_ = sorted(folder.glob("checkpoints/step-*"), reverse=True)
    damage(newest / "training.safetensors", "bit flipped")
    result = run("train", "--run", folder)
    assert f"checkpoint {newest.name} is damaged (training.safetensors has another checksum)" in result.stdout
    assert content(folder) == content(whole), "trained again from the one before, to the same end"
    damage(newest / "model.safetensors", "bit flipped")
    for command in (("evaluate", folder), ("train", config, "--initial-weights", folder, "--run", tmp_path / "new")):
        error = run(*command, check=2).stderr
        assert f"checkpoint {newest.name} is damaged (model.safetensors has another checksum)" in error
        assert "training begins at the one before it" in error, "never the weights of the one before, in silence"
    for path in folder.glob("checkpoints/step-*"):
        damage(path / "model.safetensors", "truncated")
    assert "no whole checkpoint" in run("train", "--run", folder, check=2).stderr
    assert "no whole last checkpoint" in run("evaluate", folder, check=2).stderr


def test_two_processes_on_one_folder(config: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    process = start(config, folder)
    wait_for(lambda: (folder / "episodes.csv").exists(), process)
    process.send_signal(signal.SIGSTOP)  # it keeps the folder, and cannot finish before the second one comes
    try:
        assert "in use by another process" in run("train", "--run", folder, check=2).stderr
    finally:
        process.kill()
        process.communicate()


def test_foreign_and_unwritable_folders(config: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").write_text("precious")
    assert "holds 'chapter1.tex' but no run" in run("train", config, "--run", tmp_path / "thesis", check=2).stderr
    assert (tmp_path / "thesis" / "chapter1.tex").read_text() == "precious"
    assert "is not a run of switchmt-snn" in run("evaluate", tmp_path / "thesis", check=2).stderr
    assert "no run folder" in run("evaluate", tmp_path / "nowhere", check=2).stderr
    (tmp_path / "file").write_text("")
    assert "cannot be written" in run("train", config, "--run", tmp_path / "file" / "run", check=2).stderr
    assert "no run in" in run("evaluate", check=2, cwd=tmp_path).stderr


def test_disk_full_keeps_what_was_good(config: Path, whole: Path, tmp_path: Path) -> None:
    """The system refuses files over 40 kB, as a full disk would: exit 1, and the same command goes on afterwards."""
    folder = tmp_path / "run"
    process = start(config, folder)
    wait_for(lambda: any(folder.glob("checkpoints/step-*")), process)
    process.kill()
    process.communicate()
    kept = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.glob("checkpoints/step-*/*")}
    limit = 40_000
    assert max(path.stat().st_size for path in folder.glob("checkpoints/step-*/*")) > limit

    def small_files() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    result = run("train", config, "--run", folder, check=1, preexec_fn=small_files)
    assert re.search(r"/run/\S+ cannot be written \(File too large\) at step \d+", result.stderr)
    assert "the last whole checkpoint is kept: then run the same command with --run" in result.stderr
    now = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.glob("checkpoints/step-*/*")}
    assert now == kept
    run("train", config, "--run", folder)
    assert content(folder) == content(whole)


def test_a_loss_that_is_not_finite_exits_1_and_keeps_the_checkpoint(config: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    flags = ["--learning.learning-rate", "1e30", "--recording.checkpoint-every-steps", "50"]
    result = run("train", config, "--run", folder, *flags, check=1)
    assert "the loss is not finite" in result.stderr
    steps = [json.loads((p / "manifest.json").read_text())["step"] for p in folder.glob("checkpoints/step-*")]
    assert steps
    for path in folder.glob("checkpoints/step-*"):
        for tensor in safetensors.torch.load_file(path / "model.safetensors").values():
            assert torch.isfinite(tensor).all()


def test_no_pickle_anywhere(whole: Path) -> None:
    suffixes = {path.suffix for path in whole.rglob("*") if path.is_file()}
    assert suffixes <= {".yaml", ".json", ".jsonl", ".csv", ".safetensors", ".zst", ".lock", ".html"}
