"""What happens on a GPU: an update without a word from the host, its CUDA graph, frames that lie there.

The tests that need a CUDA device are skipped where there is none; the first ones watch on the CPU what a graph needs.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from switchmt_snn.config import ExperimentConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.learner import Learner
from switchmt_snn.replay.ring import Batch, FrameReplay, Returns
from switchmt_snn.spiking.network import ObservationSpec, build_network
from switchmt_snn.updates.cuda_graph import CudaGraph
from tests.conftest import decided, small_config

CPU = torch.device("cpu")
IMAGES = ObservationSpec((4, 10, 10), 1, 1.0, True, 6, 3)
cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
FORMS: list[dict[str, Any]] = [
    {"learning": {"gradient_clip": "norm", "loss": "huber"}},
    {"learning": {"gradient_clip": "value", "double_q": False}},
    {"network": {"encoding": "rate", "neuron": "LIF", "learn_beta": True}},
    {"network": {"method": "DQN_D"}},
    {"learning": {"next_statistics": "batch"}},
    {"learning": {"next_statistics": "batch", "double_q": False}},
    {"network": {"quantiles": 4, "heads": "per_task"}, "learning": {"loss": "huber"}},
]


def config_of(form: dict[str, Any], **learning: Any) -> ExperimentConfig:
    network = {"trunk": "minatar", **form.get("network", {})}
    return small_config(network=network, learning={**form.get("learning", {}), **learning})


def learner_of(config: ExperimentConfig, device: torch.device) -> Learner:
    network = build_network(config.network, IMAGES, 1)
    return Learner(network, config.learning, np.ones((3, 6), np.bool_), device, 0)


def batch_of(seed: int) -> Batch:
    rng = np.random.default_rng(seed)
    images = (rng.random((2, 8, 4, 10, 10)) < 0.4).astype(np.uint8)
    rewards = rng.normal(size=8).astype(np.float32)
    return Batch(
        images[0], rng.integers(0, 6, 8), rewards, images[1], rng.random(8) < 0.2, np.full(8, 0.99, np.float32)
    )


class _NoWordToTheHost(TorchDispatchMode):
    """Raises where an operation makes the host wait for a number of the device's."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        waits = {"aten::_local_scalar_dense", "aten::nonzero", "aten::is_nonzero", "aten::equal", "aten::masked_select"}
        assert func._schema.name not in waits, f"{func._schema.name} reads a number back"
        return func(*args, **(kwargs or {}))


@contextmanager
def as_if_compiled(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The operations that torch.compile is given, one by one."""
    with monkeypatch.context() as patch:
        patch.setattr(torch.compiler, "is_compiling", lambda: True)
        yield


@pytest.mark.parametrize("form", FORMS)
def test_an_update_reads_nothing_back(form: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    learner = learner_of(config_of(form), CPU)
    learner.update(batch_of(0), 0)  # the optimiser makes its state
    with as_if_compiled(monkeypatch):
        with _NoWordToTheHost():
            learner.update(batch_of(1), 2)
        with _NoWordToTheHost(), pytest.raises(AssertionError, match="_local_scalar_dense"):
            float(learner.loss_sum)
    assert learner.take_means()["loss"] > 0


def test_everything_that_an_update_changes_stays_where_it_is() -> None:
    """A graph writes to the addresses that it was captured with."""
    learner = learner_of(config_of({}), CPU)
    learner.update(batch_of(0), 0)

    def places() -> list[int]:
        state = learner.optimizer.state_dict()["state"].values()
        tensors = [*learner.network.state_dict().values(), *learner.target.state_dict().values()]
        tensors += [value for values in state for value in values.values()] + [learner.loss_sum, learner.q_sum]
        return [tensor.data_ptr() for tensor in tensors]

    before = places()
    learner.update(batch_of(1), 1)
    learner.copy_target()
    learner.take_means()
    assert places() == before


def test_a_graph_refuses_a_learning_rate_that_falls() -> None:
    """The captured step holds the rate as a constant."""
    config = small_config(learning={"learning_rate_decay_updates": 100})
    reason = CudaGraph.unavailable(config, torch.device("cuda"))
    assert reason is not None
    assert "learning.learning_rate_decay_updates" in reason
    assert CudaGraph.unavailable(small_config(), torch.device("cuda")) is None


def test_a_graph_needs_a_cuda_device() -> None:
    with pytest.raises(ConfigError, match=r"learning\.engine is 'graph', expected a run on a CUDA device.*cpu.*eager"):
        decided(config_of({}, engine="graph"))


@pytest.mark.parametrize("learning", [{"replay_on_device": True, "replay_compression": "zstd"}])
def test_frames_on_the_device_are_not_compressed(learning: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"replay_compression is 'zstd', expected none on a device"):
        config_of({}, **learning)


def test_batches_are_gathered_where_the_network_lies() -> None:
    replays = [FrameReplay(200, 1, (4, 10, 10), np.uint8, 1, device=device) for device in (None, CPU)]
    losses = []
    for replay in replays:
        rng = np.random.default_rng(0)
        replay.begin(0, np.zeros((4, 10, 10), np.uint8))
        for step in range(60):
            replay.add(0, step % 6, 1.0, False, (rng.random((4, 10, 10)) < 0.4).astype(np.uint8))
        learner = learner_of(config_of({}), CPU)
        for _ in range(3):
            learner.update(replay.sample(8, rng, Returns()), 1)
        losses.append(learner.take_means())
    assert losses[0] == losses[1]
    assert isinstance(replays[1].sample(2, rng, Returns()).observations, torch.Tensor)


@cuda
@pytest.mark.parametrize("form", FORMS)
def test_a_graph_learns_what_single_operations_learn(form: dict[str, Any]) -> None:
    """To rounding, in three tasks, across captures, a copy of the target, and a loaded state."""
    device = torch.device("cuda")
    random = form.get("network", {}).get("encoding") == "rate"
    learners = [learner_of(config_of(form, engine=engine), device) for engine in ("graph", "compiled")]
    for number in range(12):
        for learner in learners:
            learner.update(batch_of(number), number % 3)
            if number == 7:
                learner.copy_target()
            if number == 9:
                learner.load_state_dict(learner.state_dict())
    ours, theirs = (learner.network.state_dict() for learner in learners)
    for name in ours if not random else ():  # whether a graph draws the same random numbers is not known
        torch.testing.assert_close(ours[name], theirs[name], rtol=1e-3, atol=1e-4)
    assert all(bool(torch.isfinite(tensor).all()) for tensor in ours.values())


@cuda
def test_frames_on_the_gpu_are_those_of_the_plain_ring() -> None:
    device = torch.device("cuda")
    plain, there = (FrameReplay(3000, 2, (1, 84, 84), np.uint8, 4, device=place) for place in (None, device))
    for replay in (plain, there):
        rng = np.random.default_rng(0)
        for lane in range(2):
            replay.begin(lane, rng.integers(0, 256, (1, 84, 84), np.uint8))
        for step in range(4000):
            frame = rng.integers(0, 256, (1, 84, 84), np.uint8)
            replay.add(step % 2, step % 18, 0.0, False, frame)
    ours, theirs = (replay.sample(64, np.random.default_rng(1), Returns()) for replay in (there, plain))
    assert isinstance(ours.observations, torch.Tensor)
    assert np.array_equal(ours.observations.cpu().numpy(), theirs.observations)
    assert np.array_equal(there.read_segment(next(there.segments())), plain.read_segment(next(plain.segments())))
