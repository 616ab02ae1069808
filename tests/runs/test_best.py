"""The best weights: by the evaluations during training if there are any, else by training returns; named at the end."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from switchmt_snn import evaluate, train
from switchmt_snn.acting.evaluation import Evaluation, EvaluationProtocol, summarize
from switchmt_snn.cli import main
from switchmt_snn.config import EvaluationConfig
from switchmt_snn.config.yaml_io import from_dict, to_yaml
from switchmt_snn.errors import CheckpointError
from switchmt_snn.runs import best as best_module
from switchmt_snn.runs.best import rise_above_random
from switchmt_snn.runs.checkpoint import Best, CheckpointStore
from switchmt_snn.runs.evaluations import Evaluations

CARTPOLE: dict[str, Any] = {
    "total_steps": 600,
    "threads": 1,
    "tasks": {"suite": "gym", "names": ["CartPole-v1"]},
    "network": {"hidden_units": 8, "timesteps": 2},
    "learning": {"batch_size": 8, "learning_starts_steps": 20, "replay_capacity_steps": 600, "learning_rate": 0.01},
    "recording": {"checkpoint_every_steps": 200},
}


@pytest.mark.slow
def test_with_evaluations_the_best_weights_are_those_of_the_best_one(tmp_path: Path) -> None:
    """Also between checkpoints, and the last one counts."""
    config = from_dict({**CARTPOLE, "evaluation": {"episodes": 5, "epsilon": 0.0, "every_steps": 70}})
    train(config, tmp_path / "run")
    scores = {
        step: Evaluations(tmp_path / "run" / "evaluations").mean_returns(step, config.evaluation)["CartPole-v1"]
        for step in [*range(70, 600, 70), 600]
    }
    best = CheckpointStore(tmp_path / "run" / "checkpoints").best()
    assert best is not None
    assert best.judged_by == "evaluation"
    assert scores[best.step] == max(scores.values())
    again = evaluate(tmp_path / "run", checkpoint="best", save=False)
    assert again.score("CartPole-v1").mean == max(scores.values())


@pytest.mark.slow
def test_without_evaluations_they_are_chosen_by_training_returns(tmp_path: Path) -> None:
    train(from_dict({**CARTPOLE, "evaluation": {"episodes": 1}}), tmp_path / "run")
    best = CheckpointStore(tmp_path / "run" / "checkpoints").best()
    assert best is not None
    assert (best.judged_by, best.step % 200) == ("returns", 0)


@pytest.mark.slow
@pytest.mark.parametrize("lost", ["not judged", "half replaced"])
def test_weights_that_a_killed_run_has_not_judged_are_judged_when_it_goes_on(
    lost: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The best of an uninterrupted run is of its second checkpoint; killed there, it is found again."""
    config = from_dict({**CARTPOLE, "total_steps": 800, "evaluation": {"episodes": 1}})
    scores = {200: 0.1, 400: 0.9, 600: 0.5, 800: 0.2}
    monkeypatch.setattr(best_module, "rise_of_returns", lambda *_: scores[stores[-1]])
    stores: list[int] = []
    save, save_best = CheckpointStore.save, CheckpointStore.save_best

    def saved(self: CheckpointStore, step: int, *rest: Any) -> Path:
        stores.append(step)
        return save(self, step, *rest)

    def killed(self: CheckpointStore, step: int, *rest: Any) -> None:
        if step != 400:
            return save_best(self, step, *rest)
        if lost == "half replaced":
            shutil.rmtree(self.folder / "best")
            (self.folder / ".best.tmp").mkdir()
        raise MemoryError("killed")

    monkeypatch.setattr(CheckpointStore, "save", saved)
    train(config, tmp_path / "whole")
    monkeypatch.setattr(CheckpointStore, "save_best", killed)
    with pytest.raises(MemoryError):
        train(config, tmp_path / "run")
    monkeypatch.setattr(CheckpointStore, "save_best", save_best)
    train(run=tmp_path / "run")
    for name in ("manifest.json", "model.safetensors"):
        whole, again = (tmp_path / run / "checkpoints" / "best" / name for run in ("whole", "run"))
        assert whole.read_bytes() == again.read_bytes()
    assert CheckpointStore(tmp_path / "run" / "checkpoints").best() == Best(400, 0.9, "returns")
    assert not (tmp_path / "run" / "checkpoints" / ".best.tmp").exists()


