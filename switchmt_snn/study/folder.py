"""The folder of a study, and how far its trials are.

trials.json  configs/NAME.yaml  trials/NAME/ (run folders)  logs/NAME.log  attempts.jsonl
and what the report writes: tables.md  study.json  trials.csv  scores.csv  curves.csv  report.html  report.json
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import filelock

from switchmt_snn.config import ExperimentConfig, differences, load_config, to_dict, to_yaml
from switchmt_snn.config.trust import SIGNATURE, allow, is_signed, modules_in, require_trusted, signature_of
from switchmt_snn.errors import ConfigError, RunFolderError, SwitchMTError
from switchmt_snn.runs.evaluations import played_as
from switchmt_snn.runs.files import json_text, parsed_json, write_atomically, writing
from switchmt_snn.runs.folder import RunFolder, locked
from switchmt_snn.study.grid import Study, Trial, folder_name

STUDIES = Path("runs") / "studies"
_TAIL_BYTES = 65_536
"""Bytes at the end of a log that hold its last whole line."""


@dataclass(frozen=True)
class Attempt:
    """One process of a trial that has ended.

    Attributes:
        code: its exit code; negative: the signal that ended it.
        steps: agent steps that it made.
        asked: whether the study asked it to stop.
    """

    trial: str
    code: int
    seconds: float
    steps: int
    asked: bool
    ended: str

    @property
    def failed(self) -> bool:
        """Whether it ended badly by itself."""
        return self.code != 0 and not self.asked


@dataclass(frozen=True)
class Progress:
    """How far a trial is: ``finished``, ``running``, ``failed``, ``stopped`` (it has begun), or ``waiting``."""

    trial: Trial
    status: str
    steps: int


class StudyFolder:
    """Paths and facts of a study on the disk; reading needs no lock."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def run(self, trial: Trial) -> Path:
        """The run folder of a trial."""
        return self.path / "trials" / trial.name

    def config(self, trial: Trial) -> Path:
        """The config that a trial is trained with."""
        return self.path / "configs" / f"{trial.name}.yaml"

    def log(self, trial: Trial) -> Path:
        """What the trial's processes printed."""
        return self.path / "logs" / f"{trial.name}.log"

    @property
    def is_study(self) -> bool:
        """Whether a study lives here."""
        try:
            return (self.path / "trials.json").is_file()
        except (OSError, ValueError):  # a path that no file system takes
            return False

    def require(self) -> StudyFolder:
        """This folder, if it holds a study.

        Raises:
            RunFolderError: it does not.
        """
        if not self.is_study:
            raise RunFolderError(f"no study in {self.path}, expected one; begin it with: switchmt-snn study CONFIG")
        return self

    def prepare(self, study: Study) -> None:
        """Make the folder of a new study, or check that the one there is the same; trials may be added.

        Raises:
            ConfigError: a trial that is here has another config, or is not in the study.
            RunFolderError: the folder holds something else, or cannot be written.
        """
        with writing(self.path, "--folder"):
            self.path.mkdir(parents=True, exist_ok=True)
            if self.is_study:
                self.require_same(study)
            else:
                stranger = next((one.name for one in self.path.iterdir() if one.name not in _BEGINNING), None)
                if stranger is not None:
                    raise RunFolderError(
                        f"{self.path} holds {stranger!r} but no study, expected an empty or new folder; name another "
                        "one with --folder"
                    )
            for name in ("trials", "configs", "logs"):
                (self.path / name).mkdir(exist_ok=True)
            for trial in study.trials:
                text = to_yaml(trial.config).encode()
                if not self.config(trial).is_file() or self.config(trial).read_bytes() != text:
                    write_atomically(self.config(trial), text)
            write_atomically(self.path / "trials.json", json_text(_listed(study), indent=1).encode())

    def require_same(self, study: Study) -> None:
        """Refuse a study that is not the one in this folder; trials may be added.

        Raises:
            ConfigError: a trial that is here has another config, or is not in the study.
            RunFolderError: there is no study here, or its trials.json cannot be read.
        """
        self.require()
        known = {trial.name: trial for trial in study.trials}
        with self._reading_trials() as listing:
            stored = [folder_name(one["name"]) for one in listing["trials"]]
        gone = [name for name in stored if name not in known]
        if gone:
            raise ConfigError(
                f"{self.path} holds trials that are not in the study: {', '.join(gone[:5])}, expected the same study "
                "(seeds and variants may be added); name another folder with --folder"
            )
        for trial in map(known.__getitem__, stored):
            path = self.config(trial)
            changed = differences(load_config(path, stored=True), trial.config) if path.is_file() else {}
            if changed:
                shown = ", ".join(f"{key} ({old!r} -> {new!r})" for key, (old, new) in sorted(changed.items())[:5])
                raise ConfigError(
                    f"{self.path} holds {trial.name} with another config: {shown}; expected the same config; name "
                    "another folder with --folder"
                )

    def study(self) -> Study:
        """The study as it was begun.

        Raises:
            RunFolderError: there is none, its trials.json cannot be read, or the config of a trial is missing.
        """
        self.require()
        with self._reading_trials() as stored:
            trials = tuple(
                Trial(folder_name(one["name"]), str(one["variant"]), int(one["seed"]), self._stored_config(one["name"]))
                for one in stored["trials"]
            )
            modules = _modules_of(trials)
            if is_signed(modules, stored.get(SIGNATURE)):
                allow(modules)
            return Study(str(stored["name"]), trials, dict(stored["references"]), str(stored["baseline"]))

    @contextmanager
    def _reading_trials(self) -> Iterator[Any]:
        """What trials.json says; what a caller cannot make of it is an error of the folder."""
        path = self.path / "trials.json"
        try:
            yield parsed_json(path.read_bytes())
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise RunFolderError(f"{path} cannot be read ({error!s:.80}), expected a study's list of trials") from error

    def _stored_config(self, name: str) -> ExperimentConfig:
        path = self.path / "configs" / f"{name}.yaml"
        if not path.is_file():
            raise RunFolderError(
                f"{path} is missing, expected the config of every trial; write it again with: "
                f"switchmt-snn study CONFIG --folder {shlex.quote(str(self.path))}"
            )
        return load_config(path, stored=True)

    def lock(self) -> filelock.BaseFileLock:
        """Take the study for this process.

        Raises:
            RunFolderError: another process has it, or the folder cannot be written.
        """
        return locked(self.path, "study", "--folder")

    def note_attempt(self, attempt: Attempt) -> None:
        """Append a line to attempts.jsonl.

        Raises:
            WriteError: the system refused.
        """
        path = self.path / "attempts.jsonl"
        with writing(path), path.open("a", encoding="utf-8") as stream:
            stream.write(json_text(vars(attempt)) + "\n")

    def attempts(self) -> list[Attempt]:
        """All attempts so far; a last line without its end, from a crash, is left out.

        Raises:
            RunFolderError: a line cannot be read.
        """
        path = self.path / "attempts.jsonl"
        text = path.read_text("utf-8") if path.is_file() else ""
        try:
            return [Attempt(**parsed_json(line)) for line in text[: text.rfind("\n") + 1].splitlines()]
        except (ValueError, TypeError) as error:
            raise RunFolderError(f"{path} cannot be read ({error!s:.80}), expected the study's attempts") from error

    def progress(self, study: Study) -> list[Progress]:
        """How far every trial is."""
        last = {attempt.trial: attempt for attempt in self.attempts()}
        found = []
        for trial in study.trials:
            run = TrialRun(self.run(trial))
            if run.folder.in_use:
                status = "running"
            elif run.final is not None:
                status = "finished"
            elif trial.name in last and last[trial.name].failed:
                status = "failed"
            else:
                status = "stopped" if run.folder.is_run else "waiting"
            found.append(Progress(trial, status, run.steps))
        return found


