"""Mutants of exported files, ONNX and NIR, opened and asked for decisions as their runtimes do it."""

from __future__ import annotations

import contextlib
import functools
import io
import os
import random
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import h5py
import numpy as np
import onnx

from switchmt_snn.acting.agent import Agent
from switchmt_snn.export.counts.nir_file import count_nir
from switchmt_snn.export.folded import fold_agent
from switchmt_snn.export.formats.nir_writer import nir_graph, write_nir
from switchmt_snn.export.formats.onnx_writer import decision_model
from switchmt_snn.export.runtimes import guarded, guarded_child
from switchmt_snn.export.runtimes.agents import NirAgent, OnnxAgent, read_nir
from tests.export.export_cases import make_agent, observations
from tests.fuzz.mutations import HOSTILE_VALUES, array_mutant, binary_mutant

_DIALECTS = {"portable": "zero", "exact": "subtract"}
"""NIR dialects, and the reset that they take."""


@functools.cache
def _agent(reset: str) -> Agent:
    return make_agent(reset=reset, trunk="mlp", hidden_units=16, timesteps=2, tasks={"frame_stack": 1})


@functools.cache
def onnx_seeds() -> dict[str, bytes]:
    """Models for every task and for one, of a network that spikes."""
    network = fold_agent(_agent("zero"))
    return {"all": decision_model(network).SerializeToString(), "one": decision_model(network, 0).SerializeToString()}


@functools.cache
def nir_seeds() -> dict[str, bytes]:
    """Files of one task in two dialects."""
    files = {}
    with tempfile.TemporaryDirectory() as folder:
        for dialect, reset in _DIALECTS.items():
            write_nir(nir_graph(fold_agent(_agent(reset)), 0, dialect), Path(folder) / "a.nir")  # type: ignore[arg-type]
            files[dialect] = (Path(folder) / "a.nir").read_bytes()
    return files


