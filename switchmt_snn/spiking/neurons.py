"""Neuron layers over T simulation steps, built from ``snntorch.Leaky``, with the membrane passed in and handed back.

Shapes: T simulation steps, B batch, ... any feature shape.

Per step (snnTorch 1.0 with ``reset_delay=True``; strict ``>``; H the Heaviside step, theta the threshold)::

    R(t) = H(U(t-1) - theta)                               the reset owed by the last spike; no gradient
    zero:      U(t) = beta * (1 - R(t)) * U(t-1) + I(t)
    subtract:  U(t) = beta * U(t-1) + I(t) - R(t) * theta
    S(t) = H(U(t) - theta)                                 gradient: the surrogate

U(t) is the membrane *before* the reset that its own spike causes, as in snnTorch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol

import snntorch
import torch
from snntorch import surrogate as snntorch_surrogate
from torch import Tensor, nn

from switchmt_snn.config import NetworkConfig

Surrogate = Callable[[Tensor], Tensor]
SurrogateGradient = Callable[[Tensor, Tensor], Tensor]
"""``(U - theta, dL/dS) -> dL/dU``, which overwrites the first argument."""

DEFAULT_SLOPE = {"atan": 2.0, "sigmoid": 25.0, "fast_sigmoid": 25.0}
_SLOPE_ARGUMENT = {
    "atan": "alpha",
    "sigmoid": "slope",
    "fast_sigmoid": "slope",
    "triangular": "threshold",
    "spike_rate_escape": "slope",
    "SFS": "slope",
}


def make_surrogate(name: str, slope: float | None = None) -> Surrogate:
    """Return ``snntorch.surrogate.<name>``, with its slope argument if one is given and the surrogate has one.

    The gradient of snnTorch's sigmoid is exp(-k x) / (1 + exp(-k x))^2, which is inf / inf = NaN in float32 once
    k x < -88 (a membrane 3.6 below the threshold at the default k = 25). Its true value there is 0, and so is ours.
    """
    factory = getattr(snntorch_surrogate, name)
    arguments = {} if slope is None or name not in _SLOPE_ARGUMENT else {_SLOPE_ARGUMENT[name]: slope}
    surrogate: Surrogate = factory(**arguments)
    if name != "sigmoid":
        return surrogate
    lowest = -80.0 / arguments.get("slope", DEFAULT_SLOPE[name])
    return lambda x: surrogate(x.clamp(min=lowest))


def make_surrogate_gradient(name: str, slope: float | None = None) -> SurrogateGradient:
    """Return the backward of :func:`make_surrogate`'s surrogate as a function of its own.

    snnTorch's backward makes temporaries of the membranes' size; the usual surrogates do without, in place. Any other
    surrogate runs its own backward.
    """
    k = slope if slope is not None else DEFAULT_SLOPE.get(name, 0.0)
    if name == "atan":  # (k / 2) / (1 + (pi k x / 2)^2)
        return lambda x, grad: x.mul_(math.pi / 2 * k).square_().add_(1.0).reciprocal_().mul_(k / 2).mul_(grad)
    if name == "fast_sigmoid":  # 1 / (1 + k |x|)^2
        return lambda x, grad: x.abs_().mul_(k).add_(1.0).square_().reciprocal_().mul_(grad)
    if name == "sigmoid":  # k sigmoid(k x) (1 - sigmoid(k x)), even in x: small numbers keep their digits at x <= 0
        return lambda x, grad: (s := x.abs_().mul_(-k).sigmoid_()).mul_(1.0 - s).mul_(k).mul_(grad)
    surrogate = make_surrogate(name, slope)

    def own_backward(x: Tensor, grad: Tensor) -> Tensor:
        with torch.enable_grad():
            leaf = x.detach().requires_grad_()
            return x.copy_(torch.autograd.grad(surrogate(leaf), leaf, grad)[0])

    return own_backward


class NeuronLayer(Protocol):
    """Input currents over time -> spikes (or activations) over time, and the state to continue from."""

    def __call__(self, current: Tensor, membrane: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Map ``[T, B, ...]`` to ``[T, B, ...]``; ``membrane`` ``[B, ...]`` or None for the resting state 0."""


