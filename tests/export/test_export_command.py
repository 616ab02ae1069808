"""``switchmt-snn export`` and ``evaluate --runtime`` on a run folder, right and wrong."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from switchmt_snn.errors import ExportError
from switchmt_snn.export import ExportSettings, export, export_run
from switchmt_snn.runs.folder import RunFolder
from tests.export.export_cases import RunCommand


@pytest.mark.slow
def test_export_writes_checks_and_the_files_play(trained_run: Path, run_command: RunCommand) -> None:
    out, _ = run_command("export", trained_run, "--onnx", "--nir", "--task", "asterix", "--parity-decisions", 200)
    assert "Parity with the trained network" in out
    folder = trained_run / "export"
    assert {path.name for path in folder.iterdir()} == {
        "decision.onnx",
        "decision_asterix.onnx",
        "step.onnx",
        "breakout.nir",
        "breakout.json",
        "asterix.nir",
        "asterix.json",
        "parity.json",
        "MODEL_CARD.md",
    }
    parity = json.loads((folder / "parity.json").read_text())
    assert parity["failures"] == []
    assert all(row["bitwise"] and row["exact_arithmetic"] for row in parity["dyadic"])
    assert all(total > 0 for row in parity["dyadic"] for total in row["spikes"].values())
    assert [(row["task"], row["runtime"], row["decisions"]) for row in parity["recorded"]] == [
        ("breakout", "onnx", 200),
        ("breakout", "nir", 200),
        ("asterix", "onnx", 200),
        ("asterix", "onnx, one task", 200),
        ("asterix", "nir", 200),
    ]
    assert parity["protocol"]["asterix"] == {"decisions": 200, "epsilon": 0.05, "seed": 10_000}
    beside = json.loads((folder / "asterix.json").read_text())
    assert beside["task"] == "asterix"
    assert beside["config_sha256"] == parity["config_sha256"]
    scores = {}
    for engine in ("torch", "onnx", "nir"):
        out, _ = run_command("evaluate", trained_run, "--runtime", engine, "--episodes", 4, "--json")
        result = json.loads(out)
        scores[engine] = [(row["task"], row["mean"], row["mean_length_steps"]) for row in result["tasks"]]
        assert engine == "torch" or result["equal_actions_share"] == 1.0
    assert scores["torch"] == scores["onnx"] == scores["nir"]
    (played,) = (folder / "evaluations").glob("nir_step-*.json")
    assert json.loads(played.read_text())["equal_actions_share"] == 1.0
    out, _ = run_command("evaluate", trained_run, "--runtime", "onnx", "--episodes", 2, "--task", "asterix")
    assert "100.00% of its decisions are those of the trained network" in out


def test_without_a_format_everything_that_fits_is_written(trained_run: Path, run_command: RunCommand) -> None:
    out, _ = run_command(
        "export", trained_run, "--parity-decisions", 20, "--out", trained_run / "elsewhere", "--int8", "--json"
    )
    result = json.loads(out)
    assert set(result["files"]) == {"decision.onnx", "step.onnx", "breakout.nir", "asterix.nir"}
    assert [row["equal_actions_share"] for row in result["parity"]["int8_storage"]] == [1.0, 1.0]
    assert (trained_run / "elsewhere" / "decision.onnx").stat().st_size < (
        trained_run / "elsewhere" / "breakout.nir"
    ).stat().st_size


@pytest.mark.slow
def test_recorded_play_is_real_kept_and_checked(trained_run: Path, run_command: RunCommand) -> None:
    run_command("export", trained_run, "--onnx", "--parity-decisions", 50)
    first = trained_run / "recordings" / "breakout-step-600.npz"
    with np.load(first) as stored:
        observations, actions = stored["observations"], stored["actions"]
    assert len(observations) == len(actions) == 52  # four copies of the task, whole steps
    assert len(np.unique(observations.reshape(52, -1), axis=0)) >= 10
    before = first.stat().st_mtime_ns
    run_command("export", trained_run, "--onnx", "--parity-decisions", 40)
    assert first.stat().st_mtime_ns == before
    first.write_bytes(b"not an archive")
    _, err = run_command("export", trained_run, "--onnx", "--parity-decisions", 40, code=2)
    assert "cannot be read" in err
    assert "delete it" in err


@pytest.mark.slow
def test_wrong_use_is_one_line(trained_run: Path, tmp_path: Path, run_command: RunCommand) -> None:
    for words, message in (
        ((tmp_path / "nowhere",), "no run folder"),
        ((trained_run, "--task", "pong"), "unknown task 'pong'"),
        ((trained_run, "--nir-dialect", "exakt"), "exakt"),
        ((trained_run, "--nir", "--task", "asterix"), "expected --onnx with it"),
        ((trained_run, "--parity-decisions", "0"), "parity_decisions is 0, expected at least 1"),
        ((trained_run, "--out", trained_run / "config.yaml"), "config.yaml"),
        ((trained_run, "--checkpoint", "best"), "no whole best checkpoint"),
    ):
        _, err = run_command("export", *words, code=2)
        assert message in err
        assert len(err.strip().splitlines()) == 1, err
    _, err = run_command("evaluate", trained_run, "--runtime", "onnx", code=2)
    assert f"export it: switchmt-snn export {trained_run} --onnx\n" in err
    run_command("export", trained_run, "--onnx", "--parity-decisions", 20)
    (trained_run / "export" / "decision.onnx").write_bytes(b"damaged")
    _, err = run_command("evaluate", trained_run, "--runtime", "onnx", code=2)
    assert "is not the file that export compared" in err
    (trained_run / "export" / "parity.json").unlink()
    _, err = run_command("evaluate", trained_run, "--runtime", "onnx", code=2)
    assert "parity.json cannot be read" in err


@pytest.mark.slow
def test_an_export_of_an_older_step_does_not_pass_for_the_newer_one(trained_run: Path, run_command: RunCommand) -> None:
    run_command("export", trained_run, "--onnx", "--parity-decisions", 20)
    run_command("train", "--run", trained_run, "--total-steps", 620)
    _, err = run_command("evaluate", trained_run, "--runtime", "onnx", code=2)
    assert "of step 600, expected 620" in err
    assert err.endswith(f"export it: switchmt-snn export {trained_run}\n")


def test_the_export_that_an_error_asks_for_has_the_checkpoint_that_is_played(tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "a run")
    with pytest.raises(ExportError, match=rf"export it: switchmt-snn export '{run.path}' --onnx --checkpoint best$"):
        export_run.step_session(run, "best")


@pytest.mark.slow
def test_a_failed_parity_exits_1_and_names_the_layer(
    trained_run: Path, run_command: RunCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A writer with a wrong threshold in one layer."""
    from switchmt_snn.export.formats import files
    from switchmt_snn.export.formats.onnx_writer import decision_model, step_model
    from switchmt_snn.export.parity import proof
    from tests.export.test_export import with_wrong_layer

    for module in (files, proof):
        monkeypatch.setattr(module, "decision_model", lambda n, task=None: decision_model(with_wrong_layer(n, 1), task))
        monkeypatch.setattr(module, "step_model", lambda n: step_model(with_wrong_layer(n, 1)))
    _, err = run_command("export", trained_run, "--onnx", "--parity-decisions", 20, code=1)
    assert "parity failed" in err
    assert "first in layer hidden" in err
    assert json.loads((trained_run / "export" / "parity.json").read_text())["failures"]


