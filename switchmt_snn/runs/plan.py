"""What a run will do, before it starts: every ``auto`` is decided here, once, and stored in the run's config.

In this order:

- ``resolve``: what follows from the config alone (policy, dendrites, T of an ANN) and from the
  suite's defaults (trunk, hidden units, frame stack, clipped rewards). A run that exists keeps its clipping.
- precision, engine and compression (``decide``), which follow from the machine and from the run's length.
- memory: a run that cannot fit is refused.

``device`` stays as it was asked for, so that a run can be continued on another machine; the run's environment.json
names the device.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import torch

from switchmt_snn.config import ExperimentConfig, resolve
from switchmt_snn.config.plugins import is_plugin, plugin_name
from switchmt_snn.config.trust import allow, modules_in
from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.switching import Criterion, SwitchingPolicy, check_policy, with_policy
from switchmt_snn.machine.devices import has_bfloat16, select_device
from switchmt_snn.replay.size import compresses_replay
from switchmt_snn.runs.description import describe_method
from switchmt_snn.runs.memory import MemoryEstimate, require_gpu_memory, require_memory
from switchmt_snn.spiking.encoding_check import try_encoding
from switchmt_snn.tasks.check import check_before_training, warnings_unless_refused
from switchmt_snn.tasks.registry import make_suite, register_suite, suite_of
from switchmt_snn.tasks.suite import Suite, TaskSuite
from switchmt_snn.updates.compiled import planned_updates
from switchmt_snn.updates.engine import ENGINES


@dataclass(frozen=True)
class Plan:
    """All that is known about a run before it starts.

    Attributes:
        config: what the run stores; no setting except ``device`` is ``auto``.
        suite: its tasks.
        device: where the network will be.
        memory: what the run will need.
        notes: choices that the user should know about, each with its reason.
    """

    config: ExperimentConfig
    suite: TaskSuite
    device: torch.device
    memory: MemoryEstimate
    notes: tuple[str, ...]


def with_classes(
    config: ExperimentConfig, policy: type[Criterion] | None, suite: type[Suite] | None
) -> ExperimentConfig:
    """The config with classes of the caller's in place of its own; their modules are trusted."""
    if policy is not None:
        config = replace(config, switching=with_policy(config.switching, policy))
        allow(modules_in(config.switching.policy))
    if suite is not None:
        config = replace(config, tasks=replace(config.tasks, suite=plugin_name(register_suite(suite), "suite")))
        allow(modules_in(config.tasks.suite))
    return config


def plan(
    config: ExperimentConfig,
    stored: ExperimentConfig | None = None,
    processes: int = 1,
    device: torch.device | None = None,
) -> Plan:
    """Plan a run.

    Args:
        config: what is asked for.
        stored: the config of the run that is continued; None for a new run.
        processes: number of processes that divide each update (``torchrun``).
        device: where the network will be; None takes the one that the config asks for.

    Raises:
        ConfigError: the machine does not have the device or engine that is asked for, the batch cannot be divided, the
            run does not fit into memory, or a class from outside the package does not do what it must.
        TaskError: a task does not exist or cannot be learned by a Q-network.
    """
    if stored is not None and config.learning.clip_rewards is None:
        config = replace(config, learning=replace(config.learning, clip_rewards=stored.learning.clip_rewards))
    config = resolve(config)
    if stored is not None and config.tasks.image_layout == "by_shape":
        config = replace(config, tasks=replace(config.tasks, image_layout=stored.tasks.image_layout))
    if device is None:
        device = select_device(config.device)
    if is_plugin(config.switching.policy):
        check_policy(config.switching)
    with warnings_unless_refused():
        suite = make_suite(config.tasks)
        warnings = check_before_training(config, suite)
    SwitchingPolicy(config.switching, len(suite.names), [suite.references.get(name) for name in suite.names])
    if is_plugin(config.network.encoding):
        try_encoding(config.network, suite.observation_shape, suite.frame_stack, suite.in_unit_range)
    config, notes = decide(config, stored, suite, device, processes)
    _require_lives(config)
    memory = describe_method(config, suite).memory
    require_memory(memory, config, suite)
    require_gpu_memory(config, suite)
    return Plan(config, suite, device, memory, (*warnings, *notes, *_learning_rate_notes(config)))


def _learning_rate_notes(config: ExperimentConfig) -> tuple[str, ...]:
    """What to say of a learning rate that is 0 before the run's last updates, as in a preset that is trained longer."""
    decay, planned = config.learning.learning_rate_decay_updates, planned_updates(config)
    if decay is None or planned <= decay:
        return ()
    return (
        f"the learning rate is 0 after {decay:,} of up to {planned:,} updates, and later ones change nothing "
        f"(learning.learning_rate_decay_updates {planned} lets it fall to the end)",
    )


def decide(
    config: ExperimentConfig,
    stored: ExperimentConfig | None,
    suite: TaskSuite,
    device: torch.device,
    processes: int = 1,
) -> tuple[ExperimentConfig, tuple[str, ...]]:
    """Replace ``auto`` in precision, engine, acting and compression by what this machine can do, and in judge_learning.

    A run that exists keeps what it began with, because precision and engine change roundings. Runs from before these
    settings existed began with float32, the eager engine, and policies that judged at every episode end.

    Args:
        config: resolved.
        stored: the config of the run that is continued; None for a new run.
        suite: the config's tasks.
        device: where the network will be.
        processes: number of processes that divide each update.

    Returns:
        the config, and what the user should know about the choices.

    Raises:
        ConfigError: an engine is asked for that this machine does not have, or the batch cannot be divided.
    """
    if processes > 1:
        _require_divisible(config, processes)
    precision, notes = _precision(config, stored, device)
    config = _with(config, precision=precision)
    engine, engine_notes = _engine(config, stored, device, processes)
    config = _with(config, engine=engine, replay_compression=_compression(config, stored, suite))
    config = _with(config, acting=_acting(config, stored))
    switching = replace(config.switching, judge_learning=_judge_learning(config, stored))
    return replace(config, switching=switching), (*notes, *engine_notes)


