"""Profiles of NIR files: our own against the network they were written from, foreign ones against dense hand counts."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import nir
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st

from switchmt_snn.errors import ExportError
from switchmt_snn.export.counts.network import TaskCounts, count_task
from switchmt_snn.export.counts.nir_file import count_nir
from switchmt_snn.export.folded import fold_agent
from switchmt_snn.export.formats.nir_writer import nir_graph, write_nir
from switchmt_snn.export.parity.dyadic import dyadic_observations, exact_copy
from switchmt_snn.export.runtimes.agents import encode
from switchmt_snn.export.runtimes.nir_interpreter import NirInterpreter
from switchmt_snn.machine.progress import Work, listening
from tests.export.export_cases import VARIANTS, make_agent, observations


def counted(path: Path, observations: Path) -> TaskCounts:
    return count_nir(path, observations).counts


INTEGERS = (-3, 4)
"""Weights and inputs whose sums float32 holds exactly."""


def saved(path: Path, **arrays: Any) -> Path:
    np.savez(path, **arrays)
    return path


def graph(nodes: dict[str, Any], edges: list[tuple[str, str]] | None = None, **metadata: Any) -> nir.NIRGraph:
    """A chain in the order of its nodes, or with edges of its own."""
    names = list(nodes)
    return nir.NIRGraph(nodes, edges or list(itertools.pairwise(names)), metadata=metadata)


def shapes(start: tuple[int, ...], end: tuple[int, ...], **between: Any) -> dict[str, Any]:
    return {"input": nir.Input({"input": np.array(start)}), **between, "output": nir.Output({"output": np.array(end)})}


def if_neurons(*shape: int, threshold: float = 1.0) -> nir.IF:
    ones = np.ones(shape, np.float32)
    return nir.IF(r=ones, v_threshold=ones * threshold, v_reset=0 * ones)


# --- convolutions in the interpreter


def convolution(weight: np.ndarray, side: tuple[int, int], stride: Any, padding: Any, **others: Any) -> nir.NIRGraph:
    arguments = {"dilation": 1, "groups": 1, "bias": np.arange(len(weight), dtype=np.float32), **others}
    node = nir.Conv2d(input_shape=side, weight=weight, stride=stride, padding=padding, **arguments)
    # nir 1.0.8 gets the output type of a rectangular kernel wrong: no type check.
    nodes = {"input": nir.Input({"input": np.array([weight.shape[1], *side])}), "c": node}
    nodes["output"] = nir.Output({"output": np.array([len(weight)])})
    edges = [("input", "c"), ("c", "output")]
    return nir.NIRGraph(nodes, edges, metadata={"dt": 1.0}, type_check=False)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    channels=st.integers(1, 3),
    out=st.integers(1, 4),
    side=st.tuples(st.integers(5, 9), st.integers(5, 9)),
    kernel=st.tuples(st.integers(1, 4), st.integers(1, 4)),
    stride=st.one_of(st.integers(1, 3), st.tuples(st.integers(1, 3), st.integers(1, 3))),
    padding=st.one_of(st.integers(0, 2), st.tuples(st.integers(0, 2), st.integers(0, 2)), st.sampled_from(["valid"])),
    as_array=st.booleans(),
    seed=st.integers(0, 2**20),
)
def test_convolutions_equal_pytorch(channels, out, side, kernel, stride, padding, as_array, seed) -> None:
    """Small integers: every sum is exact in float32, so the results are equal bit for bit."""
    rng = np.random.default_rng(seed)
    weight = rng.integers(*INTEGERS, (out, channels, *kernel)).astype(np.float32)
    x = rng.integers(*INTEGERS, (2, 3, channels, *side)).astype(np.float32)
    # A file's numbers come back as NumPy's, its pairs as arrays.
    stored = (np.asarray(v)[()] if as_array and not isinstance(v, str) else v for v in (stride, padding))
    outputs, _ = NirInterpreter(convolution(weight, side, *stored)).run(x)
    bias = torch.arange(out, dtype=torch.float64)
    for step in range(2):
        expected = F.conv2d(
            torch.from_numpy(x[step]).double(), torch.from_numpy(weight).double(), bias, stride, padding
        )
        assert np.array_equal(outputs[step], expected.numpy())


@pytest.mark.parametrize("kernel", [(1, 1), (3, 3), (5, 3)])
def test_padding_same_equals_pytorch(kernel: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    weight = rng.integers(*INTEGERS, (2, 3, *kernel)).astype(np.float32)
    x = rng.integers(*INTEGERS, (1, 4, 3, 6, 7)).astype(np.float32)
    outputs, _ = NirInterpreter(convolution(weight, (6, 7), 1, "same")).run(x)
    bias = torch.arange(2, dtype=torch.float64)
    expected = F.conv2d(torch.from_numpy(x[0]).double(), torch.from_numpy(weight).double(), bias, 1, "same")
    assert np.array_equal(outputs[0], expected.numpy())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dilation": (1, 2)}, r"node c has dilation \[1, 2\], expected 1"),
        ({"groups": 3}, "node c has groups 3, expected 1"),
        ({"stride": (-1, 1)}, r"node c has stride \[-1, 1\], expected one or two numbers >= 1"),
        ({"padding": -1}, r"node c has padding \[-1, -1\], expected one or two numbers >= 0"),
        ({"padding": np.array([1, 1, 1])}, r"padding \[1, 1, 1\], expected one or two numbers"),
        ({"padding": "same", "stride": 2}, r"padding 'same' with stride \(2, 2\)"),
        ({"padding": "same", "kernel": 2}, "a kernel of 2 x 2, expected stride 1 and odd sides"),
    ],
)
def test_convolutions_that_are_not_known_are_refused(changes: dict[str, Any], message: str) -> None:
    kernel = changes.pop("kernel", 3)
    arguments = {"stride": 1, "padding": 0, **changes}
    with pytest.raises(ExportError, match=message):
        NirInterpreter(convolution(np.ones((3, 3, kernel, kernel), np.float32), (6, 6), **arguments))


def test_structures_that_are_not_known_are_refused() -> None:
    two = shapes((2,), (2,), other=nir.Input({"input": np.array([2])}), n=if_neurons(2))
    edges = [("input", "n"), ("other", "n"), ("n", "output")]
    with pytest.raises(ExportError, match="has 2 Input nodes, expected one"):
        NirInterpreter(graph(two, edges, dt=1.0))
    apart = shapes((2,), (2,), n=if_neurons(2), a=if_neurons(2), b=if_neurons(2))
    edges = [("input", "n"), ("n", "output"), ("a", "b"), ("b", "a")]
    with pytest.raises(ExportError, match="no path leads from the NIR graph's Input to a, b"):
        NirInterpreter(graph(apart, edges, dt=1.0))
    partly = shapes((2, 3, 4), (2, 12), f=nir.Flatten({"input": np.array([2, 3, 4])}, start_dim=1, end_dim=-1))
    with pytest.raises(ExportError, match=r"f flattens to \[2, 12\], expected one dimension"):
        NirInterpreter(graph(partly, dt=1.0))
    stacked = shapes((2, 4), (2, 3), w=nir.Linear(np.ones((2, 3, 4), np.float32)))
    with pytest.raises(ExportError, match=r"w has weights of shape \(2, 3, 4\), expected \(outputs, inputs\)"):
        NirInterpreter(graph(stacked, dt=1.0))


# --- our own files


@pytest.fixture
def exported(tmp_path: Path):
    """A variant's exact copy with its NIR file of task 1 and dyadic observations."""

    def make(variant: str, profile: str | None = None, count: int = 40):
        agent = make_agent(**VARIANTS[variant])
        x = dyadic_observations(observations(agent, count))
        if variant == "rate":  # grey pixels, so that what is drawn matters
            agent.suite = replace(agent.suite, scale=0.5)
        agent, exact = exact_copy(agent, [x] * 3)
        assert exact
        written = nir_graph(fold_agent(agent), 1, profile or ("exact" if "subtract" in variant else "portable"))
        write_nir(written, tmp_path / "task.nir")
        return agent, x, tmp_path / "task.nir"

    return make


