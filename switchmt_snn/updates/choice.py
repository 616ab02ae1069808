"""Which precision and engine a run's updates use on this machine."""

from __future__ import annotations

from dataclasses import replace

import torch

from switchmt_snn.config import METHOD_TRAITS, Engine, ExperimentConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.machine.devices import has_bfloat16
from switchmt_snn.native import library as native_library
from switchmt_snn.native import neurons as native
from switchmt_snn.native.supports import spikes_as_bits

COMPILE_FROM_UPDATES = 150_000
"""``engine=auto`` compiles runs of at least this many updates: half a minute at the start, minutes to hours back."""


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
    notes = []
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
    engine, engine_notes = _settle_engine(engine, config, precision, device, begun)
    return replace(config, learning=replace(learning, precision=precision, engine=engine)), notes + engine_notes


def _settle_engine(
    engine: str, config: ExperimentConfig, precision: str, device: torch.device, begun: bool
) -> tuple[Engine, list[str]]:
    """The engine for a wish, and what the user should know; ``begun``: a run that exists has it already."""

    def unavailable(expected: str, seen: str) -> ConfigError:
        remedy = "start another run (--run OTHER --learning.engine eager)" if begun else "use learning.engine=eager"
        wish = f"learning.engine is {engine!r}" + (", with which this run was begun" if begun else "")
        return ConfigError(f"{wish}, expected {expected}, but {seen}; {remedy}")

    if engine == "graph":
        if device.type != "cuda":
            raise unavailable("a run on a CUDA device", f"this one is on device {device.type}")
        return "graph", []
    notes = []
    if engine == "native" or (engine == "auto" and native_may_pay(config, device)):
        obstacle = native_obstacle(config, device)
        if obstacle is None and engine == "auto" and precision == "float32" and not spikes_as_bits(torch.float32):
            obstacle = "it is faster in float32 only with AVX-512"
        if obstacle is None:
            said = "updates run natively, in C++ (learning.engine=eager does without)"
            return "native", [said] if engine == "auto" else []
        if engine == "native":
            raise unavailable("a spiking network on a CPU and a C++ compiler (g++, or what CXX names)", obstacle)
        notes.append(f"updates do not run natively: {obstacle}")
    if engine == "compiled" or (engine == "auto" and device.type == "cpu" and compiling_pays(config)):
        problem = compile_problem()
        if problem is None:
            said = "updates are compiled: the first ones take some 20 to 35 s (learning.engine=eager does without)"
            return "compiled", [*notes, said]
        seen = f"torch.compile fails on this machine ({problem})"
        if engine == "compiled":
            raise unavailable("a C++ compiler that it can use (Debian: apt install g++ python3-dev)", seen)
        notes.append(f"updates run uncompiled: {seen}")
    return "eager", notes


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


def planned_updates(config: ExperimentConfig) -> int:
    """Updates that a run of a resolved config makes, warm-ups not subtracted."""
    learning = config.learning
    each = len(config.tasks.names) if learning.update_tasks == "all" else 1
    return config.total_steps // learning.update_every_steps * each


def compiling_pays(config: ExperimentConfig) -> bool:
    """Whether a run is long enough for its compilation."""
    return planned_updates(config) >= COMPILE_FROM_UPDATES


def native_may_pay(config: ExperimentConfig, device: torch.device) -> bool:
    """Whether ``auto`` tries the native engine: on the nature trunk it is the fastest (docs/performance.md) if its
    products of spikes are those of bits, or the others are bfloat16. MinAtar's small network is faster compiled.
    """
    spiking = METHOD_TRAITS[config.network.method].spiking
    return device.type == "cpu" and config.network.trunk == "nature" and spiking


def native_obstacle(config: ExperimentConfig, device: torch.device) -> str | None:
    """What keeps the native engine from a run; None if nothing does."""
    if device.type != "cpu":
        return f"this run is on device {device.type}"
    setting = native.unsupported(config.network, METHOD_TRAITS[config.network.method].spiking)
    if setting is not None:
        return f"it has no code for {setting}"
    problem = native_library.problem()
    return None if problem is None else f"it cannot be built here ({problem})"


def compile_problem() -> str | None:
    """The first line of what goes wrong when something small is compiled; None if nothing does."""
    try:
        torch.compile(lambda x: x.sin() + 1.0)(torch.ones(8))
    except Exception as error:
        return str(error).strip().splitlines()[0][:120] if str(error).strip() else type(error).__name__
    return None


def built_engines() -> dict[str, str]:
    """What of the engines that need a C++ compiler works here, and what goes wrong with the others."""
    native_engine = native_library.problem()
    if native_engine is None:
        native_engine = "works" if spikes_as_bits(torch.float32) else "works, without products of bits (no AVX-512)"
    return {"torch_compile": compile_problem() or "works", "native_engine": native_engine}


def _processor_of(device: torch.device) -> str:
    return "processor" if device.type == "cpu" else f"device {device.type}"