def _with(config: ExperimentConfig, **learning: str) -> ExperimentConfig:
    values: dict[str, Any] = {**learning}
    return replace(config, learning=replace(config.learning, **values))


def _precision(
    config: ExperimentConfig, stored: ExperimentConfig | None, device: torch.device
) -> tuple[str, list[str]]:
    """bfloat16 if the hardware multiplies it faster than float32."""
    asked = config.learning.precision
    if asked == "auto" and stored is not None:
        asked = stored.learning.precision
    if asked != "auto":
        return asked, []
    hardware = "processor" if device.type == "cpu" else f"device {device.type}"
    if has_bfloat16(device):
        return "bfloat16", [f"updates compute in bfloat16: the {hardware} has bfloat16 instructions"]
    return "float32", [f"updates compute in float32: the {hardware} has no bfloat16 instructions"]


def _engine(
    config: ExperimentConfig, stored: ExperimentConfig | None, device: torch.device, processes: int
) -> tuple[str, list[str]]:
    """The first engine that says of itself that it is worth its costs for this run, and that this machine has."""
    asked = config.learning.engine
    if asked == "auto" and stored is not None:
        asked = "eager" if stored.learning.engine == "auto" or processes > 1 else stored.learning.engine
    if asked != "auto":
        reason = ENGINES[asked].unavailable(config, device, processes)
        if reason is not None:
            begun = stored is not None and stored.learning.engine == asked
            raise _unavailable(asked, reason, begun)
        return asked, []
    notes: list[str] = []
    for name, engine in ENGINES.items():
        if processes > 1 and not engine.torchrun:
            continue
        if not engine.pays(config, device, config.learning.precision):
            continue
        reason = engine.unavailable(config, device, processes)
        if reason is None:
            return name, [*notes, engine.note] if engine.note else notes
        notes.append(f"updates do not use the {name} engine: {reason}")
    raise ConfigError(f"learning.engine is 'auto', expected one engine that works: {'; '.join(notes)}")


def _acting(config: ExperimentConfig, stored: ExperimentConfig | None) -> str:
    """The engine if it acts; a run from before the setting existed began with eager."""
    engine, asked = config.learning.engine, config.learning.acting
    if asked == "auto" and stored is not None:
        asked = "eager" if stored.learning.acting == "auto" else stored.learning.acting
    if asked == "auto":
        return engine if ENGINES[engine].acts else "eager"
    if asked not in ("eager", engine):
        raise ConfigError(
            f"learning.acting is {asked!r}, expected eager, or native with learning.engine native, but the engine is "
            f"{engine!r}; use learning.acting=eager or learning.engine={asked}"
        )
    return asked


def _judge_learning(config: ExperimentConfig, stored: ExperimentConfig | None) -> Literal["always", "after_updates"]:
    """Once there were updates; a run from before the setting existed goes on as it began."""
    asked = config.switching.judge_learning
    if asked == "auto" and stored is not None:
        asked = "always" if stored.switching.judge_learning == "auto" else stored.switching.judge_learning
    return "after_updates" if asked == "auto" else asked


def _unavailable(engine: str, reason: str, begun: bool) -> ConfigError:
    origin = ", with which this run was begun" if begun else ""
    remedy = "start another run (--run OTHER --learning.engine eager)" if begun else "use learning.engine=eager"
    return ConfigError(
        f"learning.engine is {engine!r}{origin}, expected {ENGINES[engine].needs}, but {reason}; {remedy}"
    )


def _compression(config: ExperimentConfig, stored: ExperimentConfig | None, suite: TaskSuite) -> str:
    """Compressed if plain frames would take more than 1 GiB, and never on a device."""
    if config.learning.replay_compression == "auto" and stored is not None:
        config = _with(config, replay_compression=stored.learning.replay_compression)
    return "zstd" if compresses_replay(config, suite) else "none"


def _require_lives(config: ExperimentConfig) -> None:
    if config.learning.life_loss_is_terminal and not suite_of(config.tasks).tasks_with_lives:
        raise ConfigError(
            "learning.life_loss_is_terminal is True, expected false for tasks without lives "
            f"({', '.join(config.tasks.names)})"
        )


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
    batches = config.learning.reestimate_statistics_batches
    if batches:
        raise ConfigError(
            f"learning.reestimate_statistics_batches is {batches}, expected 0 for the {processes} processes that "
            "torchrun started: only the first one holds the replay"
        )
    if config.learning.first_layer_mean != "running":
        raise ConfigError(
            f"learning.first_layer_mean is {config.learning.first_layer_mean!r}, expected running for the {processes} "
            "processes that torchrun started: each one sees its part of a batch only"
        )
    size = config.learning.batch_size
    if size % processes or size // processes < 2:
        raise ConfigError(
            f"learning.batch_size is {size}, expected a multiple of the {processes} processes that torchrun started, "
            "with two transitions for each; change one of the two"
        )
