"""Exported files of strangers: what is refused before or within the child process, and that limits end it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import h5py
import nir
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from switchmt_snn.errors import ExportError
from switchmt_snn.export.folded import fold_agent
from switchmt_snn.export.formats.onnx_writer import decision_model
from switchmt_snn.export.runtimes import guarded, guarded_child
from switchmt_snn.export.runtimes.agents import OnnxAgent, onnx_session, read_nir, require_numbers
from switchmt_snn.export.runtimes.nir_interpreter import NirInterpreter
from switchmt_snn.export.runtimes.onnx_walk import MOST_NODES, require_plain
from tests.export.export_cases import make_agent


@pytest.fixture
def nir_file(tmp_path: Path) -> Path:
    eye, ones = np.eye(2, dtype=np.float32), np.ones(2, np.float32)
    nodes = {
        "input": nir.Input({"input": np.array([2])}),
        "fc": nir.Linear(eye),
        "n": nir.IF(r=ones, v_threshold=ones, v_reset=0 * ones),
        "output": nir.Output({"output": np.array([2])}),
    }
    edges = [("input", "fc"), ("fc", "n"), ("n", "output")]
    nir.write(tmp_path / "a.nir", nir.NIRGraph(nodes, edges, metadata={"dt": 1.0, "note": "é"}))
    return tmp_path / "a.nir"


@pytest.mark.slow
def test_the_child_reads_what_nir_reads(nir_file: Path) -> None:
    mine, theirs = read_nir(nir_file), nir.read(nir_file)
    assert mine.edges == theirs.edges
    assert mine.metadata == theirs.metadata
    assert list(mine.nodes) == list(theirs.nodes)
    for name, node in theirs.nodes.items():
        assert type(mine.nodes[name]) is type(node)
        np.testing.assert_equal(vars(mine.nodes[name]), vars(node))


def refuse_nir(path: Path, reason: str) -> None:
    with pytest.raises(ExportError, match=reason) as refused:
        read_nir(path)
    assert str(refused.value).isprintable()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ("soft", "'weight' is a SoftLink to another place"),
        ("external", "'weight' is a ExternalLink to another place"),
        ("storage", "the values of 'weight' lie in other files"),
        ("virtual", "the values of 'weight' lie in other files"),
        ("large", "expected at most 268,435,456"),
        ("filter", "has the filter 32000, expected gzip, shuffle, fletcher32"),
        ("loop", "its groups have more than 8 levels"),
        ("nan", "weight of 'fc' holds nan at"),
        ("text", "weight of 'fc' holds text"),
        ("compound", "expected numbers or text"),
        ("type", "it is a Linear|AssertionError"),
    ],
)
def test_hdf5_that_reaches_elsewhere_or_is_too_large(nir_file: Path, change: str, reason: str) -> None:
    secret = nir_file.with_name("secret")
    secret.write_bytes(np.ones(4, np.float32).tobytes())
    with h5py.File(nir_file.with_name("other.h5"), "w") as other:
        other["weight"] = np.eye(2, dtype=np.float32)
    with h5py.File(nir_file, "a") as file:
        node = file["node/nodes/fc"]
        del node["weight"]
        if change == "soft":
            node["weight"] = h5py.SoftLink("/node/edges")
        elif change == "external":
            node["weight"] = h5py.ExternalLink("other.h5", "weight")
        elif change == "storage":
            node.create_dataset("weight", (2, 2), "f4", external=[(str(secret), 0, 16)])
        elif change == "virtual":
            layout = h5py.VirtualLayout((2, 2), "f4")
            layout[:] = h5py.VirtualSource(nir_file.with_name("other.h5"), "weight", (2, 2))
            node.create_virtual_dataset("weight", layout)
        elif change == "large":
            node.create_dataset("weight", (2**14, 2**13), "f4", chunks=(64, 64), compression="gzip")
        elif change == "filter":
            node.create_dataset("weight", data=np.eye(2, dtype=np.float32), compression="lzf")
        elif change == "loop":
            node["weight"] = np.eye(2, dtype=np.float32)
            node["again"] = file["node"]
        elif change == "nan":
            node["weight"] = np.full((2, 2), np.nan, np.float32)
        elif change == "text":
            node.create_dataset("weight", data=np.array([["a", "b"], ["c", "d"]], object), dtype=h5py.string_dtype())
        elif change == "compound":
            node["weight"] = np.zeros((2, 2), [("a", "f4"), ("b", "f4")])
        else:
            del file["node"]
            file.create_group("node").update({"type": "Linear", "weight": np.eye(2)})
    refuse_nir(nir_file, reason)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("program", "reason"),
    [
        ("while True: pass", "takes more than 10 s of processor time"),
        ("list(bytes(2**28) for _ in range(8))", "it needs too much memory"),
        ("os.abort()", "its parser fails with SIGABRT"),
        ("print(1)", "is not the answer"),
    ],
)
def test_limits_end_the_child(
    nir_file: Path, program: str, reason: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A parser that does not end, takes all memory, or crashes."""
    source = Path(guarded_child.__file__).read_text()
    body = "MOST_CPU_S = 1\nimport sys\nsys.stdin.buffer.read(1)\ntry:\n limit_resources()\n " + program
    broken = tmp_path / "child.py"
    end = (
        "\nexcept MemoryError:\n sys.stderr.write('it needs too much memory')\n sys.stderr.flush()\n os._exit(REFUSED)"
    )
    broken.write_text(source[: source.index('\nif __name__ == "__main__"')] + "\n" + body + end)
    monkeypatch.setattr(guarded_child, "__file__", str(broken))
    refuse_nir(nir_file, reason if reason != "is not the answer" else "cannot be read")


