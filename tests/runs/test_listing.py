"""The list of runs, and logs that are read while they are written."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from switchmt_snn.cli import main
from switchmt_snn.errors import RunFolderError
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.runs.history import read_history
from switchmt_snn.runs.listing import list_runs, summarize

ROOT = Path(__file__).parents[2]
FIXTURES = ROOT / "tests" / "fixtures" / "runs"
TASKS = ("pong", "breakout", "enduro")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    shutil.copytree(FIXTURES / "minatar", tmp_path / "runs" / "minatar")
    shutil.copytree(FIXTURES / "gym", tmp_path / "runs" / "gym")
    return tmp_path / "runs"


def test_runs_come_by_the_time_they_began_with_their_facts(folder: Path) -> None:
    runs, damaged = list_runs(folder)
    assert not damaged
    assert [run.created for run in runs] == sorted(run.created for run in runs)
    by_name = {run.path.name: run for run in runs}
    assert set(by_name) == {"minatar", "gym"}
    for name, run in by_name.items():
        config = RunFolder(FIXTURES / name).config()
        assert (run.method, run.tasks, run.total_steps) == (
            config.network.method,
            config.tasks.names,
            config.total_steps,
        )
        files = [path for path in (FIXTURES / name).rglob("*") if path.is_file()]
        assert run.bytes == sum(path.stat().st_size for path in files)


@pytest.mark.slow
def test_steps_status_time_and_scores_of_stored_runs() -> None:
    lagging = summarize(ROOT / "results" / "atari" / "lagging-s1")
    assert (lagging.status, lagging.total_steps) == ("stopped", 3_000_000)
    assert lagging.steps == 930_536, "the last line of episodes.csv and switches.csv"
    enduro = lagging.scores[2]
    assert (enduro.task, enduro.of, enduro.episodes) == ("enduro", "evaluation", 10)
    assert enduro.mean == pytest.approx(140.4)
    strong = summarize(ROOT / "results" / "atari" / "strong-s1")
    assert [score.of for score in strong.scores] == ["training"] * 3
    assert summarize(ROOT / "results" / "minatar" / "switchmt-seed1").status == "finished"


def test_a_run_that_is_in_use_is_running_and_asking_does_not_disturb_it(folder: Path) -> None:
    lock = RunFolder(folder / "gym").lock()
    try:
        assert RunFolder(folder / "gym").in_use
        assert summarize(folder / "gym").status == "running"
        assert lock.is_locked
    finally:
        lock.release()
    assert not RunFolder(folder / "gym").in_use


@pytest.mark.slow
def test_damaged_folders_are_one_line_each_and_the_others_are_listed(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "notes").mkdir()
    (folder / "notes" / "thoughts.txt").write_text("no run")
    for name in ("no_config", "bad_log", "bad_evaluation", "no_environment"):
        shutil.copytree(folder / "gym", folder / name)
    (folder / "no_config" / "config.yaml").unlink()
    (folder / "no_environment" / "environment.json").write_text("{")
    with (folder / "bad_log" / "episodes.csv").open("a") as stream:
        stream.write("1,2\n")
    (folder / "bad_evaluation" / "evaluations" / "step-000000000001_x.json").write_text("[]")
    with pytest.raises(SystemExit) as stop:
        main(["runs", str(folder), "--json"])
    captured = capsys.readouterr()
    assert stop.value.code == 0
    assert {Path(run["path"]).name for run in json.loads(captured.out)} == {"gym", "minatar"}
    lines = captured.err.splitlines()
    assert sorted(line.split(": ")[1] for line in lines) == ["bad_evaluation", "bad_log", "no_config", "no_environment"]
    assert all(line.startswith("damaged: ") for line in lines)


def test_folders_without_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["runs", str(tmp_path)])
    assert stop.value.code == 0
    assert capsys.readouterr().out == f"no run in {tmp_path}\n"
    with pytest.raises(SystemExit) as stop:
        main(["runs", str(tmp_path / "nowhere")])
    assert stop.value.code == 2
    assert "expected one with run folders" in capsys.readouterr().err


def test_a_line_that_is_being_written_is_not_read_yet(tmp_path: Path) -> None:
    source = ROOT / "results" / "atari" / "strong-s1"
    whole = read_history(source, TASKS)
    for name in ("episodes.csv", "switches.csv", "metrics.jsonl"):
        content = (source / name).read_bytes()
        (tmp_path / name).write_bytes(content[:-20])
    part = read_history(tmp_path, TASKS)
    assert part.episodes == whole.episodes[:-1]
    assert part.decisions == whole.decisions[:-1]
    assert [one.step for one in part.measured] == [one.step for one in whole.measured[:-1]]
    assert read_history(tmp_path / "nothing", TASKS).last_step == 0


def test_a_line_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").write_text('{"step": 1}\n')
    with pytest.raises(RunFolderError, match=r"metrics.jsonl line 1 cannot be read .'task'., expected a line"):
        read_history(tmp_path, TASKS)
    shutil.copy(ROOT / "results" / "atari" / "strong-s1" / "switches.csv", tmp_path)
    (tmp_path / "metrics.jsonl").unlink()
    text = (tmp_path / "switches.csv").read_text().replace(",stay,", ",perhaps,", 1)
    (tmp_path / "switches.csv").write_text(text)
    with pytest.raises(RunFolderError, match=r"switches.csv line 3 cannot be read .decision is 'perhaps'."):
        read_history(tmp_path, TASKS)


def test_the_time_of_a_continued_run_is_that_of_all_its_calls(tmp_path: Path) -> None:
    header = "step,task,episode,return,length_steps,truncated,epsilon,updates,wall_s\n"
    rows = [(10, 5.0), (20, 9.5), (30, 2.0), (40, 4.0)]  # the clock starts anew
    lines = [f"{step},pong,1,0,1,0,1,0,{wall}\n" for step, wall in rows]
    (tmp_path / "episodes.csv").write_text(header + "".join(lines))
    history = read_history(tmp_path, TASKS)
    assert [[one.step for one in call] for call in history.calls] == [[10, 20], [30, 40]]
    assert history.wall_s == 9.5 + 4.0
