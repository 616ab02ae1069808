"""From words of a command line to options: the positional arguments wherever they stand, and flags over a default."""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import re
import shlex
from dataclasses import replace
from typing import Any

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from switchmt_snn.config import ExperimentConfig, load_config, presets
from switchmt_snn.config.numbers import whole_number
from switchmt_snn.config.other_names import meant
from switchmt_snn.config.trust import allow, allow_everything, modules_in
from switchmt_snn.errors import ConfigError, printable
from switchmt_snn.machine.program import runnable

ARGUMENTS = {
    "train": ("CONFIG", "a YAML file or a preset (default: with --run the config of the run there, else quickstart)"),
    "describe": ("CONFIG", "a YAML file, a preset, a run folder or pretrained/NAME (default: quickstart)"),
    "evaluate": ("RUN", "a run folder or pretrained/NAME (default: the run under runs/ that was begun last)"),
    "play": ("RUN", "a run folder or pretrained/NAME (default: the run under runs/ that was begun last)"),
    "export": ("RUN", "a run folder or pretrained/NAME (default: the run under runs/ that was begun last)"),
    "profile": ("RUN", "run folders, pretrained/NAME, or NIR files (default: the run under runs/ that was begun last)"),
    "report": ("RUN", "a run folder or pretrained/NAME (default: the run under runs/ that was begun last)"),
    "compare": ("RUN", "two or more run folders or pretrained/NAME"),
    "study": ("CONFIG", "a YAML file (docs/studies.md), a study that comes with the package, or a study's folder"),
    "replay-policies": ("RUN", "a run folder or pretrained/NAME (default: the run under runs/ that was begun last)"),
    "runs": ("FOLDER", "a folder with run folders, or one run folder (default: runs/)"),
    "pack": ("RUN", "a run folder (default: the run under runs/ that was begun last)"),
    "check-env": ("ID", "names of environments; several must fit one network"),
    "doctor": ("", ""),
}
"""The positional argument of each command, and what it is."""

_REGISTRY = ConstructorRegistry()


@_REGISTRY.primitive_rule
def _whole_numbers(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[int] | None:
    """Whole numbers as people write them: 1e6 is one."""
    if info.type is not int:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="INT",
        instance_from_str=lambda words: whole_number(words[0]),
        is_instance=lambda value: isinstance(value, int) and not isinstance(value, bool),
        str_from_instance=lambda value: [str(value)],
    )


@_REGISTRY.primitive_rule
def _number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """A number, or one that may be left open: null, as in YAML."""
    if info.type not in (float, int | None, float | None):
        return None
    read = whole_number if info.type == int | None else _float
    name = "INT" if info.type == int | None else "FLOAT"
    null = () if info.type is float else ("null", "none")
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{None}}|{name}" if null else name,
        instance_from_str=lambda words: None if words[0].lower() in null else read(words[0]),
        is_instance=lambda value: (value is None and bool(null)) or isinstance(value, (int, float)),
        str_from_instance=lambda value: [str(value)],
    )


