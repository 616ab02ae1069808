"""``switchmt-snn play``: film a run's agent beside its spikes."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import tyro

from switchmt_snn.cli.parsing import parse, split_one
from switchmt_snn.runs.files import file_name
from switchmt_snn.viewing import output


@dataclass(frozen=True)
class PlayOptions:
    """Record a video of a run's agent: the game beside spikes, Q-values and gains; every number as CSV and JSON."""

    task: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Which task; may be repeated, for tasks side by side. Default: the run's first."""
    episodes: int | None = None
    """Episodes of each task. Default: one, or as many as fit into --seconds."""
    seconds: float | None = None
    """Longest film in seconds. Default: 60, or until the --episodes end."""
    seed: int | None = None
    """Seed of environments and random actions. Default: the run's evaluation.seed."""
    epsilon: float | None = None
    """Share of random actions. Default: the run's evaluation.epsilon."""
    checkpoint: Literal["last", "best"] = "last"
    """Which weights."""
    runtime: Literal["torch", "onnx", "nir"] = "torch"
    """What plays. torch: the trained network. onnx: the run's ONNX files in onnxruntime. nir: its NIR files in the NIR
    interpreter."""
    out: Path | None = None
    """FILE.mp4, FILE.gif, or a folder for PNG frames. Default: RUN/films/TASK-step-N.mp4; with --live none."""
    fps: float | None = None
    """Frames (decisions) per second. Default: real time for Atari, else 15."""
    live: bool = False
    """Show the film in a window while it is made."""
    trust: bool = False
    """Import modules that the run names, although you did not make it: this runs their code."""
    json: bool = False
    """Print the film's facts as JSON."""


def command(argv: list[str]) -> int:
    """Run the command; returns its exit code."""
    run, rest = split_one(PlayOptions, argv, "play", PlayOptions())
    options = parse(PlayOptions, rest, "play", PlayOptions())
    from switchmt_snn.acting.evaluation import EvaluationProtocol
    from switchmt_snn.export.watching import watched_agent
    from switchmt_snn.runs.packing import open_run
    from switchmt_snn.viewing.film.film import FilmSettings, make_film
    from switchmt_snn.viewing.film.window import Window, require_screen

    if options.live:
        require_screen()
    path = open_run(run).path
    settings = FilmSettings(options.task, options.episodes, options.seconds, options.fps).require()
    agent = watched_agent(path, options.runtime, options.checkpoint)
    changes = {name: getattr(options, name) for name in ("seed", "epsilon") if getattr(options, name) is not None}
    config = agent.agent.config
    evaluation = replace(config.evaluation, episodes=options.episodes or 1, num_envs=1, **changes)
    names = tuple(agent.suite.names[agent.suite.index(name)] for name in options.task) or agent.suite.names[:1]
    protocol = EvaluationProtocol.of(evaluation, config.tasks, agent.step)
    path = open_run(path, to_write=True).path
    out = options.out
    if out is None and not options.live:
        runtime = "" if options.runtime == "torch" else f"-{options.runtime}"
        out = path / "films" / f"{file_name(*names)}-step-{agent.step}{runtime}.mp4"
    film = make_film(agent, protocol, settings, out, Window if options.live else None, note=_say)
    if film.stopped:
        _say(f"stopped after {film.frames:,} frames, which are kept")
    if options.json:
        output.print_json({"film": None if film.path is None else str(film.path), **film.facts})
        return 130 if film.stopped else 0
    for lane in film.facts["tasks"]:
        scores = ", ".join(f"{episode['score']:g}" for episode in lane["episodes"])
        print(f"{lane['task']}: {'returns ' + scores if scores else 'no episode ended'}")
    print(f"{film.frames:,} frames at {film.facts['fps']:g} per second")
    if film.path is not None:
        print(film.path)
    return 130 if film.stopped else 0


def _say(text: str) -> None:
    print(text, file=sys.stderr)
