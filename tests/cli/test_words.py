"""Words of the command line, in and out: order, numbers, help, names of commands, encodings and widths."""

from __future__ import annotations

import io
import json
import os
import shlex
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from switchmt_snn.acting.evaluation import Evaluation, EvaluationProtocol, TaskScore
from switchmt_snn.cli import main
from switchmt_snn.cli.entry import COMMANDS
from switchmt_snn.cli.evaluate import EvaluateOptions
from switchmt_snn.cli.export import ExportOptions
from switchmt_snn.cli.parsing import for_another_suite, for_named_tasks, parse, split, split_one
from switchmt_snn.cli.study import StudyOptions, how_to_go_on
from switchmt_snn.cli.train import TrainOptions, launcher
from switchmt_snn.config import ExperimentConfig, from_dict, load_config, presets
from switchmt_snn.config.numbers import whole_number
from switchmt_snn.errors import ConfigError
from switchmt_snn.machine import program as names
from switchmt_snn.viewing.output import FILE_COLUMNS, console, each_warning_once
from switchmt_snn.viewing.tables import evaluation_table, parity_table
from tests.tasks.odd_envs import Plain

TRAIN = TrainOptions(experiment=ExperimentConfig())
PONG = ["Pong-of-somebody-with-a-long-name-v0", "pong"]


