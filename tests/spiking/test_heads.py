"""Heads per task: whose rows a task reads and trains, how many there are, and what an export holds of them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from switchmt_snn.config import ExperimentConfig, LearningConfig, NetworkConfig, resolve
from switchmt_snn.errors import ConfigError
from switchmt_snn.spiking.folding import fold
from switchmt_snn.spiking.heads import TaskHeads, make_head
from switchmt_snn.spiking.layers import Dense, TaskDense
from switchmt_snn.spiking.network import (
    ObservationSpec,
    QNetwork,
    build_network,
    deployed_parameters,
    trainable_parameters,
)
from tests.export.export_cases import make_agent, observations

SMALL = ObservationSpec((4, 10, 10), 1, 1.0, True, 5, 3)
ATARI = ObservationSpec((4, 84, 84), 4, 1 / 255, True, 18, 3)


def network_of(spec: ObservationSpec = SMALL, **settings: object) -> QNetwork:
    settings = {"heads": "per_task", "trunk": "minatar" if spec is SMALL else "nature", **settings}
    if spec is SMALL:
        settings |= {"hidden_units": 16, "threshold": 0.3}
    network = NetworkConfig(**settings)  # type: ignore[arg-type]
    config = resolve(ExperimentConfig(network=network, learning=LearningConfig(loss="huber")))
    return build_network(config.network, spec, 0)


@pytest.mark.parametrize(("quantiles", "more"), [(1, 19_494), (4, 3 * 9_747 + 2 * 4 * 9_747)])
def test_heads_of_three_tasks_add_two_heads_to_the_papers_network(quantiles: int, more: int) -> None:
    """A head of the paper's network has 19 rows of 513; what decides for a task has one, without quantiles."""
    network = network_of(ATARI, quantiles=quantiles)
    assert trainable_parameters(network) == 3_300_357 + more
    assert deployed_parameters(network) == 3_300_357


