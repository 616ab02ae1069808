"""How an update's three forward passes are run: operation by operation, with neuron layers in C++, compiled, or divided
among processes.

All compute the same function with other roundings (tests compare them). A membrane that lies within rounding of the
threshold may fire in one and not in the other, as between any two orders of a sum.

One compilation serves all tasks, because a task enters as tensors (:meth:`QNetwork.context`), and all steps, because an
update's batch has one size. It is never given up midway: what cannot be compiled as a whole raises.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from switchmt_snn.native.network import NativeNetwork
from switchmt_snn.spiking.network import Context, QNetwork
from switchmt_snn.spiking.normalization import TaskBatchNorm
from switchmt_snn.updates.processes import ProcessGroup


class Values(NamedTuple):
    """What Eq. 2 needs, each ``[B, A]``."""

    q_BA: Tensor
    """Q of the observations, in training mode, with a gradient."""
    next_BA: Tensor
    """Q* of the next observations, in eval mode."""
    choice_BA: Tensor
    """Q of the next observations, in eval mode; Q* without double Q-learning."""


Evaluate = Callable[[Tensor, Tensor, int, torch.Generator], Values]
"""Raw observations and next observations ``[B, *shape]`` of a task, and the encoding's random numbers."""

_Forward = Callable[[Tensor, Context], Tensor]


def make_evaluate(
    network: QNetwork,
    target: QNetwork,
    engine: str,
    precision: torch.dtype | None,
    double_q: bool,
    group: ProcessGroup | None = None,
) -> Evaluate:
    """The forward passes of an update.

    Args:
        network: Q; read at every call.
        target: Q*; likewise.
        engine: ``native``, ``compiled``, ``graph`` (compiled, for a CUDA graph), or anything else for eager.
        precision: see :func:`~switchmt_snn.spiking.network.synaptic_products`.
        double_q: whether Q chooses the next action.
        group: the processes among which a batch is divided (eager only).

    Raises:
        ValueError: the native engine has no code for a setting of the network.
    """
    if engine == "native":
        return NativeEvaluate(network, target, precision, double_q)
    random = network.encoder.is_random
    trained: _Forward = _Replica(network, precision)
    if group is not None:
        for module in network.modules():
            if isinstance(module, TaskBatchNorm):
                module.sum_over_processes, module.num_processes = group.sum, group.size
        trained = DistributedDataParallel(trained, broadcast_buffers=False)

    def values(x: Tensor, x_next: Tensor, x_choice: Tensor, context: Context, target_context: Context) -> Values:
        if not random:  # raw observations; the generator's numbers are drawn outside of compiled code
            x, x_next = network.encode(x), network.encode(x_next)
            x_choice = x_next
        with torch.no_grad():
            choice_BA = next_BA = target.decide(x_next, target_context, precision=precision, training=False)
            if double_q:
                choice_BA = network.decide(x_choice, context, precision=precision, training=False)
        return Values(trained(x, context), next_BA, choice_BA)

    run = _compiled(values) if engine in ("compiled", "graph") else values

    def evaluate(observation: Tensor, following: Tensor, task: int, generator: torch.Generator) -> Values:
        context, target_context = network.context(task), target.context(task)
        if not random:
            return run(observation, following, following, context, target_context)
        x_next = target.encode(following, generator)
        x_choice = network.encode(following, generator) if double_q else x_next
        return run(network.encode(observation, generator), x_next, x_choice, context, target_context)

    return evaluate


class NativeEvaluate:
    """The passes through native networks; see :data:`Evaluate`."""

    def __init__(self, network: QNetwork, target: QNetwork, precision: torch.dtype | None, double_q: bool) -> None:
        self.network, self.target = NativeNetwork(network, precision), NativeNetwork(target, precision)
        self._is_random, self._double_q = network.encoder.is_random, double_q

    def __call__(self, observation: Tensor, following: Tensor, task: int, generator: torch.Generator) -> Values:
        network, target = self.network, self.target
        x_next = target.inputs(following, generator)
        with torch.no_grad():
            (next_BA,) = target.decide(x_next, target.view(task), training=False)
        if self._double_q and self._is_random:
            x_next = network.inputs(following, generator)
        x, beside = network.inputs(observation, generator), [x_next] if self._double_q else []
        q_BA, *choice = network.decide(x, network.view(task), training=True, beside=beside)
        return Values(q_BA, next_BA, *(choice or [next_BA]))


class _Replica(nn.Module):
    """The pass that is differentiated, as a module, which is what DistributedDataParallel takes."""

    def __init__(self, network: QNetwork, precision: torch.dtype | None) -> None:
        super().__init__()
        self.network = network
        self.precision = precision

    def forward(self, x: Tensor, context: Context) -> Tensor:
        return self.network.decide(x, context, precision=self.precision, training=True)


def _compiled(function: Callable[..., Values]) -> Callable[..., Values]:
    from torch import _dynamo as dynamo  # takes a second to import

    # One code object is compiled anew for every learner of the process.
    dynamo.config.recompile_limit = max(dynamo.config.recompile_limit, 256)
    compiled: Callable[..., Values] = torch.compile(function, fullgraph=True, dynamic=False)
    return compiled
