"""Operation counts: by hand, by brute force, and against NeuroBench and SpikingJelly where they are installed."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from switchmt_snn.export.counts.synapses import CountedSynapses, NeuronCounter, SynapseCounter
from switchmt_snn.spiking.layers import Conv, Dense, convolved_sides


def synapses_of(
    weight: np.ndarray,
    input_shape: tuple[int, ...],
    spiking_input: bool,
    stride: tuple[int, int] = (1, 1),
    padding: tuple[int, int] = (0, 0),
) -> CountedSynapses:
    """Synapses without a bias, for one task; a convolution if the weight is a kernel."""
    zeros = np.zeros((1, len(weight)))
    facts = {"name": "x", "weight": weight, "scale_KO": zeros + 1, "shift_KO": zeros, "input_shape": input_shape}
    if weight.ndim == 2:
        return CountedSynapses(Dense(**facts, output_shape=(len(weight),)), spiking_input)
    output_shape = (len(weight), *convolved_sides(input_shape[1:], weight.shape[2:], stride, padding))
    return CountedSynapses(Conv(**facts, output_shape=output_shape, stride=stride, padding=padding), spiking_input)


def test_three_neurons_on_paper() -> None:
    """Inputs 1, 2, 3; weights [[1, 0, 2], [0, 0, 5]]: input 1 reaches one neuron, input 2 none, input 3 both."""
    synapses = synapses_of(np.array([[1.0, 0, 2], [0, 0, 5]]), (3,), spiking_input=True)
    assert synapses.fan_out().tolist() == [1, 0, 2]
    assert synapses.dense_operations() == 6
    counter = SynapseCounter(synapses)
    # Two decisions of two steps. Step 1: {1, 3} and {2}; step 2: {} and {1, 2, 3}.
    counter.add(np.array([[[1, 0, 1], [0, 1, 0]], [[0, 0, 0], [1, 1, 1]]], np.bool_))
    assert counter.operations_T.tolist() == [3, 3]
    assert counter.active_inputs_T.tolist() == [3, 3]
    assert counter.decisions == 2
    assert synapses.operation == "AC"


def test_an_image_of_three_by_three_on_paper() -> None:
    """One 2x2 kernel over 3x3: corners are reached once, edges twice, the middle four times; 16 in all."""
    synapses = synapses_of(np.ones((1, 1, 2, 2)), (1, 3, 3), spiking_input=False)
    assert synapses.fan_out()[0].tolist() == [[1, 2, 1], [2, 4, 2], [1, 2, 1]]
    assert synapses.dense_operations() == 16
    padded = synapses_of(np.ones((1, 1, 3, 3)), (1, 3, 3), spiking_input=False, padding=(1, 1))
    assert padded.fan_out()[0].tolist() == [[4, 6, 4], [6, 9, 6], [4, 6, 4]], "padding itself is not counted"
    strided = synapses_of(np.ones((2, 1, 2, 2)), (1, 4, 4), spiking_input=False, stride=(2, 2))
    assert (strided.fan_out() == 2).all()
    assert synapses.operation == "MAC"


def test_spikes_silent_and_saturated_neurons() -> None:
    counter = NeuronCounter("n", (3,), 2)
    counter.add(np.array([[[1, 0, 1], [1, 0, 0]], [[1, 0, 0], [1, 0, 0]]], np.bool_))
    assert counter.spikes_TN.tolist() == [[2, 0, 1], [2, 0, 0]]
    assert counter.rate_N.tolist() == [1.0, 0.0, 0.25]
    assert (counter.silent, counter.saturated) == (1, 1)


def test_a_rate_on_the_edge_of_two_bins_belongs_to_the_upper_one() -> None:
    """k of 20 spikes for k = 0 ... 20: one neuron in each of the 20 bins, and the saturated one in the last."""
    counter = NeuronCounter("n", (21,), 4)
    spikes = np.zeros((4, 5, 21), np.bool_)
    for k in range(21):
        spikes.reshape(20, 21)[:k, k] = True
    counter.add(spikes)
    assert counter.rate_N.tolist() == [k / 20 for k in range(21)]
    assert counter.rate_histogram == (0, *[1] * 18, 2)
    assert NeuronCounter("n", (3,), 2).rate_histogram == (0,) * 20


LAYERS = {
    "linear": st.booleans(),
    "channels": st.integers(1, 5),
    "out": st.integers(1, 6),
    "side": st.integers(4, 11),
    "kernel": st.integers(1, 4),
    "stride": st.integers(1, 3),
    "padding": st.integers(0, 2),
    "density": st.sampled_from([0.0, 0.05, 0.4, 1.0]),
    "pruned": st.sampled_from([0.0, 0.5, 0.95]),
    "seed": st.integers(0, 2**20),
}


def random_layer(
    linear, channels, out, side, kernel, stride, padding, pruned, seed
) -> tuple[nn.Module, CountedSynapses]:
    torch.manual_seed(seed)
    layer: nn.Linear | nn.Conv2d
    if linear:
        layer, shape = nn.Linear(channels * side, out), (channels * side,)
    else:
        layer, shape = nn.Conv2d(channels, out, kernel, stride, padding), (channels, side, side)
    with torch.no_grad():
        layer.weight *= torch.rand_like(layer.weight) >= pruned
    weight = layer.weight.detach().numpy()
    return layer, synapses_of(weight, shape, True, stride=(stride, stride), padding=(padding, padding))


def counted(synapses: CountedSynapses, spikes: torch.Tensor) -> int:
    counter = SynapseCounter(synapses)
    counter.add(spikes.numpy()[None] != 0)
    return int(counter.operations_T.sum())


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(**LAYERS)
def test_counts_equal_a_pass_with_ones(
    linear, channels, out, side, kernel, stride, padding, density, pruned, seed
) -> None:
    """Every weight and input replaced by whether it is there: the layer's own output is the count."""
    layer, synapses = random_layer(linear, channels, out, side, kernel, stride, padding, pruned, seed)
    spikes = (torch.rand(3, *synapses.node.input_shape) < density).float()
    with torch.no_grad():
        layer.weight.copy_((layer.weight != 0).float())
        layer.bias.zero_()
        assert counted(synapses, spikes) == int(layer.double()(spikes.double()).sum())
        layer.weight.fill_(1.0)
        ones = torch.ones(1, *synapses.node.input_shape, dtype=torch.float64)
        assert synapses.dense_operations() == int(layer(ones).sum())


