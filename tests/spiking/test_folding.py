"""The description of a network equals the network, and what it cannot describe is refused by name."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from torch import nn

from switchmt_snn.config import ExperimentConfig, LearningConfig, NetworkConfig, resolve
from switchmt_snn.errors import ExportError, TaskError
from switchmt_snn.spiking.folding import fold, network_nodes
from switchmt_snn.spiking.layers import Conv, Dense, NeuronNode, ReadoutNode, no_rule, side_by_side
from switchmt_snn.spiking.network import ObservationSpec, QNetwork, build_network
from switchmt_snn.spiking.neurons import LeakyLayer, LeakyNode, OpaqueNode

SPEC = ObservationSpec((4, 10, 10), 1, 1.0, True, 3, 2)


@pytest.fixture
def network() -> QNetwork:
    settings = resolve(ExperimentConfig(network=NetworkConfig(trunk="minatar", hidden_units=8))).network
    return build_network(settings, SPEC, 0).eval()


def test_nodes_have_the_shapes_of_the_networks_activity(network: QNetwork) -> None:
    activity: dict[str, torch.Tensor] = {}
    network(torch.rand(2, 4, 10, 10), 0, activity=activity)
    nodes = network_nodes(network)
    shapes = {layer.name: layer.output_shape for layer in nodes.trunk}
    shapes |= {name: stream.hidden.output_shape for name, stream in nodes.streams.items()}
    assert shapes == {name: tuple(values.shape[2:]) for name, values in activity.items()}
    assert [node.name for node in fold(network).synapses] == ["conv1", "hidden", "head"]


@pytest.mark.parametrize(("kernel", "stride", "padding"), [(3, 1, 0), (5, 1, 1), (2, 2, 3)])
def test_a_convolution_node_computes_what_its_module_computes(
    network: QNetwork, kernel: int, stride: int, padding: int
) -> None:
    """Zero padding, too; every output side is 8, so that the rest of the network fits."""
    network.trunk["conv1"].synapses = nn.Conv2d(4, 16, kernel, stride, padding)
    node = network_nodes(network).trunk[0].synapses
    assert isinstance(node, Conv)
    assert node.output_shape == (16, 8, 8)
    weight, bias = (torch.from_numpy(values) for values in node.folded(1))
    x = torch.rand(2, 4, 10, 10)
    layer = network.trunk["conv1"]
    expected = layer.normalization(layer.synapses(x), 1)
    seen = nn.functional.conv2d(x, weight, bias, node.stride, node.padding)
    torch.testing.assert_close(seen, expected, atol=1e-5, rtol=1e-5)
    ones = nn.functional.conv2d(torch.ones(1, *node.input_shape), torch.ones(node.weight.shape), None, stride, padding)
    assert node.dense_operations == int(ones.sum())


def test_a_module_that_has_no_node_is_refused_by_name(network: QNetwork) -> None:
    class Scaled(nn.Linear):
        """A linear layer that computes something else."""

    trunk, stream = network.trunk["conv1"], network.streams["value"]
    cases = [
        (trunk, "synapses", nn.Conv2d(4, 16, 3, groups=2), r"the convolution of conv1 has groups 2, expected 1"),
        (trunk, "synapses", nn.Conv2d(4, 16, 3, dilation=2), r"conv1 has dilation \(2, 2\)"),
        (trunk, "synapses", nn.Conv2d(4, 16, 3, padding=1, padding_mode="circular"), "padding_mode 'circular'"),
        (trunk, "synapses", nn.Conv2d(4, 16, 3, padding="same"), "padding 'same', expected numbers"),
        (trunk, "synapses", nn.Sequential(nn.Conv2d(4, 16, 3), nn.MaxPool2d(2)), "synapses of conv1 .* MaxPool2d"),
        (trunk, "synapses", nn.Sequential(nn.Flatten(2), nn.Linear(100, 8)), "expected Flatten"),
        (trunk, "synapses", nn.ConvTranspose2d(4, 16, 3), "synapses of conv1 are a ConvTranspose2d, expected one of"),
        (trunk, "normalization", nn.BatchNorm2d(16), "normalization of conv1 is a BatchNorm2d, expected a TaskBatch"),
        (trunk, "neurons", nn.Tanh(), "neurons of conv1 are a Tanh"),
        (stream, "synapses", nn.Linear(1000, 8), r"value\.hidden has weights for 1000 inputs, expected 1024"),
        (trunk, "synapses", nn.Conv2d(3, 16, 3), "conv1 has weights for 3 channels, expected 4"),
        (stream, "synapses", Scaled(1024, 8), r"value\.synapses is a Scaled, expected a Linear"),
        (stream, "dendrites", nn.Identity(), "dendrites of value is a Identity"),
        (stream, "head", nn.Sequential(nn.Linear(8, 1)), r"value\.head is a Sequential"),
    ]
    for owner, part, module, message in cases:
        kept = getattr(owner, part)
        setattr(owner, part, module)
        with pytest.raises(ExportError, match=message):
            network_nodes(network)
        setattr(owner, part, kept)
    network_nodes(network)


@pytest.mark.parametrize(("method", "readout"), [("SwitchMT", "mean"), ("DSQN", "last_membrane"), ("DQN_D", "mean")])
def test_quantiles_fold_into_one_output_each_their_mean(method: str, readout: str) -> None:
    """The head has the shape of a network without quantiles, and computes the Q-values that the network acts by."""
    settings = NetworkConfig(
        method=method, trunk="minatar", hidden_units=8, quantiles=5, readout=readout, threshold=0.3
    )
    config = ExperimentConfig(network=settings, learning=LearningConfig(loss="huber"))
    network = build_network(resolve(config).network, SPEC, 0).eval()
    activity: dict[str, torch.Tensor] = {}
    x = torch.rand(6, 4, 10, 10)
    q_BA = network(x, 1, activity=activity).detach()
    values_BMA = network.values(network.encode(x), network.context(1)).detach()
    assert values_BMA.shape == (6, 5, 3)
    torch.testing.assert_close(values_BMA.mean(1), q_BA)
    assert (values_BMA.std(1) > 1e-3).all()
    folded = fold(network)
    weight, bias = folded.head.folded(1)
    assert weight.shape == (3, 8 * len(network.streams))
    spikes_TBN = torch.cat([activity[name] for name in network.streams], dim=-1)
    seen = folded.readout((spikes_TBN @ torch.from_numpy(weight).T + torch.from_numpy(bias)).detach().numpy())
    np.testing.assert_allclose(seen, q_BA.numpy(), rtol=1e-5, atol=1e-5)
    assert {name: stream.head.output_shape for name, stream in network_nodes(network).streams.items()} == (
        {"q": (3,)} if method == "DSQN" else {"value": (1,), "advantage": (3,)}
    )


def test_a_bare_network_gets_numbered_names(network: QNetwork) -> None:
    folded = fold(network)
    assert (folded.tasks, folded.actions) == (("task_0", "task_1"), ("action_0", "action_1", "action_2"))
    assert folded.valid_actions_KA.all()
    assert folded.observation_dtype == np.uint8
    assert folded.task_index("task_1") == 1
    with pytest.raises(TaskError, match="unknown task 'task_2'"):
        folded.task_index("task_2")


def test_layers_side_by_side_must_have_the_same_neurons() -> None:
    node = LeakyNode(np.full(2, 0.5), np.ones(2), "zero")
    both = side_by_side([node, LeakyNode(np.full(3, 0.25), np.ones(3), "zero")])
    assert both.beta_O.tolist() == [0.5, 0.5, 0.25, 0.25, 0.25]
    with pytest.raises(ExportError, match="side by side have reset"):
        side_by_side([node, dataclasses.replace(node, reset="subtract")])


def test_readouts_by_hand() -> None:
    y_TBA = np.array([[[4.0, -4.0]], [[-4.0, 2.0]]], np.float32)
    assert ReadoutNode("mean", 0.5)(y_TBA).tolist() == [[0.0, -1.0]]
    assert ReadoutNode("last_membrane", 0.5)(y_TBA).tolist() == [[-2.0, 0.0]]
    assert ReadoutNode("max_membrane", 0.5)(y_TBA).tolist() == [[4.0, 0.0]]
    with pytest.raises(ExportError, match="the readout is 'median', expected one of mean"):
        ReadoutNode("median", 0.5)


class TwiceAsFast(LeakyLayer):
    """Neurons of another equation that inherit a description which is no longer theirs."""

    def run(self, current, state):  # type: ignore[no-untyped-def]
        """Every current counts twice."""
        return super().run(2.0 * current, state)


def test_an_inherited_description_is_not_believed_when_the_equation_was_changed(network: QNetwork) -> None:
    network.trunk["conv1"].neurons = TwiceAsFast(network.config)
    neurons = network_nodes(network).trunk[0].neurons
    assert isinstance(neurons, OpaqueNode)
    assert neurons.kind.endswith("test_folding:TwiceAsFast")


def test_a_reader_without_a_rule_says_who_what_and_which() -> None:
    class Odd(NeuronNode):
        kind = "odd"

    error = no_rule("NIR", Odd(), {object: None, Dense: None, Conv: None}, "use --onnx")
    assert str(error) == "NIR cannot express odd (Odd), expected Dense or Conv; use --onnx"
