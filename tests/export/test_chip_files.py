"""Chips as YAML files: every rule by hand, wrong files in one line, chips of one's own."""

from __future__ import annotations

import json
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import yaml

from switchmt_snn.errors import ConfigError
from switchmt_snn.export.chips.chip import Chip
from switchmt_snn.export.chips.chip_file import CHIPS, MAPPINGS, read_chip
from switchmt_snn.export.chips.fit import check_fit, layer_shapes
from switchmt_snn.export.chips.rules import RULES, Widths
from switchmt_snn.export.chips.shapes import LayerShape
from switchmt_snn.export.folded import fold_agent
from switchmt_snn.export.selection import Selection
from switchmt_snn.export.yaml_files import parse
from switchmt_snn.spiking.neurons import OpaqueNode
from tests.export.chip_networks import BUILT_IN, chain, conv, linear
from tests.export.export_cases import make_agent

ROOT = Path(__file__).parents[2]
CHIP: dict[str, Any] = {
    "kind": "chip",
    "name": "mine",
    "title": "My chip",
    "vendor": "me",
    "source": "my data sheet",
    "takes": "spikes",
    "layers": ["conv", "dense"],
    "neurons": ["IF"],
    "weight_bits": 4,
    "mapping": {"rule": "whole_cores", "cores": 3},
    "limits": {"neurons": {"rule": "neurons", "has": 10, "unit": "neurons", "per": "core"}},
    "notes": ["a note"],
}
CORES = [{"count": 1, "kernels_ki": 16, "neurons_ki": 16}]
REMOVED = "no such key"  # text, so that every test worker names a case alike


def changed(changes: dict[str, Any]) -> dict[str, Any]:
    """The file with other values under dotted keys."""
    raw = deepcopy(CHIP)
    for path, value in changes.items():
        *parents, last = path.split(".")
        at = raw
        for parent in parents:
            at = at[parent]
        if value is REMOVED:
            del at[last]
        else:
            at[last] = value
    return raw


def chip(**changes: Any) -> Chip:
    return read_chip({**deepcopy(CHIP), **changes}, "my.yaml")


WIDTHS = Widths(weight_bits=4, state_bits=16)
CONV = conv("conv", (3, 10, 12), 5, 2, 2)  # 5 x 5 x 6 outputs
DENSE = linear("dense", (3, 4, 6), 7)
BY_HAND = {
    "inputs": (360, 72),
    "neurons": (150, 7),
    "fan_in": (12, 72),
    "synapses": (1800, 504),
    "synapse_memory_kib": (900 / 1024, 252 / 1024),
    "weight_memory_kib": (30 / 1024, 252 / 1024),
    "weights_and_states_bytes": (30 + 300, 252 + 14),
    "input_features": (3, 3),
    "output_features": (5, 7),
    "input_side": (12, 6),
    "output_side": (6, 1),
    "kernel_side": (2, 6),
}


def test_every_rule_gives_what_is_computed_by_hand() -> None:
    assert set(RULES) == set(BY_HAND)
    for name, rule in RULES.items():
        assert (rule(CONV, WIDTHS), rule(DENSE, WIDTHS)) == BY_HAND[name], name
        assert rule.__doc__


def test_bytes_are_whole_and_need_the_bits_of_a_state() -> None:
    rule = RULES["weights_and_states_bytes"]
    assert rule(linear("dense", 3, 1), Widths(3, 2)) == 2, "9 + 2 bits"
    with pytest.raises(ValueError, match="needs state_bits"):
        rule(CONV, Widths(8, None))


def test_a_neuron_with_two_state_variables_takes_twice_the_memory_of_states() -> None:
    two = LayerShape("dense", (72,), (7,), None, 1, 504, True, "Synaptic", states=2)
    assert RULES["weights_and_states_bytes"](two, WIDTHS) == 252 + 28


def test_every_mapping_has_a_documented_class() -> None:
    assert set(MAPPINGS) == {"whole_cores", "shared_core", "core_per_layer"}
    assert all(mapping.__doc__ for mapping, _, _ in MAPPINGS.values())


def test_whole_cores_are_counted() -> None:
    fit = check_fit(chain(5, 20, 11), chip())
    assert [layer.cores for layer in fit.layers] == [2, 2]
    assert [(limit.resource, limit.needs, limit.has) for limit in fit.limits] == [("cores", 4, 3), ("neurons", 31, 30)]
    assert (fit.fits, fit.weight_bits, fit.title, fit.source) == (False, 4, "My chip", "my data sheet")
    assert fit.change == "everything fits with network.hidden_units of at most 10 (checked)"


