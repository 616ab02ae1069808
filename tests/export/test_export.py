"""ONNX and NIR files against the trained network, on every kind of network; what cannot be exported is refused."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import nir
import numpy as np
import onnx
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from switchmt_snn.config import METHOD_TRAITS, METHODS
from switchmt_snn.errors import ExportError
from switchmt_snn.export.folded import fold_agent
from switchmt_snn.export.formats.files import obstacles
from switchmt_snn.export.formats.nir_writer import nir_graph, write_nir
from switchmt_snn.export.formats.onnx_writer import decision_model, step_model
from switchmt_snn.export.parity.compare import Exports, compare, trace_torch
from switchmt_snn.export.parity.dyadic import dyadic_copy, dyadic_observations, exact_copy
from switchmt_snn.export.runtimes.agents import OnnxAgent, encode, onnx_session, read_nir
from switchmt_snn.export.runtimes.nir_interpreter import NirInterpreter
from switchmt_snn.spiking.encodings import ENCODINGS
from switchmt_snn.spiking.folding import FoldedNetwork, quantized
from switchmt_snn.spiking.neurons import NEURONS, LeakyLayer, NeuronLayer, NeuronState
from switchmt_snn.spiking.neurons.base import RESETS
from switchmt_snn.spiking.readout import READOUTS
from tests.export.export_cases import VARIANTS, make_agent, observations


def exports(agent, profile: str | None) -> Exports:
    network = fold_agent(agent)
    graphs = None
    if profile is not None:
        graphs = {name: nir_graph(network, k, profile) for k, name in enumerate(agent.suite.names)}
    step = step_model(network).SerializeToString() if network.spiking else None
    return Exports(network, decision_model(network).SerializeToString(), step, graphs)


def profile_of(variant: str) -> str | None:
    """The NIR profile that expresses a variant exactly, if there is one."""
    if variant.startswith(("DQN", "ALIF")) or variant in ("k winners", "Synaptic"):
        return None
    return "exact" if "subtract" in variant else "portable"


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("seed", [0, 1])
def test_exact_numbers_are_bitwise_equal(variant: str, seed: int) -> None:
    """A dyadic copy in three programs: every spike and every Q-value."""
    agent = make_agent(seed, **VARIANTS[variant])
    if variant == "learned":  # as after training: every layer and stream its own
        with torch.no_grad():
            for index, module in enumerate(m for m in agent.network.modules() if isinstance(m, LeakyLayer)):
                module.leaky.beta.fill_(0.4 + 0.2 * index)
                module.leaky.threshold.fill_(0.375 + 0.125 * index)
    x = dyadic_observations(observations(agent, 24, seed))
    agent, exact = exact_copy(agent, [x] * 3)
    assert exact
    written = exports(agent, profile_of(variant))
    for task in range(3):
        for comparison in compare(agent, written, task, x):
            assert comparison.decisions_with_flips == 0, comparison
            tolerance = 1e-5 if variant == "T 7" else 0.0  # a mean over 7 steps rounds
            assert comparison.largest_q_difference <= tolerance, comparison
    if agent.network.spiking:
        totals = {name: int(spikes.sum()) for name, spikes in trace_torch(agent, x, 0, 0).spikes.items()}
        assert all(total > 0 for total in totals.values()), f"a silent layer proves nothing: {totals}"


@pytest.mark.slow
@settings(max_examples=int(os.environ.get("EXPORT_EXAMPLES", "20")), deadline=None)
@given(
    method=st.sampled_from(METHODS),
    reset=st.sampled_from(RESETS),
    timesteps=st.sampled_from([1, 2, 4, 8]),
    dendrites=st.sampled_from(["shared", "per_neuron"]),
    encoding=st.sampled_from(sorted(ENCODINGS)),
    neuron=st.sampled_from(list(NEURONS)),
    readout=st.sampled_from(list(READOUTS)),
    quantiles=st.sampled_from([1, 1, 3, 4]),
    heads=st.sampled_from(["shared", "per_task"]),
    normalization=st.sampled_from(["per_task", "shared"]),
    seed=st.integers(0, 2**20),
)
def test_any_network_is_exported_bitwise(
    method, reset, timesteps, dendrites, encoding, neuron, readout, quantiles, heads, normalization, seed
) -> None:
    """On exact numbers, whatever the combination; EXPORT_EXAMPLES=500 looks at more of them."""
    traits = METHOD_TRAITS[method]
    network = {"method": method, "timesteps": timesteps, "normalization": normalization, "heads": heads}
    if traits.spiking:
        network |= {"reset": reset, "encoding": encoding, "neuron": neuron, "readout": readout}
        network["tasks"] = {"frame_stack": ENCODINGS[encoding].steps(timesteps) or 2}
    if traits.dendrites:
        network["dendrites"] = dendrites
    if network.get("readout") != "max_membrane":
        network["quantiles"] = quantiles
    agent = make_agent(seed, **network)
    x = dyadic_observations(observations(agent, 6, seed))
    agent, exact = exact_copy(agent, [x] * 3)
    assert exact
    profile = "exact" if reset == "subtract" else "portable"
    written = exports(agent, None if "nir" in obstacles(fold_agent(agent), profile) else profile)
    for task in range(3):
        comparisons = list(compare(agent, written, task, x))
        assert comparisons
        assert all(comparison.bitwise for comparison in comparisons), comparisons


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_real_weights_decide_alike(variant: str) -> None:
    agent = make_agent(**VARIANTS[variant])
    x = observations(agent, 150)
    for task in range(3):
        comparisons = list(compare(agent, exports(agent, profile_of(variant)), task, x))
        assert comparisons
        for comparison in comparisons:
            assert comparison.equal_actions_share >= 0.99, comparison
            assert comparison.decisions_with_flips <= 3, comparison


def test_a_batch_may_mix_tasks_and_one_file_per_task_says_the_same() -> None:
    agent = make_agent()
    x, tasks = observations(agent, 30), np.arange(30) % 3
    network = fold_agent(agent)
    mixed = OnnxAgent(decision_model(network).SerializeToString(), agent.suite, agent.config)
    q = mixed.decide(x, tasks)["q_values"]
    for task in range(3):
        own = OnnxAgent(decision_model(network, task).SerializeToString(), agent.suite, agent.config)
        assert "task" not in [value.name for value in own.session.get_inputs()]
        np.testing.assert_allclose(own.q_values(x[tasks == task], task), q[tasks == task], atol=1e-5)
        np.testing.assert_allclose(agent.q_values(x[tasks == task], task), q[tasks == task], atol=1e-5)


def with_wrong_layer(network: FoldedNetwork, index: int) -> FoldedNetwork:
    """The network with all currents of one layer raised."""
    wrong = network.synapses[index]
    return network.with_synapses(lambda node: replace(node, shift_KO=node.shift_KO + 1.0) if node is wrong else node)


@pytest.mark.slow
def test_a_broken_export_is_caught_and_the_layer_named() -> None:
    """Parity must fail when one number of one layer is wrong."""
    agent = dyadic_copy(make_agent())
    x = observations(agent, 24)
    for index, name in enumerate(["conv1", "hidden", "head"]):
        wrong = with_wrong_layer(fold_agent(agent), index)
        model, own = (decision_model(wrong, task).SerializeToString() for task in (None, 1))
        graphs = {"asterix": nir_graph(wrong, 1)}
        written = Exports(wrong, model, step_model(wrong).SerializeToString(), graphs, {"asterix": own})
        comparisons = compare(agent, written, 1, x)
        assert [comparison.runtime for comparison in comparisons] == ["onnx", "onnx, one task", "nir"]
        for comparison in comparisons:
            assert not comparison.bitwise
            assert comparison.first_difference == name


@pytest.mark.parametrize("variant", ["SwitchMT", "DQN_D", "LIF", "heads per task"])
@pytest.mark.parametrize("task", [None, 2])
def test_int8_weights_are_stored_as_integers_and_mean_the_rounded_ones(variant: str, task: int | None) -> None:
    agent = make_agent(**VARIANTS[variant])
    network = quantized(fold_agent(agent))
    model = decision_model(network, task)
    stored = {t.name: onnx.numpy_helper.to_array(t) for t in model.graph.initializer}
    networks = [part if task is None else part.of_task(task) for part in (network, fold_agent(agent))]
    for node, original in zip(*(part.synapses for part in networks), strict=True):
        integers = stored[f"{node.name}_weight_int8"]
        assert integers.dtype == np.int8
        assert np.abs(integers).max() == 127
        half_a_step = node.over_weight(node.weight_steps_O) * 0.5 + 1e-12
        assert (np.abs(node.weight - original.weight) <= half_a_step).all()
    floats = network.with_synapses(lambda node: replace(node, weight_steps_O=None))
    x = observations(agent, 100)
    values = [
        OnnxAgent(m.SerializeToString(), agent.suite, agent.config).q_values(x, 2)
        for m in (model, decision_model(floats, task))
    ]
    assert (values[0].argmax(1) == values[1].argmax(1)).mean() >= 0.99
    assert np.median(np.abs(values[0] - values[1])) < 1e-5


def test_files_say_what_a_host_must_know() -> None:
    agent = make_agent(threshold=0.75, timesteps=3)
    model = decision_model(fold_agent(agent))
    facts = {entry.key: entry.value for entry in model.metadata_props}
    assert json.loads(facts["tasks"]) == ["breakout", "asterix", "space_invaders"]
    assert (facts["method"], facts["encoding"], facts["reset"]) == ("SwitchMT", "direct", "zero")
    assert json.loads(facts["timesteps"]) == 3
    assert json.loads(facts["neurons"])["hidden"] == {"neuron": "IF", "beta": 1.0, "threshold": 0.75}
    assert json.loads(facts["training_step"]) == 1234
    assert model.opset_import[0].version == 18
    assert {node.op_type for node in model.graph.node} >= {"Scan", "Conv", "Gather"}
    assert not [t for t in model.graph.initializer if t.data_location == onnx.TensorProto.EXTERNAL]


@pytest.mark.slow
@pytest.mark.parametrize("profile", ["portable", "spikingjelly", "legacy"])
@pytest.mark.parametrize("variant", ["SwitchMT", "LIF", "mlp"])
def test_nir_files_survive_the_disk(profile: str, variant: str, tmp_path: Path) -> None:
    agent = dyadic_copy(make_agent(**VARIANTS[variant]))
    network = fold_agent(agent)
    graph = nir_graph(network, 1, profile)
    write_nir(graph, tmp_path / "task.nir")
    again = read_nir(tmp_path / "task.nir")
    assert again.metadata["profile"] == profile
    assert str(again.metadata["tasks"]).split(",") == list(agent.suite.names)
    for node in again.nodes.values():
        for name in ("r", "tau", "v_threshold", "v_reset", "v_leak", "weight", "bias"):
            value = getattr(node, name, None)
            if isinstance(value, np.ndarray):
                assert value.dtype == np.float32
                if name in ("r", "tau", "v_threshold"):
                    assert value.shape == tuple(node.input_type["input"]), "full layer shape"
    x = dyadic_observations(observations(agent, 8))
    encoded = encode(agent.suite, agent.config, x, 0)
    assert np.array_equal(NirInterpreter(graph).run(encoded)[0], NirInterpreter(again).run(encoded)[0])
    q = network.readout(NirInterpreter(again).run(encoded)[0])
    np.testing.assert_allclose(q, trace_torch(agent, x, 1, 0).q_BA, rtol=1e-6, atol=1e-6)
    import h5py

    with h5py.File(tmp_path / "task.nir") as file:
        has_reset = ["v_reset" in node for node in file["node/nodes"].values() if "v_threshold" in node]
    assert has_reset == [profile != "legacy"] * 2


def test_legacy_with_subtract_needs_the_rule_from_the_metadata() -> None:
    agent = dyadic_copy(make_agent(reset="subtract"))
    x = dyadic_observations(observations(agent, 16))
    written = exports(agent, "legacy")
    (nir_comparison,) = [c for c in compare(agent, written, 0, x) if c.runtime == "nir"]
    assert nir_comparison.bitwise
    graph = written.graphs["breakout"]
    encoded = encode(agent.suite, agent.config, x, 0)
    assert not np.array_equal(
        NirInterpreter(graph).run(encoded)[0], NirInterpreter(graph, reset="subtract").run(encoded)[0]
    )


@pytest.mark.slow
def test_what_nir_cannot_say_is_refused() -> None:
    cases = {
        "DQN": "ReLU",
        "k winners": "k_winners",
        "subtract": "--nir-dialect exact",
        "Synaptic": "nir.CubaLIF resets at the spike",
        "Synaptic subtract": "--nir-dialect exact",
        "ALIF": "NIR cannot express ALIF",
    }
    for variant, message in cases.items():
        network = fold_agent(make_agent(**VARIANTS[variant]))
        assert list(obstacles(network)) == ["nir"]
        with pytest.raises(ExportError, match=message):
            nir_graph(network, 0)


def test_weights_that_are_not_finite_are_refused() -> None:
    agent = make_agent()
    with torch.no_grad():
        agent.network.trunk["conv1"].synapses.weight[0, 0, 0, 0] = torch.nan
    with pytest.raises(ExportError, match=r"trunk\.conv1\.synapses\.weight holds values that are not finite"):
        fold_agent(agent)


@pytest.mark.slow
def test_damaged_and_foreign_files_are_named(tmp_path: Path) -> None:
    agent = make_agent()
    path = tmp_path / "decision.onnx"
    onnx.save(decision_model(fold_agent(agent)), path)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ExportError, match="cannot be read"):
        onnx_session(path)
    with pytest.raises(ExportError, match="cannot be read"):
        read_nir(path)
    model = decision_model(fold_agent(agent))
    onnx.save(model, path, save_as_external_data=True, location="weights.bin", size_threshold=0)
    with pytest.raises(ExportError, match="keeps weights in other files"):
        onnx_session(path)


@pytest.mark.parametrize("neuron", NEURONS)
def test_every_registered_neuron_is_written_as_onnx_with_all_its_states(neuron: str) -> None:
    agent = make_agent(neuron=neuron)
    network = fold_agent(agent)
    layer = agent.network.trunk["conv1"].neurons
    assert network.layers[0].neurons.states == layer.STATE
    inputs = [value.name for value in step_model(network).graph.input]
    assert inputs == ["encoded", "task", *(f"{state}_{x.name}" for x in network.layers for state in layer.STATE)]


def test_a_neuron_from_outside_is_refused_by_every_writer_with_its_name() -> None:
    agent = make_agent(neuron=f"{__name__}:Unknown")
    network = fold_agent(agent)
    for write in (decision_model, step_model, lambda network: nir_graph(network, 0)):
        with pytest.raises(ExportError, match=rf"cannot express {__name__}:Unknown \(OpaqueNode\), expected"):
            write(network)
    with pytest.raises(ExportError, match=rf"{__name__}:Unknown has no rule that makes its parameters dyadic"):
        dyadic_copy(agent)


class Unknown(NeuronLayer):
    """Fires whenever its input is positive."""

    STATE = ()

    def step(self, current_t: torch.Tensor, state: NeuronState) -> tuple[torch.Tensor, NeuronState]:
        """One step without a state."""
        return self.surrogate(current_t), state


def test_legacy_refuses_leaky_neurons_that_subtract() -> None:
    network = fold_agent(make_agent(**VARIANTS["LIF subtract"]))
    with pytest.raises(ExportError, match="before the membrane decays"):
        nir_graph(network, 0, "legacy")


def test_interpreter_by_hand() -> None:
    """One neuron, threshold 1: a tie does not fire under >, and does under >=; the loop subtracts one step later."""
    one = np.ones(1, np.float32)
    x = np.full((4, 1, 1), 0.5, np.float32)

    def graph(nodes, edges):
        whole = {"input": nir.Input({"input": np.array([1])}), **nodes, "output": nir.Output({"output": np.array([1])})}
        return nir.NIRGraph(whole, edges, metadata={"dt": 1.0})

    plain = graph({"n": nir.IF(r=one, v_threshold=one, v_reset=0 * one)}, [("input", "n"), ("n", "output")])
    assert NirInterpreter(plain).run(x)[0].ravel().tolist() == [0, 0, 1, 0]
    assert NirInterpreter(plain, fires_at_threshold=True).run(x)[0].ravel().tolist() == [0, 1, 0, 1]
    loop = graph(
        {"v": nir.I(r=one), "s": nir.Threshold(threshold=one), "back": nir.Scale(scale=-one)},
        [("input", "v"), ("v", "s"), ("s", "back"), ("back", "v"), ("s", "output")],
    )
    # 0.75, 1.5 (fires), 1.5 - 1 + 0.75 = 1.25 (fires), 1.25 - 1 + 0.75 = 1.0: a tie.
    assert NirInterpreter(loop).run(x * 1.5)[0].ravel().tolist() == [0, 1, 1, 0]
    leaky = graph(
        {"n": nir.LIF(tau=2 * one, r=one, v_leak=0 * one, v_threshold=one)}, [("input", "n"), ("n", "output")]
    )
    # v += (x - v) / 2 with x = 1.5: 0.75, 1.125 (fires), 0.75, 1.125 (fires).
    assert NirInterpreter(leaky).run(x * 3)[0].ravel().tolist() == [0, 1, 0, 1]
    two = 2 * one
    cuba = graph(
        {"n": nir.CubaLIF(tau_syn=two, tau_mem=two, r=two, v_leak=0 * one, v_threshold=one, w_in=two)},
        [("input", "n"), ("n", "output")],
    )
    # i = i / 2 + x, v = v / 2 + i with x = 0.5: (0.5, 0.5), (0.75, 1.0), (0.875, 1.375: fires), (0.9375, 0.9375).
    assert NirInterpreter(cuba).run(x)[0].ravel().tolist() == [0, 0, 1, 0]
    with pytest.raises(ExportError, match="has SumPool2d"):
        NirInterpreter(graph({"p": nir.SumPool2d(one, one, one)}, [("input", "p"), ("p", "output")]))
