"""Strict YAML <-> config: an unknown key, a wrong type or a value out of range stops with one line."""

from __future__ import annotations

import dataclasses
import importlib.resources
import shlex
import typing
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from switchmt_snn.config.checks import field_types
from switchmt_snn.config.decided import KEY, closed, opened, presumably_open, record
from switchmt_snn.config.experiment import ExperimentConfig
from switchmt_snn.config.other_names import OTHER_NAMES, meant
from switchmt_snn.config.strict_yaml import parse_yaml, read_text
from switchmt_snn.config.trust import allow, modules_in, note_stored, stored_signature
from switchmt_snn.errors import ConfigError, did_you_mean, nearest, printable


def load_config(
    source: str | Path,
    absent: dict[str, dict[str, Any]] | None = None,
    reopen: bool = True,
    stored: bool = False,
) -> ExperimentConfig:
    """Read a config from a YAML file, or a preset by name (``quickstart``, ``paper``, ``configs/paper.yaml``).

    Args:
        source: file or preset.
        absent: what settings by section are, if the file does not name them; None means the defaults.
        reopen: a file that a run or ``--print-config`` wrote says which values were decided from ``auto`` or null. True
            leaves them open again, so that a variation decides them anew; False takes them as they were decided.
        stored: the user names a folder that holds the file, not the file. Modules that it names are then trusted only
            if the user made the folder (``switchmt_snn.config.trust``); so it is with the config of any run folder.

    Raises:
        ConfigError: no such file or preset, not YAML, or a key or value that the config does not take.

    Examples:
        >>> config = load_config("minatar")
        >>> config.tasks.names, config.total_steps
        (('breakout', 'asterix', 'space_invaders'), 600000)
    """
    path = Path(source)
    where = printable(source)
    preset = _preset_text(path)
    if preset is None and not _exists(path):
        raise ConfigError(f"no config file or preset {where!r}{did_you_mean(path.stem, _preset_texts())}")
    if preset is None and (path / "config.yaml").is_file():
        raise ConfigError(
            f"{where} is a run folder, expected a config; its config is {where}/config.yaml; to continue the run: "
            f"switchmt-snn train --run {shlex.quote(where)}"
        )
    text = read_text(path, "a config") if preset is None else preset
    data = parse_yaml(text, where, "a config (docs/configuration.md)")
    if data is None:
        data = {}
    if not isinstance(data, dict):
        return from_dict(data, where=where)
    settings = opened(data, where) if reopen else closed(data)
    for section, values in (absent or {}).items():
        if isinstance(settings.get(section, {}), dict):
            settings[section] = values | settings.get(section, {})
    config = from_dict(settings, where=where)
    beside = path.with_name("environment.json")
    is_of_run = preset is None and path.name == "config.yaml" and beside.is_file()
    if modules := modules_in(to_dict(config)):
        if is_of_run or stored:
            note_stored(modules, path.parent, stored_signature(beside))
        else:
            allow(modules)
    is_older_run = is_of_run and KEY not in data
    return presumably_open(config) if reopen and is_older_run else config


def presets() -> dict[str, str]:
    """The presets by name, the default first, each with the first sentence of its file."""
    texts = {name: text.split("\n# ")[0].removeprefix("# ") for name, text in sorted(_preset_texts().items())}
    names = ["quickstart", *(name for name in texts if name != "quickstart")]
    return {name: texts[name].split("\n")[0] for name in names}


def _preset_texts() -> dict[str, str]:
    entries = importlib.resources.files("switchmt_snn.configs").iterdir()
    files = [entry for entry in entries if entry.name.endswith(".yaml")]
    return {entry.name.removesuffix(".yaml"): entry.read_text(encoding="utf-8") for entry in files}


def _preset_text(path: Path) -> str | None:
    """The text of the preset that a path names; None if it names none, or a file that is there."""
    is_name = path.suffix in ("", ".yaml") and (len(path.parts) == 1 or path.parts[:-1] == ("configs",))
    return _preset_texts().get(path.stem) if is_name and not (_exists(path) and path.is_file()) else None


def _exists(path: Path) -> bool:
    """Whether something is there; False for a path that no file system takes."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def from_dict(data: object, where: str = "config") -> ExperimentConfig:
    """Build a config from nested dicts, as YAML gives them; absent keys take the field's default.

    Raises:
        ConfigError: naming the key, the value seen, and what was expected.
    """
    return typing.cast(ExperimentConfig, _build(ExperimentConfig, data, where, ""))


def to_dict(config: ExperimentConfig) -> dict[str, Any]:
    """The config as nested dicts of plain values (tuples become lists), in field order."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items()}
        return list(value) if isinstance(value, tuple) else value

    return typing.cast("dict[str, Any]", plain(dataclasses.asdict(config)))


def to_yaml(config: ExperimentConfig, asked: ExperimentConfig | None = None) -> str:
    """The config as YAML that ``load_config`` reads back.

    Args:
        config: the settings.
        asked: what it was before ``auto`` and null were decided; where it differs, a record keeps what was asked. None
            writes no record.
    """
    data = to_dict(config)
    if asked is not None:
        data[KEY] = record(differences(asked, config))
    return yaml.safe_dump(data, sort_keys=False)


def differences(old: ExperimentConfig, new: ExperimentConfig) -> dict[str, tuple[Any, Any]]:
    """Fields that differ, as ``{"learning.batch_size": (old, new)}``."""
    flat_old, flat_new = _flatten(to_dict(old)), _flatten(to_dict(new))
    return {key: (flat_old[key], flat_new[key]) for key in flat_old if flat_old[key] != flat_new[key]}


def _flatten(data: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in data.items():
        flat.update(_flatten(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value})
    return flat


def _build(cls: type[Any], data: object, where: str, prefix: str) -> Any:
    if not isinstance(data, dict):
        raise ConfigError(
            f"{where}: {prefix.rstrip('.') or 'the file'} is {data!r:.80}, expected a mapping of settings"
        )
    fields = field_types(cls)
    values: dict[str, Any] = {}
    for key, value in data.items():
        if key not in fields:
            raise ConfigError(f"{where}: unknown key {prefix}{printable(key)}{_meant(prefix, str(key), fields)}")
        nested = dataclasses.is_dataclass(fields[key])
        values[key] = _build(fields[key], value, where, f"{prefix}{key}.") if nested else value
    try:
        return cls(**values)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def _meant(prefix: str, key: str, fields: Iterable[str]) -> str:
    """What an unknown key probably means: a setting of this name elsewhere, or the nearest, here first."""
    settings = _flatten(to_dict(ExperimentConfig()))
    exists = key in OTHER_NAMES or any(name.endswith(f".{key}") for name in settings)
    here = "" if exists else nearest(key, fields)
    elsewhere = " or ".join(meant(prefix + key, settings))
    return here or (f"; did you mean {elsewhere}?" if elsewhere else did_you_mean(key, fields))
