"""A study in one YAML file: a base config, variants, grids of settings, seeds. ``load_study`` makes its trials.

Every trial is a config of its own, which ``switchmt-snn train`` takes as any other.
"""

from __future__ import annotations

import dataclasses
import importlib.resources
import itertools
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from switchmt_snn.config import ExperimentConfig, differences, from_dict, load_config, resolve, to_dict
from switchmt_snn.config.checks import require
from switchmt_snn.config.strict_yaml import parse_yaml, read_text
from switchmt_snn.config.trust import allow, modules_in
from switchmt_snn.errors import ConfigError, did_you_mean, printable

MOST_TRIALS = 10_000
"""Of a study; more is a mistake in the grid."""
LONGEST_NAME = 80
"""Characters of a variant's name: it becomes part of a folder's name."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
_OWNED = {"seed": "seeds", "name": "the names of the variants"}
"""Settings of a run that the study sets itself, and by what."""
_WHAT = "a study (docs/studies.md)"


@dataclass(frozen=True)
class Trial:
    """One training.

    Attributes:
        name: of its folder: ``eq3_seed1``.
        variant: trials that differ in their seed only share it.
        config: before ``auto`` and null are decided.
    """

    name: str
    variant: str
    seed: int
    config: ExperimentConfig


@dataclass(frozen=True)
class StudyFile:
    """The YAML of a study. Keys of settings are those of a config, as ``switching.policy`` or nested."""

    base: str
    """A preset, or a config file; a relative path starts at the study's file."""
    name: str = ""
    """A short name; it names the folder. Default: the file's name."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Settings over the base, for every trial."""
    variants: dict[str, Any] = field(default_factory=dict)
    """Settings over that, by the name of a variant; an empty one changes nothing."""
    vary: dict[str, Any] = field(default_factory=dict)
    """Settings with lists of values. Every variant is trained with every combination."""
    seeds: Any = 1
    """A number of seeds (1, 2, ...), or a list of seeds."""
    references: dict[str, Any] = field(default_factory=dict)
    """By task: the score that counts as 1, as a number, or the variant whose mean score it is."""
    baseline: str | None = None
    """The variant that the others are compared with. Default: the first."""


@dataclass(frozen=True)
class Study:
    """A study with its trials, seed by seed: one that is interrupted has the same seeds of every variant."""

    name: str
    trials: tuple[Trial, ...]
    references: dict[str, float | str]
    baseline: str

    @property
    def variants(self) -> tuple[str, ...]:
        """Names in the order of the file."""
        return tuple(dict.fromkeys(trial.variant for trial in self.trials))


def load_study(source: str | Path, overrides: Sequence[str] = (), seeds: Sequence[int] = ()) -> Study:
    """Read a study.

    Args:
        source: a YAML file, or a study that comes with the package, by name.
        overrides: ``KEY=VALUE`` over every trial: ``total_steps=2000``.
        seeds: in place of those of the file; empty for those.

    Raises:
        ConfigError: no such file, or a key, value or name that it does not take; the line names it.

    Examples:
        >>> from switchmt_snn.study.grid import load_study
        >>> study = load_study("policies_minatar", ["total_steps=2000"], seeds=[1, 2])
        >>> study.variants[0], study.trials[0].name, study.trials[0].config.total_steps
        ('uniform', 'uniform_seed1', 2000)
    """
    text, where, path = _text_of(source)
    file = _study_file(text, where, path)
    base = _base(file.base, path)
    every = _settings(file.settings, f"{where}: settings")
    given = override_settings(overrides)
    try:
        chosen = _seeds(list(seeds) if seeds else file.seeds)
        variants = {
            name: with_settings(base, every | settings | given, f"{where}: variant {name}")
            for name, settings in _variants(file, where).items()
        }
        _require_different(variants)
        count = len(variants) * len(chosen)
        require(count <= MOST_TRIALS, "the number of trials", count, f"at most {MOST_TRIALS:,}")
        study = Study(
            name=file.name,
            trials=tuple(
                Trial(f"{name}_seed{seed}", name, seed, replace(config, seed=seed, name=name))
                for seed in chosen
                for name, config in variants.items()
            ),
            references=_references(file, variants),
            baseline=next(iter(variants)) if file.baseline is None else file.baseline,
        )
        require(study.baseline in variants, "baseline", study.baseline, f"one of {', '.join(variants)}")
    except ConfigError as error:
        raise error if str(error).startswith(where) else ConfigError(f"{where}: {error}") from None
    allow(set(modules_in([to_dict(trial.config) for trial in study.trials])) - set(modules_in(to_dict(base))))
    return study