@pytest.mark.slow
def test_the_same_from_python(trained_run: Path) -> None:
    """A run folder, an agent and a bare network."""
    from switchmt_snn import load_agent
    from switchmt_snn.errors import ExportError, TaskError
    from switchmt_snn.export import check_parity, to_nir, to_onnx

    agent = load_agent(trained_run, device="cpu")
    from_run, from_agent = (to_onnx(source).SerializeToString() for source in (trained_run, agent))
    assert from_run == from_agent
    assert to_nir(trained_run, "asterix").metadata["task"] == "asterix"
    assert "task" not in [value.name for value in to_onnx(agent, task="asterix").graph.input]
    assert [value.name for value in to_onnx(trained_run, "step").graph.input][:2] == ["encoded", "task"]
    with pytest.raises(TaskError, match="unknown task 'pong'"):
        to_nir(trained_run, "pong")
    observations = {
        name: agent.suite.make(k, 1).reset(np.array([0]), np.array([0])) for k, name in enumerate(agent.suite.names)
    }
    assert check_parity(agent, observations)["failures"] == []
    bare = agent.network
    result = check_parity(bare, {"task_0": observations["breakout"], "task_1": observations["asterix"]})
    assert result["failures"] == []
    assert {row["runtime"] for row in result["recorded"]} == {"onnx", "nir"}
    with pytest.raises(ExportError, match="pass observations="):
        check_parity(bare)


@pytest.mark.slow
@pytest.mark.parametrize("written", [(np, "savez_compressed"), (export_run, "write_nir")])
def test_two_exports_of_one_run_at_once_do_not_meet(
    trained_run: Path, monkeypatch: pytest.MonkeyPatch, written: tuple[Any, str]
) -> None:
    """A whole second export comes between a file of the first and its renaming."""
    settings = ExportSettings(nir=True, parity_decisions=20)
    module, name = written
    write, seconds = getattr(module, name), []

    def write_and_export_again(*arguments: Any, **named: Any) -> None:
        write(*arguments, **named)
        if not seconds:
            seconds.append("begun")
            seconds.append(export(trained_run, settings).parity["failures"])

    monkeypatch.setattr(module, name, write_and_export_again)
    first = export(trained_run, settings)
    assert seconds == ["begun", []]
    assert first.parity["failures"] == []
    assert all(path.is_file() for path in first.files.values())
    assert not [path for path in trained_run.rglob("*") if ".tmp" in path.name]