OWN = ["DSQN", "DSQN_D", "MTSpark_AD", "SwitchMT", "rate", "latency", "frames", "events", "subtract", "LIF"]
OWN += ["LIF subtract", "Synaptic subtract", "per_neuron", "mlp", "T 7", "T 1", "last_membrane", "missing actions"]


@pytest.mark.slow
@pytest.mark.parametrize("variant", OWN)
def test_own_files_count_like_the_network(variant: str, exported, tmp_path: Path) -> None:
    agent, x, path = exported(variant)
    assert len(x) > 32, "more than one chunk"
    expected = count_task(agent, 1, x)
    seen = counted(path, saved(tmp_path / "x.npz", observations=x))
    assert (seen.task, seen.decisions, seen.timesteps, seen.spiking) == ("asterix", 40, expected.timesteps, True)
    assert all(sum(layer.spikes_T) > 0 for layer in expected.layers[:-1]), "a silent layer proves nothing"
    assert len(seen.layers) == len(expected.layers)
    for mine, theirs in zip(seen.layers, expected.layers, strict=True):
        # The file has the gains folded into its weights.
        assert vars(mine) == vars(theirs) | {"gain_multiplications_per_decision": 0}


class Heard:
    """Keeps what a piece of work was called and how far it came."""

    def __init__(self) -> None:
        self.said: list[tuple[str, int, int]] = []

    def begun(self, work: Work) -> None:
        self.advanced(work)

    def advanced(self, work: Work) -> None:
        self.said.append((work.what, work.done, work.total))

    def ended(self, work: Work) -> None:
        self.advanced(work)


