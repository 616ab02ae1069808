"""Energy: by hand from counts and constants; targets that are wrong are refused; every built-in one has its origin."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from switchmt_snn.errors import ConfigError
from switchmt_snn.export.counts.network import LayerCounts, TaskCounts
from switchmt_snn.export.energy.estimate import TARGETS, Memory, Target, estimate, read_target
from switchmt_snn.export.energy.traffic import traffic
from switchmt_snn.export.yaml_files import parse
from tests.export.export_cases import RunCommand

TEXTS = dict.fromkeys(("name", "title", "chip", "process", "source", "includes", "leaves_out"), "x")
TARGET = {**TEXTS, "evidence": "measured", "unit": "pJ", "operations": {"ac": 2.0, "mac": 10.0, "neuron_update": 3.0}}


def layer(name: str, operation: str, effective: int, dense: int, neurons: int, spikes: int, conv=False) -> LayerCounts:
    """Ten decisions of two steps; a first layer works once."""
    steps = 1 if operation == "MAC" else 2
    return LayerCounts(
        name=name,
        convolution=conv,
        operation=operation,
        decisions=10,
        effective_T=(effective // steps,) * steps,
        active_inputs_T=(30,) * steps,
        inputs=5,
        dense_per_decision=dense * steps,
        weights=100,
        outputs=neurons or 2,
        neurons=neurons,
        states=1,
        spikes_T=(spikes // 2,) * 2,
        silent=0,
        saturated=0,
        rate_histogram=(neurons,) if neurons else (),
        neuron_updates_per_decision=2 * neurons,
        gain_multiplications_per_decision=0,
    )


TASK = TaskCounts(
    "game",
    10,
    2,
    True,
    (
        layer("conv1", "MAC", 400, 50, 8, 60, conv=True),
        layer("hidden", "AC", 200, 30, 4, 20),
        layer("head", "AC", 40, 6, 0, 0),
    ),
)


def make(**changes) -> str:
    return yaml.safe_dump({**TARGET, **changes})


def target(text: str) -> Target:
    return read_target(parse(text, "my.yaml"), "my.yaml")


def test_by_hand() -> None:
    """40 MACs, 20 + 4 ACs and 24 updates per decision: 400 + 48 + 72; the twin multiplies 86 times."""
    energy = estimate(TASK, target(make()))
    assert energy.compute_pj == pytest.approx(400 + 48 + 72)
    assert (energy.memory_pj, energy.not_included) == (None, ())
    assert energy.ann_pj == pytest.approx(860)
    assert energy.by_ann == pytest.approx(520 / 860)
    # Spike counts of 0, 1, 2 need two bits: two additions of 2 pJ are cheaper than a multiplication of 10, but for the
    # first layer, which sees numbers.
    assert energy.quantised_ann_pj == pytest.approx(50 * 10 + 36 * 4)
    assert energy.by_quantised_ann == pytest.approx(520 / 644)


def test_neurons_of_two_states_have_no_price_but_twice_the_state_traffic() -> None:
    """A target's price is that of a membrane alone: 8 updates of hidden are named, not priced."""
    conv, hidden, head = TASK.layers
    two = replace(TASK, layers=(conv, replace(hidden, states=2), head))
    energy = estimate(two, target(make()))
    assert energy.not_included == ("8 neuron updates of hidden",)
    assert energy.compute_pj == pytest.approx(520 - 8 * 3)
    extra = traffic(two.layers[1], True).state - traffic(hidden, True).state
    assert extra == 2 * hidden.neuron_updates_per_decision


def test_what_has_no_price_is_named_and_not_guessed() -> None:
    energy = estimate(TASK, target(make(operations={"ac": 2.0, "ac_conv": 1.0, "spike": 5.0}, unit="nJ")))
    assert energy.compute_pj == pytest.approx(48e3 + 8 * 5e3)  # 24 accumulations, 6 + 2 spikes
    assert energy.not_included == (
        "40 multiplications of conv1",
        "16 neuron updates of conv1",
        "8 neuron updates of hidden",
    )
    assert energy.by_ann is None