def _forked(job: str, content: bytes) -> tuple[int, bytes, bytes]:
    """As ``guarded._start``, in a fork of this process, which takes a tenth of the time; the limits are the same."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, 2)
            guarded_child.MOST_CPU_S = 2  # a good file takes milliseconds
            code, output = guarded_child.answer(job, content)
            with os.fdopen(writing, "wb") as stream:
                stream.write(output)
            os._exit(code)
        finally:
            os._exit(1)
    os.close(writing)
    with os.fdopen(reading, "rb") as stream:
        output = stream.read()
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return code, output if code == 0 else b"", output


@contextmanager
def _forking() -> Iterator[None]:
    with mock.patch.object(guarded, "_start", _forked):
        yield


def read_onnx(folder: Path, content: bytes, number: int) -> None:
    """Open a model and decide."""
    path = folder / "mutant.onnx"
    path.write_bytes(content)
    agent = _agent("zero")
    with _forking():
        played = OnnxAgent(path, agent.suite, agent.config)
        q_values = played.q_values(observations(agent, 2), 0)
    assert np.isfinite(q_values[:, agent.suite.valid_actions_KA[0]]).all()


def read_nir_file(folder: Path, content: bytes, number: int) -> None:
    """Read a graph, decide, and count what it does."""
    path = folder / "mutant.nir"
    path.write_bytes(content)
    agent = _agent(list(_DIALECTS.values())[number % 2])
    x = observations(agent, 2)
    with _forking(), np.errstate(all="ignore"):
        name = agent.suite.names[0]
        played = NirAgent({name: read_nir(path)}, agent.suite, agent.config)
        q_values = played.q_values(x, name)
        assert np.isfinite(q_values[:, agent.suite.valid_actions_KA[0]]).all()
        if number % 4 == 0:
            np.savez(folder / "x.npz", observations=x)
            count_nir(path, folder / "x.npz")


def onnx_mutant(good: bytes, seed: int) -> bytes:
    """Other operators, attributes, names, sizes or weights, or damaged bytes."""
    rng = random.Random(seed)
    if rng.random() < 0.4:
        return binary_mutant(good, seed)
    model = onnx.load_from_string(good)
    for _ in range(rng.choice((1, 1, 2, 3))):
        _change_model(model, rng)
    return model.SerializeToString()


def _change_model(model: onnx.ModelProto, rng: random.Random) -> None:
    graphs = [model.graph, *(a.g for node in model.graph.node for a in node.attribute if a.HasField("g"))]
    graph = rng.choice(graphs)
    node = rng.choice(graph.node)
    change = rng.randrange(9)
    if change == 0:
        node.op_type = rng.choice(
            ("Loop", "If", "Expand", "Range", "Tile", "Pad", "Add", "Concat", "Identity", "NoSuch")
        )
    elif change == 1 and node.input:
        node.input[rng.randrange(len(node.input))] = rng.choice(
            (*[n for one in graph.node for n in one.output], "", "no")
        )
    elif change == 2 and node.attribute:
        attribute = rng.choice(node.attribute)
        if attribute.ints:
            attribute.ints[rng.randrange(len(attribute.ints))] = rng.choice((-1, 0, 7, 2**31, 2**62))
        else:
            attribute.i = rng.choice((-1, 0, 7, 2**31, 2**62))
    elif change == 3:
        graph.node.remove(node)
    elif change == 4:
        graph.node.append(node)
    elif change == 5:
        value = rng.choice((*model.graph.input, *model.graph.output))
        value.type.tensor_type.shape.dim[-1].dim_value = rng.choice((0, -1, 1, 5, 2**33))
    elif change == 6:
        entry = rng.choice(model.metadata_props)
        entry.value = rng.choice(("", "x", "-1", "9" * 5000, "nan", "\x1b[31m"))
    else:
        tensor = rng.choice(model.graph.initializer)
        try:
            changed = array_mutant(onnx.numpy_helper.to_array(tensor), rng)
        except ValueError:  # an earlier change made its shape another
            changed = None
        if changed is not None and changed.dtype.kind in "biuf":
            tensor.CopyFrom(onnx.numpy_helper.from_array(changed, tensor.name))
        else:
            tensor.dims[:] = [2**31, 2**31]


def nir_mutant(good: bytes, seed: int) -> bytes:
    """Other values, names or links, or damaged bytes, among them long runs of zeros."""
    rng = random.Random(seed)
    if rng.random() < 0.4:
        return binary_mutant(good, seed)
    if rng.random() < 0.2:
        start = rng.randrange(len(good))
        return good[:start] + bytes(len(good[start : start + rng.choice((8, 64, 512))])) + good[start + 512 :]
    content = io.BytesIO(good)
    with h5py.File(content, "r+") as file:
        for _ in range(rng.choice((1, 1, 2))):
            names: list[str] = []
            file.visit(names.append)
            name = rng.choice(names)
            with contextlib.suppress(OSError, RuntimeError):  # HDF5 refuses it after an earlier change
                _change_item(file, name, rng)
    return content.getvalue()


def _change_item(file: h5py.File, name: str, rng: random.Random) -> None:
    item: Any = file[name]
    change = rng.randrange(6)
    if change == 0:
        del file[name]
    elif change == 1:
        file.move(name, f"{name}{rng.choice(('x', chr(27), 'é'))}{rng.randrange(10**9)}")
    elif change == 2:
        del file[name]
        file[name] = rng.choice((h5py.SoftLink("/"), h5py.ExternalLink("/etc/passwd", "/"), h5py.SoftLink("/node")))
    elif change == 3:
        file[f"{name}-{rng.randrange(10**9)}"] = file.get("node", file)
    else:
        stored = item[()] if isinstance(item, h5py.Dataset) else 0
        value = rng.choice(
            [one for one in HOSTILE_VALUES if isinstance(one, (int, float, str)) and "\0" not in str(one)]
        )
        if isinstance(stored, (np.ndarray, np.generic)) and np.asarray(stored).dtype.kind in "biuf" and change == 4:
            changed = array_mutant(np.asarray(stored), rng)
            value = 0 if changed is None or changed.dtype.kind not in "biuf" else changed
        elif isinstance(value, int):
            value = int(np.clip(value, -(2**63), 2**63 - 1))
        del file[name]
        file[name] = value
