"""Everything that the page of a run says, as plain values: the content of report.json."""

from __future__ import annotations

import math
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

from switchmt_snn.acting.evaluation import EvaluationProtocol
from switchmt_snn.config import METHOD_TRAITS, to_dict
from switchmt_snn.drawing.chart import Chart, Timeline
from switchmt_snn.drawing.numbers import duration
from switchmt_snn.runs.listing import RETURN_WINDOW_EPISODES, folder_bytes
from switchmt_snn.viewing.health import ReturnsSeen, health_warnings
from switchmt_snn.viewing.report.curves import running_means
from switchmt_snn.viewing.report.figures import layer_figures, learning_figures, training_figures
from switchmt_snn.viewing.report.sources import Sources
from switchmt_snn.viewing.report.switching import switching_facts, switching_figures
from switchmt_snn.viewing.tables import published_rows

FORMAT = 1
CLEAR_ERRORS = 2.0
"""The agent is better than random play if their means differ by more than so many standard errors of the difference."""
_LINKED = (
    ("profile: spikes, operations, energy", "profile/report.html"),
    ("model card", "MODEL_CARD.md"),
    ("export: what was compared", "export/parity.json"),
    ("comparison of runs", "comparison.html"),
)
_VIDEOS = ("*.mp4", "*.gif", "videos/*.mp4", "videos/*.gif")
_PARTS = ("checkpoints", "recordings", "evaluations", "export", "profile", "tensorboard")


def figures_of(run: Sources) -> dict[str, list[Chart | Timeline]]:
    """The figures by section."""
    return {
        "learning": list(learning_figures(run)),
        "switching": switching_figures(run),
        "training": list(training_figures(run)),
        "layers": list(layer_figures(run)),
    }


def run_facts(run: Sources, figures: dict[str, list[Chart | Timeline]], out: Path) -> dict[str, Any]:
    """The facts of a run.

    Args:
        run: what was read of it.
        figures: from ``figures_of``.
        out: folder of the page, from which its links go.
    """
    verdicts = [_verdict(run, task) for task in run.tasks]
    spiking = METHOD_TRAITS[run.config.network.method].spiking
    return {
        "format": FORMAT,
        "run": run.folder.path.resolve().name,
        "headline": _headline(run, verdicts),
        **{key: value for key, value in run.summary.to_dict().items() if key not in ("path", "scores")},
        "timesteps": run.config.network.timesteps if spiking else None,
        "encoding": run.config.network.encoding if spiking else None,
        "policy": run.config.switching.policy,
        "updates": run.history.updates,
        "environment": {
            key: run.environment.get(key)
            for key in (
                "command",
                "created",
                "platform",
                "processor",
                "cores",
                "torch_threads",
                "device",
                "device_name",
            )
        },
        "versions": run.environment.get("versions", {}),
        "calls": len(run.history.calls),
        "steps_per_s": run.summary.steps / run.summary.seconds if run.summary.seconds else None,
        "peak_memory_bytes": run.history.peak_memory_bytes,
        "sizes": _sizes(run.folder.path),
        "returns": [_returns(run, index) for index in range(len(run.tasks))],
        "verdicts": verdicts,
        "switching": switching_facts(run),
        "warnings": _warnings(run),
        "evaluations": [_evaluation(one) for one in run.evaluations],
        "published": _published(run),
        "links": _links(run.folder.path, out),
        "settings": dict(_flat(to_dict(run.config))),
        "figures": {section: [asdict(one) for one in ones] for section, ones in figures.items()},
    }


def _headline(run: Sources, verdicts: list[dict[str, Any]]) -> str:
    summary = run.summary
    took = f" after {duration(summary.seconds)} (h:m:s)" if summary.seconds else ""
    where = f"{summary.steps:,} of {summary.total_steps:,} agent steps{took}"
    state = {"running": f"Running: {where}", "finished": f"Finished: {where}", "stopped": f"Stopped at {where}"}
    judged = [one for one in verdicts if one["verdict"] is not None]
    if not judged:
        return f"{state[summary.status]}. Not evaluated yet."
    told = "; ".join(f"{one['task']}: {one['verdict']}" for one in judged)
    return f"{state[summary.status]}. Newest evaluation: {told}."


