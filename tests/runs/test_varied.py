"""The normal next step of a study: a run's own config with one key changed."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from switchmt_snn import load_config, train
from switchmt_snn.cli import main
from switchmt_snn.config import resolve, to_yaml
from switchmt_snn.runs.folder import RunFolder

QUICK = """
name: study
total_steps: 100
threads: 1
tasks: {suite: gym, names: [CartPole-v1]}
network: {hidden_units: 8, timesteps: 2}
learning: {batch_size: 8, learning_starts_steps: 20, replay_capacity_steps: 200}
evaluation: {episodes: 1}
"""


@pytest.mark.slow
def test_a_runs_config_trains_another_method_and_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "study.yaml").write_text(QUICK)
    original = load_config(tmp_path / "study.yaml")
    train(original, tmp_path / "one")
    for old, method, new in (("one", "DQN", "two"), ("two", "SwitchMT", "three")):
        config, run = str(tmp_path / old / "config.yaml"), str(tmp_path / new)
        with pytest.raises(SystemExit) as stop:
            main(["train", config, "--network.method", method, "--run", run])
        assert stop.value.code == 0, capsys.readouterr().err
    one, two, three = (RunFolder(tmp_path / name).config() for name in ("one", "two", "three"))
    assert (two.network.method, two.network.dendrites, two.network.timesteps) == ("DQN", "none", 1)
    assert two.switching.policy == "fixed_episodes"
    assert three == one


@pytest.mark.slow
def test_a_continued_run_keeps_its_record_and_a_changed_one_is_refused_by_what_was_changed(tmp_path: Path) -> None:
    (tmp_path / "study.yaml").write_text(QUICK)
    train(tmp_path / "study.yaml", tmp_path / "run")
    with pytest.raises(SystemExit):
        main(["train", "--run", str(tmp_path / "run"), "--total-steps", "120"])
    stored = tmp_path / "run" / "config.yaml"
    assert load_config(stored).network.dendrites == "auto"
    assert load_config(stored).total_steps == load_config(stored, reopen=False).total_steps == 120


@pytest.mark.slow
def test_a_flag_that_a_run_cannot_take_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "study.yaml").write_text(QUICK)
    train(tmp_path / "study.yaml", tmp_path / "run")
    with pytest.raises(SystemExit) as stop:
        main(["train", "--run", str(tmp_path / "run"), "--network.method", "DQN"])
    assert stop.value.code == 2
    assert "holds a run of another config" in (error := capsys.readouterr().err)
    assert "network.method ('SwitchMT' -> 'DQN')" in error


@pytest.mark.slow
def test_a_printed_config_can_be_varied(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["train", "quickstart", "--print-config"])
    path = tmp_path / "q.yaml"
    path.write_text(capsys.readouterr().out)
    quickstart = load_config("quickstart")
    assert load_config(path, reopen=False) == resolve(quickstart)
    assert path.read_text() == to_yaml(resolve(quickstart), quickstart)
    with pytest.raises(SystemExit) as stop:
        main(["train", str(path), "--network.method", "DQN", "--print-config"])
    assert stop.value.code == 0


@pytest.mark.parametrize("words", [["--tasks.names", "MountainCar-v0"], ["--tasks.names=MountainCar-v0", "--seed=2"]])
def test_the_goals_of_a_presets_tasks_do_not_end_the_training_of_others(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    def goals(*more: str) -> list[float]:
        with pytest.raises(SystemExit):
            main(["train", "cartpole", "--print-config", *more])
        return list(yaml.safe_load(capsys.readouterr().out)["evaluation"]["stop_at_returns"])

    assert goals() == goals("--tasks.names", "CartPole-v1") == [485]
    assert goals(*words) == []
    assert goals(*words, "--evaluation.stop-at-returns", "-110") == [-110]
