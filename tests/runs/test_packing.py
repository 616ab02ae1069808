"""Packed runs: what others need, readable by every command, and the package's own under ``pretrained/``."""

from __future__ import annotations

import shlex
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from switchmt_snn import evaluate, load_agent, train
from switchmt_snn.errors import CheckpointError, RunFolderError
from switchmt_snn.export import ExportSettings, export, load_exported, profile
from switchmt_snn.runs import packing
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.runs.packing import open_run, pack
from tests.conftest import small_config


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = small_config(
        tasks={"suite": "gym", "names": ["CartPole-v1", "Acrobot-v1"]},
        evaluation={"episodes": 3, "num_envs": 3, "every_steps": 200, "max_episode_steps": 60},
        recording={"metrics_every_steps": 100, "checkpoint_every_steps": 200},
    )
    return train(config, run=tmp_path_factory.mktemp("packing") / "mine").path


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_a_packed_run_plays_exports_and_profiles_as_the_run_does(finished: Path, tmp_path: Path) -> None:
    packed = pack(finished, tmp_path / "sent" / "mine")
    for name in ("config.yaml", "environment.json", "episodes.csv", "switches.csv", "metrics.jsonl"):
        assert (packed / name).read_bytes() == (finished / name).read_bytes()
    assert not list(packed.rglob("*.zst"))
    assert not list(packed.rglob("training.safetensors"))
    here, there = load_agent(finished), load_agent(packed)
    observations = np.random.default_rng(1).normal(size=(50, *here.suite.observation_shape)).astype(np.float32)
    seen = [agent.q_values(observations, "CartPole-v1") for agent in (here, there)]
    assert np.array_equal(*seen)
    protocol = {"episodes": 4, "seed": 77}
    assert evaluate(packed, **protocol).episodes == evaluate(finished, **protocol).episodes
    assert export(packed, ExportSettings(parity_decisions=8)).files
    assert profile(packed, decisions=8).facts["training_step"] == 400


def test_the_best_weights_can_be_packed(finished: Path, tmp_path: Path) -> None:
    best = RunFolder(finished).checkpoints().best()
    assert best is not None
    packed = pack(finished, tmp_path / "best", "best")
    weights = [load_agent(*words).network.state_dict() for words in ((packed,), (finished, "best"))]
    assert all(np.array_equal(weights[0][name], weights[1][name]) for name in weights[1])
    assert load_agent(packed).step == best.step
    assert {path.name.split("_")[0] for path in (packed / "evaluations").iterdir()} == {f"step-{best.step:012d}"}


@pytest.mark.slow
def test_training_cannot_go_on_from_a_packed_run(finished: Path, tmp_path: Path) -> None:
    packed = pack(finished, tmp_path / "mine")
    before = bytes_of(packed)
    config = load_agent(packed).config
    for asked in (None, config):
        with pytest.raises(CheckpointError, match="holds weights only") as refused:
            train(asked, run=packed)
        assert "\n" not in str(refused.value)
    after = bytes_of(packed)
    after.pop("run.lock", None)
    assert after == before


def test_what_exists_is_not_replaced(finished: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    with pytest.raises(RunFolderError, match="exists, expected a new folder"):
        pack(finished, tmp_path / "mine")
    assert not list((tmp_path / "mine").iterdir())
    with pytest.raises(CheckpointError, match="expected last or best"):
        pack(finished, tmp_path / "new", "newest")
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


@pytest.fixture
def own(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package with one pretrained run, and an empty current folder."""
    monkeypatch.setattr(packing, "PRETRAINED", tmp_path / "package")
    pack(finished, tmp_path / "package" / "small")
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "package" / "small"


@pytest.mark.slow
def test_a_pretrained_run_is_read_where_it_is_and_copied_to_be_written(own: Path) -> None:
    before = bytes_of(own)
    assert load_agent("pretrained/small").step == 400
    evaluate("pretrained/small", episodes=2, save=False)
    assert not list(Path().iterdir())  # reading leaves nothing behind
    evaluate("pretrained/small", episodes=2, seed=5)
    copied = Path("runs/pretrained/small")
    assert bytes_of(own) == before
    written = {name for name in bytes_of(copied) if not name.startswith("random_play/")} - set(before)
    assert written == {
        f"evaluations/step-000000000400_Acrobot-v1+CartPole-v1_n2_seed5_epsilon0.05_envs2_longest60.{kind}"
        for kind in ("csv", "json")
    }
    assert open_run("pretrained/small", to_write=True).path == copied  # the copy with its results, not a fresh one


@pytest.mark.slow
def test_what_was_exported_of_a_pretrained_run_is_read_under_its_name(own: Path) -> None:
    export("pretrained/small", ExportSettings(onnx=True, parity_decisions=8))
    assert load_exported("pretrained/small").step == 400
    assert load_exported(own).step == 400  # the package's own folder is the same run, and stays as it is
    assert not (own / "export").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pretrained/small", "the package's folder"])
def test_training_in_a_pretrained_run_is_refused_and_its_remedy_works(own: Path, name: str) -> None:
    run = name if name == "pretrained/small" else str(own)
    for config in (None, load_agent("pretrained/small").config):
        with pytest.raises(RunFolderError, match="comes with the package and holds weights only") as refused:
            train(config, run=run)
    command = str(refused.value).split("switchmt-snn train ")[1]
    config = shlex.split(command)[0]
    assert train(config, run="mine").step == 400
    assert not Path("pretrained").exists()


def test_copies_made_at_once_are_whole(own: Path) -> None:
    with ThreadPoolExecutor(8) as pool:
        folders = list(pool.map(lambda _: open_run("pretrained/small", to_write=True), range(16)))
    assert {folder.path for folder in folders} == {Path("runs/pretrained/small")}
    assert bytes_of(folders[0].path) == bytes_of(own)
    assert [path.name for path in Path("runs/pretrained").iterdir()] == ["small"]


def test_a_folder_of_ones_own_comes_first_and_unknown_names_are_told_the_known(own: Path) -> None:
    with pytest.raises(RunFolderError, match="no pretrained run 'smal', expected one of small; did you mean 'small'"):
        open_run("pretrained/smal")
    shutil.copytree(own, "pretrained/small")
    assert open_run("pretrained/small", to_write=True).path == Path("pretrained/small")


@pytest.mark.slow
@pytest.mark.parametrize("name", packing.pretrained_names())
def test_the_packages_own_runs_are_whole_and_hold_their_scores(name: str) -> None:
    folder = open_run(f"pretrained/{name}")
    agent = load_agent(f"pretrained/{name}")
    for task in agent.suite.names:
        known = folder.evaluations.best_known(agent.step, task)
        assert known is not None
        assert known["episodes"] >= 30
        assert known["score"] > known["random_score"]


def test_the_package_has_pretrained_runs() -> None:
    assert packing.pretrained_names()
