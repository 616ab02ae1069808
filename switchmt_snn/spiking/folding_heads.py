"""Folding of heads: quantiles become their mean, and the heads of several streams become one.

So a head has one output per action, whatever training needed. Heads per task stay apart, in a ``TaskDense``.

Shapes: S sets of rows (K with heads per task, else 1), K tasks, M quantiles, O outputs, I inputs, A actions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from switchmt_snn.errors import ExportError
from switchmt_snn.spiking.layers import Dense, TaskDense


def head_node(rows: Dense, quantiles: int, per_task: bool) -> Dense | TaskDense:
    """A stream's head.

    Args:
        rows: all rows of the module: ``[S, M, O]``, in this order.
        quantiles: M. Their mean is linear, so weights and biases become their means.
        per_task: whether each task has rows of its own.
    """
    tasks = len(rows.shift_KO)
    sets = tasks if per_task else 1
    if sets == quantiles == 1:
        return rows
    weight_SOI = rows.weight.reshape(sets, quantiles, -1, rows.weight.shape[1]).mean(axis=1)
    shift_SO = rows.shift_KO[0].reshape(sets, quantiles, -1).mean(axis=1)
    outputs, shift_KO = shift_SO.shape[1], np.tile(shift_SO, (tasks // sets, 1))
    scale_KO = np.ones_like(shift_KO)
    heads = [
        replace(rows, weight=weight_OI, scale_KO=scale_KO, shift_KO=shift_KO, output_shape=(outputs,))
        for weight_OI in weight_SOI
    ]
    return _of_tasks(heads) if per_task else heads[0]


def joined_heads(heads: Mapping[str, Dense | TaskDense]) -> Dense | TaskDense:
    """The streams' heads as one linear map of ``[h_value, h_advantage]``, or of ``h_q``."""
    first = next(iter(heads.values()))
    if isinstance(first, TaskDense):
        tasks = range(len(first.shift_KO))
        return _of_tasks([_joined({name: head.of_task(k) for name, head in heads.items()}) for k in tasks])
    return _joined({name: head.of_task(0) for name, head in heads.items()})


def _joined(heads: Mapping[str, Dense]) -> Dense:
    """Q = q(h), or V(h) + A(h) - mean over actions of A(h)."""
    if heads.keys() == {"q"}:
        return replace(heads["q"], name="head")
    if heads.keys() != {"value", "advantage"}:
        raise ExportError(f"the streams are {', '.join(heads)}, expected q, or value and advantage")
    value, advantage = heads["value"], heads["advantage"]
    shared = np.repeat(value.weight, len(advantage.weight), axis=0)
    weight = np.concatenate([shared, advantage.weight - advantage.weight.mean(axis=0)], axis=1)
    shift_KO = value.shift_KO + advantage.shift_KO - advantage.shift_KO.mean(axis=1, keepdims=True)
    return replace(advantage, name="head", weight=weight, shift_KO=shift_KO, input_shape=(weight.shape[1],))


def _of_tasks(heads: Sequence[Dense]) -> TaskDense:
    """Heads that differ in their weights, one for each task, as one node."""
    first = heads[0]
    return TaskDense(
        name=first.name,
        weight=np.concatenate([head.weight for head in heads]),
        scale_KO=first.scale_KO,
        shift_KO=first.shift_KO,
        input_shape=first.input_shape,
        output_shape=first.output_shape,
    )