def test_a_part_of_the_network_is_not_compared_with_the_whole_twin() -> None:
    energy = estimate(TASK, target(make(operations={"ac": 2.0, "mac": 10.0})))
    assert len(energy.not_included) == 2, "neuron updates have no price"
    assert energy.ann_pj == pytest.approx(860)
    assert (energy.by_ann, energy.by_quantised_ann) == (None, None)


def test_memory_is_read_for_every_operation() -> None:
    memory = Memory(64, {8.0: 10.0, 32.0: 20.0, 1024.0: 100.0}, 8, 16)
    assert memory.access_pj(8 * 1024, 8) == pytest.approx(10 / 8)
    assert memory.access_pj(8 * 1024 + 1, 8) == pytest.approx(20 / 8)
    assert memory.access_pj(10**9, 8) == pytest.approx(100 / 8), "beyond the table: its largest"
    raw = {"access_bits": 64, "energy_by_kilobytes": {8: 10}, "weight_bits": 8, "state_bits": 16}
    energy = estimate(TASK, target(make(memory=raw)))
    weight, state = 10 / 8, 10 / 4  # pJ per access of 8 and 16 bits
    # Per decision: a first convolution (40 operations, 8 neurons of 2 steps, 6 spikes), a hidden layer that 6 spikes
    # feed (20 operations, 4 neurons, 2 spikes), a head of 2 actions that 6 spikes feed (4 operations).
    conv1, hidden, head = energy.layers
    assert conv1.memory_pj == pytest.approx(
        {"events": 6 * state, "activations": 40 * state, "weights": 40 * weight, "biases": 8 * weight}
        | {"state": 2 * 16 * state}
    )
    assert hidden.memory_pj == pytest.approx(
        {"events": (6 + 2) * state, "activations": 0, "weights": 20 * weight, "biases": 8 * weight}
        | {"state": 2 * (20 + 8) * state}
    )
    assert head.memory_pj == pytest.approx(
        {"events": 6 * state, "activations": 2 * state, "weights": 4 * weight, "biases": 4 * weight}
        | {"state": 2 * (4 + 4) * state}
    )
    assert energy.memory_pj == pytest.approx(sum(sum(layer.memory_pj.values()) for layer in energy.layers))
    # The ANN: a convolution reads an input per multiplication, a linear layer each of its 5 once.
    reads, written, biases = 50 + 5 + 5, 8 + 4 + 2, 8 + 4 + 2
    memory = (reads + written) * state + (86 + biases) * weight
    assert energy.ann_pj == pytest.approx(860 + memory)
    # Activations of two bits instead of 16 in the hidden layer and the head.
    saved = (5 + 4 + 5 + 2) * state * (1 - 2 / 16)
    assert energy.quantised_ann_pj == pytest.approx(644 + memory - saved)