def test_counting_says_how_far_it_is(exported, tmp_path: Path) -> None:
    _, x, path = exported("T 1")
    heard = Heard()
    with listening(heard):
        counted(path, saved(tmp_path / "x.npz", observations=x))
    assert heard.said[0] == (f"counting {path.name}", 0, 40)
    assert heard.said[-1] == (f"counting {path.name}", 40, 40)
    assert 0 < heard.said[1][1] < 40, "it is told between the chunks"


@pytest.mark.slow
@pytest.mark.parametrize(("variant", "profile"), [("LIF", "legacy"), ("subtract", "legacy"), ("LIF", "spikingjelly")])
def test_other_profiles_count_the_same(variant: str, profile: str, exported, tmp_path: Path) -> None:
    agent, x, path = exported(variant, profile)
    seen, expected = counted(path, saved(tmp_path / "x.npz", observations=x)), count_task(agent, 1, x)
    assert [layer.effective_T for layer in seen.layers] == [layer.effective_T for layer in expected.layers]
    assert [layer.spikes_T for layer in seen.layers] == [layer.spikes_T for layer in expected.layers]


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["SwitchMT", "latency", "frames"])
def test_encoded_inputs_count_like_raw_observations(variant: str, exported, tmp_path: Path) -> None:
    agent, x, path = exported(variant)
    encoded = encode(agent.suite, agent.config, x, 0)
    raw = counted(path, saved(tmp_path / "x.npz", observations=x))
    assert counted(path, saved(tmp_path / "e.npz", inputs=encoded)) == raw
    if variant == "SwitchMT":  # inputs that do change are not counted once
        changing = encoded.copy()
        changing[1] = 0
        seen = counted(path, saved(tmp_path / "c.npz", inputs=changing)).layers[0]
        assert seen.effective_T == (raw.layers[0].effective_T[0], 0, *raw.layers[0].effective_T * 2)


@pytest.mark.slow
def test_a_missing_event_threshold_is_not_guessed(exported, tmp_path: Path) -> None:
    _, x, path = exported("events")
    stored = nir.read(path)
    del stored.metadata["event_threshold"]
    write_nir(stored, path)
    with pytest.raises(ExportError, match="no event_threshold, expected it for events; export again"):
        counted(path, saved(tmp_path / "x.npz", observations=x))