@_REGISTRY.primitive_rule
def _numbers(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """A list of numbers."""
    if info.type not in (tuple[int, ...], tuple[float, ...]):
        return None
    read, name = (whole_number, "INT") if info.type == tuple[int, ...] else (_float, "FLOAT")
    return PrimitiveConstructorSpec(
        nargs="*",
        metavar=f"[{name} [{name} ...]]",
        instance_from_str=lambda words: tuple(map(read, words)),
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda value: list(map(str, value)),
    )


def _float(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise ValueError(f"{word!r} is not a number") from None


_TRUTHS = {"true": True, "false": False, "null": None, "none": None}


@_REGISTRY.primitive_rule
def _truth_or_null(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """A truth value that may be left open: true, false or null, as in YAML."""
    if info.type != bool | None:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="{true,false,null}",
        instance_from_str=lambda words: _truth(words[0]),
        is_instance=lambda value: value is None or isinstance(value, bool),
        str_from_instance=lambda value: ["null" if value is None else str(value).lower()],
    )


def _truth(word: str) -> bool | None:
    if word.lower() not in _TRUTHS:
        raise ValueError(f"{word!r} is not true, false or null")
    return _TRUTHS[word.lower()]


def split(kind: Any, argv: list[str], command: str, default: Any) -> tuple[list[str], list[str]]:
    """The positional arguments, wherever they stand, and the flags with their values.

    A word is positional if no flag takes it. A flag that takes a list takes every word up to the next flag, and so does
    a flag that the command does not have: the parser then names it.
    """
    parser = tyro.extras.get_parser(kind, default=default, registry=_REGISTRY)
    takes = {flag: action.nargs for action in parser._actions for flag in action.option_strings}
    names: list[str] = []
    flags: list[str] = []
    open_values: float = 0  # words that the last flag still takes
    for word in argv:
        if word.startswith("--") or word == "-h":
            flag, equals, _ = word.partition("=")
            flag = RENAMED.get(command, {}).get(flag, flag).replace("_", "-")
            nargs = takes.get(flag, "*")
            open_values = 0 if equals else 1 if nargs is None else nargs if isinstance(nargs, int) else float("inf")
            flags.append(word)
        elif open_values > 0:
            open_values -= 1
            flags.append(word)
        else:
            names.append(word)
    return names, flags


def split_one(kind: Any, argv: list[str], command: str, default: Any) -> tuple[str | None, list[str]]:
    """As ``split``, for a command with one positional argument; None if it is left out.

    Raises:
        ConfigError: there are several.
    """
    names, flags = split(kind, argv, command, default)
    if len(names) > 1:
        argument = ARGUMENTS[command][0]
        hint = _on_or_off(kind, argv, default)
        raise ConfigError(
            f"{command} got {' '.join(names)}, expected one {argument}{hint}; see switchmt-snn {command} --help"
        )
    return names[0] if names else None, flags


def _shown(command: str) -> str:
    """The argument in the line of usage, in brackets if it has a default."""
    name, meaning = ARGUMENTS[command]
    return "" if not name else f" [{name}]" if "(default: " in meaning else f" {name}"


def _description(kind: Any, command: str) -> str:
    """The help's first paragraphs: what the command does, and what its argument is."""
    name, meaning = ARGUMENTS[command]
    lines = [" ".join((kind.__doc__ or "").split())]
    if name:
        lines += ["", f"{name}: {meaning}"]
    if name == "CONFIG":
        lines += [f"  {preset:<11} {text}" for preset, text in presets().items()]
    return "\n".join(lines)


def peek(argv: list[str], flag: str) -> str | None:
    """The value of a flag, before the others are parsed: it says which config they change."""
    for index, word in enumerate(argv):
        if word == flag and index + 1 < len(argv):
            return argv[index + 1]
        if word.startswith(f"{flag}="):
            return word.split("=", 1)[1]
    return None


def _without(argv: list[str], flag: str) -> list[str]:
    """The words without a flag and its value."""
    following = [False, *(word == flag for word in argv)]
    return [
        word
        for word, is_value in zip(argv, following, strict=False)
        if not (is_value or word.partition("=")[0] == flag)
    ]


def for_named_tasks(config: ExperimentConfig, argv: list[str]) -> ExperimentConfig:
    """A config without its settings by task if flags name other tasks: they were chosen for its own.

    Args:
        config: that flags will change.
        argv: the flags.
    """
    flag = "--tasks.names"
    if not any(word == flag or word.startswith(f"{flag}=") for word in argv):
        return config
    start = next(index for index, word in enumerate(argv) if word.partition("=")[0] == flag)
    _, equals, first = argv[start].partition("=")
    following = itertools.takewhile(lambda word: not word.startswith("--"), argv[start + 1 :])
    named = (first,) if equals else tuple(following)
    if named == config.tasks.names:
        return config
    return replace(
        config,
        learning=replace(config.learning, longest_random_action_steps_by_task=()),
        evaluation=replace(config.evaluation, stop_at_returns=()),
        switching=replace(config.switching, reference_scores=(), floor_scores=()),
    )


def for_another_suite(
    source: str | None, default: ExperimentConfig, config: ExperimentConfig, argv: list[str], command: str
) -> str | None:
    """What to say where flags put tasks of another suite into a preset: its settings were chosen for its own.

    Args:
        source: what is named as CONFIG; None for quickstart.
        default: the config that flags change.
        config: with the flags.
        argv: the flags.
        command: its name.
    """
    source, suite = source or "quickstart", config.tasks.suite
    if suite == default.tasks.suite or source not in presets():
        return None
    told = f"note: the settings of the preset {source} are for the suite {default.tasks.suite}, not for {suite}; "
    made_for = presets_for(suite)
    if not made_for:
        return f"{told}no preset is for that suite, so write a config of your own (docs/configuration.md)"
    nearest = nearest_preset(config) or source
    again = shlex.join(["switchmt-snn", command, nearest, *_without(argv, "--run")])
    return f"{told}presets for that suite: {', '.join(made_for)}. Try: {runnable(again)}"


def presets_for(suite: str) -> list[str]:
    """Names of the presets whose tasks are of a suite."""
    return [name for name in presets() if load_config(name).tasks.suite == suite]


def nearest_preset(config: ExperimentConfig) -> str | None:
    """The preset for a config's suite whose number of tasks is the nearest; None if none is for that suite."""
    made_for, count = presets_for(config.tasks.suite), len(config.tasks.names)
    return min(made_for, key=lambda name: abs(len(load_config(name).tasks.names) - count), default=None)


RENAMED = {"evaluate": {"--engine": "--runtime"}, "export": {"--nir-profile": "--nir-dialect"}}
"""Older spellings of flags, by command; they still work, and the help does not list them."""


def parse(kind: Any, argv: list[str], command: str, default: Any) -> Any:
    """Options from flags; what no flag names has the default's value.

    Raises:
        ConfigError: an unknown flag or a wrong value; tyro's boxed message in one line.
    """
    argv = [_renamed(word, RENAMED.get(command, {})) for word in argv]
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            options = tyro.cli(
                kind,
                default=default,
                args=argv,
                prog=f"switchmt-snn {command}{_shown(command)}",
                description=_description(kind, command),
                registry=_REGISTRY,
            )
    except SystemExit as stop:
        if stop.code == 0:
            raise
        unknown = _unknown_flags(kind, argv, command, default)
        text = unknown or _one_line(complaint.getvalue())
        hint = _on_or_off(kind, argv, default)
        raise ConfigError(f"{text}{hint}; see switchmt-snn {command} --help") from None
    if getattr(options, "trust", False):
        allow_everything()
    allow(_modules_named(argv))
    return options


def _modules_named(argv: list[str]) -> tuple[str, ...]:
    """Modules that values of flags name, as in ``--task my_module:MyEnv-v0`` and ``--set tasks.names=[a:B-v0]``.

    The name of a file or folder says nothing of a user's trust: somebody else may have chosen it.
    """
    values = [word for word in argv if not word.startswith("--")] + [word.partition("=")[2] for word in argv]
    return modules_in([re.split(r"[\s=,\[\]'\"]+", value) for value in values if not os.path.exists(value)])


def _renamed(word: str, renamed: dict[str, str]) -> str:
    flag, equals, value = word.partition("=")
    return renamed.get(flag, flag) + equals + value


def _unknown_flags(kind: Any, argv: list[str], command: str, default: Any) -> str:
    """The flags that the command does not have, each with what was probably meant; nothing if it has all."""
    parser = tyro.extras.get_parser(kind, default=default, registry=_REGISTRY)
    flags = {flag for action in parser._actions for flag in action.option_strings}
    settings = {flag.removeprefix("--").replace("-", "_"): flag for flag in flags}
    told = []
    for word in argv:
        flag = word.partition("=")[0]
        if not word.startswith("--") or flag.replace("_", "-") in flags:
            continue
        near = [settings[name] for name in meant(flag.removeprefix("--").replace("-", "_"), settings)]
        told.append(printable(flag) + (f" (did you mean {' or '.join(near)}?)" if near else ""))
    return f"{command} has no option {', '.join(told)}" if told else ""


def _on_or_off(kind: Any, argv: list[str], default: Any) -> str:
    """What to write in place of ``--FLAG true`` and ``--FLAG=false``, where FLAG is on or off; nothing if none is."""
    parser = tyro.extras.get_parser(kind, default=default, registry=_REGISTRY)
    switches = {flag for action in parser._actions for flag in action.option_strings if action.nargs == 0}
    for word, following in itertools.zip_longest(argv, argv[1:], fillvalue=""):
        flag, equals, value = word.replace("_", "-").partition("=")
        if flag in switches and (value if equals else following).lower() in ("true", "false"):
            section, dot, name = flag.removeprefix("--").rpartition(".")
            on, off = (f"--{section}{dot}{no}{name.removeprefix('no-')}" for no in ("", "no-"))
            return f"; an option that is on or off takes no value: {on}, or {off}"
    return ""


def _one_line(boxed: str) -> str:
    """The message in tyro's box (drawn with lines in a UTF-8 terminal, with spaces elsewhere), without its title."""
    lines = [line.strip("│ ") for line in boxed.splitlines() if line.strip() and line[0] not in "╭╰"]
    if "│" not in boxed:
        lines = lines[1:]
    text = " ".join(line for line in lines if not set(line) <= set("─-"))
    return text.split("For full helptext")[0].split("Argument helptext")[0].strip().rstrip(".")
