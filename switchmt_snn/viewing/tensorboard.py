"""TensorBoard as one more observer: a view of the run's own logs, never needed by anything."""

from __future__ import annotations

from typing import Any

from switchmt_snn.errors import MissingExtraError
from switchmt_snn.learning.events import EpisodeEnded, Event, Measured
from switchmt_snn.learning.training import Training
from switchmt_snn.runs.folder import RunFolder


class TensorBoard:
    """Writes returns, losses and firing rates to ``<run>/tensorboard``."""

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
        if isinstance(event, EpisodeEnded):
            task = self._tasks[event.task]
            self._writer.add_scalar(f"return/{task}", event.episode_return, event.step)
            self._writer.add_scalar(f"length_steps/{task}", event.length_steps, event.step)
        elif isinstance(event, Measured):
            values = {"learning/loss": event.loss, "learning/q": event.q}
            values |= {f"firing_rate/{name}": layer.rate for name, layer in event.layers.items()}
            for name, value in values.items():
                if value is not None:
                    self._writer.add_scalar(name, value, event.step)
        if isinstance(event, EpisodeEnded | Measured):
            self._writer.flush()  # else points wait up to two minutes

    def note(self, text: str) -> None:
        """Not shown here."""

    def stop(self) -> None:
        """Close the files."""
        self._writer.close()