def _verdict(run: Sources, task: str) -> dict[str, Any]:
    """Whether the agent is better than random play, by the newest evaluation of the task."""
    found = run.newest_evaluation(task)
    facts: dict[str, Any] = {"task": task, "verdict": None, "agent": None, "random": None, "step": None}
    if found is None:
        return facts
    agent, random = found["rows"]["agent"], found["rows"].get("random")
    facts |= {"step": found["step"], "agent": agent["mean"], "random": None if random is None else random["mean"]}
    if random is None:
        return facts | {"verdict": "no random play to compare with"}
    errors = (agent["standard_error"], random["standard_error"])
    difference = agent["mean"] - random["mean"]
    if None in errors:
        return facts | {"verdict": "one episode says nothing"}
    spread = CLEAR_ERRORS * math.hypot(*errors)
    word = "better than" if difference > spread else "worse than" if difference < -spread else "no better than"
    return facts | {"verdict": f"{word} random play", "standard_error": math.hypot(*errors)}


def _returns(run: Sources, task: int) -> dict[str, Any]:
    """First, newest and best running mean of training returns."""
    episodes = run.episodes_of(task)
    returns = [one.episode_return for one in episodes]
    means = running_means(returns, RETURN_WINDOW_EPISODES)[RETURN_WINDOW_EPISODES - 1 :]
    measured = run.history.measured
    return {
        "task": run.tasks[task],
        "steps": measured[-1].steps_by_task[task] if measured else None,
        "episodes": len(episodes),
        "first_mean": means[0] if means else None,
        "newest_mean": means[-1] if means else None,
        "best_mean": max(means, default=None),
        "longest_steps": max((one.length_steps for one in episodes), default=None),
    }


def _warnings(run: Sources) -> list[dict[str, Any]]:
    """What looked wrong at a measurement, by its name: when first and last, how often, the newest words."""
    found: dict[str, dict[str, Any]] = {}
    returns, episodes = ReturnsSeen(), iter(run.history.episodes)
    following = next(episodes, None)
    for measured in run.history.measured:
        while following is not None and following.step <= measured.step:
            returns.add(following.episode_return)
            following = next(episodes, None)
        for name, warned in health_warnings(measured, run.config, returns).items():
            one = found.setdefault(name, {"name": name, "first_step": measured.step, "times": 0})
            one |= {"last_step": measured.step, "times": one["times"] + 1, "text": str(warned)}
            one["task"] = run.tasks[measured.task]
    count = len(run.history.measured)
    last = run.history.measured[-1].step if count else None
    return [{**one, "of": count, "lasts": one["last_step"] == last} for one in found.values()]


def _evaluation(stored: dict[str, Any]) -> dict[str, Any]:
    protocol = EvaluationProtocol.from_dict(stored["protocol"])
    return {"step": stored["step"], "file": stored["file"], "protocol": str(protocol), "rows": stored["tasks"]}


def _published(run: Sources) -> list[dict[str, Any]]:
    if run.suite is None:
        return []
    sources = {row.policy: row.source for row in run.suite.published}
    return [
        {"policy": policy, "task": task, "mean": mean, "source": sources[policy]}
        for policy, task, mean in published_rows(run.suite, list(run.tasks))
    ]


def _sizes(path: Path) -> list[dict[str, Any]]:
    return [{"part": part, "bytes": folder_bytes(path / part)} for part in _PARTS if (path / part).is_dir()]


def _links(path: Path, out: Path) -> list[dict[str, str]]:
    """Other files of the run that people open, as addresses from the page's folder."""
    found = [(title, path / name) for title, name in _LINKED]
    found += [(f"video: {file.name}", file) for pattern in _VIDEOS for file in sorted(path.glob(pattern))]
    found += [
        (f"file: {file.name}", file) for kind in ("onnx", "nir") for file in sorted(path.glob(f"export/*.{kind}"))
    ]
    return [
        {"title": title, "href": Path(os.path.relpath(file, out)).as_posix()} for title, file in found if file.exists()
    ]


def _flat(values: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    pairs: list[tuple[str, Any]] = []
    for key, value in values.items():
        pairs += _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else [(prefix + key, value)]
    return pairs
