"""TensorBoard and trackio as observers: views of the run's own logs, never needed by anything."""

from __future__ import annotations

import contextlib
import sys
from dataclasses import asdict
from typing import Any

from switchmt_snn.config import RecordingConfig
from switchmt_snn.errors import MissingExtraError
from switchmt_snn.learning.events import EpisodeEnded, Event, Measured
from switchmt_snn.learning.training import Training
from switchmt_snn.runs.folder import RunFolder


def values_of(event: Event, tasks: tuple[str, ...]) -> dict[str, float]:
    """What a dashboard shows of an event, by name: returns and lengths by task, loss, Q, firing rates by layer."""
    if isinstance(event, EpisodeEnded):
        task = tasks[event.task]
        return {f"return/{task}": event.episode_return, f"length_steps/{task}": event.length_steps}
    if isinstance(event, Measured):
        rates = {f"firing_rate/{name}": layer.rate for name, layer in event.layers.items()}
        values = {"learning/loss": event.loss, "learning/q": event.q, **rates}
        return {name: value for name, value in values.items() if value is not None}
    return {}


class TensorBoard:
    """Writes to ``<run>/tensorboard``."""

    def __init__(self) -> None:
        """Raises MissingExtraError if TensorBoard is not installed."""
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ModuleNotFoundError as error:
            remedy = "run: pip install 'switchmt-snn[tensorboard]'"
            raise MissingExtraError(
                f"recording.tensorboard is true and TensorBoard is not installed; {remedy}"
            ) from error
        self._writer_class: Any = SummaryWriter

    def start(self, training: Training, folder: RunFolder, resumed_at: int | None) -> None:
        """Open the files; points after a resumed step are replaced."""
        self._tasks = training.suite.names
        self._writer = self._writer_class(str(folder.path / "tensorboard"), purge_step=resumed_at)

    def __call__(self, event: Event) -> None:
        """Write points."""
        if values := values_of(event, self._tasks):
            for name, value in values.items():
                self._writer.add_scalar(name, value, event.step)
            self._writer.flush()  # else points wait up to two minutes

    def note(self, text: str) -> None:
        """Not shown here."""

    def stop(self) -> None:
        """Close the files."""
        self._writer.close()


class Trackio:
    """Writes to trackio's own database on this machine (``TRACKIO_DIR``), as project ``switchmt-snn``; what cannot be
    written is a warning there, and the run goes on."""

    def __init__(self) -> None:
        """Raises MissingExtraError if trackio is not installed."""
        try:
            import trackio
        except ModuleNotFoundError as error:
            remedy = "run: pip install 'switchmt-snn[trackio]'"
            raise MissingExtraError(f"recording.trackio is true and trackio is not installed; {remedy}") from error
        self._trackio: Any = trackio

    def start(self, training: Training, folder: RunFolder, resumed_at: int | None) -> None:
        """Begin a run of the folder's name; a run that is continued goes on in the same one."""
        self._tasks = training.suite.names
        with contextlib.redirect_stdout(sys.stderr):  # it prints; our stdout is the result
            self._run = self._trackio.init(
                project="switchmt-snn",
                name=folder.path.resolve().name,
                config=asdict(training.config),
                resume="never" if resumed_at is None else "allow",
                embed=False,
                auto_log_gpu=False,
                auto_log_cpu=False,
            )

    def __call__(self, event: Event) -> None:
        """Write points."""
        if values := values_of(event, self._tasks):
            self._run.log(values, step=event.step)

    def note(self, text: str) -> None:
        """Not shown here."""

    def stop(self) -> None:
        """Wait until all points are written."""
        with contextlib.redirect_stdout(sys.stderr):
            self._trackio.finish()


def chosen_dashboards(recording: RecordingConfig) -> list[TensorBoard | Trackio]:
    """Those that a config asks for."""
    return [*([TensorBoard()] if recording.tensorboard else []), *([Trackio()] if recording.trackio else [])]
