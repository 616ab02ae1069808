"""How an update's networks are run: operation by operation, or compiled by ``torch.compile``.

A compiled network computes the same function with other roundings (a test compares the two). One compilation serves all
tasks, because a task enters as tensors (:meth:`QNetwork.context`), and all steps, because an update's batch has one
size. It is never given up midway: what cannot be compiled as a whole raises.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from switchmt_snn.learning.processes import ProcessGroup
from switchmt_snn.spiking.network import Context, QNetwork
from switchmt_snn.spiking.normalization import TaskBatchNorm

QUpdateFunction = Callable[[Tensor, int, torch.Generator], Tensor]
"""Raw observations ``[B, *shape]`` of a task, and the encoding's random numbers -> Q-values ``[B, A]``."""


def q_function(network: QNetwork, engine: str, precision: torch.dtype | None) -> QUpdateFunction:
    """The network as an update runs it.

    Args:
        network: read at every call; its mode and its weights may change.
        engine: ``compiled``, or anything else for eager.
        precision: see :func:`~switchmt_snn.spiking.network.synaptic_products`.
    """
    if engine != "compiled":
        return lambda observation, task, generator: network(observation, task, generator=generator, precision=precision)
    from torch import _dynamo as dynamo  # takes a second to import

    # One code object is compiled anew for training and evaluation mode and for every learner of the process.
    dynamo.config.recompile_limit = max(dynamo.config.recompile_limit, 256)

    def decide(x: Tensor, context: Context) -> Tensor:
        return network.decide(x, context, precision=precision)

    if network.encoder.is_random:  # the generator's numbers are drawn outside of compiled code
        decided = torch.compile(decide, fullgraph=True, dynamic=False)
        return lambda observation, task, generator: decided(
            network.encode(observation, generator), network.context(task)
        )

    def encode_and_decide(observation: Tensor, context: Context) -> Tensor:
        return decide(network.encode(observation), context)

    compiled = torch.compile(encode_and_decide, fullgraph=True, dynamic=False)
    return lambda observation, task, generator: compiled(observation, network.context(task))


class _Replica(nn.Module):
    """A network's update function as a module, which is what DistributedDataParallel takes."""

    def __init__(self, network: QNetwork, q: QUpdateFunction) -> None:
        super().__init__()
        self.network = network
        self._q = q

    def forward(self, observation: Tensor, task: int, generator: torch.Generator) -> Tensor:
        return self._q(observation, task, generator)


def divided(network: QNetwork, q: QUpdateFunction, group: ProcessGroup) -> QUpdateFunction:
    """``q`` for a part of a batch: gradients are averaged and batch statistics pooled over all processes."""
    for module in network.modules():
        if isinstance(module, TaskBatchNorm):
            module.sum_over_processes, module.num_processes = group.sum, group.size
    replica: QUpdateFunction = DistributedDataParallel(_Replica(network, q), broadcast_buffers=False)
    return replica
