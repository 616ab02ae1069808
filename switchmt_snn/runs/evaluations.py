"""The evaluations of a run: an evaluation's files are named by all that its scores depend on, so none replaces another.

evaluations/step-000000012000_breakout+pong_n30_seed10000_epsilon0.05_envs8.json  (and .csv)
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from switchmt_snn.acting.evaluation import Evaluation, EvaluationProtocol
from switchmt_snn.config import EvaluationConfig
from switchmt_snn.config.numbers import exact
from switchmt_snn.errors import ConfigError, RunFolderError, reason_of
from switchmt_snn.runs.files import file_name, json_text, made, parsed_json, write_atomically

CLEARLY_ABOVE = 1.96
"""Standard errors of the difference of two means by which an agent must lead random play to be called better."""


def evaluation_name(evaluation: Evaluation) -> str:
    """The name of an evaluation's files: step, tasks and protocol."""
    protocol = evaluation.protocol
    tasks = file_name(*sorted({row.task for row in evaluation.tasks}))
    played = f"n{protocol.episodes}_seed{protocol.seed}_epsilon{exact(protocol.epsilon)}_envs{protocol.num_envs}"
    statistics = f"_statistics{protocol.statistics_batches}" if protocol.statistics_batches else ""
    longest = protocol.max_episode_steps
    cut = "" if longest == EvaluationConfig.max_episode_steps else f"_longest{longest}"
    return f"{_step_name(evaluation.step)}_{tasks}_{played}{cut}{statistics}"


def played_as(
    evaluations: Iterable[dict[str, Any]], asked: EvaluationConfig, seed: int | None = None
) -> list[dict[str, Any]]:
    """The stored evaluations that were played as a config asks; what older files do not state counts as asked.

    The number of copies changes no score but by rounding: those with the asked one come last.

    Args:
        evaluations: summaries.
        asked: the settings.
        seed: in place of theirs.
    """
    wanted = {
        "episodes": asked.episodes,
        "epsilon": asked.epsilon,
        "seed": asked.seed if seed is None else seed,
        "max_episode_steps": asked.max_episode_steps,
    }
    fitting = [one for one in evaluations if all(one["protocol"].get(key, v) == v for key, v in wanted.items())]
    return sorted(fitting, key=lambda one: one["protocol"].get("num_envs") == min(asked.num_envs, asked.episodes))


class Evaluations:
    """The stored evaluations of a run folder, those of older versions (shorter names) included."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def save(self, evaluation: Evaluation) -> Path:
        """Write a summary (JSON) and the episodes (CSV); returns the CSV's path.

        Raises:
            WriteError: the folder cannot be written.
        """
        rows = [asdict(episode) for episode in evaluation.episodes]
        text = io.StringIO()
        writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        path = made(self.folder) / f"{evaluation_name(evaluation)}.csv"
        write_atomically(path, text.getvalue().encode())
        write_atomically(path.with_suffix(".json"), json_text(evaluation.to_dict(), indent=1).encode())
        return path

    def mean_returns(self, step: int, settings: EvaluationConfig) -> dict[str, float]:
        """Mean return of the agent by task, from evaluations of this step's weights with these settings."""
        means: dict[str, float] = {}
        for stored in played_as(self._at(step), settings):
            means |= {row["task"]: row["mean"] for row in stored["tasks"] if row["policy"] == "agent"}
        return means

    def best_known(self, step: int, task: str) -> dict[str, Any] | None:
        """What this step's weights are worth in a task: of its evaluations that of most weight.

        Returns:
            ``episodes``, ``score``, ``random_score``, ``better_than_random`` (None if standard errors are missing),
            ``decisions_per_episode`` and ``protocol`` (in words), or None.

        Raises:
            RunFolderError: a file is no evaluation.
        """
        found: dict[str, Any] | None = None
        best = (0, 0)
        for stored in self._at(step):
            rows = {row["policy"]: row for row in stored["tasks"] if row["task"] == task}
            if "agent" in rows and (weight := weight_of(stored, rows["agent"])) >= best:
                best = weight
                found = {
                    "episodes": rows["agent"]["episodes"],
                    "score": rows["agent"]["mean"],
                    "random_score": rows["random"]["mean"],
                    "better_than_random": better_than_random(stored, task),
                    "decisions_per_episode": rows["agent"]["mean_length_steps"],
                    "protocol": str(EvaluationProtocol.from_dict(stored["protocol"])),
                }
        return found

    def all(self) -> list[dict[str, Any]]:
        """Every stored summary (``step``, ``protocol``, ``tasks``) with its ``file``, by step, then by name.

        Raises:
            RunFolderError: a file is no evaluation.
        """
        return [{**_read(path), "file": path.name} for path in sorted(self.folder.glob("step-*.json"))]

    def _at(self, step: int) -> list[dict[str, Any]]:
        """The stored summaries of a step, in order of their names."""
        return [_read(path) for path in sorted(self.folder.glob(f"{_step_name(step)}_*.json"))]


def weight_of(stored: Mapping[str, Any], row: Mapping[str, Any]) -> tuple[int, int]:
    """By which of two evaluations of the same weights is shown: the episodes, and how long they may last."""
    return int(row["episodes"]), EvaluationProtocol.from_dict(stored["protocol"]).max_episode_steps


def better_than_random(stored: Mapping[str, Any], task: str) -> bool | None:
    """Whether an evaluation's agent leads random play clearly (``CLEARLY_ABOVE``); None if it does not say."""
    rows = {row["policy"]: row for row in stored["tasks"] if row["task"] == task}
    if not {"agent", "random"} <= rows.keys():
        return None
    agent, random = rows["agent"], rows["random"]
    if agent.get("standard_error") is None or random.get("standard_error") is None:
        return None
    spread = (float(agent["standard_error"]) ** 2 + float(random["standard_error"]) ** 2) ** 0.5
    return bool(agent["mean"] - random["mean"] > CLEARLY_ABOVE * spread)


def _step_name(step: int) -> str:
    return f"step-{step:012d}"


def _read(path: Path) -> dict[str, Any]:
    try:
        if not path.is_file():
            raise ValueError("it is no plain file")
        stored = dict(parsed_json(path.read_bytes()))
        stored = {
            "step": _count(stored["step"]),
            "protocol": dict(stored["protocol"]),
            "tasks": [dict(row) for row in stored["tasks"]],
        }
        _count(stored["protocol"].get("statistics_batches", 0))
        str(EvaluationProtocol.from_dict(stored["protocol"]))
        for row in stored["tasks"]:
            row["mean"] = math.nan if row["mean"] is None else _number(row["mean"])  # JSON has no NaN
            row["mean_length_steps"] = _number(row["mean_length_steps"])
            row["episodes"] = _count(row["episodes"])
            for key in ("median", "standard_error", "human_normalized", "mean_q"):  # some are not in older files
                row[key] = None if row.get(key) is None else _number(row[key])
            if not all(isinstance(row[key], str) and row[key].isprintable() for key in ("policy", "task")):
                raise ValueError("a policy or a task is no printable text")
    except (ArithmeticError, AttributeError, ConfigError, KeyError, OSError, TypeError, ValueError) as error:
        raise RunFolderError(
            f"{path} cannot be read ({reason_of(error):.80}), expected an evaluation; delete it, or evaluate again"
        ) from error
    return stored


def _number(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{value!s:.40} is not a finite number")
    return number


def _count(value: Any) -> int:
    if isinstance(value, bool) or int(value) != value or not 0 <= value < 2**62:
        raise ValueError(f"{value!s:.40} is not a whole number from 0")
    return int(value)
