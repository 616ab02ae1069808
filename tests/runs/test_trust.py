"""A module that a stored file names is imported only for its maker, or for a user who names or trusts it."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import gymnasium
import pytest
import yaml

from switchmt_snn import load_agent, train
from switchmt_snn.cli import main
from switchmt_snn.config import from_dict, trust
from switchmt_snn.errors import UntrustedError
from switchmt_snn.runs.packing import pack
from switchmt_snn.study.folder import StudyFolder
from switchmt_snn.study.grid import load_study

RUN = Path(__file__).parents[1] / "fixtures" / "runs" / "gym"
EVIL = """
from pathlib import Path
Path("imported").touch()
"""
OWN = """
import gymnasium
gymnasium.register("Own-v0", "gymnasium.envs.classic_control:CartPoleEnv", max_episode_steps=20)
"""
PLANTS: dict[str, dict[str, Any]] = {
    "task": {"tasks": {"names": ["evil:Acrobot-v1", "CartPole-v1"]}},
    "later task": {"tasks": {"later_names": ["evil:Acrobot-v1", "CartPole-v1"], "later_from_steps": 10}},
    "wrapper": {"tasks": {"wrappers": ["evil:Wrapper"]}},
    "suite": {"tasks": {"suite": "evil:Suite"}},
    "neuron": {"network": {"neuron": "evil:Neuron"}},
    "encoding": {"network": {"encoding": "evil:Encoding"}},
    "policy": {"switching": {"policy": "evil:Policy"}},
}
BUILDS = (
    ["evaluate", "stranger"],
    ["play", "stranger"],
    ["export", "stranger"],
    ["profile", "stranger"],
    ["train", "--run", "stranger"],
    ["train", "--run", "stranger", "--total-steps", "900"],
    ["train", "stranger/config.yaml", "--run", "mine"],
    ["describe", "stranger/config.yaml"],
    ["study", "grid.yaml"],
    ["study", "grid.yaml", "--dry-run"],
)
"""Commands that build the tasks or the network of a stored config."""
READS = (
    ["report", "stranger"],
    ["runs", "."],
    ["pack", "stranger"],
    ["replay-policies", "stranger"],
    ["evaluate", "stranger", "--task", "CartPole-v1", "--episodes", "1"],
    ["study", "grid.yaml", "--status"],
)


def planted(settings: dict[str, Any]) -> None:
    """The folder ``stranger`` in the current one: a run whose config names ``evil``, which lies beside it."""
    shutil.copytree(RUN, "stranger")
    config = yaml.safe_load(Path("stranger/config.yaml").read_text())
    for section, values in settings.items():
        config[section] |= values
    Path("stranger/config.yaml").write_text(yaml.safe_dump(config))
    Path("evil.py").write_text(EVIL)
    Path("grid.yaml").write_text("base: stranger/config.yaml\nseeds: 1\n")


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for module in ("evil", "own_tasks"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    gymnasium.registry.pop("Own-v0", None)


def called(argv: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """A command's exit code and what it said, each in a process that knows nothing (``trust.known``)."""
    trust.known = trust.Known()
    with pytest.raises(SystemExit) as stop:
        main(argv)
    return int(stop.value.code or 0), capsys.readouterr().err


@pytest.mark.parametrize("plant", PLANTS)
def test_no_command_imports_what_a_strangers_run_names(plant: str, capsys: pytest.CaptureFixture[str]) -> None:
    planted(PLANTS[plant])
    trains = [argv for argv in BUILDS if argv[0] in ("train", "study")]
    for argv in trains if plant == "policy" else BUILDS:  # only training needs the policy
        code, error = called(argv, capsys)
        assert not Path("imported").exists(), argv
        assert (code, error.count("\n")) == (2, 1), (argv, error)
        assert "stranger names the module evil" in error, (argv, error)
        assert "--trust" in error, (argv, error)
    assert not Path("mine").exists()
    assert not Path("runs").exists()


@pytest.mark.parametrize("plant", PLANTS)
def test_commands_that_read_import_nothing(plant: str, capsys: pytest.CaptureFixture[str]) -> None:
    planted(PLANTS[plant])
    for argv in READS:
        called(argv, capsys)
        assert not Path("imported").exists(), argv
    if plant != "policy":
        with pytest.raises(UntrustedError, match="evil"):
            load_agent("stranger")
    if plant != "task":  # of which the logs know nothing
        assert called(["runs", "."], capsys) == (0, "")
        assert called(["report", "stranger"], capsys)[0] == 0
    assert not Path("imported").exists()


def test_an_old_evaluation_names_no_module(capsys: pytest.CaptureFixture[str]) -> None:
    planted({})
    path = next(Path("stranger/evaluations").glob("*.json"))
    evaluation = json.loads(path.read_bytes())
    evaluation["protocol"] |= {"suite": "evil:Suite"}
    evaluation["protocol"].pop("environment", None)
    path.write_text(json.dumps(evaluation))
    for argv in (["runs", "."], ["report", "stranger"], ["pack", "stranger"], ["train", "--run", "stranger"]):
        called(argv, capsys)
        assert not Path("imported").exists(), argv


