"""IF and LIF: the leaky integrate-and-fire neuron ``snntorch.Leaky``; IF is LIF with beta 1.

Shapes: T simulation steps, B batch, ... any feature shape.

Per step (snnTorch 1.0 with ``reset_delay=True``; strict ``>``; H the Heaviside step, theta the threshold)::

    R(t) = H(U(t-1) - theta)                               the reset owed by the last spike; no gradient
    zero:      U(t) = beta * (1 - R(t)) * U(t-1) + I(t)
    subtract:  U(t) = beta * U(t-1) + I(t) - R(t) * theta
    S(t) = H(U(t) - theta)                                 gradient: the surrogate

U(t) is the membrane *before* the reset that its own spike causes, as in snnTorch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import snntorch
import torch
from torch import Tensor

from switchmt_snn.config import NetworkConfig
from switchmt_snn.spiking.layers import Array, NeuronNode
from switchmt_snn.spiking.neurons.base import NeuronLayer, NeuronState, over_time, unlisted
from switchmt_snn.spiking.neurons.surrogates import SurrogateGradient, make_surrogate_gradient


@dataclass(frozen=True)
class LeakyNode(NeuronNode):
    """Leaky integrate-and-fire neurons.

    Attributes:
        beta_O: decay of the membrane per simulation step.
        threshold_O: a neuron fires when its membrane is strictly above it.
        reset: ``zero`` or ``subtract``.
    """

    beta_O: Array
    threshold_O: Array
    reset: str

    @property
    def kind(self) -> str:
        """``IF`` if no membrane decays, else ``LIF``."""
        return "IF" if (self.beta_O == 1.0).all() else "LIF"

    @property
    def states(self) -> tuple[str, ...]:
        """The membrane."""
        return LeakyLayer.STATE


class LeakyLayer(NeuronLayer):
    """IF or LIF neurons over T steps.

    ``neuron_engine="snntorch"`` calls ``snntorch.Leaky`` step by step. ``"fused"`` does the same float32 arithmetic in
    one autograd function (forward bitwise equal, gradients equal to rounding: tests/spiking/test_neurons.py); under
    torch.compile it is the loop over ``step``. Learnable beta or threshold, and the stochastic surrogate SSO,
    always run through ``snntorch.Leaky``.

    Attributes:
        leaky: the snnTorch neuron, which holds beta, threshold and surrogate. Its own membrane is never used.
    """

    STATE = ("membrane",)
    ENGINES = ("fused", "snntorch")

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        neuron = snntorch.Leaky(
            beta=1.0 if config.neuron == "IF" else config.beta,
            threshold=config.threshold,
            spike_grad=self.surrogate,
            learn_beta=config.learn_beta,
            learn_threshold=config.learn_threshold,
            reset_mechanism=config.reset,
            reset_delay=True,
        )
        self.leaky = unlisted(neuron)
        self.reset = config.reset
        # SSO draws random gradients: one draw per step in snn.Leaky, which a single backward over T would change.
        needs_snntorch = config.learn_beta or config.learn_threshold or config.surrogate == "SSO"
        self.fused = config.neuron_engine == "fused" and not needs_snntorch
        self.surrogate_gradient = make_surrogate_gradient(config.surrogate, config.surrogate_slope)

    def step(self, current_t: Tensor, state: NeuronState) -> tuple[Tensor, NeuronState]:
        """The module's equations: bitwise the values of ``snntorch.Leaky``."""
        (membrane,) = state
        beta, threshold = self.leaky.beta.clamp(0, 1), self.leaky.threshold
        fired = (membrane > threshold).to(current_t.dtype)
        if self.reset == "zero":
            membrane = membrane * (1.0 - fired) * beta + current_t
        else:
            membrane = membrane * beta + current_t - fired * threshold
        return self.surrogate(membrane - threshold), (membrane,)

    def node(self, channels: int) -> LeakyNode:
        """See ``LeakyNode``."""
        beta, threshold = float(self.leaky.beta.detach().clamp(0, 1)), float(self.leaky.threshold.detach())
        return LeakyNode(np.full(channels, beta), np.full(channels, threshold), self.reset)

    def run(self, current: Tensor, state: NeuronState) -> tuple[Tensor, NeuronState]:
        """T steps in the form that the config and the settings ask for."""
        if not self.fused:
            spikes, state = over_time(self._snntorch_step, current, state)
            self.leaky.mem = torch.zeros(0, device=current.device)
            return spikes, state
        if torch.compiler.is_compiling():
            return over_time(self.step, current, state)
        # The two parameters are constants; reading them as floats keeps the step free of broadcasts.
        beta, threshold = float(self.leaky.beta.clamp(0, 1)), float(self.leaky.threshold)
        spikes, membrane = _FusedLeaky.apply(  # type: ignore[no-untyped-call, unused-ignore]
            current, *state, beta, threshold, self.reset == "zero", self.surrogate_gradient
        )
        return spikes, (membrane,)

    def _snntorch_step(self, current_t: Tensor, state: NeuronState) -> tuple[Tensor, NeuronState]:
        spikes_t, membrane = self.leaky(current_t, *state)
        return spikes_t, (membrane,)


class _FusedLeaky(torch.autograd.Function):
    """T steps of ``LeakyLayer.step`` with fixed beta and threshold, and their gradients, in one autograd function.

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
