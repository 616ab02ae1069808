"""The registry of update engines: every value of ``learning.engine`` and the class behind it."""

from __future__ import annotations

from switchmt_snn.errors import ConfigError
from switchmt_snn.updates.compiled import Compiled
from switchmt_snn.updates.cuda_graph import CudaGraph
from switchmt_snn.updates.eager import Eager
from switchmt_snn.updates.native import Native
from switchmt_snn.updates.protocol import Engine

ENGINES: dict[str, type[Engine]] = {engine.name: engine for engine in (Native, Compiled, CudaGraph, Eager)}
"""Every engine by its name. ``auto`` takes the first one that pays and is available."""


def engine_class(name: str) -> type[Engine]:
    """The class of an engine. A learner that is made without a run, and so without a plan, takes ``auto`` as eager.

    Raises:
        ConfigError: unknown name.
    """
    known: dict[str, type[Engine]] = {"auto": Eager, **ENGINES}
    if name not in known:
        raise ConfigError(f"learning.engine is {name!r}, expected one of: {', '.join(known)}")
    return known[name]