_BEGINNING = {"study.lock", "trials", "configs", "logs"}
"""What a study that was killed while its folder was made may have left."""


def require_trusted_trials(trials: Iterable[Trial]) -> None:
    """Refuse trials with modules that this user does not trust: their processes are given configs, which they trust.

    Raises:
        UntrustedError: naming the folder and its modules.
    """
    require_trusted(_modules_of(trials))


def _modules_of(trials: Iterable[Trial]) -> tuple[str, ...]:
    """Modules outside this package that trials name."""
    return modules_in([to_dict(trial.config) for trial in trials])


def _signature(study: Study) -> dict[str, str]:
    """What says that this user made the study; nothing if it names no module, or no key can be kept."""
    modules = _modules_of(study.trials)
    with suppress(OSError):
        return {SIGNATURE: signature_of(modules)} if modules else {}
    return {}


def _listed(study: Study) -> dict[str, Any]:
    trials = [{"name": one.name, "variant": one.variant, "seed": one.seed} for one in study.trials]
    return {
        "format": 1,
        "name": study.name,
        "baseline": study.baseline,
        "references": study.references,
        "trials": trials,
        **_signature(study),
    }


class TrialRun:
    """What the study needs to know of a run folder, read without its replay and without PyTorch's tensors."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.folder = RunFolder(path)

    @property
    def steps(self) -> int:
        """The newest step that a log or a checkpoint names; 0 before the first."""
        stored = [_step_of(path.name) for path in (self.path / "checkpoints").glob("step-*")]
        return max([_last_logged(self.path), *stored], default=0)

    @cached_property
    def config(self) -> ExperimentConfig | None:
        """The run's config; None before it has one."""
        try:
            return self.folder.config() if self.folder.is_run else None
        except SwitchMTError:
            return None

    @cached_property
    def final(self) -> dict[str, Any] | None:
        """The evaluation with which the training ended (``step``, ``protocol``, ``tasks``, ``file``); None before that.

        A run ends at ``total_steps``, or when ``evaluation.stop_at_returns`` is reached; then other episodes are
        played, those of the next seed. A run whose checkpoints were left out, to keep its numbers only, ended at its
        last evaluation.
        """
        config = self.config
        if config is None:
            return None
        evaluation = config.evaluation
        stored = [_step_of(path.name) for path in (self.path / "checkpoints").glob("step-*")]
        last = max(stored or [one["step"] for one in self.folder.evaluations.all()], default=-1)
        if last < config.total_steps and not evaluation.stop_at_returns:
            return None
        seed = evaluation.seed if last >= config.total_steps else evaluation.seed + 1
        for one in reversed(played_as(self.folder.evaluations.all(), evaluation, seed)):
            tasks = {row["task"] for row in one["tasks"] if row["policy"] == "agent"}
            if one["step"] == last and tasks == set(config.tasks.names):
                return dict(one)
        return None


def _step_of(name: str) -> int:
    digits = name.removeprefix("step-")
    return int(digits) if digits.isdigit() else 0


def _last_logged(path: Path) -> int:
    """The newest step of episodes.csv and metrics.jsonl, from their ends only: the study asks often."""
    steps = [0]
    for name in ("episodes.csv", "metrics.jsonl"):
        for line in reversed(_last_lines(path / name)):
            try:
                steps.append(int(parsed_json(line)["step"] if name.endswith("jsonl") else line.split(",", 1)[0]))
                break
            except (ValueError, KeyError, TypeError):
                continue  # the header, or part of a line
    return max(steps)


def _last_lines(path: Path) -> list[str]:
    """The last whole lines of a file; none if it is not there."""
    try:
        with path.open("rb") as stream:
            size = stream.seek(0, 2)
            stream.seek(max(0, size - _TAIL_BYTES))
            content = stream.read()
    except OSError:
        return []
    return content[: content.rfind(b"\n") + 1].decode("utf-8", "replace").splitlines()


def moment() -> str:
    """Now, ISO 8601 with the zone."""
    return datetime.now().astimezone().isoformat(timespec="seconds")
