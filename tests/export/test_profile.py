"""Profiles: every count against an independent one, made of hooks on the network's own layers."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import nn

from switchmt_snn.config import METHOD_TRAITS
from switchmt_snn.errors import ExportError, RunFolderError
from switchmt_snn.export import profile, provenance
from switchmt_snn.export.chips.precision import at_precision, effect_of_precision
from switchmt_snn.export.counts.network import count_task
from switchmt_snn.export.folded import fold_agent
from switchmt_snn.runs.description import describe_method
from switchmt_snn.runs.trained import load_agent
from tests.export.export_cases import VARIANTS, RunCommand, make_agent, observations


def hooked_counts(agent, x: np.ndarray, task: int) -> dict[str, int]:
    """Operations of the synaptic modules on the inputs that they really get, as a pass of ones over them."""
    counts: dict[str, int] = {}

    def hook(name: str):
        def count(module, inputs, output) -> None:
            present = (inputs[0] != 0).double()
            weight = (module.weight != 0).double()
            if isinstance(module, nn.Conv2d):
                counts[name] = counts.get(name, 0) + int(F.conv2d(present, weight, stride=module.stride).sum())
            else:
                counts[name] = counts.get(name, 0) + int(F.linear(present, weight).sum())

        return count

    handles = []
    for layer in agent.network.trunk:
        synapses = agent.network.trunk[layer].synapses
        module = synapses[-1] if isinstance(synapses, nn.Sequential) else synapses
        handles.append(module.register_forward_hook(hook(layer)))
    for stream in agent.network.streams.values():
        handles.append(stream.synapses.register_forward_hook(hook("hidden")))
    with torch.no_grad():
        agent.network.eval()(torch.from_numpy(x), task, generator=torch.Generator().manual_seed(0))
    for handle in handles:
        handle.remove()
    return counts


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_counts_equal_hooks_on_the_network(variant: str) -> None:
    agent = make_agent(**VARIANTS[variant])
    with torch.no_grad():  # some weights pruned
        for module in agent.network.modules():
            if isinstance(module, (nn.Conv2d, nn.Linear)):
                module.weight *= torch.rand_like(module.weight) > 0.3
    x = observations(agent, 60)
    for task in range(3):
        profile = count_task(agent, task, x)
        expected = hooked_counts(agent, x, task)
        seen = {layer.name: sum(layer.effective_T) for layer in profile.layers}
        for name, count in expected.items():
            assert seen[name] == count, (name, task)
        activity: dict[str, torch.Tensor] = {}
        with torch.no_grad():
            generator = torch.Generator().manual_seed(0)
            agent.network.eval()(torch.from_numpy(x), task, activity=activity, generator=generator)
        by_layer: dict[str, int] = {}
        for name, values in activity.items():
            layer = name if name in agent.network.trunk else "hidden"
            by_layer[layer] = by_layer.get(layer, 0) + int((values != 0).sum())
        assert {layer.name: sum(layer.spikes_T) for layer in profile.layers if layer.neurons} == by_layer


@pytest.mark.slow
def test_what_is_a_multiplication_and_what_an_accumulation() -> None:
    def kinds(variant: str) -> list[str]:
        agent = make_agent(**VARIANTS[variant])
        return [layer.operation for layer in count_task(agent, 0, observations(agent, 5)).layers]

    assert kinds("SwitchMT") == ["MAC", "AC", "AC"]
    assert kinds("frames") == ["MAC", "AC", "AC"]
    for spikes_in in ("rate", "latency", "events"):
        assert kinds(spikes_in) == ["AC", "AC", "AC"]
    for method, traits in METHOD_TRAITS.items():
        assert traits.spiking or kinds(method) == ["MAC", "MAC", "MAC"]


def test_sums_do_not_depend_on_the_chunks_or_the_batch() -> None:
    agent = make_agent()
    x = observations(agent, 130)
    whole = count_task(agent, 1, x)
    parts = [count_task(agent, 1, part) for part in (x[:64], x[64:65], x[65:])]
    for index, layer in enumerate(whole.layers):
        assert sum(sum(part.layers[index].effective_T) for part in parts) == sum(layer.effective_T)
        assert sum(sum(part.layers[index].spikes_T) for part in parts) == sum(layer.spikes_T)
    assert whole.layers[0].dense_per_decision == 16 * 6 * 9 * 64  # out x channels x kernel x positions, once
    assert whole.layers[1].dense_per_decision == 4 * 1024 * 64  # T x inputs x both streams


def test_the_ann_twin_is_the_dense_network_once() -> None:
    spiking, ann = (make_agent(method=method) for method in ("SwitchMT", "DQN_D"))
    x = observations(spiking, 5)
    macs = 16 * 6 * 9 * 64 + 1024 * 64 + 64 * 6
    assert count_task(spiking, 0, x).dense_macs_of_ann_twin == macs
    assert sum(layer.dense_per_decision for layer in count_task(ann, 0, x).layers) == macs


def test_describe_counts_what_the_profile_calls_dense() -> None:
    """Of networks without dueling: folding makes one head of a dueling network's two."""
    for method in ("DQN", "DSQN", "MTSpark_AD"):
        agent = make_agent(method=method)
        dense = sum(layer.dense_per_decision for layer in count_task(agent, 0, observations(agent, 5)).layers)
        assert describe_method(agent.config, agent.suite).dense_operations_per_decision == dense


