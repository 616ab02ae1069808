"""The native neuron layers (C++) against PyTorch's operations."""

from __future__ import annotations

import copy
import gc
import weakref
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from switchmt_snn.config import NetworkConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.native import library as native_library
from switchmt_snn.native.adam import NativeAdam
from switchmt_snn.native.network import NativeNetwork
from switchmt_snn.native.neurons import Currents, Neurons, batch_moments, scaled_images
from switchmt_snn.spiking.network import ObservationSpec, QNetwork, build_network
from switchmt_snn.spiking.neurons import LeakyLayer
from switchmt_snn.spiking.readout import READOUTS
from switchmt_snn.updates import choice as machine
from tests.conftest import small_config

CPU = torch.device("cpu")
builds = pytest.mark.skipif(native_library.problem() is not None, reason="no C++ compiler")
FORMS = {
    "neuron": st.sampled_from(["IF", "LIF"]),
    "reset": st.sampled_from(["zero", "subtract"]),
    "surrogate": st.sampled_from(["atan", "fast_sigmoid"]),
    "surrogate_slope": st.sampled_from([None, 0.5, 3.0]),
    "beta": st.floats(0.0, 1.0, width=32),
    "threshold": st.sampled_from([0.125, 0.5, 1.0]),
}


def plain_gated(config: NetworkConfig, y_SRC: Tensor, gain_C: Tensor) -> Tensor:
    current_SRC = y_SRC.float() * gain_C
    spikes, _ = LeakyLayer(config)(current_SRC.expand(config.timesteps, *y_SRC.shape[1:]))
    return spikes


@builds
@settings(max_examples=60, deadline=None)
@given(
    form=st.fixed_dictionaries(FORMS),
    timesteps=st.integers(1, 7),
    shared=st.booleans(),
    rows=st.integers(1, 80),
    channels=st.integers(1, 70),
    low=st.booleans(),
    seed=st.integers(0, 2**31),
)
def test_spikes_are_bitwise_those_of_the_eager_neurons(form, timesteps, shared, rows, channels, low, seed) -> None:
    """And gradients equal to rounding, for shared and single currents, whole and broken blocks of channels."""
    config = NetworkConfig(timesteps=timesteps, **form)
    torch.manual_seed(seed)
    y = (torch.randn(1 if shared else timesteps, rows, channels) * 1.5).to(torch.bfloat16 if low else torch.float32)
    weights, gain = torch.randn(timesteps, rows, channels), torch.linspace(0.3, 1.2, channels)
    y_SRC, gain_C = y.clone().requires_grad_(), gain.clone().requires_grad_()
    theirs = plain_gated(config, y_SRC, gain_C)
    (theirs * weights).sum().backward()
    neurons = Neurons(config)
    ours, currents_4C = neurons.fire(y, Currents(gain), "floats")
    grad_y, (grad_gain, _) = neurons.unfire(y, currents_4C, weights)
    assert torch.equal(ours, theirs)
    for our_grad, their_grad in ((grad_y, y_SRC.grad), (grad_gain, gain_C.grad)):
        scale = float(their_grad.abs().max()) + 1e-6
        torch.testing.assert_close(
            our_grad, their_grad, rtol=1e-2 if low else 1e-4, atol=scale * (5e-3 if low else 1e-5)
        )


@builds
@pytest.mark.parametrize("channels", [5, 16, 32, 47, 80])
def test_every_form_has_the_same_spikes(channels: int) -> None:
    """Numbers, floats, bits (no bit beyond the channels), mean."""
    neurons, currents = Neurons(NetworkConfig(timesteps=3)), Currents(torch.ones(channels))
    y = (torch.randn(3, 21, channels) * 2).bfloat16()
    floats, _ = neurons.fire(y, currents, "floats")
    assert 0.1 < floats.mean() < 0.9
    assert torch.equal(neurons.fire(y, currents, "numbers")[0], floats.bfloat16())
    unpacked = (neurons.fire(y, currents, "bits")[0][..., None] >> torch.arange(32)) & 1
    assert torch.equal(unpacked.flatten(2), F.pad(floats, (0, -channels % 32)).int())
    mean, currents_4C = neurons.fire(y, currents, "mean")
    assert torch.equal(mean, floats.mean(0, keepdim=True))
    shared = torch.randn(1, 21, channels).expand(3, -1, -1)
    for ours, theirs in zip(
        neurons.unfire(y, currents_4C, shared), neurons.unfire(y, currents_4C, shared.contiguous()), strict=True
    ):
        assert torch.equal(ours, theirs)