@pytest.mark.slow
def test_metadata_that_is_no_number_is_refused(exported, tmp_path: Path) -> None:
    _, x, path = exported("events")
    good, inputs = nir.read(path), saved(tmp_path / "x.npz", observations=x)
    for key in ("timesteps", "frame_stack", "scale", "event_threshold", "observation_shape"):
        changed = nir.read(path)
        changed.metadata = {**good.metadata, key: np.zeros((0, 2))}
        write_nir(changed, tmp_path / "changed.nir")
        with pytest.raises(ExportError, match=f"the NIR graph's {key} is .*, expected .* number"):
            counted(tmp_path / "changed.nir", inputs)


# --- anybody's files


def foreign(**metadata: Any) -> nir.NIRGraph:
    """Padding 1, stride (2, 1), no metadata of ours; some weights pruned."""
    rng = np.random.default_rng(3)
    kernel = rng.integers(*INTEGERS, (3, 2, 3, 3)).astype(np.float32)
    weight = rng.integers(*INTEGERS, (4, 3 * 3 * 5)).astype(np.float32)
    conv = nir.Conv2d((6, 5), kernel, (2, 1), 1, 1, 1, np.ones(3, np.float32))
    flatten = nir.Flatten({"input": np.array([3, 3, 5])}, start_dim=0, end_dim=-1)
    between = {"conv": conv, "fire": if_neurons(3, 3, 5, threshold=2.0), "flat": flatten, "fc": nir.Linear(weight)}
    return graph(shapes((2, 6, 5), (4,), **between), **metadata)


def dense_hand_count(present: np.ndarray, weight: np.ndarray) -> int:
    """Pairs of a non-zero input and a non-zero weight, position by position of the foreign graph's convolution."""
    count = 0
    for top in range(-1, 6 + 1 - 2, 2):
        for left in range(-1, 5 + 1 - 2):
            for y in range(3):
                for x in range(3):
                    if 0 <= top + y < 6 and 0 <= left + x < 5:
                        reached = (weight[:, :, y, x] != 0).sum(axis=0)
                        count += int((present[:, :, :, top + y, left + x].sum(axis=(0, 1)) * reached).sum())
    return count


@pytest.mark.slow
@pytest.mark.parametrize("binary", [True, False])
def test_a_foreign_graph_equals_a_dense_hand_count(binary: bool, tmp_path: Path) -> None:
    written = foreign()
    nir.write(tmp_path / "foreign.nir", written)
    rng = np.random.default_rng(4)
    inputs = rng.integers(0, 2 if binary else 4, (3, 35, 2, 6, 5)).astype(np.uint8)
    seen = counted(tmp_path / "foreign.nir", saved(tmp_path / "x.npz", inputs=inputs, dt=1.0))
    assert (seen.task, seen.decisions, seen.timesteps) == ("foreign", 35, 3)
    conv, fc = seen.layers
    kernel, weight = written.nodes["conv"].weight, written.nodes["fc"].weight
    assert (conv.name, conv.convolution, conv.operation) == ("conv", True, "AC" if binary else "MAC")
    assert (fc.name, fc.convolution, fc.operation) == ("fc", False, "AC")
    assert sum(conv.effective_T) == dense_hand_count(inputs != 0, kernel)
    assert conv.dense_per_decision == 3 * dense_hand_count(np.ones((1, 1, 2, 6, 5)), np.ones_like(kernel))
    # IF by hand, on PyTorch's convolution.
    currents = [
        F.conv2d(torch.from_numpy(x).double(), torch.from_numpy(kernel).double(), torch.ones(3).double(), (2, 1), 1)
        for x in inputs
    ]
    v, spikes = torch.zeros_like(currents[0]), []
    for current in currents:
        v = v + current
        spikes.append(v > 2.0)
        v = torch.where(spikes[-1], 0.0, v)
    fired = torch.stack(spikes).numpy()
    assert conv.spikes_T == tuple(fired.sum(axis=(1, 2, 3, 4)))
    assert (conv.neurons, conv.outputs, conv.neuron_updates_per_decision) == (45, 45, 135)
    assert fc.effective_T == tuple((fired.reshape(3, 35, -1).sum(axis=1) @ (weight != 0).sum(axis=0)).tolist())
    assert (fc.neurons, fc.outputs, fc.spikes_T, fc.neuron_updates_per_decision) == (0, 4, (), 0)


