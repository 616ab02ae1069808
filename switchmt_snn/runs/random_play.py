"""Random play that was evaluated before: kept beside the run, because no training changes it.

random_play/breakout_3f1c09aa52c4e7d1.json

The name holds a hash of everything that decides the episodes, and the file names it: the task and its settings, the
protocol, versions, processor, ROMs, and this package's own code that plays. If one of them differs, the episodes are
played again. Tasks with code from outside the suite's packages always are, because nothing tells all of their code.
"""

from __future__ import annotations

import hashlib
import json
import platform
from dataclasses import asdict, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from switchmt_snn import tasks as tasks_package
from switchmt_snn.acting import episodes as episodes_module
from switchmt_snn.acting import evaluation as evaluation_module
from switchmt_snn.acting.episodes import EpisodeScore
from switchmt_snn.acting.evaluation import EvaluationProtocol
from switchmt_snn.config import ExperimentConfig
from switchmt_snn.runs.environment import processor
from switchmt_snn.runs.files import file_name, json_text, made, parsed_json, sha256, write_atomically
from switchmt_snn.tasks.registry import suite_of
from switchmt_snn.tasks.suite import TaskSuite


class RandomPlay:
    """The kept episodes of one run under one protocol; a ``KnownEpisodes`` for ``evaluate_agent``."""

    def __init__(self, run: Path, config: ExperimentConfig, suite: TaskSuite, protocol: EvaluationProtocol) -> None:
        """Nothing is read yet.

        Args:
            run: the run's folder.
            config: the run's config.
            suite: its tasks.
            protocol: of the evaluation. Its epsilon does not matter: random play is all random.
        """
        self.folder = run / "random_play"
        self._config, self._suite, self._protocol = config, suite, protocol
        self._facts = _facts(config, protocol) if suite.versioned else None

    def read(self, task: str) -> list[EpisodeScore] | None:
        """The task's episodes; None if they are not known, or a file is damaged."""
        if self._facts is None:
            return None
        facts, path = self._of(task)
        try:
            stored = parsed_json(path.read_bytes())
            episodes = [EpisodeScore(**episode) for episode in stored["episodes"]]
        except (OSError, ValueError, KeyError, TypeError):
            return None
        whole = [episode.episode for episode in episodes] == list(range(self._protocol.episodes))
        return episodes if stored["decided_by"] == facts and whole else None

    def keep(self, task: str, episodes: list[EpisodeScore]) -> None:
        """Keep episodes that were played now; scores that JSON cannot hold (NaN) are not kept.

        Raises:
            WriteError: the folder cannot be written.
        """
        if self._facts is None or not all(np.isfinite(episode.score) for episode in episodes):
            return
        facts, path = self._of(task)
        made(self.folder)
        content = {"decided_by": facts, "episodes": [asdict(episode) for episode in episodes]}
        write_atomically(path, json_text(content, indent=1).encode())

    def _of(self, task: str) -> tuple[dict[str, Any], Path]:
        """What decides a task's episodes, and the file that holds them."""
        assert self._facts is not None
        index = self._suite.index(task)
        valid = self._suite.valid_actions_KA[index].tolist()
        facts = {"task": task, "index": index, "valid_actions": valid, **self._facts}
        return facts, self.folder / f"{file_name(task)}_{sha256(json_text(facts).encode())[:16]}.json"


def _facts(config: ExperimentConfig, protocol: EvaluationProtocol) -> dict[str, Any]:
    """Everything that decides random episodes of all tasks of a run, as JSON gives it back."""
    suite = suite_of(config.tasks)
    of_the_agent = ("epsilon", "statistics_batches")
    played = {name: value for name, value in asdict(protocol).items() if name not in of_the_agent}
    settings = {field.name: getattr(config.tasks, field.name) for field in fields(config.tasks)}
    settings.pop("num_envs")  # of training; the protocol has its own
    folder = Path(tasks_package.__file__ or "").parent
    code = [*sorted(folder.glob("*.py")), Path(episodes_module.__file__), Path(evaluation_module.__file__)]
    facts = {
        "protocol": played,
        "tasks": settings,
        "versions": {name: _version(name) for name in ("switchmt-snn", "numpy", *suite.packages)},
        "python": platform.python_version(),
        "processor": processor(),
        "registered": suite.registered,
        "files_sha256": {name: sha256(path.read_bytes()) for name, path in suite.files.items()},
        "code_sha256": hashlib.sha256(b"".join(path.read_bytes() for path in code)).hexdigest(),
    }
    return dict(json.loads(json_text(facts)))


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