def test_wrong_observations_are_refused() -> None:
    agent = make_agent()
    for wrong in (np.zeros((0, *agent.suite.observation_shape), np.uint8), np.zeros((3, 2, 10, 10), np.uint8)):
        with pytest.raises(ExportError, match="recorded observations have shape"):
            count_task(agent, 0, wrong)


@pytest.mark.slow
def test_profile_command(trained_run: Path, run_command: RunCommand) -> None:
    out, _ = run_command("profile", trained_run, "--decisions", 50)
    assert "breakout: per decision, mean of 52" in out
    facts = json.loads((trained_run / "profile" / "profile.json").read_text())
    assert facts["schema"] == 2
    with (trained_run / "profile" / "layers.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    for task in facts["tasks"]:
        for layer in task["layers"]:
            assert layer["accesses"]["weights"] == layer["effective_per_decision"]
        mine = [row for row in rows if row["task"] == task["task"]]
        assert sum(int(row["effective"]) for row in mine) / 52 == pytest.approx(
            task["per_decision"]["acs"] + task["per_decision"]["macs"]
        )
        assert sum(int(row["spikes"]) for row in mine) / 52 == pytest.approx(task["per_decision"]["spikes"])
    out, _ = run_command("profile", trained_run, "--decisions", 50, "--json")
    assert {**json.loads(out), "created": ""} == {**facts, "created": ""}
    _, err = run_command("profile", trained_run, "--decisions", 0, code=2)
    assert "decisions is 0, expected 1 to 10,000,000" in err


@pytest.mark.slow
def test_chips_and_targets_are_chosen_by_name(trained_run: Path, run_command: RunCommand) -> None:
    out, _ = run_command("profile", trained_run, "--decisions", 20, "--target", "speck")
    assert "speck" in out
    facts = json.loads((trained_run / "profile" / "profile.json").read_text())
    assert ([chip["chip"] for chip in facts["chips"]], facts["targets"]) == (["speck"], {})
    assert facts["chips"][0]["fits"], "16 hidden units of a MinAtar network"
    assert facts["tasks"][0]["precision"][0]["bits"] == 8
    _, err = run_command("profile", trained_run, "--target", "spekc", code=2)
    assert "unknown target 'spekc', expected a YAML file" in err
    assert "xylo-audio-3" in err, "all of them"


@pytest.mark.slow
def test_a_chip_of_ones_own_is_checked(trained_run: Path, tmp_path: Path, run_command: RunCommand) -> None:
    """From the command line and from Python: a small copy of a built-in chip with weights of 4 bits."""
    text = (Path(__file__).parents[2] / "export" / "chips" / "builtin" / "loihi-1.yaml").read_text()
    text = text.replace("name: loihi-1", "name: my-chip").replace("cores: 128", "cores: 2")
    (tmp_path / "my.yaml").write_text(text.replace("weight_bits: 8", "weight_bits: 4"))
    out, _ = run_command(
        "profile", trained_run, "--decisions", 20, "--target", tmp_path / "my.yaml", "--target", "speck"
    )
    assert "my-chip" in out
    facts = profile(trained_run, decisions=20, targets=[str(tmp_path / "my.yaml")]).facts
    assert [(chip["chip"], chip["fits"], chip["weight_bits"]) for chip in facts["chips"]] == [("my-chip", False, 4)]
    assert [effect["bits"] for effect in facts["tasks"][0]["precision"]] == [4]
    (tmp_path / "my.yaml").write_text(text.replace("neurons: [IF, LIF, Synaptic]", "neurons: [LIF]"))
    out, _ = run_command("profile", trained_run, "--decisions", 20, "--target", tmp_path / "my.yaml")
    assert "not held: neuron kind IF" in " ".join(out.split())
    (tmp_path / "my.yaml").write_text(text.replace("rule: fan_in", "rule: fan_inn"))
    _, err = run_command("profile", trained_run, "--target", tmp_path / "my.yaml", code=2)
    assert "did you mean 'fan_in'?" in err
    assert len(err.strip().splitlines()) == 1


def test_energy_per_episode_needs_an_evaluation_at_this_step(trained_run: Path) -> None:
    (row,) = [
        row
        for path in (trained_run / "evaluations").glob("*.json")
        for row in json.loads(path.read_text())["tasks"]
        if (row["policy"], row["task"]) == ("agent", "breakout")
    ]
    task = profile(trained_run, decisions=20).facts["tasks"][0]
    assert task["evaluation"]["decisions_per_episode"] == row["mean_length_steps"]
    assert task["evaluation"]["score"] == row["mean"]
    assert task["energy"][0]["per_episode_pj"] == task["energy"][0]["total_pj"] * row["mean_length_steps"]
    assert task["energy"][0]["power_uw"] is None, "MinAtar has no frames per second"
    for path in (trained_run / "evaluations").glob("*.json"):
        path.write_text("{}")
    with pytest.raises(RunFolderError, match="expected an evaluation; delete it"):
        profile(trained_run, decisions=20)
    shutil.rmtree(trained_run / "evaluations")
    task = profile(trained_run, decisions=20).facts["tasks"][0]
    assert (task["evaluation"], task["energy"][0]["per_episode_pj"]) == (None, None)


@pytest.mark.slow
def test_decisions_are_the_same_from_a_longer_recording(trained_run: Path) -> None:
    def counts(decisions: int) -> list:
        return [task["layers"] for task in profile(trained_run, decisions=decisions).facts["tasks"]]

    first = counts(60)
    counts(120)
    assert counts(60) == first
    shutil.rmtree(trained_run / "recordings")
    assert counts(60) == first


@pytest.mark.slow
def test_long_profiles_count_while_they_play(trained_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = profile(trained_run, decisions=400).facts["tasks"]
    shutil.rmtree(trained_run / "recordings")
    monkeypatch.setattr("switchmt_snn.export.profile_run.KEPT_DECISIONS", 40)
    streamed = profile(trained_run, decisions=400).facts["tasks"]
    assert [task["layers"] for task in streamed] == [task["layers"] for task in kept]
    assert [task["precision"][0]["decisions"] for task in streamed] == [40, 40]


@pytest.mark.slow
def test_a_network_without_a_voice_and_an_ann_say_so(trained_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    agent = load_agent(trained_run, "last", "cpu")
    with torch.no_grad():
        for stream in agent.network.streams.values():
            stream.neurons.leaky.threshold.fill_(1e6)
    monkeypatch.setattr("switchmt_snn.export.profile_run.load_agent", lambda *_: agent)
    facts = profile(trained_run, decisions=20).facts
    assert facts["headline"].startswith("No neuron fires in hidden in breakout, hidden in asterix: Q does not depend")
    ann = make_agent(method="DQN_D", tasks={"names": ["breakout", "asterix"]})
    monkeypatch.setattr("switchmt_snn.export.profile_run.load_agent", lambda *_: ann)
    facts = profile(trained_run, decisions=20).facts
    assert facts["headline"].startswith("This is an ANN")
    assert facts["chips"] == []
    assert set(facts["targets"]) == {"cmos45-fp32", "cmos45-int8"}, "only those that multiply"


def test_an_out_that_cannot_be_written_to_is_refused_first(
    trained_run: Path,
    tmp_path: Path,
    run_command: RunCommand,
) -> None:
    (tmp_path / "file").write_text("")
    _, err = run_command("profile", trained_run, "--out", tmp_path / "file" / "inside", code=2)
    assert "inside cannot be written (Not a directory)" in err
    assert not (trained_run / "recordings").exists()


def test_the_commit_is_that_of_this_package_only(tmp_path: Path) -> None:
    shutil.copy(provenance.__file__, tmp_path / "provenance.py")
    for words in (
        ("init", "-q"),
        ("-c", "user.name=x", "-c", "user.email=x", "commit", "-q", "--allow-empty", "-m", "x"),
    ):
        subprocess.run(["git", "-C", tmp_path, *words], check=True)
    code = "import provenance; print(provenance.provenance()['git_commit'])"
    answer = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "unknown"


@pytest.mark.slow
def test_rounded_weights_are_those_of_a_layers_own_step() -> None:
    agent = make_agent()
    for task in range(3):
        rounded = at_precision(fold_agent(agent), task, 8)
        for node, trained_node in zip(rounded.synapses, fold_agent(agent).synapses, strict=True):
            weight, shift = node.folded(task)
            original, expected_shift = trained_node.folded(task)
            step = np.abs(original).max() / 127
            steps = np.abs(weight / step)
            assert np.allclose(steps, np.rint(steps), atol=1e-3)
            assert steps.max() == pytest.approx(127)
            assert np.abs(weight - original).max() <= step * 0.5001
            assert np.array_equal(shift, expected_shift)
    coarse, fine = (effect_of_precision(agent, 0, bits, observations(agent, 100)) for bits in (3, 16))
    assert fine.equal_actions_share > coarse.equal_actions_share
    assert fine.decisions_with_flips < coarse.decisions_with_flips


def test_bad_profiles_are_refused_in_one_line(
    trained_run: Path,
    tmp_path: Path,
    run_command: RunCommand,
) -> None:
    _, err = run_command("profile", tmp_path / "nothing.nir", "--observations", tmp_path / "x.npz", code=2)
    assert "cannot be read" in err
    _, err = run_command("profile", trained_run, "--observations", tmp_path / "x.npz", code=2)
    assert "belong together" in err
    _, err = run_command("profile", tmp_path / "graph.nir", code=2)
    assert "belong together" in err
    recording = trained_run / "recordings" / "breakout-step-600.npz"
    recording.parent.mkdir(exist_ok=True)
    recording.write_bytes(b"PK damaged")
    _, err = run_command("profile", trained_run, code=2)
    assert "cannot be read" in err


def test_weights_that_are_not_numbers_are_refused(trained_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    agent = load_agent(trained_run, "last", "cpu")
    with torch.no_grad():
        agent.network.streams["value"].head.weight[0, 0] = torch.nan
    monkeypatch.setattr("switchmt_snn.export.profile_run.load_agent", lambda *_: agent)
    with pytest.raises(ExportError, match="not finite"):
        profile(trained_run)
    assert not (trained_run / "profile").exists()