def test_only_plain_files_of_bounded_size_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path, reason in (
        (tmp_path / "pipe", "no plain file"),
        (Path("/dev/zero"), "no plain file"),
        (tmp_path, "no pl"),
    ):
        refuse_nir(path, reason)
        with pytest.raises(ExportError, match=reason):
            onnx_session(path)
    monkeypatch.setattr(guarded, "MOST_FILE_BYTES", 10)
    (tmp_path / "large").write_bytes(bytes(11))
    refuse_nir(tmp_path / "large", "it has 11 bytes, expected at most 10")


@pytest.mark.parametrize(
    ("node", "reason"),
    [
        (nir.Scale(np.ones(3, np.float32)), r"x has scale of shape \(3,\), which do not fit a signal of \(2,\)"),
        (nir.Linear(np.ones((2, 3), np.float32)), "x has weights of 3 inputs"),
        (nir.LIF(*(np.zeros(2, np.float32),) * 4, v_reset=np.zeros(2)), "x has a tau of 0 or less"),
    ],
)
def test_nir_nodes_that_do_not_fit_their_signal(node: nir.NIRNode, reason: str) -> None:
    nodes = {"i": nir.Input({"input": np.array([2])}), "x": node, "o": nir.Output({"output": np.array([2])})}
    graph = nir.NIRGraph(nodes, [("i", "x"), ("x", "o")], metadata={"dt": 1.0}, type_check=False)
    with pytest.raises(ExportError, match=reason):
        NirInterpreter(graph)


def test_nir_graphs_whose_signals_or_dt_are_out_of_bounds() -> None:
    def graph(side: Any, dt: Any = 1.0, nodes: int = 0) -> nir.NIRGraph:
        shape = np.array(side)
        more = {f"s{number}": nir.Scale(np.ones(1, np.float32)) for number in range(nodes)}
        ends = {"i": nir.Input({"input": shape}), "o": nir.Output({"output": shape})}
        return nir.NIRGraph(ends | more, [("i", "o")], metadata={"dt": dt}, type_check=False)

    for made, reason in (
        (graph([10**6, 10**6]), "signals have 1,000,000,000,000 values at i, expected at most"),
        (graph([2.5]), "has the shape"),
        (graph([0]), "has the shape"),
        (graph([2], "x"), "dt is x, expected one number above 0"),
        (graph([2], np.nan), "dt is nan"),
        (graph([2], 1.0, 500), "has 502 nodes, expected at most 500"),
    ):
        with pytest.raises(ExportError, match=reason):
            NirInterpreter(made)
    with pytest.raises(ExportError, match=r"Input has the shape \(2,\), expected \(3,\)"):
        NirInterpreter(graph([2])).run(np.zeros((1, 1, 3), np.float32))


def model(*nodes: onnx.NodeProto, initializer: tuple[onnx.TensorProto, ...] = (), domain: str = "") -> onnx.ModelProto:
    x, y = (helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", 2]) for name in "xy")
    graph = helper.make_graph(list(nodes), "g", [x], [y], list(initializer))
    return helper.make_model(graph, opset_imports=[helper.make_opsetid(domain, 18)], ir_version=8)


def outside() -> onnx.TensorProto:
    tensor = numpy_helper.from_array(np.ones(2, np.float32), "w")
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="/etc/passwd")
    return tensor