@builds
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("steps", [1, 4])
def test_normalized_spikes_equal_batch_norm_and_neurons(dtype: torch.dtype, steps: int) -> None:
    """In training: spikes, and the gradient through the batch's own mean and variance."""
    config = NetworkConfig(timesteps=4)
    torch.manual_seed(3)
    y, g = (torch.randn(steps, 400, 24) * 3 + 5).to(dtype), torch.randn(4, 400, 24)
    weight, bias = torch.rand(24) + 0.5, torch.randn(24) / 3
    y_SRC, weight_C, bias_C = (x.clone().requires_grad_() for x in (y, weight, bias))
    flat = y_SRC.flatten(0, 1).to(torch.float64)
    current = F.batch_norm(flat, None, None, weight_C.double(), bias_C.double(), True, 0.1, 1e-5)
    current = current.float().view(steps, 400, 24).expand(4, 400, 24)
    spikes, _ = LeakyLayer(config)(current)
    (spikes * g.to(dtype).float()).sum().backward()
    neurons = Neurons(config)
    ours, currents_4C = neurons.fire(y, Currents(weight, bias, *batch_moments(y), 1e-5), "numbers")
    grad_y, (grad_weight, grad_bias) = neurons.unfire(y, currents_4C, g.to(dtype))
    assert ours.mean() > 0.1
    assert torch.equal(ours.float(), spikes)
    low = dtype == torch.bfloat16
    for our_grad, part in ((grad_y, y_SRC), (grad_weight, weight_C), (grad_bias, bias_C)):
        assert part.grad is not None
        scale = float(part.grad.abs().max())
        torch.testing.assert_close(
            our_grad, part.grad, rtol=1e-2 if low else 1e-4, atol=scale * (1e-2 if low else 1e-5)
        )


@builds
@pytest.mark.parametrize(("mean", "first"), [(300.0, 300.0), (-1e4, -1e4), (0.0, 1000.0)])
def test_moments_keep_their_digits(mean: float, first: float) -> None:
    """Far from zero, and beside a value that is far from all others."""
    y = torch.randn(2, 5000, 40) + mean
    y[0, 0] = first
    mean_C, var_C = batch_moments(y)
    torch.testing.assert_close(mean_C.double(), y.double().mean((0, 1)), rtol=1e-6, atol=1e-7 * abs(first))
    torch.testing.assert_close(var_C.double(), y.double().var((0, 1), correction=0), rtol=1e-5, atol=0)


@builds
@pytest.mark.parametrize(("steps", "rows"), [(1, 2), (1, 63), (4, 150)])
def test_running_moments_move_as_in_batch_norm(steps: int, rows: int) -> None:
    y, (mean_C, var_C) = torch.randn(steps, rows, 37) * 3 + 2, (torch.randn(37), torch.rand(37))
    theirs = mean_C.clone(), var_C.clone()
    F.batch_norm(y.flatten(0, 1), *theirs, training=True, momentum=0.3)
    batch_moments(y, (mean_C, var_C), 0.3)
    torch.testing.assert_close((mean_C, var_C), theirs, rtol=1e-5, atol=1e-6)
    with pytest.raises(ValueError, match="expected float32 for 37 channels"):
        batch_moments(y, (mean_C.double(), var_C), 0.3)
    with pytest.raises(ValueError, match="one row, expected two"):
        batch_moments(y[:1, :1], (mean_C, var_C), 0.3)