def studies() -> dict[str, str]:
    """The studies that come with the package by name, each with the first line of its file."""
    return {name: text.split("\n")[0].removeprefix("# ") for name, text in sorted(_packaged().items())}


def with_settings(config: ExperimentConfig, settings: dict[str, Any], where: str) -> ExperimentConfig:
    """A config with settings by dotted key in place of its own.

    Raises:
        ConfigError: a key or a value that a config does not take.
    """
    data = to_dict(config)
    for key, value in settings.items():
        place = data
        *sections, last = key.split(".")
        for section in sections:
            inner = place.get(section)
            if not isinstance(inner, dict):  # a wrong key: from_dict names it
                inner = place[section] = {}
            place = inner
        place[last] = value
    return from_dict(data, where)


def _text_of(source: str | Path) -> tuple[str, str, Path | None]:
    """Text, name for errors, and path of a study; the path is None for one of the package."""
    path, where = Path(source), printable(source)
    packaged = _packaged()
    if _is_file(path):
        return read_text(path, _WHAT), where, path
    if path.suffix in ("", ".yaml") and path.parts[:-1] in ((), ("configs", "studies")) and path.stem in packaged:
        return packaged[path.stem], where, None
    raise ConfigError(f"no study {where!r}, expected a YAML file or a study's name{did_you_mean(path.stem, packaged)}")


def _is_file(path: Path) -> bool:
    """Whether a file is there; False for a path that no file system takes."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _packaged() -> dict[str, str]:
    folder = importlib.resources.files("switchmt_snn.configs").joinpath("studies")
    files = [entry for entry in folder.iterdir() if entry.name.endswith(".yaml")]
    return {entry.name.removesuffix(".yaml"): entry.read_text(encoding="utf-8") for entry in files}


def _study_file(text: str, where: str, path: Path | None) -> StudyFile:
    """The file's keys with their types checked."""
    data = parse_yaml(text, where, _WHAT)
    if not isinstance(data, dict):
        raise ConfigError(f"{where} is {data!r:.80}, expected {_WHAT}: a mapping with base and seeds")
    fields = {one.name: one for one in dataclasses.fields(StudyFile)}
    for key, value in data.items():
        if key not in fields:
            raise ConfigError(f"{where}: unknown key {printable(key)}{did_you_mean(str(key), fields)}")
        maps = fields[key].default_factory is dict
        if value is None and maps:
            data[key] = {}
        elif key != "seeds" and not isinstance(value, dict if maps else str):
            kind = "a mapping" if maps else "text"
            raise ConfigError(f"{where}: {key} is {value!r:.120}, expected {kind}")
    if "base" not in data:
        raise ConfigError(f"{where}: base is missing, expected a preset or a config file, as base: minatar")
    file = StudyFile(**data)
    name = file.name or Path(path or where).stem
    _require_name(name, f"{where}: name")
    return replace(file, name=name)


def _base(source: str, study: Path | None) -> ExperimentConfig:
    beside = None if study is None else study.parent / source
    return load_config(beside if beside is not None and _is_file(beside) else source)


def _settings(value: Any, where: str) -> dict[str, Any]:
    """A mapping of settings by dotted key; the study's own are refused.

    Raises:
        ConfigError: no mapping, a key that comes twice, or one that the study sets.
    """
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise ConfigError(f"{where} is {value!r:.120}, expected a mapping of settings, as switching.policy: interleave")
    found: dict[str, Any] = {}
    for key, item in _flat(value):
        if key in found:
            raise ConfigError(f"{where}: {printable(key)} is given twice, expected it once")
        if item == {}:
            raise ConfigError(f"{where}: {printable(key)} is {{}}, expected a value")
        if key in _OWNED:
            raise ConfigError(f"{where}: {key} is {item!r:.40}, expected none: {_OWNED[key]} of the study set it")
        found[key] = item
    return found


def _flat(mapping: dict[Any, Any], before: str = "") -> Iterable[tuple[str, Any]]:
    for key, value in mapping.items():
        if isinstance(value, dict) and value:
            yield from _flat(value, f"{before}{key}.")
        else:
            yield f"{before}{key}", value


def override_settings(words: Sequence[str], example: str = "total_steps=2000") -> dict[str, Any]:
    """Settings by dotted key of the words ``KEY=VALUE`` that follow ``--set``.

    Raises:
        ConfigError: another word, a key that comes twice, or a setting that is not a user's.
    """
    settings: dict[str, Any] = {}
    for word in words:
        key, equals, text = word.partition("=")
        if not equals or not key:
            raise ConfigError(f"--set has {word!r:.80}, expected KEY=VALUE, as {example}")
        value = {key: parse_yaml(text, f"--set {key}", "a value")}
        if key in settings:
            raise ConfigError(f"--set has {key} twice, expected it once")
        settings |= _settings(value, "--set")
    return settings