def test_layers_share_one_core() -> None:
    limits = {"neurons": {"rule": "neurons", "has": 10, "unit": "neurons", "per": "chip"}}
    shared = chip(mapping={"rule": "shared_core"}, limits=limits)
    assert check_fit(chain(5, 6, 4), shared).fits
    assert not check_fit(chain(5, 7, 4), shared).fits


def test_a_core_per_layer_lists_its_strides() -> None:
    def resources(strides: list[int], stride: int) -> list[str]:
        mapping = {"rule": "core_per_layer", "cores": CORES, "strides": strides}
        limits = {"side": {"rule": "input_side", "has": 99, "unit": "pixels"}}
        fit = check_fit([conv("conv", (1, 9, 9), 1, 1, stride)], chip(mapping=mapping, limits=limits))
        return [str(limit) for limit in fit.layers[0].limits if not limit.fits]

    assert resources([1], 2) == ["stride (1) 2 of 1 pixels"]
    assert resources([1, 2], 3) == ["stride (1 or 2) 3 of 2 pixels"]
    assert resources([1, 2, 4], 4) == []


@pytest.mark.parametrize("name", BUILT_IN)
def test_a_neuron_that_a_chip_does_not_have_is_named_and_does_not_fit(name: str) -> None:
    layers = [LayerShape(**{**vars(layer), "neuron": "Izhikevich"}) for layer in chain(16, 4, 2)]
    fit = check_fit(layers, name)
    assert not fit.fits
    assert fit.change == ""
    for layer in fit.layers:
        assert (layer.fits, layer.to_dict()["fits"]) == (False, False)
        assert layer.not_held.startswith(f"neuron kind Izhikevich ({name} has IF, LIF")
        assert layer.change == f"not held: {layer.not_held}"


@pytest.mark.parametrize(
    ("neuron", "holding", "states"), [("LIF", set(BUILT_IN), 1), ("Synaptic", set(BUILT_IN) - {"speck"}, 2)]
)
def test_neurons_of_real_networks_are_looked_up(neuron: str, holding: set[str], states: int) -> None:
    shapes = layer_shapes(fold_agent(make_agent(neuron=neuron)))
    assert [shape.neuron for shape in shapes] == [neuron] * (len(shapes) - 1) + [None]
    assert [shape.states for shape in shapes] == [states] * (len(shapes) - 1) + [1]
    held = {name for name in BUILT_IN if not any(layer.not_held for layer in check_fit(shapes, name).layers)}
    assert held == holding


def test_adaptive_neurons_are_held_only_where_neurons_are_programs() -> None:
    shapes = layer_shapes(fold_agent(make_agent(neuron="ALIF")))
    held = {name for name in BUILT_IN if not any(layer.not_held for layer in check_fit(shapes, name).layers)}
    assert held == {"loihi-2", "spinnaker2"}
    assert shapes[0].states == 2


def test_a_neuron_class_of_ones_own_is_not_held_until_a_chip_lists_it() -> None:
    """Its kind is its name in a config; a chip's file may list that name."""
    node = OpaqueNode("my_module:MyNeuron", ("membrane", "current", "trace"))
    layer = LayerShape("dense", (4,), (2,), None, 1, 8, True, node.kind, states=len(node.states))
    assert "neuron kind my_module:MyNeuron" in check_fit([layer], "loihi-2").layers[0].not_held
    assert check_fit([layer], chip(neurons=["my_module:MyNeuron"])).fits


def test_a_layer_that_a_chip_does_not_have_is_named() -> None:
    fit = check_fit([conv("conv", (1, 3, 3), 1, 1)], chip(layers=["dense"], neurons=["LIF"]))
    assert fit.layers[0].change == ("not held: layer kind conv (mine has dense); neuron kind IF (mine has LIF)")