@pytest.mark.parametrize("method", ["SwitchMT", "DSQN", "DQN_D"])
@pytest.mark.parametrize("quantiles", [1, 3])
def test_a_task_reads_and_trains_its_own_rows_only(method: str, quantiles: int) -> None:
    network, x = network_of(method=method, quantiles=quantiles), torch.rand(4, 4, 10, 10)
    before = [network(x, task).detach() for task in range(3)]
    heads = [stream.head for stream in network.streams.values()]
    q = network(x, 1)
    (q * torch.linspace(-1, 2, q.numel()).view_as(q)).sum().backward()
    assert len(heads) == (1 if method == "DSQN" else 2)
    for head in heads:
        assert isinstance(head, TaskHeads)
        for part in (head.weight, head.bias):
            trained = [bool(rows.any()) for rows in part.grad.unflatten(0, (3, -1))]
            assert trained == [False, True, False]
    with torch.no_grad():
        for head in heads:
            head.bias.unflatten(0, (3, -1))[2] += torch.arange(len(head.bias) // 3).float()
    network.train(False)
    for _ in range(2):
        after = [network(x, task).detach() for task in range(3)]
    assert not torch.equal(after[2], before[2])
    network.train(True)
    after = [network(x, task).detach() for task in range(2)]
    assert all(torch.equal(now, then) for now, then in zip(after, before, strict=False))


def test_a_head_of_a_task_is_that_of_a_network_with_the_same_rows() -> None:
    """The rows of a task, copied into a shared head, give the same Q-values."""
    own, shared, x = (
        network_of(quantiles=2).eval(),
        network_of(quantiles=2, heads="shared").eval(),
        torch.rand(4, 4, 10, 10),
    )
    state = own.state_dict()
    for task in range(3):
        rows = {name: value.unflatten(0, (3, -1))[task] if ".head." in name else value for name, value in state.items()}
        shared.load_state_dict(rows)
        torch.testing.assert_close(own(x, task), shared(x, task), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("quantiles", [1, 3])
def test_a_folded_network_of_a_task_holds_its_rows_only(quantiles: int) -> None:
    network = network_of(quantiles=quantiles).eval()
    folded, x = fold(network), torch.rand(4, 4, 10, 10)
    assert isinstance(folded.head, TaskDense)
    assert folded.head.weight.shape == (3 * 5, 2 * 16)
    assert folded.head.dense_operations == 5 * 32
    for task in range(3):
        activity: dict[str, torch.Tensor] = {}
        q_BA = network(x, task, activity=activity).detach().numpy()
        alone = folded.of_task(task).head
        assert isinstance(alone, Dense)
        spikes_BN = torch.cat([activity[name] for name in network.streams], dim=-1).mean(0).detach().numpy()
        for node in (folded.head, alone):
            weight, bias = node.folded(task)
            assert weight.shape == (5, 32)
            np.testing.assert_allclose(spikes_BN @ weight.T + bias, q_BA, rtol=1e-5, atol=1e-5)
    assert folded.of_task(1).layers == folded.layers


def test_one_task_is_counted_and_placed_on_chips_with_its_own_head() -> None:
    from switchmt_snn.export.chips.fit import layer_shapes
    from switchmt_snn.export.counts.network import count_task
    from switchmt_snn.export.folded import fold_agent

    own, shared = make_agent(heads="per_task"), make_agent()
    counts = [count_task(agent, 2, observations(agent, 8)) for agent in (own, shared)]
    for ours, theirs in zip(*(count.layers for count in counts), strict=True):
        assert (ours.weights, ours.outputs, ours.dense_per_decision) == (
            theirs.weights,
            theirs.outputs,
            theirs.dense_per_decision,
        )
    assert layer_shapes(fold_agent(own)) == layer_shapes(fold_agent(shared))


def test_unknown_heads_are_refused_by_name() -> None:
    config = network_of().config
    object.__setattr__(config, "heads", "per_game")
    with pytest.raises(ConfigError, match=r"network\.heads is 'per_game', expected shared or per_task"):
        make_head(config, 4, 2, 3)


def test_max_membrane_of_a_dueling_network_is_the_largest_of_the_combined_membranes() -> None:
    """By hand, as docs/algorithm.md defines it; the sum of the streams' own maxima is another number."""
    network = network_of(heads="shared", readout="max_membrane", readout_beta=0.5).eval()
    activity: dict[str, torch.Tensor] = {}
    q_BA = network(torch.rand(8, 4, 10, 10), 0, activity=activity)
    membranes = {}
    for name, stream in network.streams.items():
        membranes[name] = [stream.head(activity[name][0])]
        for spikes_BN in activity[name][1:]:
            membranes[name].append(0.5 * membranes[name][-1] + stream.head(spikes_BN))
    value, advantage = (torch.stack(membranes[name]) for name in ("value", "advantage"))
    torch.testing.assert_close(q_BA, (value + advantage - advantage.mean(-1, keepdim=True)).amax(0))
    apart = value.amax(0) + advantage.amax(0) - advantage.amax(0).mean(-1, keepdim=True)
    assert not torch.allclose(q_BA, apart, atol=1e-4)


def test_what_algorithm_md_says_of_adams_steps_holds() -> None:
    """0.76 % of the initial norm at the first step of 1e-4; 3.16 learning rates where a gradient follows many of 0."""
    weights = [weight.detach() for weight in network_of(ATARI, heads="shared").parameters() if weight.requires_grad]
    norm = torch.cat([weight.flatten() for weight in weights]).norm()
    assert 1e-4 * 3_300_357**0.5 / float(norm) == pytest.approx(0.0076, abs=1e-4)
    moved = torch.zeros(1, requires_grad=True)
    adam = torch.optim.Adam([moved], lr=1.0)
    for gradient in (0.0, 1.0):
        moved.grad = torch.tensor([gradient])
        adam.step()
        adam.state[moved]["step"].fill_(1e6)  # as after many steps
    assert float(-moved.detach()) == pytest.approx(3.16, abs=0.01)
