"""The first layer's running means: those of the present weights, in every engine and after a resume."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.training import Training
from switchmt_snn.replay.ring import Returns
from switchmt_snn.runs.plan import decide
from switchmt_snn.updates.engine import ENGINES
from tests.conftest import CountingEnvironment, small_config, vector_suite
from tests.learning.resuming import assert_continues_exactly

builds = pytest.mark.skipif(not ENGINES["native"].status().startswith("works"), reason="no C++ compiler")
engines = pytest.mark.parametrize("engine", ["eager", pytest.param("native", marks=builds)])
CPU = torch.device("cpu")


def training(mean: str = "input", engine: str = "eager", **network: Any) -> Training:
    config = small_config(
        network={"mlp_normalization": "batch", "stream_normalization": "batch", **network},
        learning={"first_layer_mean": mean, "engine": engine, "acting": engine},
    )
    return Training(config, vector_suite(lambda task, n: CountingEnvironment(task, n, 7), 4), CPU)


def played(mean: str = "input", engine: str = "eager") -> Training:
    part = training(mean, engine)
    for _ in part.events():
        pass
    return part


@pytest.mark.slow
@engines
def test_running_means_are_the_mean_currents_of_the_present_weights(engine: str) -> None:
    part = played(engine=engine)
    rng, learner = np.random.default_rng(0), part.learner
    layer = learner.network.trunk["linear1"]
    means: list[torch.Tensor] = [torch.tensor(0)] * 2
    for count in range(40):
        for task in range(2):
            batch = part.replays[task].sample(8, rng, Returns())
            learner.update(batch, task)
            inputs = torch.from_numpy(batch.observations).float().mean(0) * part.suite.scale
            means[task] = means[task].lerp(inputs, 0.1) if count else learner.first_layer.inputs[task].clone()
    for task in range(2):
        torch.testing.assert_close(learner.first_layer.inputs[task], means[task])
        expected = layer.synapses(means[task][None])[0]
        torch.testing.assert_close(layer.normalization.running_mean_KC[task], expected)


def lag(mean: str) -> torch.Tensor:
    """How far the running means of a trained network are from the mean currents of many frames, over the neurons."""
    part = played(mean)
    layer = part.learner.network.trunk["linear1"]
    frames = torch.from_numpy(part.replays[1].sample(512, np.random.default_rng(0), Returns()).observations)
    current = layer.synapses(frames.float() * part.suite.scale).mean(0)
    return (layer.normalization.running_mean_KC[1] - current).abs().mean().detach()


@pytest.mark.slow
def test_running_means_of_currents_lag_further_behind() -> None:
    assert lag("input") < 0.7 * lag("running")


@pytest.mark.slow
def test_the_target_network_takes_them() -> None:
    part = played()
    part.learner.copy_target()
    ours, target = (net.trunk["linear1"].normalization for net in (part.learner.network, part.learner.target))
    assert torch.equal(ours.running_mean_KC, target.running_mean_KC)


@pytest.mark.slow
@engines
def test_a_run_continues_exactly(engine: str) -> None:
    assert_continues_exactly(lambda: training(engine=engine), at_steps=(61, 155))


@pytest.mark.parametrize(
    ("network", "message"),
    [
        ({"encoding": "rate"}, r"network\.encoding is 'rate', expected direct with learning\.first_layer_mean=input"),
        ({"normalization": "shared"}, r"network\.normalization is 'shared', expected per_task with learning\.first"),
        ({"mlp_normalization": "none"}, r"first_layer_mean is input, expected running for a first layer without"),
    ],
)
def test_networks_without_such_a_mean_are_refused(network: dict[str, str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        training(**network)


def test_torchrun_is_refused() -> None:
    part = training()
    with pytest.raises(ConfigError, match=r"first_layer_mean is 'input', expected running .*torchrun"):
        decide(part.config, None, part.suite, CPU, processes=2)