def test_built_in_targets_have_origin_and_price() -> None:
    targets = TARGETS.built_in
    assert {"cmos45-fp32", "cmos45-int8", "loihi-2018", "loihi-sanafe"} <= set(targets)
    by_chip: dict[str, int] = {}
    for name, target in targets.items():
        assert name == target.name
        assert any(word in target.source for word in ("doi", "arXiv", "PMC"))
        assert all(math.isfinite(price) and price >= 0 for price in target.operations_pj.values())
        assert target.operations_pj["ac"] > 0
        by_chip[target.chip] = by_chip.get(target.chip, 0) + 1
    assert by_chip["Loihi"] > 1, "several sources for one chip give a range"
    assert targets["spinnaker-system"].operations_pj["ac"] == pytest.approx(13_300)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"unit": "calories"}, "unit is 'calories', expected one of fJ, pJ, nJ"),
        ({"source": ""}, "source is '', expected a text"),
        ({"operations": {"ac": -1}}, "operations.ac is -1, expected a number of at least 0"),
        ({"operations": {"ac": 0}}, "operations.ac is 0, expected a number above 0"),
        ({"name": "a/b"}, "name is 'a/b', expected a name of one line without /"),
        (
            {"memory": {"access_bits": 64, "energy_by_kilobytes": {32: 10, 8: 20}, "weight_bits": 8, "state_bits": 8}},
            "energy_by_kilobytes has 10 for 32 kB and 20 for 8 kB, expected no less for a larger memory",
        ),
        ({"operations": {"mac": 1}}, "has no operations.ac"),
        ({"operations": {"ac": 1, "macc": 1}}, "unknown key operations.macc; did you mean 'mac'"),
        ({"operations": {"ac": "1 pJ"}}, "operations.ac is '1 pJ'"),
        ({"evidence": "hearsay"}, "evidence is 'hearsay'"),
        ({"volts": 1}, "unknown key volts"),
        ({"memory": {"access_bits": 64}}, "has no memory.energy_by_kilobytes"),
        ({"unit": ["pJ"]}, "unit is ['pJ']"),
        ({"operations": {"ac": 10**400}}, "a whole number of 401 digits, expected at most 19"),
        ({"operations": {"ac": 10**18}}, "operations.ac is 1000"),
        ({"operations": {"ac": "2e-3"}}, "YAML reads 2e-3 as text: write 2.0e-3"),
        (
            {"memory": {"access_bits": 0, "energy_by_kilobytes": {8: 1}, "weight_bits": 8, "state_bits": 8}},
            "memory.access_bits is 0, expected a whole number of bits",
        ),
        (
            {"memory": {"access_bits": 64, "energy_by_kilobytes": {8: 1}, "weight_bits": 8.7, "state_bits": 8}},
            "memory.weight_bits is 8.7, expected a whole number of bits",
        ),
    ],
)
def test_wrong_targets_are_refused_in_one_line(changes: dict, message: str) -> None:
    with pytest.raises(ConfigError) as error:
        target(make(**changes))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_source_and_text_that_is_no_target(tmp_path: Path) -> None:
    without = {key: value for key, value in TARGET.items() if key != "source"}
    for text, message in ((yaml.safe_dump(without), "has no source"), ("[1, 2", "is not YAML"), ("7", "expected keys")):
        with pytest.raises(ConfigError, match=message):
            target(text)
    with pytest.raises(ConfigError, match="unknown energy target 'loihi-2081'; did you mean 'loihi-2018'"):
        TARGETS.load("loihi-2081")
    with pytest.raises(ConfigError, match="cannot be read"):
        TARGETS.load("nowhere.yaml")
    (tmp_path / "latin.yaml").write_bytes("title: 1 \u00b5J".encode("latin-1"))
    with pytest.raises(ConfigError, match="not UTF-8 text"):
        TARGETS.load(str(tmp_path / "latin.yaml"))


@pytest.mark.slow
def test_a_target_of_ones_own(trained_run: Path, tmp_path: Path, run_command: RunCommand) -> None:
    (tmp_path / "chip.yaml").write_text(make(name="my-chip"))
    out, _ = run_command(
        "profile", trained_run, "--decisions", 20, "--target", tmp_path / "chip.yaml", "--target", "loihi-2018"
    )
    assert "my-chip" in out
    assert "loihi-2018" in out
    assert "cmos45-fp32" not in out
    assert "The spiking network costs" in out
    (tmp_path / "twin.yaml").write_text(make(name="loihi-2018"))
    _, err = run_command("profile", trained_run, "--target", tmp_path / "twin.yaml", "--target", "loihi-2018", code=2)
    assert "name is 'loihi-2018', which is a built-in energy target" in err
    (tmp_path / "chip.yaml").write_text(make(unit="eV"))
    _, err = run_command("profile", trained_run, "--target", tmp_path / "chip.yaml", code=2)
    assert "unit is 'eV'" in err