def test_a_head_needs_no_neurons_of_the_chip() -> None:
    head = LayerShape("head", (4,), (2,), None, 1, 8, True, None)
    assert check_fit([*chain(16, 4), head], chip()).fits


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"takes": "volts"}, "takes is 'volts', expected one of spikes, values"),
        ({"nuerons": ["IF"]}, "unknown key nuerons; did you mean 'neurons'"),
        ({"vendor": REMOVED}, "has no vendor, expected one"),
        ({"source": " "}, "source is ' ', expected a text; every constant needs its origin"),
        ({"kind": "cihp"}, "kind is 'cihp', expected one of chip"),
        ({"weight_bits": "8"}, "weight_bits is '8', expected a whole number of bits, 2 to 32"),
        ({"weight_bits": 1}, "weight_bits is 1, expected a whole number of bits, 2 to 32"),
        ({"neurons": "IF"}, "neurons is 'IF', expected a list of texts"),
        ({"neurons": []}, "neurons is [], expected a list of texts with at least one"),
        ({"neurons": ["IF", "LIFF"]}, "neurons has 'LIFF', expected IF, LIF, Synaptic, ALIF, or a neuron of your own"),
        ({"notes": "none"}, "notes is 'none', expected a list of texts"),
        ({"layers": ["conf"]}, "layers has 'conf'; did you mean 'conv'"),
        ({"limits": [1]}, "limits is [1], expected keys and values"),
        ({"limits": {}}, "limits is {}, expected at least one limit"),
        ({"limits.neurons": 7}, "limits.neurons is 7, expected keys and values"),
        ({"limits.neurons.rule": "neuron"}, "limits.neurons.rule is 'neuron', expected one of inputs, neurons"),
        ({"limits.neurons.rule": "layer.neurons * 2"}, "limits.neurons.rule is 'layer.neurons * 2'"),
        ({"limits.neurons.has": REMOVED}, "has no limits.neurons.has"),
        ({"limits.neurons.has": -1}, "limits.neurons.has is -1, expected a number of at least 0"),
        ({"limits.neurons.has": 0}, "limits.neurons.has is 0, expected more than 0"),
        ({"limits.neurons.pre": "core"}, "unknown key limits.neurons.pre; did you mean 'per'"),
        (
            {"limits.neurons.only": "middle"},
            "limits.neurons.only is 'middle', expected one of any, first, hidden",
        ),
        ({"limits.neurons.whole_channels": 1}, "limits.neurons.whole_channels is 1, expected true or false"),
        (
            {"limits.neurons.per": "chip", "limits.neurons.whole_channels": True},
            "limits.neurons.whole_channels is True, expected per: core with it",
        ),
        (
            {"limits.neurons.rule": "weights_and_states_bytes"},
            "limits.neurons.rule is 'weights_and_states_bytes', expected state_bits in the file with it",
        ),
        ({"mapping": {"rule": "shared_core"}}, "limits.neurons.per is 'core', expected layer or chip"),
        ({"mapping.rule": "whole_core"}, "core_per_layer; did you mean 'whole_cores'"),
        ({"mapping.cores": 0}, "mapping.cores is 0, expected a whole number of cores"),
        ({"mapping.cores": True}, "mapping.cores is True, expected a whole number of cores"),
        ({"mapping.strides": [1]}, "unknown key mapping.strides"),
        ({"mapping": {"rule": "core_per_layer", "cores": 3, "strides": [1]}}, "mapping.cores is 3, expected a list"),
        ({"mapping": {"rule": "core_per_layer", "cores": CORES}}, "has no mapping.strides"),
        (
            {"mapping": {"rule": "core_per_layer", "cores": [{"count": 1}], "strides": [1]}},
            "has no mapping.cores[0].kernels_ki",
        ),
        (
            {"mapping": {"rule": "core_per_layer", "cores": CORES, "strides": [2, 4]}},
            "mapping.strides is [2, 4], expected a list of ascending whole numbers that begins with 1",
        ),
    ],
    ids=str,
)
def test_wrong_chips_are_refused_in_one_line(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as error:
        read_chip(changed(changes), "my.yaml")
    assert message in str(error.value)
    assert str(error.value).startswith("my.yaml")
    assert "\n" not in str(error.value)


def test_a_key_that_is_written_twice_is_refused() -> None:
    """YAML readers keep the second one: a limit would be lost silently."""
    with pytest.raises(ConfigError, match=r"the key 'neurons' is written twice"):
        parse("limits:\n  neurons: {has: 1}\n  neurons: {has: 2}\n", "my.yaml")


def test_files_of_both_kinds_are_told_apart(tmp_path: Path) -> None:
    def select(raw: object) -> Selection:
        (tmp_path / "my.yaml").write_text(yaml.safe_dump(raw))
        return Selection.of([tmp_path / "my.yaml"])

    energy = dict.fromkeys(("name", "title", "chip", "process", "source", "includes", "leaves_out"), "x")
    energy |= {"evidence": "measured", "unit": "pJ", "operations": {"ac": 1}}
    without_kind = {key: value for key, value in CHIP.items() if key != "kind"}
    for raw in (CHIP, without_kind):
        assert [chip.name for chip in select(raw).chips] == ["mine"]
    for raw in (energy, {"kind": "energy", **energy}):
        assert [target.name for target in select(raw).targets] == ["x"]
    with pytest.raises(ConfigError, match="kind is 'chips', expected one of energy, chip"):
        select({**CHIP, "kind": "chips"})
    for name in ("one.yaml", "two.yaml"):
        (tmp_path / name).write_text(yaml.safe_dump(CHIP))
    with pytest.raises(ConfigError, match="two chips have one name"):
        Selection.of([tmp_path / "one.yaml", tmp_path / "two.yaml"])


def test_a_file_cannot_pass_for_a_built_in_target_or_chip(tmp_path: Path) -> None:
    target = ROOT / "export" / "energy" / "targets" / "loihi-2018.yaml"
    cheaper = yaml.safe_load(target.read_text()) | {"operations": {"ac": 0.001}}
    for raw, kind in ((cheaper, "energy target"), ({**CHIP, "name": "speck"}, "chip")):
        (tmp_path / "my.yaml").write_text(yaml.safe_dump(raw))
        with pytest.raises(ConfigError, match=rf"my\.yaml: name is '{raw['name']}', which is a built-in {kind} "):
            Selection.of([tmp_path / "my.yaml"])
    assert Selection.of([target]) == Selection.of(["loihi-2018"])


def test_a_target_that_is_named_twice_is_refused() -> None:
    with pytest.raises(ConfigError, match="the target 'loihi-2' is named 2 times, expected each once"):
        Selection.of(["loihi-2", "speck", "loihi-2"])


def test_a_chips_name_fits_into_tables_and_lists() -> None:
    for name in ("a/b", "a,b", "a\nb"):
        with pytest.raises(ConfigError, match="expected a name of one line without /"):
            chip(name=name)


def test_notes_may_be_left_out_or_empty() -> None:
    assert read_chip(changed({"notes": REMOVED}), "my.yaml").notes == ()
    assert chip(notes=[]).notes == ()


def test_a_name_of_both_kinds_selects_both_and_no_name_everything() -> None:
    both = Selection.of(["spinnaker2"])
    assert ([target.name for target in both.targets], [chip.name for chip in both.chips]) == (["spinnaker2"],) * 2
    assert {chip.name for chip in Selection.of(()).chips} == set(BUILT_IN)
    assert Selection.of("speck") == Selection.of(["speck"])


def test_built_in_files_bear_their_chips_names() -> None:
    folder = ROOT / "export" / "chips" / "builtin"
    assert {path.stem for path in folder.glob("*.yaml")} == set(CHIPS.built_in) == set(BUILT_IN)
    for path in folder.glob("*.yaml"):
        assert CHIPS.load(path) == CHIPS.built_in[path.stem]


def test_fits_are_plain_json(tmp_path: Path) -> None:
    (tmp_path / "my.yaml").write_text(yaml.safe_dump(CHIP))
    fit = check_fit(chain(5, 3), str(tmp_path / "my.yaml"))
    assert json.loads(json.dumps(fit.to_dict(), allow_nan=False))["layers"][0]["not_held"] == ""


def recipe(heading: str) -> str:
    """The YAML file in a section of docs/extending.md."""
    section = (ROOT / "docs" / "extending.md").read_text().split(f"\n## {heading}\n")[1].split("\n## ")[0]
    return section.split("```yaml\n")[1].split("```")[0]


def test_the_recipes_in_the_docs_are_a_target_and_a_chip(tmp_path: Path) -> None:
    for name, heading in (("my_target.yaml", "Energy target"), ("my_chip.yaml", "Chip")):
        (tmp_path / name).write_text(recipe(heading))
    selection = Selection.of([tmp_path / "my_target.yaml", tmp_path / "my_chip.yaml"])
    (target,), (own,) = selection.targets, selection.chips
    assert (target.name, target.operations_pj["mac"], own.name) == ("my-target", 2.5, "my-chip")
    assert check_fit(chain(64, 32, 8), own).fits
    assert not check_fit(chain(64, 32, 33), own).fits


def test_the_docs_name_every_key_of_a_chip_file() -> None:
    keys = (ROOT / "docs" / "energy.md").read_text().split("### A chip of your own")[1]
    for chip_key in yaml.safe_load(recipe("Chip")):
        assert f"`{chip_key}`" in keys
    for key in ("per", "only", "whole_channels", "has", "unit"):
        assert f"`{key}`" in keys
