"""Running statistics that are estimated anew from the replay: their values, and nothing but them."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from switchmt_snn.config import LearningConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.statistics import reestimate_statistics
from switchmt_snn.learning.training import Training
from switchmt_snn.replay.ring import Returns
from switchmt_snn.runs.plan import decide
from switchmt_snn.spiking.network import QNetwork
from switchmt_snn.spiking.normalization import TaskBatchNorm
from switchmt_snn.updates.engine import ENGINES
from tests.conftest import CountingEnvironment, small_config, vector_suite
from tests.learning.resuming import assert_continues_exactly

builds = pytest.mark.skipif(not ENGINES["native"].status().startswith("works"), reason="no C++ compiler")
CPU = torch.device("cpu")
NETWORK = {"mlp_normalization": "batch", "stream_normalization": "batch"}


def training(batches: int, engine: str = "eager", **network: Any) -> Training:
    suite = vector_suite(lambda task, n: CountingEnvironment(task, n, 7), 4)
    suite = replace(suite, in_unit_range=True, scale=1e-4)  # rate takes it, too
    config = small_config(
        network={**NETWORK, **network},
        learning={"reestimate_statistics_batches": batches, "engine": engine, "acting": engine},
    )
    return Training(config, suite, CPU)


def played(batches: int, **network: Any) -> Training:
    part = training(batches, **network)
    for _ in part.events():
        pass
    return part


def layers(network: QNetwork) -> list[TaskBatchNorm]:
    return [module for module in network.modules() if isinstance(module, TaskBatchNorm)]


@pytest.mark.slow
def test_statistics_are_the_means_over_batches_of_the_replay() -> None:
    part = played(0)
    network, naive = part.learner.network, copy.deepcopy(part.learner.network)
    rng = np.random.default_rng(3)
    batches = [torch.from_numpy(part.replays[1].sample(8, rng, Returns()).observations) for _ in range(5)]
    expected: list[list[torch.Tensor]] = []
    for batch in batches:
        for layer in layers(naive):
            layer.momentum = 1.0
        naive.train()(batch, 1)
        expected.append([torch.stack(layer.statistics(1)).clone() for layer in layers(naive)])
    reestimate_statistics(network, 1, batches, torch.Generator())
    assert len(layers(network)) == 3
    for number, layer in enumerate(layers(network)):
        mean = torch.stack([each[number] for each in expected]).mean(0)
        torch.testing.assert_close(torch.stack(layer.statistics(1)), mean)
        assert layer.momentum == 0.1


@pytest.mark.slow
def test_nothing_but_the_task_s_statistics_changes() -> None:
    part = played(0)
    network = part.learner.network
    before = copy.deepcopy(network.state_dict())
    batch = torch.from_numpy(part.replays[1].sample(8, np.random.default_rng(3), Returns()).observations)
    reestimate_statistics(network, 1, [batch], torch.Generator())
    changed = 0
    for name, tensor in network.state_dict().items():
        if "running" in name:
            assert torch.equal(tensor[0], before[name][0]), name
            changed += not torch.equal(tensor[1], before[name][1])
        else:
            assert torch.equal(tensor, before[name]), name
    assert changed == 6, "mean and variance of trunk, value and advantage"


def updated(**network: Any) -> Training:
    """A training whose statistics have moved since they were estimated last, those of both tasks."""
    part, rng = played(3, **network), np.random.default_rng(0)
    for task in range(2):
        part.learner.update(part.replays[task].sample(8, rng, Returns()), task)
    return part


def changed_tasks(network: QNetwork, before: dict[str, torch.Tensor]) -> set[int]:
    """The tasks whose statistics are others now, in every layer."""
    changed = [
        {task for task in range(2) if not torch.equal(tensor[task], before[name][task])}
        for name, tensor in network.state_dict().items()
        if "running" in name
    ]
    assert all(tasks == changed[0] for tasks in changed)
    return changed[0]


@pytest.mark.slow
@pytest.mark.parametrize("task", [0, 1])
def test_a_visit_starts_with_fresh_statistics_of_its_task(task: int) -> None:
    part = updated()
    before = copy.deepcopy([part.learner.network.state_dict(), part.learner.target.state_dict()])
    part._enter(task)
    assert changed_tasks(part.learner.network, before[0]) == {task}
    assert changed_tasks(part.learner.target, before[1]) == set()


@pytest.mark.slow
def test_the_target_network_is_copied_with_fresh_statistics_of_all_tasks() -> None:
    part = updated()
    fresh = part.settled_acting_network().state_dict()
    assert changed_tasks(part.learner.target, fresh) == {0, 1}
    part._copy_target(passed=part.target_clock.period_steps)
    for name, tensor in part.learner.target.state_dict().items():
        assert torch.equal(tensor, fresh[name]), name


def test_estimating_twice_at_a_step_gives_the_same_statistics_and_draws_nothing_of_training() -> None:
    part = updated(encoding="rate")
    draws = copy.deepcopy((part.sample_rng.bit_generator.state, part.learner.generator.get_state()))
    fresh = part.settled_acting_network().state_dict()
    assert any(not torch.equal(fresh[name], x) for name, x in part.learner.network.state_dict().items())
    for _ in range(2):
        part.reestimate_statistics()
        for name, tensor in part.learner.network.state_dict().items():
            assert torch.equal(tensor, fresh[name]), name
    assert part.sample_rng.bit_generator.state == draws[0]
    assert torch.equal(part.learner.generator.get_state(), draws[1])


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["eager", pytest.param("native", marks=builds)])
def test_a_run_with_fresh_statistics_continues_exactly(engine: str) -> None:
    assert_continues_exactly(lambda: training(3, engine), at_steps=(61, 155))


def test_what_it_cannot_be_combined_with_is_refused_by_name() -> None:
    with pytest.raises(ConfigError, match=r"reestimate_statistics_batches is -1, expected at least 0"):
        LearningConfig(reestimate_statistics_batches=-1)
    with pytest.raises(ConfigError, match=r"reestimate_statistics_batches is 3, .*network\.normalization=shared"):
        training(3, normalization="shared")
    part = training(3)
    with pytest.raises(ConfigError, match=r"reestimate_statistics_batches is 3, .*torchrun"):
        decide(part.config, None, part.suite, CPU, processes=2)