def body(*nodes: onnx.NodeProto, initializer: tuple[onnx.TensorProto, ...] = ()) -> onnx.GraphProto:
    return helper.make_graph(list(nodes), "b", [], [], list(initializer))


def nested(levels: int) -> onnx.NodeProto:
    return helper.make_node("Scan", [], [], body=body(nested(levels - 1)) if levels else body(), num_scan_inputs=1)


IDENTITY = helper.make_node("Identity", ["x"], ["y"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("made", "reason"),
    [
        (model(IDENTITY, initializer=(outside(),)), "keeps weights in other files"),
        (model(helper.make_node("Constant", [], ["y"], value=outside())), "keeps weights in other files"),
        (model(helper.make_node("Scan", ["x"], ["y"], body=body(initializer=(outside(),)))), "keeps weights in other"),
        (model(helper.make_node("Loop", ["", ""], ["y"], body=body())), "the operator Loop, expected one whose cost"),
        (model(helper.make_node("If", ["x"], ["y"], then_branch=body(helper.make_node("Loop", [], [])))), "operator"),
        (model(helper.make_node("Scan", ["x"], ["y"], body=body(helper.make_node("Loop", [], [])))), "operator Loop"),
        (model(*[IDENTITY] * (MOST_NODES + 1)), "more than 100,000 operators"),
        (model(nested(5)), "graphs in more than 4 levels"),
        (model(IDENTITY, domain="com.microsoft"), "the operators of 'com.microsoft'"),
        (model(helper.make_node("Identity", ["x"], ["y"], domain="own")), "the operator own:Identity"),
        (model(helper.make_node("ConstantOfShape", ["x"], ["y"])), "the size of 'y' depends on values"),
        (model(helper.make_node("Expand", ["x", "x"], ["y"])), "the size of 'y' depends on values"),
        (
            model(IDENTITY, initializer=(numpy_helper.from_array(np.float32(np.nan), "w"),)),
            "'w' holds a number that is",
        ),
        (onnx.ModelProto(), "it has no graph"),
    ],
)
def test_onnx_that_reaches_elsewhere_or_has_no_bound(made: onnx.ModelProto, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        require_plain(made)
    with pytest.raises(ExportError, match=reason.replace("'w'", ".w.")):
        onnx_session(made.SerializeToString() or b"")


@pytest.mark.slow
def test_a_model_is_tried_in_a_child_before_it_is_opened_here(tmp_path: Path) -> None:
    side = numpy_helper.from_array(np.array([2**33], np.int64), "side")
    large = model(helper.make_node("ConstantOfShape", ["side"], ["z"]), IDENTITY, initializer=(side,))
    large.graph.output[0].name = "z"
    (tmp_path / "large.onnx").write_bytes(large.SerializeToString())
    with pytest.raises(ExportError, match=r"large.onnx cannot be read \(.*expected an ONNX file"):
        onnx_session(tmp_path / "large.onnx")
    agent = make_agent()
    ours = tmp_path / "decision.onnx"
    ours.write_bytes(decision_model(fold_agent(agent)).SerializeToString())
    assert OnnxAgent(ours, agent.suite, agent.config).step == agent.step


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ("name", "the ONNX file gives 'others', expected q_values"),
        ("shape", r"Q-values of type uint8 and shape \(3, 6, 10, 10\) in"),
        ("step", "training_step is 'x', expected a whole number"),
        ("input", "the ONNX file cannot decide"),
    ],
)
def test_an_onnx_file_of_another_network(change: str, reason: str) -> None:
    agent = make_agent()
    made = model(IDENTITY)
    made.graph.input[0].name = "observation"
    made.graph.node[0].input[0] = "observation"
    made.graph.node[0].output[0] = made.graph.output[0].name = "others" if change == "name" else "q_values"
    made.metadata_props.add(key="training_step", value="x" if change == "step" else "3")
    for value in (made.graph.input[0], made.graph.output[0]):
        value.type.tensor_type.ClearField("shape")
        if change != "input":
            value.type.tensor_type.elem_type = TensorProto.UINT8

    def play(observations: Any) -> None:
        OnnxAgent(made.SerializeToString(), agent.suite, agent.config).q_values(observations, 0)

    with pytest.raises(ExportError, match=reason):
        play(np.zeros((3, *agent.suite.observation_shape), np.uint8))
    with pytest.raises(ExportError, match="of shape"):
        require_numbers(np.zeros((1, 2), np.float32), 2, np.ones(2, np.bool_), "NIR", "a")
