"""What a NIR file leaves to its tool: the length of a step, and what a spike does. Is it plausible, is it stated?

NIR is continuous in time, so a file says nothing of steps; and tools that write nir.LIF reset in different ways.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import nir
import numpy as np

from switchmt_snn.errors import ExportError
from switchmt_snn.export.runtimes.nir_interpreter import Float

_SLACK = 1e-6
"""Of float32 time constants."""
_LEAST_DECAY = 0.01
"""What membranes should lose in all steps together, if they are said to leak."""
_GAINS = (0.01, 100.0)
"""Of the input of an integrator per step; tools that count in steps have 1."""


@dataclass(frozen=True)
class NirConvention:
    """How a file is simulated.

    Attributes:
        dt: length of a simulation step, in the unit of the file's time constants.
        reset: see ``switchmt_snn.export.runtimes.nir_interpreter.RESETS``.
        fires_at_threshold: whether a membrane that is exactly at its threshold fires.
    """

    dt: float
    reset: str
    fires_at_threshold: bool


def stated(graph: nir.NIRGraph, own: bool, dt: float, reset: str | None, fires_at_threshold: bool) -> NirConvention:
    """The convention of a file of ours, which its metadata holds, or of anybody's, as stated; else NIR's.

    Raises:
        ExportError: a convention was stated for a file of ours.
    """
    if own and (reset is not None or fires_at_threshold):
        raise ExportError(
            f"a reset was stated for a file that switchmt-snn wrote, expected its own ({graph.metadata.get('reset')}); "
            "leave the convention out"
        )
    return NirConvention(dt, reset or str(graph.metadata.get("reset", "zero")), fires_at_threshold)


def require_stable(graph: nir.NIRGraph, dt: float) -> None:
    """Refuse a step that is longer than a time constant: a membrane would overshoot and change its sign.

    Raises:
        ExportError: such a node.
    """
    for name, _, tau in _time_constants(graph):
        shortest = float(tau.min())
        if dt > shortest * (1 + _SLACK):
            raise ExportError(
                f"dt is {dt:.6g} and the NIR node {name} has tau {shortest:.6g}, expected dt <= tau; store dt in the "
                f"file's unit of time (snnTorch writes 1e-4)"
            )


def doubts(graph: nir.NIRGraph, convention: NirConvention, timesteps: int, reset_is_known: bool) -> tuple[str, ...]:
    """What looks wrong about a simulation of a file of somebody else, in whole sentences."""
    found, dt = [], convention.dt
    for name, kind, tau in _time_constants(graph):
        lost = -np.expm1(timesteps * np.log1p(-np.minimum(dt / tau.astype(np.float64), 1 - 1e-12))).max()
        if lost < _LEAST_DECAY:
            found.append(
                f"In {timesteps} steps of dt {dt:.6g}, {kind} {name} (tau {float(tau.min()):.6g}) leaks {lost:.2g} of "
                "its value: is dt in the file's unit of time?"
            )
            break
    for name, node in graph.nodes.items():
        if isinstance(node, (nir.IF, nir.I)):
            gain = dt * np.abs(node.r.astype(np.float64))
            if gain.max() < _GAINS[0] or gain.min() > _GAINS[1]:
                found.append(
                    f"Node {name} multiplies its input by r dt = {float(gain.max()):.3g} per step: is dt in the file's "
                    "unit of time?"
                )
                break
    resets = any(isinstance(node, (nir.IF, nir.LIF, nir.CubaLIF)) for node in graph.nodes.values())
    if resets and not reset_is_known:
        found.append(
            "The file does not say how its tool resets; simulated as NIR defines it, to v_reset (snnTorch's default is "
            "--reset subtract_after_decay)."
        )
    return tuple(found)


def _time_constants(graph: nir.NIRGraph) -> Iterator[tuple[str, str, Float]]:
    """Node, what decays, and its time constants."""
    for name, node in graph.nodes.items():
        if isinstance(node, (nir.LIF, nir.LI)):
            yield name, "membrane", np.atleast_1d(node.tau)
        elif isinstance(node, nir.CubaLIF):
            yield name, "current", np.atleast_1d(node.tau_syn)
            yield name, "membrane", np.atleast_1d(node.tau_mem)