@builds
@pytest.mark.parametrize("shape", [(3, 4, 84, 84), (2, 4, 7, 9), (2, 1, 5, 5), (1, 6, 13, 11)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_scaled_images_are_bitwise_those_of_torch(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    x = torch.randint(0, 256, shape, dtype=torch.uint8)
    ours = scaled_images(x, 1 / 255, dtype)
    assert torch.equal(ours, (x.float() * (1 / 255)).to(dtype))
    assert ours.is_contiguous(memory_format=torch.channels_last)


@builds
def test_what_cplusplus_would_read_wrongly_is_refused() -> None:
    neurons, ones = Neurons(NetworkConfig(timesteps=4)), torch.ones(8)
    for y in (
        torch.zeros(4, 8, 5).transpose(1, 2),
        torch.zeros(3, 5, 8),
        torch.zeros(4, 5, 8, dtype=torch.float64),
        torch.zeros(4, 5, 8, device="meta"),
    ):
        with pytest.raises(ValueError, match="expected"):
            neurons.fire(y, Currents(ones), "floats")
    for gain_C in (ones.double(), torch.ones(1)):
        with pytest.raises(ValueError, match="expected float32 for 8 channels"):
            neurons.fire(torch.zeros(4, 5, 8), Currents(gain_C), "floats")
    for grad in (torch.zeros(1, 5, 8), torch.zeros(4, 5, 8).bfloat16()):
        with pytest.raises(ValueError, match=r"gradient .*expected float32"):
            neurons.unfire(torch.zeros(4, 5, 8), torch.zeros(4, 8), grad)


@builds
def test_any_number_of_threads_gives_the_same_bits() -> None:
    neurons, currents = Neurons(NetworkConfig(timesteps=4)), Currents(torch.ones(48))
    y, g = torch.randn(4, 333, 48), torch.randn(4, 333, 48)
    threads, results = torch.get_num_threads(), []
    try:
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            spikes, currents_4C = neurons.fire(y, currents, "floats")
            results.append((spikes, *neurons.unfire(y, currents_4C, g), *batch_moments(y)))
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@builds
def test_a_target_is_read_anew_after_its_copy() -> None:
    """Its weights are kept between copies, and only between them."""
    spec = ObservationSpec((4, 10, 10), 1, 1.0, True, 6, 3)
    config = small_config(network={"trunk": "minatar"}).network
    network, target = build_network(config, spec, 1), build_network(config, spec, 2).requires_grad_(False)
    native = NativeNetwork(target, torch.bfloat16)
    before = native.view(1)
    assert native.view(1) is before
    gain_N = before.gain_N.clone()
    target.load_state_dict(network.state_dict())
    learning = NativeNetwork(network, torch.bfloat16)
    after, fresh = native.view(1), learning.view(1)
    assert not torch.equal(after.gain_N, gain_N)
    assert torch.equal(after.gain_N, fresh.gain_N)
    assert not torch.equal(after.gain_N, native.view(0).gain_N)
    assert len(native.copies) == 5  # a convolution's weight, two streams' weights and biases
    for ours, theirs in zip(native.copies.items(), learning.copies.items(), strict=True):
        assert torch.equal(ours[0], theirs[0])
        assert torch.equal(ours[1], theirs[1])


def decision(readout: str) -> tuple[QNetwork, NativeNetwork, Tensor]:
    """A network, natively; and its inputs."""
    settings_ = {"trunk": "minatar", "readout": readout, "threshold": 0.2}
    network = build_network(
        small_config(network=settings_).network, ObservationSpec((4, 10, 10), 1, 1.0, True, 6, 3), 1
    )
    native = NativeNetwork(network, None)
    return network, native, native.inputs(torch.rand(5, 4, 10, 10), torch.Generator())


@builds
@pytest.mark.parametrize("readout", READOUTS)
def test_a_decision_leaves_no_cycle_behind(readout: str) -> None:
    """Its memory is free at once, not when Python looks for cycles."""
    _, native, x = decision(readout)
    held = weakref.ref(x)
    gc.collect()
    gc.disable()
    try:
        values = native.decide(x, native.view(0), training=True, beside=[x])
        values[0].sum().backward()
        del x, values
        assert held() is None
    finally:
        gc.enable()


@builds
def test_a_way_back_is_gone_once_and_with_the_parameters_of_the_decision() -> None:
    network, native, x = decision("mean")
    parameters = list(network.parameters())
    (q,) = native.decide(x, native.view(0), training=True)
    (other,) = native.decide(x * 0.5, native.view(1), training=True)
    late = torch.autograd.grad(q.square().sum(), parameters, retain_graph=True)
    (q_again,) = native.decide(x, native.view(0), training=True)
    for ours, theirs in zip(late, torch.autograd.grad(q_again.square().sum(), parameters), strict=True):
        assert torch.equal(ours, theirs)
    with pytest.raises(RuntimeError, match="a second way back"):
        q.sum().backward()
    with torch.no_grad():
        parameters[0].add_(1.0)
    with pytest.raises(RuntimeError, match="parameters have changed"):
        other.sum().backward()


@builds
@pytest.mark.parametrize("task", [-1, 3])
def test_a_task_that_there_is_not_is_refused(task: int) -> None:
    _, native, _ = decision("mean")
    with pytest.raises(IndexError, match=f"task {task}, expected 0 to 2"):
        native.view(task)


@builds
@pytest.mark.parametrize("precision", [None, torch.bfloat16])
def test_adam_is_pytorchs_to_rounding_and_keeps_copies_true(precision: torch.dtype | None) -> None:
    spec = ObservationSpec((4, 10, 10), 1, 1.0, True, 6, 3)
    ours, theirs = (build_network(small_config(network={"trunk": "minatar"}).network, spec, 1) for _ in range(2))
    native = NativeNetwork(ours, precision)
    optimizers = (
        NativeAdam(ours.parameters(), 1e-2, 1e-5, native),
        torch.optim.Adam(theirs.parameters(), lr=1e-2, eps=1e-5, fused=True),
    )
    for number in range(5):
        native.view(0)
        for index, (our, their) in enumerate(zip(ours.parameters(), theirs.parameters(), strict=True)):
            grad = torch.randn(our.shape) * 10.0 ** (-index)
            grad = grad.contiguous(memory_format=torch.channels_last) if our.dim() == 4 and number % 2 else grad
            our.grad, their.grad = (
                (None, None) if index == number else (grad, grad.clone(memory_format=torch.contiguous_format))
            )
        before = [parameter._version for parameter in ours.parameters()]
        for optimizer in optimizers:
            optimizer.step()
        moved = [parameter._version > old for parameter, old in zip(ours.parameters(), before, strict=True)]
        assert moved.count(False) == 1
        assert len(optimizers[0].state) == len(optimizers[1].state)
        assert native.copies_are_true()
        for part, written in native.copies.items():
            assert torch.equal(written, part.to(written.dtype))
    our_state, their_state = (optimizer.state_dict()["state"] for optimizer in optimizers)
    assert our_state.keys() == their_state.keys()
    for (name, our), their in zip(ours.named_parameters(), theirs.parameters(), strict=True):
        torch.testing.assert_close(our, their, rtol=1e-5, atol=1e-7, msg=name)
    for index, our in our_state.items():
        assert our.keys() == their_state[index].keys()
        for key in our:
            their_part = their_state[index][key]
            torch.testing.assert_close(our[key], their_part, rtol=1e-5, atol=1e-6 * float(their_part.abs().max()))
    with torch.no_grad():
        next(iter(native.copies)).add_(1.0)
    assert not native.copies_are_true()
    optimizers[0].step()
    assert not native.copies_are_true()
    native.view(0)
    assert native.copies_are_true()
    assert all(torch.equal(written, part.to(written.dtype)) for part, written in native.copies.items())
    with pytest.raises(ValueError, match="closure"):
        optimizers[0].step(lambda: 0.0)
    for optimizer, other in (optimizers, optimizers[::-1]):  # each goes on from the other's state
        optimizer.load_state_dict(copy.deepcopy(other.state_dict()))
    state = copy.deepcopy(optimizers[0].state_dict())
    state["state"][0]["exp_avg"] = state["state"][0]["exp_avg"][:1]
    with pytest.raises(ValueError, match=r"exp_avg is .*expected that of a parameter"):
        optimizers[0].load_state_dict(state)
    theirs.load_state_dict(ours.state_dict())
    before = [parameter.detach().clone() for parameter in ours.parameters()]
    for our, their in zip(ours.parameters(), theirs.parameters(), strict=True):
        our.grad = their.grad = torch.randn(our.shape)
    for optimizer in optimizers:  # as it was; and anew, where parameters lie elsewhere
        optimizer.step()
        optimizer.state.clear()
    for parameter in ours.parameters():
        parameter.data = parameter.data.clone()
    for optimizer in optimizers:
        optimizer.step()
    for our, their, old in zip(ours.parameters(), theirs.parameters(), before, strict=True):
        assert not torch.equal(our, old)
        torch.testing.assert_close(our, their, rtol=1e-5, atol=1e-6)
    assert optimizers[0].state_dict()["state"].keys() == optimizers[1].state_dict()["state"].keys()


@pytest.mark.parametrize(
    ("setting", "named"),
    [
        ({"method": "DQN_D"}, "no spikes"),
        ({"learn_beta": True, "neuron": "LIF"}, "learn_beta"),
        ({"surrogate": "sigmoid"}, "surrogate=sigmoid"),
        ({"k_winners": 3}, "k_winners"),
        ({"neuron_engine": "snntorch"}, "neuron_engine"),
    ],
)
def test_what_it_has_no_code_for_is_refused_by_name(setting: dict[str, Any], named: str) -> None:
    asked = small_config(network=setting, learning={"engine": "native"})
    with pytest.raises(ConfigError, match=f"learning.engine is 'native', .*it has no code for .*{named}.*eager"):
        machine.settle(asked, None, CPU)


@pytest.mark.parametrize("has_bits", [True, False])
def test_auto_is_native_on_the_nature_trunk(has_bits: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """In float32 only where the processor has products of bits."""
    monkeypatch.setattr(machine, "native_obstacle", lambda config, device: None)
    monkeypatch.setattr(machine, "spikes_as_bits", lambda dtype: has_bits)

    def settled(trunk: str, precision: str, engine: str = "auto") -> tuple[str, list[str]]:
        asked = small_config(network={"trunk": trunk}, learning={"precision": precision, "engine": engine})
        config, words = machine.settle(asked, None, CPU)
        return config.learning.engine, words

    engine, words = settled("nature", "bfloat16")
    assert engine == "native"
    assert "C++" in words[-1]
    engine, words = settled("nature", "float32")
    assert engine == ("native" if has_bits else "eager")
    assert has_bits or "AVX-512" in words[-1]
    assert settled("minatar", "bfloat16")[0] == settled("nature", "bfloat16", "eager")[0] == "eager"
    monkeypatch.setattr(machine, "native_obstacle", lambda config, device: "expected luck")
    engine, words = settled("nature", "bfloat16")
    assert engine == "eager"
    assert "expected luck" in words[-1]
    ann = small_config(network={"trunk": "nature", "method": "DQN_D"}, learning={"precision": "float32"})
    config, words = machine.settle(ann, None, CPU)
    assert (config.learning.engine, words) == ("eager", [])


@builds
def test_it_is_built_once_and_kept_and_again_if_damaged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    build, folders = native_library._build, []

    def counted(compiler: list[str], folder: Path) -> Path:
        folders.append(folder)
        return build(compiler, folder)

    monkeypatch.setattr(native_library, "_build", counted)

    def load() -> Path:
        native_library.library.cache_clear()
        assert native_library.problem() is None
        (kept,) = (tmp_path / "switchmt_snn").iterdir()
        return kept

    try:
        damaged = native_library._cache() / f"native-{native_library._key(native_library._compiler())}.so"
        damaged.parent.mkdir()
        damaged.write_bytes(b"not a library")
        assert load() == load() == damaged
        assert damaged.stat().st_size > 10_000
        assert len(folders) == 1
        monkeypatch.setenv("XDG_CACHE_HOME", "/proc/no-such-folder")
        native_library.library.cache_clear()
        assert native_library.problem() is None
        assert not any(folder.exists() for folder in folders)
        assert native_library._key(["g++"]) != native_library._key(["g++", "-g"])
    finally:
        native_library.library.cache_clear()


def test_no_compiler_and_a_failing_one_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    native_library.library.cache_clear()
    try:
        monkeypatch.setenv("CXX", "no-such-compiler")
        assert native_library.problem() == "no C++ compiler 'no-such-compiler'"
        script = tmp_path / "failing"
        script.write_text("#!/bin/sh\n[ $1 = --version ] && exit 0\necho unhappy >&2\nexit 1\n")
        script.chmod(0o755)
        monkeypatch.setenv("CXX", str(script))
        assert native_library.problem() == "unhappy"
        assert not (tmp_path / "switchmt_snn").exists()
        asked = small_config(learning={"engine": "native"})
        with pytest.raises(ConfigError, match=r"a C\+\+ compiler .*\(unhappy\); use learning.engine=eager"):
            machine.settle(asked, None, CPU)
        with pytest.raises(ConfigError, match=r"this run was begun, .*\(unhappy\); start another run \(--run OTHER"):
            machine.settle(small_config(), asked, CPU)
        with pytest.raises(ConfigError, match=r"is 'native', expected .*\(unhappy\); use learning.engine=eager"):
            machine.settle(asked, small_config(learning={"engine": "eager"}), CPU)  # not what it was begun with
        for value in ('"g++', "no-such-compiler -g"):
            monkeypatch.setenv("CXX", value)
            assert str(native_library.problem()).startswith("no C++ compiler")
    finally:
        native_library.library.cache_clear()
