"""A small trained run, and the command line as a function."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import yaml

from switchmt_snn.cli import main
from tests.export.export_cases import RunCommand

CONFIG = {
    "name": "exported",
    "seed": 5,
    "total_steps": 600,
    "threads": 1,
    "device": "cpu",
    "tasks": {"suite": "minatar", "names": ["breakout", "asterix"], "num_envs": 2},
    "network": {"hidden_units": 16, "timesteps": 2},
    "learning": {"batch_size": 8, "learning_starts_steps": 50, "replay_capacity_steps": 600, "update_every_steps": 4},
    "switching": {"max_stay_steps": 100},
    "evaluation": {"episodes": 2, "num_envs": 2},
}


@pytest.fixture(scope="session")
def trained_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run that all tests share; only read it, or take ``trained_run``."""
    folder = tmp_path_factory.mktemp("trained")
    (folder / "config.yaml").write_text(yaml.safe_dump(CONFIG))
    with pytest.raises(SystemExit) as stop:
        main(["train", str(folder / "config.yaml"), "--run", str(folder / "run")])
    assert stop.value.code == 0
    return folder / "run"


@pytest.fixture
def trained_run(trained_once: Path, tmp_path: Path) -> Path:
    """A copy of the trained run that a test may change."""
    return Path(shutil.copytree(trained_once, tmp_path / "run"))


@pytest.fixture
def run_command(capsys: pytest.CaptureFixture[str]) -> RunCommand:
    """``run_command("profile", run, code=0)`` calls the command line, checks its exit code, returns both outputs."""

    def call(*words: object, code: int = 0) -> tuple[str, str]:
        with pytest.raises(SystemExit) as stop:
            main([str(word) for word in words])
        out, err = capsys.readouterr()
        assert stop.value.code == code, err
        assert "Traceback" not in err
        return out, err

    return call
