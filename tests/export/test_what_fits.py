"""Whether a format can express a network: what the check says, the writer and the proof say, too."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from switchmt_snn.acting.agent import Agent
from switchmt_snn.errors import ExportError
from switchmt_snn.export.folded import fold_agent
from switchmt_snn.export.formats.files import obstacles
from switchmt_snn.export.formats.nir_writer import nir_graph
from switchmt_snn.export.parity.compare import Exports, compare
from switchmt_snn.export.parity.dyadic import dyadic_copy
from switchmt_snn.spiking.neurons import LeakyLayer
from tests.export.export_cases import VARIANTS, RunCommand, make_agent, observations


def with_decays(agent: Agent, betas: tuple[float, ...]) -> Agent:
    layers = [module for module in agent.network.modules() if isinstance(module, LeakyLayer)]
    with torch.no_grad():
        for layer, beta in zip(layers, betas, strict=True):
            layer.leaky.beta.fill_(beta)
    return agent


@pytest.mark.slow
@pytest.mark.parametrize("reset", ["zero", "subtract"])
def test_the_exact_copy_fits_where_the_network_does_whatever_decays_were_learned(reset: str) -> None:
    """Learned decays leave [0, 1] (neurons clamp them), and streams have one each; the trunk here is one layer."""
    dialect = "exact" if reset == "subtract" else "portable"
    for betas in itertools.product([-0.3, 0.5, 1.0, 1.2], repeat=3):
        agent = with_decays(make_agent(neuron="LIF", learn_beta=True, reset=reset, hidden_units=4), betas)
        found, of_copy = obstacles(fold_agent(agent), dialect), obstacles(fold_agent(dyadic_copy(agent)), dialect)
        assert found == of_copy, betas
        one_stream_decays = len({min(beta, 1.0) == 1.0 for beta in betas[1:]}) == 2
        assert list(found) == (["nir"] if one_stream_decays else []), betas


def advised(message: str) -> list[str]:
    """Dialects that a message sends the reader to."""
    return [
        dialect
        for dialect in ("portable", "spikingjelly", "exact", "legacy")
        if re.search(rf"(--nir-dialect |or ){dialect}", message)
    ]


@pytest.mark.parametrize("variant", [name for name in VARIANTS if "subtract" in name])
def test_a_dialect_that_a_refusal_names_expresses_the_network(variant: str) -> None:
    network = fold_agent(make_agent(**VARIANTS[variant]))
    if variant == "ALIF subtract":
        assert "--onnx" in obstacles(network)["nir"]
        return
    for dialect in ("portable", "spikingjelly", "legacy"):
        with_dialect = obstacles(network, dialect)
        if with_dialect:
            assert "exact" in advised(with_dialect["nir"]), with_dialect
            for other in advised(with_dialect["nir"]):
                assert obstacles(network, other) == {}, other


@pytest.mark.parametrize("neuron", ["IF", "LIF", "Synaptic"])
@pytest.mark.parametrize("dialect", ["exact", "legacy"])
def test_a_threshold_below_zero_is_not_written_as_nir_with_subtraction(neuron: str, dialect: Any) -> None:
    """The network subtracts it at the first step, from a membrane that is above it at rest; ONNX says the same."""
    agent = make_agent(neuron=neuron, reset="subtract", learn_threshold=True)
    with torch.no_grad():
        for name, parameter in agent.network.named_parameters():
            if name.endswith("threshold"):
                parameter.fill_(-0.25)
    network, x = fold_agent(agent), observations(agent, 12)
    with pytest.raises(
        ExportError, match=r"a learned threshold is -0.25, expected at least 0|expected IF|expected 'sub"
    ):
        nir_graph(network, 0, dialect)
    from switchmt_snn.export.formats.onnx_writer import decision_model, step_model

    models = (model(network).SerializeToString() for model in (decision_model, step_model))
    (comparison,) = compare(agent, Exports(network, *models), 0, x)
    assert comparison.equal_actions == 12
    assert comparison.flipped_spikes.keys() == comparison.spikes.keys()
    assert sum(comparison.spikes.values()) > 0


def test_nothing_is_written_where_a_format_that_was_asked_for_does_not_fit(
    trained_run: Path, run_command: RunCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    from switchmt_snn.export import export_run

    def refuse(*_: object) -> None:
        raise ExportError("NIR cannot say this, expected something else; use --onnx")

    monkeypatch.setattr(export_run, "nir_graphs", refuse)
    _, err = run_command("export", trained_run, "--onnx", "--nir", "--parity-decisions", 8, code=2)
    assert "NIR cannot say this" in err
    assert not list((trained_run / "export").glob("*")), "ONNX was not written either"


@pytest.mark.slow
@pytest.mark.parametrize("error", [KeyboardInterrupt(), ExportError("no copy")])
def test_files_that_could_not_be_compared_do_not_stay(
    error: BaseException, trained_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from switchmt_snn.export import ExportSettings, export, export_run

    export(trained_run, ExportSettings(onnx=True, parity_decisions=8))
    assert (trained_run / "export" / "parity.json").is_file()

    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(export_run, "prove", fail)
    with pytest.raises(type(error)):
        export(trained_run, ExportSettings(parity_decisions=8))
    assert not list((trained_run / "export").glob("*")), "no file, and no parity.json of older ones"


def test_decays_are_compared_where_one_was_learned_above_one() -> None:
    agent = with_decays(make_agent(neuron="LIF", learn_beta=True), (1.2, 1.3, 1.0))
    twin = dyadic_copy(agent)
    nodes = [layer.neurons.beta_O for layer in fold_agent(twin).layers]
    assert all((beta_O == 1.0).all() for beta_O in nodes)
    assert np.isfinite(agent.q_values(observations(agent, 2), 0)).all()