@pytest.mark.slow
def test_a_recurrent_layer_shares_its_neurons(tmp_path: Path) -> None:
    """The neurons belong to the weights that come first; what a Scale has changed is multiplied."""
    eye = np.eye(2, dtype=np.float32)
    between = {
        "fc": nir.Linear(2 * eye),
        "fire": if_neurons(2),
        "back": nir.Linear(eye),
        "half": nir.Scale(np.full(2, 0.5, np.float32)),
        "head": nir.Linear(np.ones((1, 2), np.float32)),
    }
    edges = [("input", "fc"), ("fc", "fire"), ("fire", "back"), ("back", "fire"), ("fire", "half"), ("half", "head")]
    nir.write(tmp_path / "loop.nir", graph(shapes((2,), (1,), **between), [*edges, ("head", "output")], dt=1.0))
    inputs = np.array([[[1, 0]], [[0, 0]], [[0, 1]]], np.float32)
    seen = counted(tmp_path / "loop.nir", saved(tmp_path / "x.npz", inputs=inputs))
    by_name = {layer.name: layer for layer in seen.layers}
    # Neuron 1 fires at step 1 and is driven back by 1, which is no more than the threshold; neuron 2 fires at step 3.
    assert by_name["fc"].spikes_T == (1, 0, 1)
    assert {name: layer.neurons for name, layer in by_name.items()} == {"fc": 2, "back": 0, "head": 0}
    assert {name: layer.operation for name, layer in by_name.items()} == {"fc": "AC", "back": "AC", "head": "MAC"}
    assert all(layer.effective_T == (1, 0, 1) for layer in seen.layers)


# --- bad input


def refused(path: Path, observations: Path, message: str) -> None:
    with pytest.raises(ExportError, match=message) as caught:
        counted(path, observations)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_bad_observations_are_refused_in_one_line(tmp_path: Path, exported) -> None:
    _, x, path = exported("SwitchMT", count=4)
    stored = tmp_path / "x.npz"
    refused(path, tmp_path / "none.npz", r"none\.npz cannot be read \(.*No such file.*expected an \.npz file")
    for content in (b"", b"not an archive", b"PK\x03\x04 cut off"):
        stored.write_bytes(content)
        refused(path, stored, "cannot be read .*expected an .npz file with 'observations' or 'inputs'")
    with stored.open("wb") as file:
        np.save(file, x)
    refused(path, stored, r"cannot be read \(it is a single array\)")
    saved(stored, observations=x)
    stored.write_bytes(stored.read_bytes().replace(x.tobytes()[:64], bytes(64)))
    refused(path, stored, "cannot be read .*CRC")
    refused(path, saved(stored, observations=np.array([{}])), "cannot be read .*observations.npy holds objects")
    refused(path, saved(stored, frames=x), "holds 'frames', expected an .npz file with 'observations'")
    refused(path, saved(stored, observations=x, inputs=x), "holds observations and inputs, expected either")
    refused(path, saved(stored, observations=x.astype(str)), "observations has values of type <U3, expected numbers")
    bad = x.astype(np.float32)
    bad[2, 0, 1, 1] = np.nan
    refused(path, saved(stored, observations=bad), r"observations holds nan at \[2, 0, 1, 1\], expected finite numbers")
    shape = r"expected \[N, 6, 10, 10\] with N >= 1"
    refused(path, saved(stored, observations=x[:, :2]), rf"has shape \[4, 2, 10, 10\], {shape}")
    refused(path, saved(stored, observations=x[:0]), rf"has shape \[0, 6, 10, 10\], {shape}")
    refused(path, saved(stored, observations=1), rf"has shape \[\], {shape}")
    encoded = np.stack([x] * 4)
    shape = r"expected \[4, N, 6, 10, 10\] with T and N >= 1"
    for wrong in (encoded[0], encoded[:3], encoded[:, :0], encoded[:, :, :2], np.array(1)):
        refused(path, saved(stored, inputs=wrong), shape)
    for dt in (0.0, [1.0, 2.0]):
        refused(path, saved(stored, inputs=encoded, dt=dt), "dt is .*, expected one number above 0")


