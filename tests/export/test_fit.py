"""Fit on the chip: answers by hand, networks that just fit, brute force, and sinabs' own formulas where it is there."""

from __future__ import annotations

import importlib
import itertools
import json
import math
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from switchmt_snn.errors import ConfigError
from switchmt_snn.export.chips.chip_file import CHIPS
from switchmt_snn.export.chips.fit import ChipFit, check_fit, layer_shapes
from switchmt_snn.export.chips.mappings import CorePerLayer, assign_cores, convolution_memory_ki
from switchmt_snn.export.chips.shapes import LayerShape
from switchmt_snn.export.folded import fold_agent
from tests.export.chip_networks import ATARI, BUILT_IN, CONVOLUTIONS, GOLDEN, chain, conv, golden_fits, linear
from tests.export.export_cases import make_agent

SPECK = CHIPS.built_in["speck"].mapping
assert isinstance(SPECK, CorePerLayer)
SPECK_CORES = [(core.kernels_ki, core.neurons_ki) for core in SPECK.cores]


def limits(fit: ChipFit, layer: str) -> dict[str, tuple[float, float]]:
    found = next(part for part in fit.layers if part.layer == layer)
    return {limit.resource: (limit.needs, limit.has) for limit in found.limits}


@pytest.mark.slow
def test_built_in_chips_answer_as_stored() -> None:
    """Bit for bit what was answered when chips were still written in Python."""
    stored, now = json.loads(GOLDEN.read_text()), json.loads(json.dumps(golden_fits()))
    assert list(now) == list(stored)
    for name, fit in now.items():
        assert all(layer.pop("not_held") == "" for layer in fit["layers"]), name
        assert fit == stored[name], name


def test_the_papers_network_on_speck() -> None:
    assert [convolution_memory_ki(layer) for layer in CONVOLUTIONS] == [(8, 32), (32, 16), (64, 4)]
    assert check_fit(CONVOLUTIONS, "speck").fits
    fit = check_fit(ATARI, "speck")
    assert not fit.fits
    assert [layer.layer for layer in fit.layers if not layer.fits] == ["hidden/value", "hidden/advantage"]
    hidden = fit.layers[3]
    assert (hidden.limiting.needs, hidden.limiting.has, hidden.limiting.unit) == (2048, 64, "Ki")
    assert hidden.change == "fits with at most 16 units on these inputs (checked)"
    # With 16 units conv3 and both streams want 64 Ki of kernels, which two cores have; with 8 a stream wants 32.
    assert fit.change == "everything fits with network.hidden_units of at most 8 (checked)"
    assert limits(fit, "head")["input features"] == (1024, 1024)


def test_a_minatar_layer_fills_a_core_of_speck() -> None:
    fit = check_fit([linear("hidden", (16, 8, 8), 64)], "speck")
    assert fit.fits
    assert limits(fit, "hidden")["kernel memory of a core"] == (64, 64)
    assert not check_fit([linear("hidden", (16, 8, 8), 65)], "speck").fits


def test_the_papers_network_on_many_cores() -> None:
    """By hand; for Loihi: synapses / 131,072 of each layer, rounded up; for SpiNNaker2 41 units of 3,140 bytes a PE."""
    cores = {name: [layer.cores for layer in check_fit(ATARI, name).layers] for name in BUILT_IN}
    assert cores["loihi-1"] == [25, 21, 14, 13, 13, 1]
    assert cores["loihi-2"] == [4, 3, 2, 9, 9, 1]
    assert cores["spinnaker2"] == [1, 1, 1, 13, 13, 1]
    assert [check_fit(ATARI, name).fits for name in ("loihi-1", "loihi-2", "spinnaker2")] == [True] * 3
    first = check_fit(ATARI, "loihi-1")
    assert [limit.needs for limit in first.limits if limit.resource == "synaptic memory"] == [10_967_040 / 1024]
    assert [limit.needs for limit in check_fit(ATARI, "spinnaker2").limits] == [30, 3_307_520 + 4 * 22_162]