def call(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as stop:
        main(list(words))
    out = capsys.readouterr()
    return int(stop.value.code or 0), out.out, out.err


@pytest.mark.parametrize(
    "words",
    [
        ["a", "--episodes", "5", "--json"],
        ["--episodes", "5", "a", "--json"],
        ["--episodes=5", "--json", "a"],
        ["--json", "a", "--episodes", "5"],
    ],
)
def test_a_run_may_stand_before_between_and_after_options(words: list[str]) -> None:
    name, flags = split_one(EvaluateOptions, words, "evaluate", EvaluateOptions())
    assert name == "a"
    assert sorted(flags) == sorted(word for word in words if word != "a")


def test_a_list_takes_the_words_up_to_the_next_flag() -> None:
    words = ["--tasks.names", "pong", "breakout", "--seed", "-1", "paper", "--tasks.num_envs", "3"]
    assert split(TrainOptions, words, "train", TRAIN) == (["paper"], [word for word in words if word != "paper"])
    assert split(ExportOptions, ["--task", "a", "run", "--task", "b"], "export", ExportOptions()) == (
        ["run"],
        ["--task", "a", "--task", "b"],
    )


def test_an_older_spelling_takes_its_value() -> None:
    words = ["--engine", "onnx", "run"]
    assert split_one(EvaluateOptions, words, "evaluate", EvaluateOptions()) == ("run", ["--engine", "onnx"])


def test_two_runs_where_one_is_expected_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = call(capsys, "evaluate", "a", "--json", "b")
    assert (code, err) == (2, "switchmt-snn: evaluate got a b, expected one RUN; see switchmt-snn evaluate --help\n")


@pytest.mark.slow
@pytest.mark.parametrize("text", ["1e6", "1000000", "1_000_000", "1.0e6"])
def test_a_number_of_steps_as_people_write_it(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = call(capsys, "train", "--total-steps", text, "--tasks.frame-stack", "2", "--print-config")
    assert code == 0
    assert "\ntotal_steps: 1000000\n" in out
    assert from_dict({"total_steps": text}).total_steps == whole_number(text) == 1_000_000


@pytest.mark.parametrize("text", ["1.5", "many", "inf", "nan", ""])
def test_what_is_no_whole_number_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is not a whole number such as 1000000 or 1e6"):
        whole_number(text)
    with pytest.raises(ConfigError, match="expected a whole number"):
        from_dict({"total_steps": text})


@pytest.mark.slow
@pytest.mark.parametrize("command", ["train", "describe"])
def test_help_names_config_and_the_presets(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = call(capsys, command, "--help")
    assert code == 0
    assert f"usage: switchmt-snn {command} [CONFIG]" in out
    assert next(iter(presets())) == "quickstart"
    for preset, text in presets().items():
        assert preset in out
        assert len(text) > 20
        load_config(preset)


@pytest.mark.parametrize("command", ["evaluate", "export", "profile"])
def test_help_names_run(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    _, out, _ = call(capsys, command, "--help")
    assert f"usage: switchmt-snn {command} [RUN]" in out
    assert "begun last" in out


def test_commands_in_messages_begin_as_the_program_was_called(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = tmp_path / "switchmt-snn"
    script.write_text("")
    script.chmod(0o755)
    text = "run switchmt-snn train; switchmt-snn: x; /elsewhere/switchmt-snn train; switchmt-snn walks"
    monkeypatch.setattr(sys, "argv", [str(script), "train"])
    monkeypatch.setenv("PATH", "/nowhere")
    assert names.runnable(text) == text.replace("run switchmt-snn train", f"run {script} train")
    for command in COMMANDS:
        assert names.runnable(f"switchmt-snn {command}") == f"{script} {command}"
    monkeypatch.setenv("PATH", str(tmp_path))
    assert names.runnable(text) == text
    monkeypatch.setattr(sys, "argv", ["/somewhere/switchmt_snn/__main__.py", "train"])
    assert names.program() == f"{sys.executable} -m switchmt_snn"
    monkeypatch.setattr(sys, "argv", ["my_script.py"])
    assert names.program() == "switchmt-snn"


@pytest.mark.slow
def test_a_printed_command_runs(tmp_path: Path) -> None:
    """Off the PATH, the remedy of an error is followed as it is printed."""
    environment = {**os.environ, "PATH": "/usr/bin:/bin"}
    words = [sys.executable, "-m", "switchmt_snn", "evaluate", "--nothing"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.returncode == 2
    remedy = done.stderr.strip().split("see ")[-1]
    again = subprocess.run(remedy, shell=True, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert again.returncode == 0, again.stderr
    assert "usage: switchmt-snn evaluate [RUN]" in again.stdout


@pytest.mark.slow
@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252", "utf-8"])
def test_streams_of_any_encoding_take_every_character(encoding: str, tmp_path: Path) -> None:
    code = (
        "from switchmt_snn.viewing.output import speak_any_encoding, console; speak_any_encoding();"
        "from switchmt_snn.viewing.tables import _table; t = _table('Energy in µJ', 'ä ± × … 語 \\udcff');"
        "t.add_column('µ'); t.add_row('±1'); console().print(t); print('done µ ± 語 \\udcff')"
    )
    environment = {**os.environ, "PYTHONIOENCODING": encoding, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, env=environment, cwd=tmp_path)
    assert done.returncode == 0, done.stderr.decode(errors="replace")
    text = done.stdout.decode(encoding)
    assert "done" in text
    if encoding == "ascii":
        assert text.splitlines()[-1] == "done u +- \\u8a9e \\udcff"


@pytest.mark.slow
def test_a_printed_config_is_the_same_in_any_encoding(tmp_path: Path) -> None:
    """Letters outside ASCII are escaped, not spelled out."""
    words = [sys.executable, "-m", "switchmt_snn", "train", "--name", "prüfung", "--print-config"]
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(words, capture_output=True, env=environment, check=True)
    (tmp_path / "q.yaml").write_bytes(done.stdout)
    assert load_config(tmp_path / "q.yaml").name == "prüfung"


def evaluated(task: str, suite: str) -> Evaluation:
    rows = [
        TaskScore(policy, task, 30, mean, mean, 1234.5, None, 1234.0, -16.9)
        for policy, mean in (("agent", 1234567.0), ("random", -20.7))
    ]
    protocol = EvaluationProtocol(30, 0.05, 10_000, 8, suite)
    return Evaluation(protocol, 1_000, tuple(rows), ())


def printed(evaluation: Evaluation, width: int) -> str:
    stream = io.StringIO()
    Console(file=stream, width=width, force_terminal=False).print(evaluation_table(evaluation))
    return stream.getvalue()


@pytest.mark.parametrize("width", [80, 200])
@pytest.mark.parametrize("task", PONG)
def test_tables_cut_no_word_and_no_number(width: int, task: str) -> None:
    text = printed(evaluated(task, "gym"), width)
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= width
    for number in ("1234567.00", "-20.70", "1234.50", "-16.900"):
        assert text.count(number) >= 1
    names = "".join(line.split("  ")[0].strip() for line in text.splitlines())
    assert task in names or task in text


def test_agent_random_and_published_scores_of_a_task_stand_together() -> None:
    lines = [line.split() for line in printed(evaluated("pong", "atari"), 100).splitlines() if line[1:5] == "pong"]
    assert [line[1] for line in lines[:2]] == ["agent", "random"]
    assert len(lines) > 3, "rows of publications follow"


def test_tables_in_files_have_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    assert console().width == FILE_COLUMNS
    monkeypatch.setenv("COLUMNS", "90")
    assert console().width == 90


def test_what_environments_print_is_not_mixed_with_json(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Plain, "reward", lambda self, action: print("hello") or 0.0)
    code, out, err = call(capsys, "check-env", "tests.tasks.odd_envs:Plain-v0", "--steps", "40", "--json")
    assert code == 0
    assert json.loads(out)[0]["task"] == "tests.tasks.odd_envs:Plain-v0"
    assert "hello" in err


@pytest.mark.parametrize(
    ("words", "presets_named", "command"),
    [
        ("--tasks.suite gym --tasks.names CartPole-v1", "cartpole, classic", "train cartpole {}"),
        ("quickstart --tasks.suite=gym --tasks.names A-v0 B-v0 --seed 2", "cartpole, classic", "train classic {}"),
        ("classic --tasks.names asterix --tasks.suite minatar", "minatar", "train minatar {}"),
        ("cartpole --tasks.suite atari --tasks.names pong", "quickstart, fast, paper, pong", "train pong {}"),
    ],
)
def test_tasks_of_another_suite_than_the_presets_are_told_its_presets(
    words: str, presets_named: str, command: str
) -> None:
    """Its remedy, when followed, has nothing more to say; a run's folder, which exists by then, is left out."""
    said, flags = suite_note([*words.split(), "--run", "runs/x"])
    assert said is not None
    assert f"; presets for that suite: {presets_named}" in said
    again = shlex.split(said.partition(" Try: ")[2])
    assert again == ["switchmt-snn", *command.format(" ".join(flags[:-2])).split()]
    assert suite_note(again[2:])[0] is None


def test_a_suite_without_a_preset_and_a_config_of_ones_own() -> None:
    default = load_config("quickstart")
    config = replace(default, tasks=replace(default.tasks, suite="tests.tasks.test_suites:Counting", names=("a",)))
    said = for_another_suite(None, default, config, [], "train")
    assert said is not None
    assert said.endswith("no preset is for that suite, so write a config of your own (docs/configuration.md)")
    assert for_another_suite("my.yaml", default, config, [], "train") is None


def suite_note(words: list[str]) -> tuple[str | None, list[str]]:
    """What train says about suites, and the flags."""
    source, flags = split_one(TrainOptions, words, "train", TRAIN)
    default = for_named_tasks(load_config(source or "quickstart"), flags)
    config = parse(TrainOptions, flags, "train", TrainOptions(experiment=default)).experiment
    return for_another_suite(source, default, config, flags, "train"), flags


@pytest.mark.parametrize("spiking", [False, True])
def test_a_table_of_parity_speaks_of_spikes_where_there_are_some(spiking: bool) -> None:
    row: dict[str, Any] = {
        "task": "pong",
        "runtime": "onnx",
        "decisions": 32,
        "equal_actions_share": 1.0,
        "decisions_with_flips": 0,
        "flipped_spikes": {"conv1": 0} if spiking else {},
        "largest_q_difference": 0.0,
        "bitwise": True,
    }
    stream = io.StringIO()
    Console(file=stream, width=200).print(parity_table({"dyadic": [row], "recorded": [row], "simulators": []}))
    text = stream.getvalue()
    assert ("spike" in text) == ("flips:" in text) == spiking
    assert "every Q-value" in text


def test_a_warning_is_shown_once_although_a_library_resets_pythons_memory(capsys: pytest.CaptureFixture[str]) -> None:
    with warnings.catch_warnings():  # pytest's own record
        warnings.resetwarnings()
        warnings.showwarning = lambda message, *_: print(message)
        with each_warning_once():
            for text in ("a", "b", "a"):
                warnings.warn(text, stacklevel=1)
                with warnings.catch_warnings():
                    pass
        warnings.warn("a", stacklevel=1)
    assert capsys.readouterr().out.split() == ["a", "b", "a"]


def test_a_study_is_continued_as_it_was_begun() -> None:
    assert how_to_go_on(Path("my study"), StudyOptions()) == "switchmt-snn study 'my study'"
    options = StudyOptions(jobs=2, engine="ray", address="host:6379", gpus_per_trial=0.5, seeds=(1, 2))
    assert how_to_go_on(Path("s"), options) == (
        "switchmt-snn study s --jobs 2 --engine ray --address host:6379 --gpus-per-trial 0.5"
    )


def test_a_training_is_continued_by_as_many_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    assert launcher() == "switchmt-snn"
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    assert launcher() == "torchrun --nproc-per-node 2 -m -- switchmt_snn"