class ReLULayer(nn.Module):
    """The ANN methods' neuron: no time, no state."""

    def forward(self, current: Tensor, membrane: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
        """Return ``relu(current)`` and no state."""
        return torch.relu(current), None


class SpikingLayer(nn.Module):
    """IF or LIF neurons (``snntorch.Leaky``) over T steps with explicit state.

    ``engine="snntorch"`` calls ``snntorch.Leaky`` step by step; ``"fused"`` does the same float32 arithmetic in one
    autograd function (bitwise equal forward, gradients equal to rounding: tests/spiking/test_neurons.py). Learnable
    beta or threshold, and the stochastic surrogate SSO, always run through ``snntorch.Leaky``.

    Attributes:
        leaky: the snnTorch neuron; holds beta, threshold, reset mechanism and surrogate. Its own ``mem`` is never used.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.leaky = snntorch.Leaky(
            beta=1.0 if config.neuron == "IF" else config.beta,
            threshold=config.threshold,
            spike_grad=make_surrogate(config.surrogate, config.surrogate_slope),
            learn_beta=config.learn_beta,
            learn_threshold=config.learn_threshold,
            reset_mechanism=config.reset,
            reset_delay=True,
        )
        # snnTorch keeps every neuron it ever made in one process-wide list, for its hidden-state helpers. State is
        # explicit here, and the list would keep discarded networks alive.
        snntorch.SpikingNeuron.instances.remove(self.leaky)
        self.reset = config.reset
        # SSO draws random gradients: one draw per step in snn.Leaky, which a single backward over T would change.
        needs_leaky = config.learn_beta or config.learn_threshold or config.surrogate == "SSO"
        self.fused = config.neuron_engine == "fused" and not needs_leaky
        self.surrogate_gradient = make_surrogate_gradient(config.surrogate, config.surrogate_slope)

    def forward(self, current: Tensor, membrane: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Run T steps.

        Args:
            current: ``[T, B, ...]`` float input currents.
            membrane: ``[B, ...]`` state U(0) to start from; None is 0 (rest).

        Returns:
            spikes ``[T, B, ...]`` in {0, 1}, and the last membrane U(T) ``[B, ...]``.
        """
        if membrane is None:
            membrane = torch.zeros_like(current[0])
        if torch.compiler.is_compiling() and self.fused:
            return self._traced(current, membrane)
        if self.fused:
            # The two parameters are fixed numbers; reading them as floats keeps the step free of broadcasts.
            beta, threshold = float(self.leaky.beta.clamp(0, 1)), float(self.leaky.threshold)
            fused: tuple[Tensor, Tensor] = _FusedLeaky.apply(  # type: ignore[no-untyped-call]
                current, membrane, beta, threshold, self.reset == "zero", self.surrogate_gradient
            )
            return fused
        return self._step_by_step(current, membrane)

    def _traced(self, current: Tensor, membrane: Tensor) -> tuple[Tensor, Tensor]:
        """The same steps as plain operations, which torch.compile fuses with what stands around them."""
        beta, threshold, spikes = self.leaky.beta.clamp(0, 1), self.leaky.threshold, []
        fired = (membrane > threshold).to(current.dtype)
        for current_t in current:
            kept = membrane * (1.0 - fired) if self.reset == "zero" else membrane
            membrane = kept * beta + current_t
            if self.reset == "subtract":
                membrane = membrane - fired * threshold
            spikes.append(self.leaky.spike_grad(membrane - threshold))
            fired = spikes[-1].detach()
        return torch.stack(spikes), membrane

    def _step_by_step(self, current: Tensor, membrane: Tensor) -> tuple[Tensor, Tensor]:
        spikes = []
        for current_t in current:
            spikes_t, membrane = self.leaky(current_t, membrane)
            spikes.append(spikes_t)
        self.leaky.mem = torch.zeros(0, device=current.device)
        return torch.stack(spikes), membrane


class _FusedLeaky(torch.autograd.Function):
    """T steps of ``snntorch.Leaky`` with fixed beta and threshold.

    Spikes are kept as floats and resets written as ``u - u * s``, which is exactly 0 or u: arithmetic between floats
    and booleans, and ``torch.where``, are up to 30 times slower on a CPU.
    """

    @staticmethod
    def forward(
        ctx: Any,
        current: Tensor,
        membrane: Tensor,
        beta: float,
        threshold: float,
        zero: bool,
        surrogate_gradient: SurrogateGradient,
    ) -> tuple[Tensor, Tensor]:
        membranes = torch.empty_like(current, memory_format=torch.contiguous_format)
        spikes = torch.empty_like(membranes)
        previous, fired = membrane, torch.gt(membrane, threshold).to(current.dtype)
        for t in range(current.shape[0]):
            u = membranes[t]
            if zero:
                torch.addcmul(previous, previous, fired, value=-1.0, out=u)
                if beta != 1.0:
                    u.mul_(beta)
                u.add_(current[t])
            else:
                torch.add(previous if beta == 1.0 else previous * beta, current[t], out=u)
                u.sub_(fired, alpha=threshold)
            previous, fired = u, torch.gt(u, threshold, out=spikes[t])
        ctx.save_for_backward(membranes, spikes, membrane)
        ctx.set_materialize_grads(False)
        ctx.beta, ctx.threshold, ctx.zero, ctx.surrogate_gradient = beta, threshold, zero, surrogate_gradient
        return spikes, membranes[-1].clone()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        grad_spikes, grad_last = gradients  # dL/dS, dL/dU(T); None where the output was not used
        membranes, spikes, initial = ctx.saved_tensors
        grad = torch.empty_like(membranes)  # dL/dU(t), from the last step to the first
        through = torch.empty_like(initial)  # dL/dU(t+1) dU(t+1)/dU(t)
        for t in range(membranes.shape[0] - 1, -1, -1):
            torch.sub(membranes[t], ctx.threshold, out=grad[t])
            if grad_spikes is None:
                grad[t].zero_()
            else:
                ctx.surrogate_gradient(grad[t], grad_spikes[t])
            if t + 1 < membranes.shape[0]:
                after = grad[t + 1]
                if ctx.zero:
                    after = torch.addcmul(after, after, spikes[t], value=-1.0, out=through)
                grad[t].add_(after, alpha=ctx.beta)
            elif grad_last is not None:
                grad[t].add_(grad_last)
        grad_initial = None
        if ctx.needs_input_grad[1]:
            grad_initial = grad[0] * ctx.beta
            if ctx.zero:
                grad_initial = grad_initial * (initial <= ctx.threshold)
        return grad, grad_initial, None, None, None, None


def make_neuron_layer(config: NetworkConfig, spiking: bool) -> SpikingLayer | ReLULayer:
    """The neuron layer of a method: ``snntorch.Leaky`` over time, or ReLU for the ANN methods."""
    return SpikingLayer(config) if spiking else ReLULayer()