def _seeds(value: Any) -> list[int]:
    if isinstance(value, int) and not isinstance(value, bool):
        require(1 <= value <= MOST_TRIALS, "seeds", value, f"a number from 1 to {MOST_TRIALS:,}, or a list of seeds")
        return list(range(1, value + 1))
    whole = isinstance(value, list) and bool(value) and all(type(one) is int and one >= 0 for one in value)
    require(whole, "seeds", value, "a number of seeds, or a list of whole numbers of at least 0")
    require(len(set(value)) == len(value), "seeds", value, "each seed once")
    return list(value)


def _variants(file: StudyFile, where: str) -> dict[str, dict[str, Any]]:
    """Settings of every variant by name: named ones, each with every combination of ``vary``."""
    named = {"": {}} if not file.variants else file.variants
    grid = _settings({}, where) if not file.vary else _settings(file.vary, f"{where}: vary")
    for key, values in grid.items():
        if not isinstance(values, list) or not values or any(isinstance(value, dict) for value in values):
            raise ConfigError(f"{where}: vary {printable(key)} is {values!r:.80}, expected a list of values")
    count = len(named) * math.prod(map(len, grid.values()))
    require(count <= MOST_TRIALS, f"{where}: the number of variants", count, f"at most {MOST_TRIALS:,}")
    short = _short_keys(grid)
    found: dict[str, dict[str, Any]] = {}
    for own, settings in named.items():
        if file.variants:
            _require_name(own, f"{where}: variants")
        fixed = _settings(settings, f"{where}: variant {own}")
        for key in fixed:
            if key in grid:
                raise ConfigError(f"{where}: {key} is in vary and in variant {own}, expected it in one of them")
        for values in itertools.product(*grid.values()):
            chosen = dict(zip(grid, values, strict=True))
            parts = [own] if own else []
            parts += [f"{short[key]}-{_slug(value)}" for key, value in chosen.items()]
            name = "_".join(parts) or file.name
            _require_name(name, f"{where}: the name of a variant")
            if name in found:
                raise ConfigError(f"{where}: two variants are called {name}, expected other names; use variants")
            found[name] = fixed | chosen
    return found


def _short_keys(keys: Iterable[str]) -> dict[str, str]:
    """The last part of each dotted key, or all of it where the last parts are alike."""
    last = {key: key.rpartition(".")[2] for key in keys}
    return {key: short if list(last.values()).count(short) == 1 else key for key, short in last.items()}


def _slug(value: Any) -> str:
    text = "-".join(map(str, value)) if isinstance(value, list) else "null" if value is None else str(value)
    return re.sub(r"[^A-Za-z0-9_.-]", "-", text)


def folder_name(name: Any) -> str:
    """The name of a stored trial: part of a path, and never of another folder.

    Raises:
        ValueError: it is no such name.
    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise ValueError(f"{name!r:.40} is no name of a trial")
    return name


def _require_name(name: Any, key: str) -> None:
    plain = isinstance(name, str) and _NAME.fullmatch(name) is not None and len(name) <= LONGEST_NAME
    expected = f"letters, digits, - _ and . (at most {LONGEST_NAME}): it becomes part of a folder's name"
    require(plain, key, name, expected)


def _require_different(variants: dict[str, ExperimentConfig]) -> None:
    """Refuse two variants that train the same."""
    seen: dict[str, str] = {}
    for name, config in variants.items():
        same = seen.setdefault(str(to_dict(resolve(config))), name)
        if same != name:
            raise ConfigError(f"the variants {same} and {name} have the same settings, expected different ones")


def _references(file: StudyFile, variants: dict[str, ExperimentConfig]) -> dict[str, float | str]:
    tasks = {task for config in variants.values() for task in config.tasks.names}
    found: dict[str, float | str] = {}
    for task, value in file.references.items():
        require(task in tasks, "references", task, f"a task of the study ({', '.join(sorted(tasks))})")
        if isinstance(value, str):
            plays = value in variants and task in variants[value].tasks.names
            require(plays, f"references.{task}", value, "a number, or a variant that plays this task")
            found[task] = value
        else:
            number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
            require(number, f"references.{task}", value, "a finite number, or a variant that plays this task")
            found[task] = float(value)
    return found


def changed_settings(old: ExperimentConfig, new: ExperimentConfig) -> str:
    """The settings in which two configs differ, for an error; empty if in none."""
    pairs = sorted(differences(old, new).items())
    return ", ".join(f"{key} ({before!r} -> {after!r})" for key, (before, after) in pairs)
