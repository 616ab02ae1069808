"""Run folders: which one a new run gets, and which one is the newest."""

from __future__ import annotations

import json
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from switchmt_snn.errors import RunFolderError
from switchmt_snn.runs.folder import RunFolder, claim_new_run, latest_run
from switchmt_snn.runs.run import train
from tests.conftest import small_config


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def begun(name: str, created: str, file_time: float) -> Path:
    path = Path("runs") / name / "environment.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps({"program": "switchmt-snn", "created": created}))
    os.utime(path, (file_time, file_time))
    return path.parent


def test_trainings_that_begin_together_get_folders_of_their_own() -> None:
    with ThreadPoolExecutor(12) as pool:
        folders = list(pool.map(claim_new_run, ["same"] * 24))
    paths = {folder.path for folder in folders}
    assert len(paths) == 24
    assert all(path.is_dir() and "_same" in path.name for path in paths)


def test_a_folder_without_a_run_is_refused_with_the_nearest_one_and_the_command_for_a_new_one() -> None:
    begun("cartpole", "2026-01-01T00:00:00+0000", 0)
    Path("runs/cartpol").mkdir()
    Path("runs/cartpol/run.lock").touch()
    command = "switchmt-snn train quickstart --run runs/cartpol; did you mean 'cartpole'?"
    for use in (lambda: train(run="runs/cartpol"), RunFolder(Path("runs/cartpol")).require):
        with pytest.raises(RunFolderError, match="no run folder runs/cartpol, expected one") as refused:
            use()
        assert str(refused.value).endswith(command)
    assert [path.name for path in Path("runs/cartpol").iterdir()] == ["run.lock"]


@pytest.mark.slow
def test_a_run_that_was_killed_while_its_folder_was_made_is_begun_anew() -> None:
    """Killed before environment.json is written: at any of these moments nothing has been trained."""
    moments = [["checkpoints/"], ["checkpoints/", "evaluations/"], ["checkpoints/", "evaluations/", "config.yaml"]]
    moments += [["run.lock", *moments[1], ".config.yaml.12-ab.tmp"], [*moments[2], ".environment.json.12-ab.tmp"]]
    config = small_config(total_steps=60, tasks={"names": ["CartPole-v1"]}, evaluation={"episodes": 1})
    for number, names in enumerate(moments):
        folder = Path(f"run{number}")
        folder.mkdir()
        for name in names:
            (folder / name).mkdir() if name.endswith("/") else (folder / name).touch()
        with pytest.raises(RunFolderError, match="no run folder"):
            RunFolder(folder).require()
        if number in (0, len(moments) - 1):
            assert train(config, folder).status == "finished"
    for names in (["config.yaml"], ["checkpoints/", "config.yaml"], ["evaluations/", "checkpoints/", "notes.txt"]):
        folder = Path("strange-" + str(len(names)))
        folder.mkdir()
        for name in names:
            (folder / name).mkdir() if name.endswith("/") else (folder / name).touch()
        with pytest.raises(RunFolderError, match="but no run, expected an empty or new folder"):
            train(config, folder)


def test_a_folder_that_became_a_run_in_the_meantime_is_refused() -> None:
    folder = RunFolder(begun("a", "2026-01-01T00:00:00+0000", 0))
    folder.require_unchanged(was_run=True)
    with pytest.raises(RunFolderError, match="became a run of another process in the meantime"):
        folder.require_unchanged(was_run=False)


def test_the_newest_run_was_begun_last_whatever_the_times_of_its_files() -> None:
    begun("copied", "2026-01-02T10:00:00+0000", file_time=9_000)
    newest = begun("newest", "2026-01-02T12:30:00.000001+02:00", file_time=1_000)
    begun("same-second", "2026-01-02T10:30:00+0000", file_time=5_000)
    (Path("runs") / "broken").mkdir()
    (Path("runs") / "broken" / "environment.json").write_text("{}")
    assert latest_run() == newest


def test_a_copy_of_the_newest_run_does_not_take_its_place() -> None:
    moment = "2026-01-02T10:00:00.123456+00:00"
    original, copied = begun("a", moment, file_time=1_000), begun("a-backup", moment, file_time=9_000)
    assert latest_run() == original
    (copied / "checkpoints" / "step-000000000200").mkdir(parents=True)
    (original / "checkpoints" / "step-000000001000").mkdir(parents=True)
    assert latest_run() == original
    (copied / "checkpoints" / "step-000000003000").mkdir(parents=True)
    assert latest_run() == copied, "the one that is trained on"


def test_without_a_run_there_is_no_newest() -> None:
    with pytest.raises(RunFolderError, match="run switchmt-snn train, or name a run folder"):
        latest_run()