@pytest.mark.slow
def test_bad_graphs_are_refused_in_one_line(tmp_path: Path) -> None:
    path, inputs = tmp_path / "graph.nir", np.ones((2, 3, 2, 6, 5), np.float32)
    stored = saved(tmp_path / "x.npz", inputs=inputs)

    def written(it: nir.NIRNode) -> Path:
        nir.write(path, it)
        return path

    refused(tmp_path / "none.nir", stored, r"none\.nir cannot be read")
    refused(written(if_neurons(2)), stored, "cannot be read .*expected a NIR file")
    refused(written(foreign()), stored, "has dt, expected the length of a simulation step; store it beside the inputs")
    raw = saved(tmp_path / "raw.npz", observations=inputs[0])
    refused(written(foreign(dt=1.0)), raw, r"store encoded inputs of shape \[T, N, 2, 6, 5\] as 'inputs' instead")
    for value in (np.nan, np.inf):
        bad = foreign(dt=1.0)
        bad.nodes["conv"].weight[1, 0, 2, 2] = value
        refused(written(bad), stored, rf"weight of 'conv' holds {value} at \[1, 0, 2, 2\], expected finite numbers")
    pool = nir.SumPool2d(np.array([2, 2]), np.array([2, 2]), np.array([0, 0]))
    refused(written(graph(shapes((2, 6, 4), (2, 3, 2), pool=pool), dt=1.0)), stored, "has SumPool2d, expected only")

    flat_kernel = nir.Conv2d((6, 5), np.ones((3, 2, 3, 1), np.float32), 1, 0, 1, 1, np.ones(3, np.float32))
    between = {"conv": flat_kernel, "n": if_neurons(3, 4, 3)}
    # nir takes it for a square one, so the neurons have to have the wrong shape.
    wrong = r"n has r of shape \(3, 4, 3\), which do not fit a signal of \(3, 4, 5\)"
    refused(written(graph(shapes((2, 6, 5), (3, 4, 3), **between), dt=1.0)), stored, wrong)

    flat = saved(tmp_path / "flat.npz", inputs=np.ones((2, 3, 2), np.float32))
    eye = np.eye(2, dtype=np.float32)
    refused(
        written(graph(shapes((2,), (2,), fc=nir.Linear(eye)), dt=1.0)), flat, "has no spiking node, expected one of IF"
    )
    refused(written(graph(shapes((2,), (2,), n=if_neurons(2)), dt=1.0)), flat, "no weights lead to the NIR node n")
    fork = shapes((2,), (2,), fc=nir.Linear(eye), a=if_neurons(2), b=if_neurons(2))
    edges = [("input", "fc"), ("fc", "a"), ("fc", "b"), ("a", "output"), ("b", "output")]
    refused(written(graph(fork, edges, dt=1.0)), flat, "fc feeds the spiking nodes . and ., expected one")
    joined = shapes((2,), (2,), fc=nir.Linear(eye), n=if_neurons(2), skip=nir.Linear(eye))
    edges = [("input", "fc"), ("fc", "n"), ("n", "skip"), ("input", "skip"), ("skip", "output")]
    refused(written(graph(joined, edges, dt=1.0)), flat, "skip adds up n, input, expected one source before weights")
