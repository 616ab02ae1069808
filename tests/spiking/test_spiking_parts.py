"""Encodings, dendrites, normalisation: small cases by hand, properties against PyTorch."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from switchmt_snn.config import NetworkConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.spiking.dendrites import ActiveDendrites, keep_k_winners
from switchmt_snn.spiking.encodings import Encoder
from switchmt_snn.spiking.normalization import TaskBatchNorm


def encoder(encoding: str, timesteps: int, stack: int = 1) -> Encoder:
    return Encoder(NetworkConfig(encoding=encoding, timesteps=timesteps), stack, inputs_in_unit_range=True)


def test_direct_is_the_observation_once() -> None:
    x = torch.rand(2, 3, 4, 4)
    assert torch.equal(encoder("direct", 5)(x), x[None])


def test_latency_fires_once_earlier_for_brighter() -> None:
    x = torch.tensor([[1.0, 0.5, 0.1, 0.0]])
    spikes = encoder("latency", 3)(x)[:, 0]
    # (1 - x) * 2 = 0, 1, 1.8 -> steps 0, 1, 2; a black pixel never fires
    assert spikes.tolist() == [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]


def test_rate_is_seeded_and_has_the_right_mean() -> None:
    x = torch.tensor([[0.0, 0.25, 1.0]]).repeat(4000, 1)
    one = encoder("rate", 4)(x, torch.Generator().manual_seed(3))
    two = encoder("rate", 4)(x, torch.Generator().manual_seed(3))
    assert torch.equal(one, two)
    means = one.mean(dim=(0, 1))
    assert means[0] == 0
    assert means[2] == 1
    assert abs(float(means[1]) - 0.25) < 0.015  # 16,000 draws: 4 standard errors are 0.0137


def test_frames_gives_one_frame_per_step() -> None:
    x = torch.arange(2 * 4 * 2).view(2, 4, 2).float()
    out = encoder("frames", 4, stack=4)(x)
    assert out.shape == (4, 2, 1, 2)
    assert torch.equal(out[2, :, 0], x[:, 2])


def test_events_are_on_and_off_changes() -> None:
    frames = torch.tensor([0.5, 0.5, 0.9, 0.1]).view(1, 4, 1, 1)
    out = encoder("events", 4, stack=4)(frames)
    assert out.shape == (4, 1, 2, 1, 1)
    assert out[:, 0, 0, 0, 0].tolist() == [1, 0, 1, 0]  # brighter: first frame against darkness, then 0.5 -> 0.9
    assert out[:, 0, 1, 0, 0].tolist() == [0, 0, 0, 1]  # darker: 0.9 -> 0.1


def test_vectors_cannot_be_rate_encoded() -> None:
    with pytest.raises(ConfigError, match="rate and latency need values"):
        Encoder(NetworkConfig(encoding="rate"), 1, inputs_in_unit_range=False)


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
