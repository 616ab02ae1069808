"""Real studies of seconds: trials are plain runs, a killed study goes on exactly, failures stop nothing else."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest

from switchmt_snn.cli import main
from switchmt_snn.config import load_config
from switchmt_snn.errors import ConfigError, RunFolderError
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.runs.run import train
from switchmt_snn.study import local, processes
from switchmt_snn.study.engine import last_words
from switchmt_snn.study.folder import StudyFolder, TrialRun
from switchmt_snn.study.grid import load_study

ROOT = Path(__file__).parents[2]
TINY = """
base: cartpole
settings:
  total_steps: {steps}
  network: {{hidden_units: 16, timesteps: 2}}
  learning: {{learning_starts_steps: 100, update_every_steps: 20, updates_per_round: 1, batch_size: 8}}
  evaluation: {{episodes: 3, num_envs: 3, every_steps: null, stop_at_returns: []}}
  recording: {{checkpoint_every_steps: 200, metrics_every_steps: 100}}
"""


def tiny(path: Path, rest: str, steps: int = 400) -> Path:
    path.write_text(TINY.format(steps=steps) + rest)
    return path


def study_command(*words: str | Path) -> list[str]:
    return [sys.executable, "-m", "switchmt_snn", "study", *map(str, words)]


def begin(*words: str | Path, cwd: Path) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{cwd}"}
    return subprocess.Popen(
        study_command(*words), cwd=cwd, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    out, _ = process.communicate(timeout=600)
    return process.returncode, out


def eventually(what: Callable[[], Any], seconds: float = 240.0) -> Any:
    end = time.monotonic() + seconds
    while not (value := what()):
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)
    return value


def trained(run: Path) -> dict[str, Any]:
    """What a training leaves but for times."""
    with (run / "episodes.csv").open() as stream:
        rows = [{key: value for key, value in row.items() if key != "wall_s"} for row in csv.DictReader(stream)]
    final = TrialRun(run).final
    return {"episodes": rows, "switches": (run / "switches.csv").read_text(), "final": final}


@pytest.mark.slow
def test_a_study_that_is_killed_goes_on_as_if_it_had_not_been(tmp_path: Path) -> None:
    """SIGKILL of the study and of its trial, in the middle of a run; the trials are those of plain ``train``."""
    path = tiny(tmp_path / "s.yaml", "vary: {network.timesteps: [1, 2]}\n", steps=3000)
    process = begin(path, "--folder", "killed", "--jobs", "1", cwd=tmp_path)
    second = tmp_path / "killed" / "trials" / "timesteps-2_seed1"
    eventually(lambda: list((second / "checkpoints").glob("step-*")))
    children = psutil.Process(process.pid).children()
    assert len(children) == 1
    process.kill()
    children[0].kill()
    process.communicate()
    psutil.wait_procs(children)
    assert not (tmp_path / "killed" / "tables.md").exists()
    status = json.loads(
        subprocess.run(
            study_command(path, "--folder", "killed", "--status", "--json"),
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
    )
    assert status["counts"] == {"finished": 1, "running": 0, "stopped": 1, "waiting": 0, "failed": 0}
    assert status["seconds_left"] > 0
    code, out = ended(begin(path, "--folder", "killed", cwd=tmp_path))
    assert code == 0, out
    assert "2 trials (2 variants), 1 finished" in out
    for trial in load_study(path).trials:
        plain = train(trial.config, tmp_path / "plain" / trial.name)
        run = tmp_path / "killed" / "trials" / trial.name
        assert trained(run) == trained(plain.path)
        assert RunFolder(run).config() == RunFolder(plain.path).config()
    code, out = ended(begin(tmp_path / "killed", cwd=tmp_path))  # the folder itself is a study, too
    assert code == 0, out
    assert "2 finished" in out
    shutil.rmtree(tmp_path / "killed" / "trials" / "timesteps-1_seed1" / "checkpoints")  # a study of numbers only
    code, out = ended(begin(tmp_path / "killed", cwd=tmp_path))
    assert code == 0, out
    assert "2 finished" in out
    assert not list((tmp_path / "killed" / "trials" / "timesteps-1_seed1" / "checkpoints").glob("step-*"))
    code, out = ended(begin(path, "--folder", "whole", cwd=tmp_path))
    assert code == 0, out
    for name in ("tables.md", "study.json", "trials.csv", "scores.csv", "curves.csv"):
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    assert "All 2 trials finished." in (tmp_path / "killed" / "report.html").read_text()


@pytest.mark.slow
def test_a_trial_of_a_killed_study_ends_by_itself_with_a_checkpoint(tmp_path: Path) -> None:
    if sys.platform != "linux":
        pytest.skip("only Linux tells a process of its parent's end")
    path = tiny(tmp_path / "s.yaml", "", steps=1_000_000)
    process = begin(path, "--folder", "s", cwd=tmp_path)
    run = tmp_path / "s" / "trials" / "s_seed1"
    eventually(lambda: list((run / "checkpoints").glob("step-*")))
    (child,) = psutil.Process(process.pid).children()
    process.kill()
    process.communicate()
    child.wait(60)
    steps = max(int(one.name[5:]) for one in (run / "checkpoints").glob("step-*"))
    assert steps % 200 != 0 or steps == TrialRun(run).steps  # saved where it stood
    assert not RunFolder(run).in_use


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_stop_ends_all_trials_with_their_checkpoints(number: int, tmp_path: Path) -> None:
    path = tiny(tmp_path / "s.yaml", "seeds: 2\n", steps=1_000_000)
    jobs = min(2, local.free_cores())
    process = begin(path, "--folder", "s", "--jobs", str(jobs), cwd=tmp_path)
    runs = [tmp_path / "s" / "trials" / f"s_seed{seed}" for seed in range(1, jobs + 1)]
    eventually(lambda: all(TrialRun(run).steps > 0 for run in runs))
    process.send_signal(number)
    code, out = ended(process)
    assert code == 130, out
    assert "stopping: " in out
    for run in runs:
        assert list((run / "checkpoints").glob("step-*"))
        assert not RunFolder(run).in_use
    attempts = StudyFolder(tmp_path / "s").attempts()
    assert len(attempts) == jobs
    assert all(one.asked and not one.failed for one in attempts)


HICCUP = """
from pathlib import Path
from switchmt_snn.learning.switching import Criterion, Verdict

