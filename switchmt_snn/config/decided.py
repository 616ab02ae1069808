"""What a stored config keeps of the values that were left open, so that a variation of it decides them anew.

A run stores decided values (``network.dendrites: shared``). With another method these would contradict it, although the
user never set them. So a stored config also says what stood there before:

    decided:
      network.dendrites: {asked: auto, decided: shared}

Values are opened again where a config is the start of another run, and stay decided where a run is continued or read.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from switchmt_snn.config.experiment import ExperimentConfig, resolve
from switchmt_snn.config.methods import METHOD_TRAITS
from switchmt_snn.errors import ConfigError

KEY = "decided"
"""The key of a config's YAML under which the record stands; it is no setting."""

_MACHINE_INDEPENDENT = ("tasks.suite",)
"""Settings whose short name is known in one process only; what was decided is the name for all."""


def record(differing: dict[str, tuple[Any, Any]]) -> dict[str, dict[str, Any]]:
    """The record of a config.

    Args:
        differing: settings that differ between what was asked for and what was decided, as ``differences`` gives them.
    """
    return {
        key: {"asked": asked, "decided": decided}
        for key, (asked, decided) in differing.items()
        if key not in _MACHINE_INDEPENDENT
    }


def opened(data: dict[str, Any], where: str) -> dict[str, Any]:
    """A config's content without its record; a decided value that nobody changed since is what was asked for again.

    Args:
        data: nested dicts, as YAML gives them; not changed.
        where: the file, for errors.

    Raises:
        ConfigError: the record is damaged.
    """
    settings = closed(data)
    for key, pair in _record_of(data, where).items():
        section, _, name = key.rpartition(".")
        values = settings.get(section) if section else settings
        if isinstance(values, dict) and name in values and values[name] == pair["decided"]:
            values = {**values, name: pair["asked"]}
            settings = {**settings, section: values} if section else values
    return settings


def closed(data: dict[str, Any]) -> dict[str, Any]:
    """A config's content without its record, each value as it was decided."""
    return {key: value for key, value in data.items() if key != KEY}


def _record_of(data: dict[str, Any], where: str) -> dict[str, dict[str, Any]]:
    stored = data.get(KEY) or {}
    if not isinstance(stored, dict) or not all(
        isinstance(pair, dict) and pair.keys() == {"asked", "decided"} for pair in stored.values()
    ):
        raise ConfigError(
            f"{where}: {KEY} is {stored!r:.80}, expected 'setting: {{asked: ..., decided: ...}}' as train wrote it; "
            "delete it"
        )
    return stored


_OPEN: dict[str, Any] = {
    "tasks.frame_stack": None,
    "network.trunk": "auto",
    "network.hidden_units": None,
    "network.dendrites": "auto",
    "learning.clip_rewards": None,
    "switching.policy": "auto",
}
"""Settings for which ``resolve`` has a rule, with the values that leave them open."""


def presumably_open(config: ExperimentConfig) -> ExperimentConfig:
    """A run's config from before there were records: values that the rules give as well are taken as left open.

    T of an ANN was not stored; it becomes the default. So do an engine other than eager, which not every network has,
    the engine that acts, if it is the one that updates, and the compression of the replay, which changes no number.
    """
    for key, value in _OPEN.items():
        section, name = key.split(".")
        candidate = replace(config, **{section: replace(getattr(config, section), **{name: value})})
        if resolve(candidate) == resolve(config):
            config = candidate
    network, learning = config.network, replace(config.learning, replay_compression="auto")
    if not METHOD_TRAITS[network.method].spiking:
        network = replace(network, timesteps=type(network).timesteps)
    if learning.acting == learning.engine:
        learning = replace(learning, acting="auto")
    if learning.engine != "eager":
        learning = replace(learning, engine="auto")
    return replace(config, network=network, learning=learning)
