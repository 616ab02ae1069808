"""Surrogate gradients: the derivative that training uses in place of the Heaviside step's.

snnTorch defines them (``snntorch.surrogate``). This file adds their backward functions without temporary tensors.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from snntorch import surrogate as snntorch_surrogate
from torch import Tensor

from switchmt_snn.config.checks import require
from switchmt_snn.spiking.settings import require_known

Surrogate = Callable[[Tensor], Tensor]
"""``U - theta -> S``: 1.0 where the argument is above 0, else 0.0; differentiable by the surrogate."""

SurrogateGradient = Callable[[Tensor, Tensor], Tensor]
"""``(U - theta, dL/dS) -> dL/dU``; it overwrites the first argument."""

DEFAULT_SLOPE = {"atan": 2.0, "sigmoid": 25.0, "fast_sigmoid": 25.0}
"""snnTorch's default slopes."""

SURROGATES: dict[str, str | None] = {
    "atan": "alpha",
    "sigmoid": "slope",
    "fast_sigmoid": "slope",
    "triangular": "threshold",
    "straight_through_estimator": None,
    "spike_rate_escape": "slope",
    "SFS": "slope",
    "SSO": None,
    "heaviside": None,
}
"""Functions of ``snntorch.surrogate``, and the argument of each that ``network.surrogate_slope`` sets; None: it has
none."""


def make_surrogate(name: str, slope: float | None = None) -> Surrogate:
    """``snntorch.surrogate.<name>``, with its slope argument if one is given.

    The gradient of snnTorch's sigmoid is exp(-k x) / (1 + exp(-k x))^2, which is inf / inf = NaN in float32 once
    k x < -88 (a membrane 3.6 below the threshold at the default k = 25). Its true value there is 0, and so is ours.

    Raises:
        ConfigError: ``name`` is not in ``SURROGATES``, or a slope is given for one without.
    """
    require_known("surrogate", name, SURROGATES)
    argument = SURROGATES[name]
    if argument is None:
        require(slope is None, "network.surrogate_slope", slope, f"null with network.surrogate={name}")
    arguments = {} if slope is None or argument is None else {argument: slope}
    surrogate: Surrogate = getattr(snntorch_surrogate, name)(**arguments)
    if name != "sigmoid":
        return surrogate
    lowest = -80.0 / arguments.get("slope", DEFAULT_SLOPE[name])
    return lambda x: surrogate(x.clamp(min=lowest))


def make_surrogate_gradient(name: str, slope: float | None = None) -> SurrogateGradient:
    """The backward of ``make_surrogate``'s surrogate as a function of its own.

    snnTorch's backward allocates temporaries of the membranes' size. The usual surrogates work in place here; any other
    one runs its own backward.
    """
    k = slope if slope is not None else DEFAULT_SLOPE.get(name, 0.0)
    if name == "atan":  # (k / 2) / (1 + (pi k x / 2)^2)
        return lambda x, grad: x.mul_(math.pi / 2 * k).square_().add_(1.0).reciprocal_().mul_(k / 2).mul_(grad)
    if name == "fast_sigmoid":  # 1 / (1 + k |x|)^2
        return lambda x, grad: x.abs_().mul_(k).add_(1.0).square_().reciprocal_().mul_(grad)
    if name == "sigmoid":  # k sigmoid(k x) (1 - sigmoid(k x)), even in x: small values keep their digits at x <= 0
        return lambda x, grad: (s := x.abs_().mul_(-k).sigmoid_()).mul_(1.0 - s).mul_(k).mul_(grad)
    surrogate = make_surrogate(name, slope)

    def own_backward(x: Tensor, grad: Tensor) -> Tensor:
        with torch.enable_grad():
            leaf = x.detach().requires_grad_()
            return x.copy_(torch.autograd.grad(surrogate(leaf), leaf, grad)[0])

    return own_backward