class Hiccup(Criterion):
    columns = ()

    def end_of_episode(self, record):
        if not Path("asked").exists():
            Path("asked").touch()
            raise RuntimeError("a hiccup")
        return Verdict(False, "stays", {})
"""


@pytest.mark.slow
def test_a_trial_that_fails_is_named_tried_once_more_and_stops_no_other(tmp_path: Path) -> None:
    path = tiny(
        tmp_path / "s.yaml",
        """
variants:
  broken: {tasks.names: [CartPole-v999]}
  flaky: {switching.policy: "hiccup:Hiccup"}
  whole: {}
""",
    )
    (tmp_path / "hiccup.py").write_text(HICCUP)
    code, out = ended(begin(path, "--folder", "s", "--jobs", "1", cwd=tmp_path))
    assert code == 1, out
    assert out.count("failed broken_seed1 (exit code 2): switchmt-snn: ") == 2
    assert "CartPole-v999" in out
    assert "trying broken_seed1 again" in out
    assert out.count("failed flaky_seed1") == 1
    assert "a hiccup" in out
    assert "finished flaky_seed1" in out
    assert "finished whole_seed1" in out
    folder = StudyFolder(tmp_path / "s")
    assert [(one.trial, one.code) for one in folder.attempts()] == [
        ("broken_seed1", 2),
        ("flaky_seed1", 2),
        ("whole_seed1", 0),
        ("broken_seed1", 2),
        ("flaky_seed1", 0),
    ]
    assert {one.trial.name: one.status for one in folder.progress(folder.study())} == {
        "broken_seed1": "failed",
        "flaky_seed1": "finished",
        "whole_seed1": "finished",
    }


@pytest.mark.slow
def test_a_dry_run_measures_each_kind_and_leaves_nothing(tmp_path: Path) -> None:
    path = tiny(tmp_path / "s.yaml", "vary: {switching.visit_episodes: [3, 4], network.timesteps: [1, 2]}\nseeds: 2\n")
    process = begin(path, "--folder", "s", "--jobs", "1", "--dry-run", "--json", cwd=tmp_path)
    code, out = ended(process)
    assert code == 0, out
    facts = json.loads(out[out.index("{") :])
    assert (facts["trials"], facts["finished"], facts["jobs"]) == (8, 0, 1)
    assert out.count("probing ") == 2  # switching and seeds are no other kind
    assert facts["core_seconds"] == pytest.approx(facts["seconds"])
    assert facts["seconds"] == pytest.approx(sum(row["seconds"] * row["trials"] for row in facts["variants"]))
    assert facts["seconds"] > 8
    assert facts["disk_bytes"] > 8 * 10_000
    assert 100 * 2**20 < facts["memory_bytes"] < facts["memory_available_bytes"]
    assert not (tmp_path / "s").exists()


def test_more_jobs_than_cores_are_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(local, "free_cores", lambda: 4)
    trials = load_study(tiny(tmp_path / "s.yaml", "")).trials
    assert local.jobs_for(trials, None) == 4
    assert local.jobs_for(trials, 3) == 3
    with pytest.raises(ConfigError, match="--jobs is 5, expected 1 to 4: one thread each on the 4 cores here"):
        local.jobs_for(trials, 5)
    two = load_study(tiny(tmp_path / "s.yaml", ""), ["threads=2"]).trials
    assert local.jobs_for(two, None) == 2
    with pytest.raises(ConfigError, match="--jobs is 3, expected 1 to 2: 2 threads each"):
        local.jobs_for(two, 3)
    with pytest.raises(ConfigError, match="--jobs is 0"):
        local.jobs_for(two, 0)


@pytest.mark.slow
def test_a_folder_takes_more_trials_but_no_other_ones(tmp_path: Path) -> None:
    path, folder = tmp_path / "s.yaml", StudyFolder(tmp_path / "study")
    folder.prepare(load_study(tiny(path, "seeds: 2\n")))
    folder.prepare(load_study(tiny(path, "seeds: 3\n")))
    assert folder.study() == load_study(path)
    assert load_config(folder.config(folder.study().trials[2])) == folder.study().trials[2].config
    with pytest.raises(ConfigError, match="holds trials that are not in the study: s_seed3"):
        folder.prepare(load_study(tiny(path, "seeds: 2\n")))
    with pytest.raises(ConfigError, match=r"holds s_seed1 with another config: network.timesteps \(2 -> 3\)"):
        folder.prepare(load_study(path, ["network.timesteps=3"], [1, 2, 3]))
    folder.config(folder.study().trials[1]).unlink()
    with pytest.raises(RunFolderError, match=r"s_seed2.yaml is missing, expected the config of every trial; write it"):
        folder.study()
    folder.prepare(load_study(tiny(path, "seeds: 3\n")))
    assert folder.study() == load_study(path)
    strange = tmp_path / "strange"
    strange.mkdir()
    (strange / "thesis.tex").touch()
    with pytest.raises(RunFolderError, match=r"holds 'thesis.tex' but no study, expected an empty or new folder"):
        StudyFolder(strange).prepare(load_study(path))
    held = folder.lock()
    with pytest.raises(RunFolderError, match="is in use by another process, expected a free study"):
        StudyFolder(folder.path).lock()
    held.release()


@pytest.mark.parametrize("option", ["--report", "--status", "--dry-run"])
def test_what_only_looks_at_a_folder_takes_no_other_study(
    option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tiny(tmp_path / "s.yaml", "")
    folder = StudyFolder(tmp_path / "s")
    folder.prepare(load_study(path))
    for words, expected in (
        ([], None),
        (["--set", "learning.learning_rate=0.7"], "holds s_seed1 with another config: learning.learning_rate"),
        (["--seeds", "2"], "holds trials that are not in the study: s_seed1, expected the same study"),
    ):
        if expected is None and option == "--dry-run":
            continue  # it would train
        with pytest.raises(SystemExit) as stop:
            main(["study", str(path), "--folder", str(folder.path), *words, option])
        error = capsys.readouterr().err
        if expected is not None:
            assert (stop.value.code, error.count("\n")) == (2, 1)
            assert expected in error
        elif option == "--report":
            assert (stop.value.code, error.count("\n")) == (2, 1)
            assert "no trial of" in error
        else:
            assert stop.value.code == 0
    assert not (folder.path / "tables.md").exists()


def test_last_words_are_those_of_the_newest_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "_command_of", lambda words: [sys.executable, "-c", *words])
    log = tmp_path / "log"
    assert last_words(log) == "it printed nothing"
    for words, said in (("print('one'); print()", "one"), ("pass", "it printed nothing"), ("print('two')", "two")):
        process = processes.ProgramProcess([words], log, 1)
        assert process.process.wait(60) == 0
        assert last_words(log) == said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], "study got no CONFIG, expected a YAML file or one of ablation_minatar, policies_atari, policies_"),
        (["nothing.yaml"], "no study 'nothing.yaml', expected a YAML file or a study's name"),
        (["policies_minatar", "--status"], "no study in runs/studies/policies_minatar, expected one; begin it with"),
        (["policies_minatar", "--report"], "no study in runs/studies/policies_minatar, expected one; begin it with"),
        (["policies_minatar", "--report", "--dry-run"], "study got several of --dry-run, --status and --report"),
        (["policies_minatar", "--jobs", "1000"], "--jobs is 1000, expected 1 to "),
    ],
)
def test_wrong_use_is_one_line(
    words: list[str], expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(["study", *words])
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith(f"switchmt-snn: {expected}")
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())
