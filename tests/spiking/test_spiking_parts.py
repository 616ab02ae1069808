"""Dendrites, normalisation: small cases by hand, properties against PyTorch."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from switchmt_snn.config import NetworkConfig
from switchmt_snn.spiking.dendrites import ActiveDendrites, keep_k_winners
from switchmt_snn.spiking.network import ObservationSpec, build_network, trainable_parameters
from switchmt_snn.spiking.normalization import TaskBatchNorm
from tests.conftest import small_config


@pytest.mark.parametrize(("gating", "expected"), [("max", 0.5), ("absolute_max", -2.0)])
def test_gain_is_the_sigmoid_of_the_winning_segment(gating: str, expected: float) -> None:
    """Eq. 1 with a one-hot context: max_j d_j^T c is the largest weight in the task's column."""
    dendrites = ActiveDendrites(NetworkConfig(dendrites="shared", dendritic_gating=gating), 512, 2)
    dendrites.segments_NSK.data = torch.tensor([[[9.0, 0.5], [8.0, -2.0], [7.0, 0.25]]])
    gain = dendrites(1).detach()
    assert gain.shape == (1,)
    assert float(gain) == pytest.approx(1 / (1 + torch.exp(torch.tensor(-expected)).item()))


def test_per_neuron_segments_have_their_own_weights() -> None:
    dendrites = ActiveDendrites(NetworkConfig(dendrites="per_neuron"), 512, 3)
    assert sum(p.numel() for p in dendrites.parameters()) == 512 * 3 * 3
    assert dendrites(2).shape == (512,)
    dendrites(2).sum().backward()
    gradient = dendrites.segments_NSK.grad
    assert (gradient[:, :, :2] == 0).all(), "another task's weights get no gradient"
    assert (gradient[:, :, 2] != 0).sum() == 512, "only the winning segment of each neuron gets one"


def test_k_winners_keep_the_largest_currents() -> None:
    current = torch.tensor([[[3.0, -1.0, 2.0, 0.5]]], requires_grad=True)
    kept = keep_k_winners(current, 2)
    assert kept.tolist() == [[[3.0, 0.0, 2.0, 0.0]]]
    kept.sum().backward()
    assert current.grad.tolist() == [[[1.0, 0.0, 1.0, 0.0]]]


def test_batch_norm_equals_pytorch_and_keeps_tasks_apart() -> None:
    ours = TaskBatchNorm(5, num_tasks=2, per_task=True, momentum=0.1)
    theirs = nn.BatchNorm2d(5)
    x = torch.randn(8, 5, 3, 3) * 2 + 1
    assert torch.equal(ours(x, 0), theirs(x))
    assert torch.equal(ours.running_mean_KC[0], theirs.running_mean)
    assert torch.equal(ours.running_var_KC[0], theirs.running_var)
    assert (ours.running_mean_KC[1] == 0).all(), "another task's statistics do not move"
    ours.eval(), theirs.eval()
    assert torch.equal(ours(x, 0), theirs(x))
    assert not torch.equal(ours(x, 1), theirs(x))
    before = ours.running_mean_KC.clone()
    ours(x, 0)
    assert torch.equal(ours.running_mean_KC, before), "eval mode moves nothing"


def test_shared_statistics_serve_all_tasks() -> None:
    norm = TaskBatchNorm(2, num_tasks=3, per_task=False, momentum=0.1)
    norm(torch.randn(16, 2), 2)
    assert norm.running_mean_KC.shape == (1, 2)
    norm.eval()
    x = torch.randn(4, 2)
    assert torch.equal(norm(x, 0), norm(x, 2))


@pytest.mark.parametrize("thresholds", [0.5, 1.25])
def test_normalized_streams_have_the_currents_asked_for_and_no_more_parameters(thresholds: float) -> None:
    """Before the gain: mean and standard deviation are some thresholds; the parameters are the paper's."""
    spec = ObservationSpec((4, 84, 84), 4, 1 / 255, True, 18, 3)
    networks = {}
    for name in ("none", "batch"):
        settings = {"trunk": "nature", "hidden_units": 512, "threshold": 0.8, "stream_normalization": name}
        settings["stream_current_thresholds"] = thresholds
        config = small_config(tasks={"suite": "atari", "names": ["pong", "breakout", "enduro"]}, network=settings)
        networks[name] = build_network(config.network, spec, 1)
    assert {trainable_parameters(network) for network in networks.values()} == {3_300_357}
    stream = networks["batch"].streams["advantage"]
    features = (torch.rand(2, 64, 3136, generator=torch.Generator().manual_seed(0)) < 0.15).float()
    gated = stream.current(features, stream.context(1), None, training=True).detach()
    current_RN = (gated / stream.dendrites(1).detach()).flatten(0, 1)
    asked = torch.full((512,), 0.8 * thresholds)
    torch.testing.assert_close(current_RN.mean(0), asked, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(current_RN.std(0, unbiased=False), asked, rtol=1e-3, atol=1e-3)
    plain = networks["none"].streams["advantage"]
    quiet = plain.current(features, plain.context(1), None, training=True)
    assert float((quiet > 0.8).float().mean()) < 0.001
    assert float((gated > 0.8).float().mean()) > 0.02