def test_a_run_whose_checkpoints_are_gone_does_not_begin_anew(tmp_path: Path) -> None:
    train(from_dict({**CARTPOLE, "evaluation": {"episodes": 1}}), tmp_path / "run")
    log = (tmp_path / "run" / "episodes.csv").read_bytes()
    shutil.rmtree(tmp_path / "run" / "checkpoints")
    with pytest.raises(CheckpointError, match=r"has no checkpoint, expected one of a run whose logs reach step \d+"):
        train(run=tmp_path / "run")
    assert (tmp_path / "run" / "episodes.csv").read_bytes() == log


def test_a_score_of_another_kind_is_not_compared(tmp_path: Path) -> None:
    """A run of an older version kept its best by returns; the first evaluation replaces it."""
    store = CheckpointStore(tmp_path)
    store.save_best(10, {"w": torch.ones(1)}, 99.0, "returns")
    manifest = json.loads((tmp_path / "best" / "manifest.json").read_text())
    assert manifest["judged_by"] == "returns"
    assert store.best() == Best(10, 99.0, "returns")
    assert load_file(tmp_path / "best" / "model.safetensors")["w"] == 1


def test_the_score_of_an_evaluation_is_the_rise_above_random_play() -> None:
    from switchmt_snn.acting.episodes import EpisodeScore
    from switchmt_snn.tasks.registry import make_suite

    suite = make_suite(from_dict(CARTPOLE).tasks)
    scores = {"agent": [110.0, 130.0], "random": [10.0, 30.0]}
    episodes = [
        EpisodeScore(policy, "CartPole-v1", number, 0, value, 9, None, False)
        for policy, values in scores.items()
        for number, value in enumerate(values)
    ]
    rows = tuple(summarize(suite, [one for one in episodes if one.policy == policy]) for policy in scores)
    protocol = EvaluationProtocol.of(EvaluationConfig(), from_dict(CARTPOLE).tasks)
    assert rise_above_random(Evaluation(protocol, 1, rows, tuple(episodes))) == pytest.approx((120 - 20) / 10)


@pytest.mark.slow
def test_the_end_of_a_run_names_its_best_weights(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = from_dict({**CARTPOLE, "evaluation": {"episodes": 2, "every_steps": 100}})
    (tmp_path / "c.yaml").write_text(to_yaml(config))
    with pytest.raises(SystemExit) as stop:
        main(["train", str(tmp_path / "c.yaml"), "--run", str(tmp_path / "a run")])
    out = capsys.readouterr().out
    assert stop.value.code == 0
    best = CheckpointStore(tmp_path / "a run" / "checkpoints").best()
    assert best is not None
    named = f"The best weights by the evaluations during training are those of step {best.step:,} (--checkpoint best)."
    assert (named in out) == (best.step != 600)
    assert f"describe '{tmp_path / 'a run' / 'config.yaml'}'" in out
    following = [line.strip() for line in out.split("Next:\n")[1].splitlines()[:-1]]
    assert len(following) >= 5


def test_a_damaged_best_checkpoint_is_named_and_a_missing_one_is_not_called_damaged(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no whole best checkpoint in .* \(none\), .*use --checkpoint last"):
        CheckpointStore(tmp_path).load_model("best")
    (tmp_path / "best").mkdir()
    (tmp_path / "best" / "manifest.json").write_text("{}")
    with pytest.raises(CheckpointError, match=r"checkpoint best is damaged .*use --checkpoint last"):
        CheckpointStore(tmp_path).load_model("best")
