"""``switchmt-snn check-env``: what an environment is taken for, and how it plays."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from switchmt_snn.cli.parsing import parse, split
from switchmt_snn.errors import ConfigError
from switchmt_snn.viewing import output

if TYPE_CHECKING:
    from switchmt_snn.tasks.report import EnvironmentReport


MOST_STEPS = 10_000_000


@dataclass(frozen=True)
class CheckEnvOptions:
    """What environments are taken for, how they play, and why training would refuse them."""

    suite: str = "gym"
    """As tasks.suite: gym (Gymnasium ids, also module:MyEnv-v0), atari, minatar, or module:MySuite."""
    wrappers: tuple[str, ...] = ()
    """As tasks.wrappers."""
    image_layout: Literal["by_shape", "channels_last", "channels_first"] = "by_shape"
    """As tasks.image_layout."""
    steps: int = 1000
    """Steps of random play."""
    seconds: float = 30.0
    """About how long the check of one environment may take: half of it for the random play, half for playing again."""
    json: bool = False
    """Print the facts as JSON."""


def command(argv: list[str]) -> int:
    """Run the command; returns its exit code."""
    names, rest = split(CheckEnvOptions, argv, "check-env", CheckEnvOptions())
    options = parse(CheckEnvOptions, rest, "check-env", CheckEnvOptions())
    if not names:
        raise ConfigError("check-env was given no environment, expected one: switchmt-snn check-env CartPole-v1")
    if not 1 <= options.steps <= MOST_STEPS:
        raise ConfigError(f"--steps is {options.steps}, expected 1 to {MOST_STEPS:,}")
    if not options.seconds > 0:
        raise ConfigError(f"--seconds is {options.seconds:g}, expected more than 0")
    from switchmt_snn.tasks.report import check_env

    reports = check_env(
        *names,
        suite=options.suite,
        steps=options.steps,
        seconds=options.seconds,
        say=_say,
        wrappers=options.wrappers,
        image_layout=options.image_layout,
    )
    refused = _refused_network(options, tuple(names))
    if options.json:
        output.print_json([{**report.to_dict(), "refused_network": refused} for report in reports])
        return 0
    for report in reports:
        print("\n".join(_lines(report, refused)))
    return 0


def _refused_network(options: CheckEnvOptions, names: tuple[str, ...]) -> str | None:
    """Why ``train`` without CONFIG refuses to build a network for these tasks; None if it builds one."""
    from switchmt_snn.config import load_config, resolve
    from switchmt_snn.learning.parts import observation_spec
    from switchmt_snn.spiking.network import build_network
    from switchmt_snn.tasks.registry import make_suite

    asked = load_config("quickstart")
    tasks = replace(
        asked.tasks, suite=options.suite, names=names, wrappers=options.wrappers, image_layout=options.image_layout
    )
    try:
        config = resolve(replace(asked, tasks=tasks))
        build_network(config.network, observation_spec(make_suite(config.tasks)), seed=0)
    except ConfigError as error:
        return str(error)
    return None


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _lines(report: EnvironmentReport, refused_network: str | None) -> list[str]:
    kinds = {
        "vector": "a vector of {0} numbers",
        "channels_last": "images, channels last: frames of {0} channels, {1} x {2}",
        "channels_first": "images, channels first: frames of {0} channels, {1} x {2}",
        "grey": "grey images: frames of {0} channel, {1} x {2}",
    }
    from switchmt_snn.tasks.gym_spaces import in_short

    low, high = report.observed
    count = len(report.episode_lengths)
    ended = f"{count} ended in {report.steps:,} steps of random play"
    if report.ended_by_limit_s is not None:
        ended += f" (ended by its limit of {report.ended_by_limit_s:g} s; --seconds raises it)"
    if count:
        lengths, returns = report.episode_lengths, report.episode_returns
        ended += (
            f", after {min(lengths):,} to {max(lengths):,} steps (mean {sum(lengths) / count:,.0f}), "
            f"{report.truncated} of them truncated; returns from {min(returns):g} to {max(returns):g} (mean "
            f"{sum(returns) / count:g})"
        )
    yes = {True: "yes", False: "no"}
    threads = "several threads at a time" if report.played_in_threads else "one thread"
    rows = {
        "space": None if report.observes is None else in_short(report.observes),
        "taken for": kinds[report.layout].format(*report.frame_shape)
        + f", {report.frame_dtype}, times {report.scale:g}",
        "observed": f"values from {low:g} to {high:g}",
        "actions": f"{len(report.actions)}: {_numbers(report.actions)}",
        "rewards": f"from {report.rewards[0]:g} to {report.rewards[1]:g}",
        "episodes": ended,
        "limit": None if report.limit_steps is None else f"{report.limit_steps:,} steps",
        "same seed": f"plays the same {report.compared_steps:,} steps again: {yes[report.repeats]}; "
        f"after other episodes: {yes[report.starts_afresh]}",
        "other seed": f"plays something else: {yes[report.seeds_differ]}",
        "threads": f"evaluations use {threads}; the same in several: {yes[report.same_in_threads]}",
        "speed": f"{report.steps_per_s:,.0f} steps/s, one copy",
    }
    trained = "can be trained" if refused_network is None else "can be played, but train's own network does not fit"
    lines = [f"{report.task} ({report.suite}): {trained}"]
    lines += [f"  {key:<10} {value}" for key, value in rows.items() if value is not None]
    notes = report.notes if refused_network is None else (refused_network, *report.notes)
    return [*lines, *(f"  note: {note}" for note in notes)]


def _numbers(actions: tuple[int, ...]) -> str:
    if actions == tuple(range(actions[0], actions[-1] + 1)) and len(actions) > 1:
        return f"{actions[0]} to {actions[-1]}"
    return ", ".join(map(str, actions))