@pytest.mark.parametrize(
    "argv",
    [
        ["evaluate", "stranger", "--trust"],
        ["train", "--run", "stranger", "--trust"],
        ["describe", "stranger/config.yaml", "--trust"],
        ["evaluate", "stranger", "--task", "evil:Acrobot-v1"],
        ["train", "named.yaml", "--run", "stranger"],
    ],
)
def test_what_the_user_trusts_or_names_is_imported(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    planted(PLANTS["task"])
    shutil.copy("stranger/config.yaml", "named.yaml")
    called(argv, capsys)
    assert Path("imported").exists()


def test_a_folders_name_trusts_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    planted(PLANTS["task"])
    Path("stranger").rename("evil:Run")
    for argv in (["evaluate", "evil:Run"], ["train", "--run", "evil:Run"], ["train", "--run=evil:Run"]):
        assert called(argv, capsys)[0] == 2
        assert not Path("imported").exists(), argv


def own_run() -> None:
    """The run ``mine`` of this user, whose tasks the module ``own_tasks`` registers."""
    Path("own_tasks.py").write_text(OWN)
    config = {"total_steps": 60, "threads": 1, "tasks": {"suite": "gym", "names": ["own_tasks:Own-v0"]}}
    config |= {"network": {"hidden_units": 8, "timesteps": 1}, "evaluation": {"episodes": 1, "num_envs": 1}}
    train(from_dict(config), run="mine")


def test_its_maker_needs_no_flag(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    state = tmp_path / "state"
    monkeypatch.setenv("XDG_STATE_HOME", str(state))
    own_run()
    key = state / "switchmt-snn" / "trust.key"
    assert (key.stat().st_mode & 0o777, key.stat().st_size) == (0o600, 32)
    shutil.copytree("mine", "renamed")
    for argv in (["evaluate", "mine"], ["evaluate", "renamed"], ["train", "--run", "mine", "--total-steps", "70"]):
        code, error = called(argv, capsys)
        assert code == 0, error

    pack("mine", "packed")  # is given away without the signature
    code, error = called(["evaluate", "packed"], capsys)
    assert code == 2
    assert "packed names the module own_tasks" in error
    assert called(["evaluate", "packed", "--trust"], capsys)[0] == 0

    config = yaml.safe_load(Path("renamed/config.yaml").read_text())  # the signature is over its names
    config["switching"]["policy"] = "evil:Policy"
    Path("renamed/config.yaml").write_text(yaml.safe_dump(config))
    code, error = called(["evaluate", "renamed"], capsys)
    assert code == 2
    assert "the modules evil, own_tasks" in error

    key.chmod(0o644)
    code, error = called(["evaluate", "mine"], capsys)
    assert code == 2
    assert "none is known as yours" in error
    assert "only you can read" in error
    key.chmod(0o600)
    key.rename(tmp_path / "moved.key")
    key.symlink_to(tmp_path / "moved.key")
    assert called(["evaluate", "mine"], capsys)[0] == 2
    key.unlink()  # somebody else's key
    assert called(["evaluate", "mine"], capsys)[0] == 2


def test_a_user_without_a_key_is_told_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "no folder").write_text("")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "no folder"))
    Path("own_tasks.py").write_text(OWN)
    words = ["train", "quickstart", "--total-steps", "40", "--tasks.suite", "gym", "--tasks.names"]
    words += ["own_tasks:Own-v0", "--tasks.frame-stack", "1", "--evaluation.episodes", "1", "--run", "mine"]
    code, error = called([*words, "--json"], capsys)
    assert code == 0, error
    assert error.count("later commands on it need --trust") == 1
    code, error = called(["evaluate", "mine"], capsys)
    assert code == 2
    assert "none is known as yours" in error
    assert called(["evaluate", "mine", "--trust"], capsys)[0] == 0
    assert called(words, capsys)[0] == 0  # the same command continues


def test_a_strangers_study(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    Path("own_tasks.py").write_text(OWN)
    Path("grid.yaml").write_text(
        "base: quickstart\nsettings: {total_steps: 40, threads: 1, tasks: {suite: gym, names: ['own_tasks:Own-v0'], "
        "frame_stack: 1}, network: {hidden_units: 8, trunk: auto}, evaluation: {episodes: 1}}\n"
    )
    StudyFolder(Path("study")).prepare(load_study("grid.yaml"))
    Path("own_tasks.py").write_text(EVIL)
    assert called(["study", "study", "--status"], capsys)[0] == 0
    StudyFolder(Path("study")).prepare(StudyFolder(Path("study")).study())  # its maker's

    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "another"))
    for words in ([], ["--dry-run"]):
        code, error = called(["study", "study", *words], capsys)
        assert code == 2
        assert "names the module own_tasks" in error
    assert not Path("imported").exists()
    assert not any(Path("study/trials").iterdir())


def test_a_study_names_no_folder_outside(capsys: pytest.CaptureFixture[str]) -> None:
    Path("grid.yaml").write_text("base: classic\n")
    StudyFolder(Path("study")).prepare(load_study("grid.yaml"))
    listed = json.loads(Path("study/trials.json").read_bytes())
    listed["trials"][0]["name"] = "../outside"
    Path("study/trials.json").write_text(json.dumps(listed))
    shutil.copy(next(Path("study/configs").glob("*.yaml")), "study/outside.yaml")
    code, error = called(["study", "study"], capsys)
    assert code == 2
    assert "'../outside' is no name of a trial" in error
