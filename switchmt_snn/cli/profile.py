"""``switchmt-snn profile``: count what a network does while it plays, and estimate its energy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import tyro

from switchmt_snn.cli.parsing import parse, split
from switchmt_snn.errors import ConfigError
from switchmt_snn.viewing import output


@dataclass(frozen=True)
class ProfileOptions:
    """profile [RUN ...] or profile FILE.nir: count what a network does while it plays, and estimate its energy."""

    decisions: int = 1000
    """Recorded decisions per task."""
    target: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Energy target or chip: a built-in one by name, or a YAML file. May be repeated. Default: all built-in ones."""
    checkpoint: Literal["last", "best"] = "last"
    """Which weights."""
    observations: Path | None = None
    """For a NIR file: an .npz file with observations [N, ...] or encoded inputs [T, N, ...]."""
    reset: Literal["zero", "subtract", "subtract_after_decay"] | None = None
    """For a NIR file of another tool: what a spike does there. zero: to v_reset (NIR). subtract: takes the threshold
    off at once. subtract_after_decay: after the next decay (snnTorch's default). Default: the file's, else zero."""
    fires_at_threshold: bool = False
    """For a NIR file of another tool: a membrane exactly at its threshold fires (SpikingJelly, sinabs)."""
    out: Path | None = None
    """Folder to write to. Default: RUN/profile/; with several runs, the comparison goes into the first one's."""
    trust: bool = False
    """Import modules that the runs name, although you did not make them: this runs their code."""
    json: bool = False
    """Print the profile as JSON."""


def command(argv: list[str]) -> int:
    """Run the command; returns its exit code."""
    names, rest = split(ProfileOptions, argv, "profile", ProfileOptions())
    options = parse(ProfileOptions, rest, "profile", ProfileOptions())
    from switchmt_snn.export import ProfileResult, compare_profiles, profile, profile_file
    from switchmt_snn.runs.packing import open_run
    from switchmt_snn.viewing.progress_bar import ProgressBars

    files = [name for name in names if name.endswith(".nir")]
    if (options.observations is not None) != bool(files):
        raise ConfigError(
            "a NIR file and --observations belong together, expected switchmt-snn profile FILE.nir --observations "
            "FILE.npz; a run has recorded observations of its own"
        )
    if files and (options.decisions, options.checkpoint) != (ProfileOptions.decisions, ProfileOptions.checkpoint):
        raise ConfigError("--decisions and --checkpoint are for runs, expected neither with a NIR file; leave them out")
    if not files and (options.reset is not None or options.fires_at_threshold):
        raise ConfigError(
            "--reset and --fires-at-threshold are for NIR files, expected neither for a run; leave them out"
        )
    for path in set(names) - set(files):  # all of them, before the first is profiled
        open_run(path)
    profiles: list[ProfileResult] = []
    # With several, --out is for the comparison; each one's own files go to its own folder.
    out = options.out if len(names) < 2 else None
    chosen: list[str | None] = [*names] or [None]  # None is the newest run
    with ProgressBars():
        for name in chosen:
            if name is not None and name in files:
                observations = cast(Path, options.observations)
                counted = profile_file(
                    name, observations, out, options.target, options.reset, options.fires_at_threshold
                )
            else:
                counted = profile(name, options.decisions, options.checkpoint, out, options.target)
            profiles.append(counted)
    report = profiles[0].folder / "report.html"
    if len(profiles) > 1:
        report = compare_profiles(profiles, options.out)
    if options.json:
        output.print_json(profiles[0].facts if len(profiles) == 1 else report.with_suffix(".json").read_text("utf-8"))
        return 0
    _print_profiles([one.facts for one in profiles])
    print(report)
    return 0


def _print_profiles(profiles: list[dict[str, Any]]) -> None:
    from switchmt_snn.viewing.tables import comparison_table, energy_table, fit_table, profile_table

    console = output.console()
    if len(profiles) > 1:
        console.print(comparison_table(profiles))
    for facts in profiles:
        if len(profiles) > 1:
            console.rule(facts["run"], align="left", characters="-")
        console.print(facts["headline"], soft_wrap=True)
        for task in facts["tasks"]:
            console.print(profile_table(task))
        if facts["targets"]:
            console.print(energy_table(facts))
        if facts["chips"]:
            console.print(fit_table(facts))