JUST = {
    "speck: kernels": ("speck", lambda n: chain((16, 8, 8), n), 64),
    "speck: neurons": ("speck", lambda n: [conv("conv", (1, 32, 32), n, 1)], 64),
    "speck: input features": ("speck", lambda n: chain(n, 1), 1024),
    "speck: output features": ("speck", lambda n: chain(16, n), 1024),
    "speck: input side": ("speck", lambda n: [conv("conv", (1, n, n), 1, 2, 2)], 128),
    "speck: output side": ("speck", lambda n: [conv("conv", (1, n, n), 1, 1)], 64),
    "speck: kernel side": ("speck", lambda n: [conv("conv", (1, 32, 32), 1, n)], 16),
    "speck: stride": ("speck", lambda n: [conv("conv", (1, 64, 64), 1, 2, n)], 2),
    "speck: square": ("speck", lambda n: [linear("hidden", (1, 4, n), 1)], 4),
    "speck: cores": ("speck", lambda n: chain(*[8] * (n + 1)), 9),
    "speck: cores of 64 Ki": ("speck", lambda n: [linear(f"{i}", (16, 8, 8), 64) for i in range(n)], 2),
    "loihi-1: fan-in": ("loihi-1", lambda n: chain(n, 1), 4096),
    "loihi-1: synapses": ("loihi-1", lambda n: chain(1024, n), 128 * 128),
    "loihi-1: neurons": ("loihi-1", lambda n: chain(1, n), 128 * 1024),
    "loihi-1: cores": ("loihi-1", lambda n: chain(*[1] * (n + 1)), 128),
    "loihi-2: weights": ("loihi-2", lambda n: chain(1024, n), 128 * 192),
    "loihi-2: synapses": ("loihi-2", lambda n: [conv("conv", (1000, 20, 20), n, 1)], 300),
    "loihi-2: neurons": ("loihi-2", lambda n: chain(1, n), 128 * 8192),
    "spinnaker2: SRAM": ("spinnaker2", lambda n: chain(1020, n), 152 * 128),
    "spinnaker2: whole channels": ("spinnaker2", lambda n: chain(3136, n), 152 * 41),
    "xylo-audio-2: inputs": ("xylo-audio-2", lambda n: chain(n, 4, 8), 16),
    "xylo-audio-2: hidden": ("xylo-audio-2", lambda n: chain(16, n, 8), 1000),
    "xylo-audio-2: hidden in sum": ("xylo-audio-2", lambda n: chain(16, 60, n, 8), 940),
    "xylo-audio-2: outputs": ("xylo-audio-2", lambda n: chain(16, 9, n), 8),
    "xylo-audio-2: fan-in": ("xylo-audio-2", lambda n: chain(16, n, 9, 8), 63),
    "xylo-audio-3: inputs": ("xylo-audio-3", lambda n: chain(n, 4, 8), 16),
    "xylo-audio-3: reached": ("xylo-audio-3", lambda n: chain(16, n, 9, 8), 128),
    "xylo-audio-3: reaching": ("xylo-audio-3", lambda n: chain(16, 9, n, 8), 128),
    "xylo-audio-3: hidden": ("xylo-audio-3", lambda n: chain(16, 128, n, 128, 8), 736),
    "xylo-audio-3: outputs": ("xylo-audio-3", lambda n: chain(16, 9, n), 32),
}


@pytest.mark.parametrize("case", JUST)
def test_just_fits_and_just_misses(case: str) -> None:
    chip, network, most = JUST[case]
    fit, miss = (check_fit(network(size), chip) for size in (most, most + 1))
    assert fit.fits, [str(limit) for part in (*fit.layers, fit) for limit in part.limits if not limit.fits]
    assert [*(layer.change for layer in fit.layers), fit.change] == [""] * (len(fit.layers) + 1)
    assert not miss.fits
    assert all(bool(layer.change) is not layer.fits for layer in miss.layers)


def test_whole_channels_that_are_too_large_for_a_core_are_divided() -> None:
    assert check_fit(chain(200_000, 3), "spinnaker2").layers[0].cores == math.ceil(600_012 / 131_072)


def test_no_limit_is_zero() -> None:
    """Others divide by what there is; here no core of Speck holds any layer."""
    fit = check_fit(chain(30_000, 9_000, 9_000), "speck")
    assert all(limit.has > 0 for part in (*fit.layers, fit) for limit in part.limits)
    assert not any(layer.fits for layer in fit.layers)
    contended = check_fit([linear(f"{i}", (16, 8, 8), 64) for i in range(4)], "speck")
    assert [(limit.needs, limit.has) for limit in contended.limits] == [(4, 9), (4, 2)]


def test_two_memories_that_no_core_has_together() -> None:
    layer = conv("conv", (64, 34, 34), 32, 3)  # 32 Ki of kernels and of neurons: one core; twice the kernels: none
    assert convolution_memory_ki(layer) == (32, 32)
    assert check_fit([layer], "speck").fits
    wide = conv("conv", (128, 34, 34), 32, 3)
    fit = check_fit([wide], "speck")
    assert limits(fit, "conv")["kernel memory of a core"] == (64, 64)
    assert fit.layers[0].limiting.resource == "neuron memory of a core that holds the kernels"
    assert (fit.layers[0].limiting.needs, fit.layers[0].limiting.has) == (32, 16)
    assert fit.layers[0].change == "fits with at most 16 output channels on these inputs (checked)"


