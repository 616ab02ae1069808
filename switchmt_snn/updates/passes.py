"""An update's three forward passes through a ``QNetwork``, for all engines that run PyTorch's operations.

One compilation serves all tasks, because a task enters as tensors (``QNetwork.context``), and all steps, because an
update's batch has one size.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from switchmt_snn.config import LearningConfig
from switchmt_snn.spiking.network import Context, QNetwork
from switchmt_snn.updates.protocol import Values

Passes = Callable[[Tensor, Tensor, int, torch.Generator], Values]
"""Raw observations and next observations ``[B, *shape]`` of a task, and the encoding's random numbers."""

Encoded = Callable[[Tensor, Tensor, Tensor, Context, Context], Values]
"""The part of ``Passes`` that may be compiled: inputs of the three passes, and a task's context of Q and Q*."""


class DifferentiatedPass(nn.Module):
    """The pass that has a gradient, as a module, because DistributedDataParallel takes modules."""

    def __init__(self, network: QNetwork, precision: torch.dtype | None) -> None:
        super().__init__()
        self.network = network
        self.precision = precision

    def forward(self, x: Tensor, context: Context) -> Tensor:
        """``Values.online`` of encoded inputs."""
        return self.network.values(x, context, precision=self.precision, training=True)


def forward_passes(
    network: QNetwork,
    target: QNetwork,
    differentiated: nn.Module,
    precision: torch.dtype | None,
    config: LearningConfig,
    compile_: Callable[[Encoded], Encoded] | None = None,
) -> Passes:
    """The forward passes of an update.

    Args:
        network: Q; read at every call.
        target: Q*; likewise.
        differentiated: the pass that has a gradient; see ``DifferentiatedPass``.
        precision: see ``synaptic_products``.
        config: says whether Q chooses the next action, and what normalizes next states.
        compile_: compiles what needs no random numbers; None leaves it as it is.
    """
    random, double_q, by_batch = network.encoder.is_random, config.double_q, config.next_statistics == "batch"

    def values(x: Tensor, x_next: Tensor, x_choice: Tensor, context: Context, target_context: Context) -> Values:
        if not random:  # raw observations; random numbers are drawn outside of compiled code
            x, x_next = network.encode(x), network.encode(x_next)
            x_choice = x_next
        with torch.no_grad():
            target_context = _copied(target_context) if by_batch else target_context
            next_values = target.values(x_next, target_context, precision=precision, training=by_batch)
            if double_q:
                next_context = _copied(context) if by_batch else context
                choice_BA = network.decide(x_choice, next_context, precision=precision, training=by_batch)
            else:
                choice_BA = target.expected(next_values)
        return Values(differentiated(x, context), next_values, choice_BA)

    run = values if compile_ is None else compile_(values)

    def passes(observations: Tensor, next_observations: Tensor, task: int, generator: torch.Generator) -> Values:
        context, target_context = network.context(task), target.context(task)
        if not random:
            return run(observations, next_observations, next_observations, context, target_context)
        x_next = target.encode(next_observations, generator)
        x_choice = network.encode(next_observations, generator) if double_q else x_next
        return run(network.encode(observations, generator), x_next, x_choice, context, target_context)

    return passes


def _copied(context: Context) -> Context:
    """Running statistics that may be moved without a trace."""
    return {name: tuple(tensor.clone() for tensor in tensors) for name, tensors in context.items()}
