"""Exported files as agents: onnxruntime and the NIR interpreter play and answer like the trained network."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import nir
import numpy as np
import numpy.typing as npt
import onnx
import onnxruntime
import torch

from switchmt_snn.acting.agent import Agent
from switchmt_snn.acting.evaluation import DecisionMaker
from switchmt_snn.config import ExperimentConfig
from switchmt_snn.errors import ExportError, reason_of
from switchmt_snn.export.npz import not_finite
from switchmt_snn.export.runtimes.guarded import nir_tree, read_file, require_runnable
from switchmt_snn.export.runtimes.nir_interpreter import Float, NirInterpreter
from switchmt_snn.export.runtimes.onnx_walk import require_plain
from switchmt_snn.machine.torch_settings import as_when_started
from switchmt_snn.spiking.encodings import encoding_class, make_encoding
from switchmt_snn.spiking.layers import ReadoutNode
from switchmt_snn.tasks.observations import raw_batch
from switchmt_snn.tasks.suite import TaskSuite

Observations = npt.NDArray[Any]


def onnx_session(model: Path | bytes, threads: int = 1) -> onnxruntime.InferenceSession:
    """A session; on one thread sums have one order.

    A file is first run once in a child process with limits of time and memory (``guarded``); bytes are of this process.

    Raises:
        ExportError: not an ONNX file, or one that this package does not run (``onnx_walk``).
    """
    content = model if isinstance(model, bytes) else read_file(model, "an ONNX file")
    with _readable(model, "an ONNX file"):
        require_plain(onnx.load_from_string(content))
        if not isinstance(model, bytes):
            require_runnable(content)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        options.log_severity_level = 3
        # Its fallback is to the same provider, and prints.
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"], enable_fallback=0)
        # Names and metadata that are no text fail when they are asked for.
        _ = (
            session.get_modelmeta().custom_metadata_map,
            [value.name for value in (*session.get_inputs(), *session.get_outputs())],
        )
        return session


def read_nir(path: Path) -> nir.NIRGraph:
    """A NIR graph from a file, which a child process reads (``guarded``).

    Raises:
        ExportError: missing, not a NIR file, or one that holds numbers that are not finite.
    """
    content = read_file(path, "a NIR file")
    with _readable(path, "a NIR file"):
        graph = nir.dict2NIRNode(nir_tree(content))
        if not isinstance(graph, nir.NIRGraph):
            raise ValueError(f"it is a {type(graph).__name__}")
        for name, node in graph.nodes.items():
            for parameter, values in vars(node).items():
                if parameter in ("padding", "metadata", "input_type", "output_type") or values is None:
                    continue
                if np.asarray(values).dtype.kind not in "biuf":
                    raise ValueError(f"{parameter} of {name!r:.60} holds text, expected numbers")
                if not np.isfinite(values).all():
                    raise ValueError(f"{parameter} of {name!r:.60} holds {not_finite(values)}, expected finite numbers")
        return graph


@contextmanager
def _readable(source: Path | bytes, expected: str) -> Iterator[None]:
    try:
        yield
    except ExportError:
        raise
    except Exception as error:  # onnx, onnxruntime, h5py and nir raise whatever their parsers meet
        name = str(source) if isinstance(source, Path) else "a model in memory"
        reason = reason_of(error)
        raise ExportError(f"{name} cannot be read ({reason:.160}), expected {expected}; export again") from error


def encode(suite: TaskSuite, config: ExperimentConfig, observations: Observations, seed_or_generator: Any) -> Float:
    """Encoded inputs ``[T, B, ...]`` as the network sees them (random encodings draw from the generator).

    Raises:
        ExportError: an encoding that is said to give spikes gave other values.
    """
    generator = seed_or_generator
    if isinstance(generator, int):
        generator = torch.Generator().manual_seed(generator)
    encoder = make_encoding(config.network, suite.frame_stack, suite.in_unit_range)
    scaled = torch.from_numpy(np.ascontiguousarray(observations)).to(torch.float32) * suite.scale
    encoded: Float = encoder(scaled, generator).numpy()
    if encoder.makes_spikes and not ((encoded == 0) | (encoded == 1)).all():
        raise ExportError(
            f"network.encoding {config.network.encoding} gave values other than 0 and 1, expected spikes as its "
            "makes_spikes says; set makes_spikes = False"
        )
    return np.broadcast_to(encoded, (config.network.timesteps, *encoded.shape[1:]))


def existing_only(q_BA: Float, valid_A: npt.NDArray[np.bool_]) -> Float:
    """Q ``[B, A]`` with -inf where an action does not exist."""
    return np.where(valid_A, q_BA, np.float32(-np.inf))


def require_numbers(q_BA: Float, batch: int, valid_A: npt.NDArray[np.bool_], file: str, task: str) -> None:
    """Refuse what are no Q-values ``[B, A]``, and those of existing actions that are not finite: their largest says
    nothing.

    Raises:
        ExportError: another shape, or one is NaN or infinite.
    """
    if q_BA.shape != (batch, len(valid_A)) or q_BA.dtype.kind != "f":
        raise ExportError(
            f"the {file} file gives Q-values of type {q_BA.dtype} and shape {q_BA.shape} in {task}, expected floats of "
            f"shape {(batch, len(valid_A))}; export the run again"
        )
    seen = q_BA[:, valid_A]
    if not np.isfinite(seen).all():
        raise ExportError(
            f"the {file} file gives the Q-value {seen[~np.isfinite(seen)][0]} in {task}, expected finite numbers; "
            "export the run again"
        )


def training_step(stored: Any) -> int:
    """The training step in a file's metadata.

    Raises:
        ExportError: it is no whole number.
    """
    try:
        return int(stored)
    except (TypeError, ValueError, OverflowError) as error:
        raise ExportError(
            f"the exported file's training_step is {stored!r:.60}, expected a whole number; export the run again"
        ) from error


class OnnxAgent:
    """``decision.onnx`` in onnxruntime.

    Attributes:
        step: training step of the weights, from the file.
    """

    def __init__(self, model: Path | bytes, suite: TaskSuite, config: ExperimentConfig, threads: int = 1) -> None:
        """Open a model.

        Args:
            model: file or bytes.
            suite: tasks of the run that it came from.
            config: of that run.
            threads: of onnxruntime; with more than one a single decision is faster.
        """
        self.session = onnx_session(model, threads)
        self.suite, self.config = suite, config
        self.step = training_step(self.session.get_modelmeta().custom_metadata_map.get("training_step"))
        self._inputs = [value.name for value in self.session.get_inputs()]
        self._generator = torch.Generator()

    def independent(self) -> OnnxAgent:
        """The same session (onnxruntime's may run in several threads) with random numbers of its own."""
        other = copy.copy(self)
        other._generator = torch.Generator()
        return other

    @property
    def draws(self) -> bool:
        """Whether a decision draws random numbers: of a random encoding."""
        return encoding_class(self.config.network.encoding).is_random

    def reseed(self, seed: int) -> None:
        """Restart the random numbers of the ``rate`` encoding."""
        self._generator.manual_seed(seed)

    def decide(
        self, observations: Observations, tasks_B: npt.NDArray[np.int64], encoded_TB: Float | None = None
    ) -> dict[str, npt.NDArray[Any]]:
        """All outputs by name; a batch may mix tasks. ``encoded_TB`` replaces the drawing of a random encoding."""
        fed: dict[str, Any] = {}
        if "encoded" in self._inputs:
            drawn = encode(self.suite, self.config, observations, self._generator) if encoded_TB is None else encoded_TB
            fed["encoded"] = np.ascontiguousarray(drawn)
        else:
            fed["observation"] = np.ascontiguousarray(observations)
        if "task" in self._inputs:
            fed["task"] = tasks_B
        names = [value.name for value in self.session.get_outputs()]
        return dict(zip(names, self._run(names, fed), strict=True))

    def _run(self, names: list[str], fed: dict[str, Any]) -> list[npt.NDArray[Any]]:
        try:
            values: list[npt.NDArray[Any]] = self.session.run(names, fed)
        except Exception as error:  # onnxruntime raises classes of its own, and ValueError for inputs that do not fit
            reason = reason_of(error)
            raise ExportError(
                f"the ONNX file cannot decide ({reason:.160}), expected a model of this run; export the run again"
            ) from error
        return values

    def q_values(self, observation: Observations, task: str | int) -> npt.NDArray[np.float32]:
        """As ``Agent.q_values``: ``[B, A]``, of one observation ``[A]``; -inf where an action does not exist."""
        index = self.suite.index(task)
        batch, single = raw_batch(self.suite, observation)
        outputs = self.decide(batch, np.full(len(batch), index))
        if "q_values" not in outputs:
            raise ExportError(
                f"the ONNX file gives {', '.join(outputs)!r:.80}, expected q_values; export the run again"
            )
        values: npt.NDArray[np.float32] = outputs["q_values"]
        valid_A = self.suite.valid_actions_KA[index]
        require_numbers(values, len(batch), valid_A, "ONNX", self.suite.names[index])
        return values[0] if single else values


class NirAgent:
    """NIR files, one per task, in the reference interpreter; encoding and readout are the host's."""

    def __init__(self, graphs: dict[str, nir.NIRGraph], suite: TaskSuite, config: ExperimentConfig) -> None:
        self.suite, self.config = suite, config
        # Only the legacy profile's IF may mean a reset by subtraction; a loop says it in its nodes.
        self.interpreters = {
            name: NirInterpreter(graph, reset=str(graph.metadata.get("reset", "zero")))
            for name, graph in graphs.items()
        }
        self.step = training_step(next(iter(graphs.values())).metadata.get("training_step"))
        self._generator = torch.Generator()

    def independent(self) -> NirAgent:
        """The same interpreters (a run keeps nothing) with random numbers of their own."""
        other = copy.copy(self)
        other._generator = torch.Generator()
        return other

    @property
    def draws(self) -> bool:
        """Whether a decision draws random numbers: of a random encoding."""
        return encoding_class(self.config.network.encoding).is_random

    def reseed(self, seed: int) -> None:
        """Restart the random numbers of the ``rate`` encoding."""
        self._generator.manual_seed(seed)

    def q_values(self, observation: Observations, task: str | int) -> npt.NDArray[np.float32]:
        """As ``Agent.q_values``: ``[B, A]``, of one observation ``[A]``; -inf where an action does not exist."""
        index = self.suite.index(task)
        batch, single = raw_batch(self.suite, observation)
        with as_when_started():
            encoded = encode(self.suite, self.config, batch, self._generator)
        outputs, _ = self.interpreters[self.suite.names[index]].run(encoded)
        settings = self.config.network
        q_BA, valid_A = (
            ReadoutNode(settings.readout, settings.readout_beta)(outputs),
            self.suite.valid_actions_KA[index],
        )
        require_numbers(q_BA, len(batch), valid_A, "NIR", self.suite.names[index])
        values = existing_only(q_BA, valid_A)
        return values[0] if single else values


class ComparedAgent:
    """A runtime that plays while the trained network is asked about the same observations.

    Attributes:
        compared: for every batch of greedy decisions, how many there were, and how many had the same action.
    """

    def __init__(self, runtime: DecisionMaker, reference: Agent) -> None:
        self.runtime, self.reference = runtime, reference
        self.suite, self.step = runtime.suite, runtime.step
        self.compared: list[tuple[int, int]] = []

    def independent(self) -> ComparedAgent:
        """Both for another thread; what is compared there is counted here as well."""
        other = ComparedAgent(self.runtime.independent(), self.reference.independent())
        other.compared = self.compared
        return other

    @property
    def draws(self) -> bool:
        """As the runtime."""
        return self.runtime.draws

    def reseed(self, seed: int) -> None:
        """Restart both."""
        self.runtime.reseed(seed)
        self.reference.reseed(seed)

    def q_values(self, observation: Observations, task: str | int) -> npt.NDArray[np.float32]:
        """The runtime's Q-values; the comparison is counted."""
        values, expected = self.runtime.q_values(observation, task), self.reference.q_values(observation, task)
        self.compared.append((len(values), int((values.argmax(axis=1) == expected.argmax(axis=1)).sum())))
        return values