def test_what_forbids_every_size_is_named() -> None:
    fit = check_fit(chain(28_224, 40, 8), "loihi-1")
    assert fit.layers[0].change == "fits with no number of units: inputs of a neuron 28,224 of 4,096 axons"
    assert fit.change == ""


@pytest.mark.slow
@given(st.lists(st.lists(st.integers(0, 4), unique=True, max_size=4), max_size=5))
@settings(max_examples=150, deadline=None)
def test_assignment_is_as_good_as_brute_force(options: list[list[int]]) -> None:
    found = assign_cores(options)
    assert all(core in options[layer] for layer, core in found.items())
    assert len(set(found.values())) == len(found), "a core holds one layer"
    most = max(
        sum(core in choices for core, choices in zip(cores, options, strict=False))
        for cores in itertools.permutations(range(5))
    )
    assert len(found) == most


LAYERS = st.builds(
    lambda channels, side, units, kernel, stride: conv(
        "conv", (channels, side, side), units, min(kernel, side), stride
    ),
    st.integers(1, 160),
    st.integers(1, 60),
    st.integers(1, 160),
    st.integers(1, 9),
    st.sampled_from([1, 2, 4]),
)


@given(st.lists(LAYERS, min_size=1, max_size=4))
@settings(max_examples=40, deadline=None)
def test_a_network_on_speck_is_placed_as_by_brute_force(layers: list[LayerShape]) -> None:
    kinds = sorted(set(SPECK_CORES))
    memories = [convolution_memory_ki(layer) for layer in layers]
    placed = any(
        all(kernel <= core[0] and neuron <= core[1] for (kernel, neuron), core in zip(memories, cores, strict=True))
        and all(cores.count(kind) <= SPECK_CORES.count(kind) for kind in kinds)
        for cores in itertools.product(kinds, repeat=len(layers))
    )
    assert check_fit(layers, "speck").fits == placed


def stated(change: str) -> int:
    assert "(checked)" in change
    return int(re.search(r"at most ([\d,]+)", change)[1].replace(",", ""))  # type: ignore[index]


@given(LAYERS, st.sampled_from(BUILT_IN))
@settings(max_examples=60, deadline=None)
def test_a_stated_change_of_a_layer_is_true(layer: LayerShape, chip: str) -> None:
    network = [*chain(1, 3), layer, *chain(3, 3)]
    change = check_fit(network, chip).layers[1].change
    if "at most" in change:
        for more, fits in ((0, True), (1, False)):
            network[1] = layer.resized(stated(change) + more)
            assert check_fit(network, chip).layers[1].fits is fits


@pytest.mark.parametrize("trunk", ["auto", "mlp"])
def test_a_stated_number_of_hidden_units_is_true(trunk: str) -> None:
    def fit(hidden_units: int) -> ChipFit:
        return check_fit(layer_shapes(fold_agent(make_agent(hidden_units=hidden_units, trunk=trunk))), "speck")

    most = stated(fit(300).change)
    assert fit(most).fits
    assert not fit(most + 1).fits


def test_hidden_units_change_what_comes_after_them_but_not_the_head() -> None:
    """Xylo Audio 3: 128 neurons reach the outputs, so 64 in each of two streams."""

    def network(units: int) -> list[LayerShape]:
        streams = [linear(f"hidden/{name}", units, units) for name in ("value", "advantage")]
        return [linear("linear1", 16, units), *streams, linear("head", 2 * units, 8)]

    assert stated(check_fit(network(100), "xylo-audio-3").change) == 64
    assert [check_fit(network(units), "xylo-audio-3").fits for units in (64, 65)] == [True, False]


@pytest.mark.parametrize("settings", [{}, {"trunk": "mlp"}, {"method": "DSQN"}, {"method": "DQN"}], ids=str)
def test_shapes_of_real_networks(settings: dict[str, str]) -> None:
    network = fold_agent(make_agent(**settings))
    shapes = layer_shapes(network)
    assert sum(shape.weights for shape in shapes) == sum(node.weight.size for node in network.synapses)
    assert all(shape.weights == shape.units * shape.fan_in for shape in shapes)
    assert shapes[-1].output_shape == network.head.output_shape
    dueling = network.layers[-1].synapses.groups == 2
    streams = ["hidden/value", "hidden/advantage"] if dueling else ["hidden"]
    first = "linear1" if settings.get("trunk") == "mlp" else "conv1"
    assert [shape.name for shape in shapes] == [first, *streams, "head"]
    assert [shape.spiking_input for shape in shapes] == [False] + [network.spiking] * (len(shapes) - 1)
    assert shapes[1].input_image == (None if first == "linear1" else (16, 8, 8))
    for chip in BUILT_IN:
        fit = check_fit(shapes, chip)
        again = json.loads(json.dumps(fit.to_dict(), allow_nan=False))
        assert again == fit.to_dict() | {"conditions": again["conditions"]}
        assert (again["fits"], again["weight_bits"]) == (fit.fits, 8)
        assert [layer["layer"] for layer in again["layers"]] == [shape.name for shape in shapes]