@pytest.mark.slow
@pytest.mark.skipif(not importlib.util.find_spec("neurobench"), reason="neurobench is not installed")
@pytest.mark.filterwarnings("ignore")
@settings(max_examples=60, deadline=None)
@given(**LAYERS)
def test_counts_equal_neurobench(linear, channels, out, side, kernel, stride, padding, density, pruned, seed) -> None:
    from neurobench.metrics.utils.layers import single_layer_MACs

    layer, synapses = random_layer(linear, channels, out, side, kernel, stride, padding, pruned, seed)
    spikes = (torch.rand(3, *synapses.node.input_shape) < density).float()
    operations, _ = single_layer_MACs(spikes, layer)
    assert counted(synapses, spikes) == operations
    dense, _ = single_layer_MACs(spikes, layer, total=True)
    assert 3 * synapses.dense_operations() == dense


@pytest.mark.slow
@pytest.mark.skipif(not importlib.util.find_spec("spikingjelly"), reason="spikingjelly is not installed")
@pytest.mark.filterwarnings("ignore")
@settings(max_examples=40, deadline=None)
@given(**{name: values for name, values in LAYERS.items() if name != "pruned"})
def test_counts_equal_spikingjelly(linear, channels, out, side, kernel, stride, padding, density, seed) -> None:
    from spikingjelly.activation_based.op_counter import DispatchCounterMode, SynOpCounter

    layer, synapses = random_layer(linear, channels, out, side, kernel, stride, padding, 0.0, seed)
    spikes = (torch.rand(3, *synapses.node.input_shape) < density).float()
    counter = SynOpCounter()
    with torch.no_grad(), DispatchCounterMode([counter]):
        layer(spikes)
    assert counted(synapses, spikes) == counter.get_total()
