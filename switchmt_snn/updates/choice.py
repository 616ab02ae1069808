"""Which precision and engine a run's updates use on this machine."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import torch

from switchmt_snn.config import Engine, ExperimentConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.machine.devices import has_bfloat16
from switchmt_snn.updates.engine import ENGINES, engine_class


def settle(
    config: ExperimentConfig, stored: ExperimentConfig | None, device: torch.device, processes: int = 1
) -> tuple[ExperimentConfig, list[str]]:
    """Replace ``learning.precision`` and ``learning.engine`` ``auto`` by what this machine can do.

    Both change roundings, so a run that exists keeps what it began with (before there was a choice: eager, float32).

    Args:
        config: resolved.
        stored: the config of the run to be continued; None for a new one.
        device: where the network will run.
        processes: among which updates are divided; only uncompiled ones can be, and only even parts.

    Returns:
        the config, and what the user should know about the choice.

    Raises:
        ConfigError: an engine is asked for that cannot be had here, or the batch cannot be divided.
    """
    learning = config.learning
    precision, engine = learning.precision, learning.engine
    notes: list[str] = []
    if stored is not None:
        precision = stored.learning.precision if precision == "auto" else precision
        engine = stored.learning.engine if engine == "auto" else engine
        engine = "eager" if engine == "auto" else engine
    if precision == "auto":
        precision = "bfloat16" if has_bfloat16(device) else "float32"
        reason = "has" if precision == "bfloat16" else "has no"
        notes.append(f"updates compute in {precision}: the {_processor_of(device)} {reason} bfloat16 instructions")
    if processes > 1:
        _require_divisible(config, processes)
        engine = "eager"
    begun = stored is not None and stored.learning.engine == engine
    engine, engine_notes = _settle_engine(engine, config, precision, device, processes, begun)
    return replace(config, learning=replace(learning, precision=precision, engine=engine)), notes + engine_notes


def _settle_engine(
    name: str, config: ExperimentConfig, precision: str, device: torch.device, processes: int, begun: bool
) -> tuple[Engine, list[str]]:
    """The engine for a requested one, and what the user should know; ``begun``: a run that exists has it already."""
    if name != "auto":
        engine = engine_class(name)
        if (reason := engine.unavailable(config, device, processes)) is not None:
            remedy = "start another run (--run OTHER --learning.engine eager)" if begun else "use learning.engine=eager"
            seen = f"learning.engine is {name!r}" + (", with which this run was begun" if begun else "")
            raise ConfigError(f"{seen}, expected {engine.needs}, but {reason}; {remedy}")
        return cast(Engine, name), []
    notes: list[str] = []
    for engine in ENGINES.values():
        if (processes > 1 and not engine.torchrun) or not engine.pays(config, device, precision):
            continue
        if (reason := engine.unavailable(config, device, processes)) is None:
            return cast(Engine, engine.name), [*notes, engine.note] if engine.note else notes
        notes.append(f"updates do not use the {engine.name} engine: {reason}")
    raise ConfigError(f"learning.engine is 'auto', expected one engine that works: {'; '.join(notes)}")


def _require_divisible(config: ExperimentConfig, processes: int) -> None:
    if config.learning.replay_on_device:
        raise ConfigError(
            f"learning.replay_on_device is True, expected False for the {processes} processes that torchrun started: "
            "batches are dealt out from the host"
        )
    if config.learning.engine not in ("auto", "eager"):
        raise ConfigError(
            f"learning.engine is {config.learning.engine!r}, expected eager or auto for the {processes} processes that "
            "torchrun started"
        )
    size = config.learning.batch_size
    if size % processes or size // processes < 2:
        raise ConfigError(
            f"learning.batch_size is {size}, expected a multiple of the {processes} processes that torchrun started, "
            "with two transitions for each; change one of the two"
        )


def built_engines() -> dict[str, str]:
    """Whether the engines that need a C++ compiler work here, or what goes wrong."""
    return {"torch_compile": ENGINES["compiled"].status(), "native_engine": ENGINES["native"].status()}


def _processor_of(device: torch.device) -> str:
    return "processor" if device.type == "cpu" else f"device {device.type}"