@pytest.mark.slow
def test_inputs_that_are_no_spikes_need_a_host() -> None:
    def host(chip: str, **settings: object) -> str:
        return check_fit(layer_shapes(fold_agent(make_agent(**settings))), chip).conditions[0]

    assert "a host must compute conv1 (" in host("speck")
    assert "compute conv1, hidden, head (" in host("loihi-1", method="DQN")
    events = {"encoding": "events", "tasks": {"frame_stack": 4}}
    assert all("host must" not in text for text in (host("loihi-2"), host("spinnaker2"), host("speck", **events)))


def test_every_chip_has_its_source_and_says_what_it_leaves_out() -> None:
    assert set(CHIPS.built_in) == set(BUILT_IN)
    for name, chip in CHIPS.built_in.items():
        assert (chip.name, bool(chip.source), len(chip.notes) > 1) == (name, True, True)
    with pytest.raises(ConfigError, match="unknown chip 'loihi1'; did you mean 'loihi-1'"):
        check_fit(ATARI, "loihi1")


@pytest.fixture
def sinabs(monkeypatch: pytest.MonkeyPatch) -> Iterator[SimpleNamespace]:
    """sinabs' own memory formulas, constraints and mapping; its packages import samna, which none of this needs."""
    root = Path(pytest.importorskip("sinabs").__file__).parent / "backend" / "dynapcnn"
    before = set(sys.modules)
    for name, folder in {
        "samna": None,
        "sinabs.backend.dynapcnn": root,
        "sinabs.backend.dynapcnn.chips": "chips",
    }.items():
        stub = ModuleType(name)
        if folder is not None:
            stub.__path__ = [str(root / folder)]
        monkeypatch.setitem(sys.modules, name, stub)
    names = ("dynapcnn_layer", "mapping", "chips.dynapcnn")
    layer, mapping, chip = (importlib.import_module(f"sinabs.backend.dynapcnn.{name}") for name in names)
    yield SimpleNamespace(
        Layer=layer.DynapcnnLayer, place=mapping.get_valid_mapping, cores=chip.DynapcnnConfigBuilder.get_constraints()
    )
    for name in set(sys.modules) - before:
        if name.startswith("sinabs.backend.dynapcnn"):
            del sys.modules[name]


@pytest.mark.slow
def test_speck_as_sinabs_has_it(sinabs: SimpleNamespace) -> None:
    """Memory of each layer, the cores that hold it, and whether all of them find one."""
    spiking = importlib.import_module("sinabs.layers").IAFSqueeze(batch_size=1)
    assert [(core.kernel_memory, core.neuron_memory) for core in sinabs.cores] == [
        (kernel * 1024, neuron * 1024) for kernel, neuron in SPECK_CORES
    ]
    generator = torch.Generator().manual_seed(1)

    def pick(high: int) -> int:
        return int(torch.randint(1, high + 1, (), generator=generator))

    outcomes = set()
    for _ in range(40):
        shapes, theirs = [], {}
        for index in range(pick(4)):
            image = (pick(100), *[pick(16)] * 2)
            if index % 2:
                shapes.append(linear("linear", image, pick(100)))
                synapses: nn.Module = nn.Linear(math.prod(image), shapes[-1].units)
            else:
                image = (image[0], *[pick(60)] * 2)
                shapes.append(conv("conv", image, pick(100), min(pick(9), image[1]), 2 ** (pick(3) - 1)))
                kernel, stride = shapes[-1].kernel, shapes[-1].stride
                synapses = nn.Conv2d(image[0], shapes[-1].units, kernel or 0, stride)
            theirs[index] = sinabs.Layer(synapses, spiking, image, [(1, 1)], discretize=False)
            memory = theirs[index].memory_summary()
            assert convolution_memory_ki(shapes[-1]) == (memory["kernel"] / 1024, memory["neuron"] / 1024)
            assert check_fit(shapes[-1:], "speck").fits == any(core.fits(theirs[index]) for core in sinabs.cores)
        try:
            fits = len(sinabs.place(theirs, sinabs.cores)) == len(shapes)
        except ValueError:
            fits = False
        assert check_fit(shapes, "speck").fits is fits
        outcomes.add((len(shapes) > 1, fits))
    assert len(outcomes) == 4, "both answers, of one layer and of several"
