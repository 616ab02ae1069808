"""Progress of a training: a live table in a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections import deque

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from switchmt_snn.config import METHOD_TRAITS
from switchmt_snn.drawing.numbers import duration
from switchmt_snn.learning.events import EpisodeEnded, Event, Measured, Stepped, SwitchDecided
from switchmt_snn.learning.switching import SwitchTo
from switchmt_snn.learning.training import Training
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.tasks.registry import suite_of
from switchmt_snn.viewing.health import ReturnsSeen, health_warnings

RETURN_WINDOW_EPISODES = 20
PLAIN_EVERY_S = 15.0
LIVE_EVERY_S = 0.5


class Progress:
    """An observer that shows where a run stands; see ``switchmt_snn.runs.run.Observer``."""

    def __init__(self, console: Console | None = None, first: str | None = None) -> None:
        """Write to ``console``, ``first`` above all else: once nothing can be refused any more."""
        self.console = console or Console()
        self._first = first
        self._live: Live | None = None
        self._epsilon = 1.0
        self._warming_up = False
        self._warnings: dict[str, str] = {}
        self._said: set[str] = set()  # a plain log says each warning once
        self._seen = ReturnsSeen()
        self._distance = ""
        self._shown_at = 0.0
        self._loss: float | None = None
        self._q: float | None = None

    def start(self, training: Training, folder: RunFolder, resumed_at: int | None) -> None:
        """Greet, and open the live table if there is a terminal."""
        self._training = training
        self._returns: list[deque[float]] = [deque(maxlen=RETURN_WINDOW_EPISODES) for _ in training.suite.names]
        self._speed = Speed(time.monotonic(), training.steps)
        if self._first is not None:
            self.note(self._first)
        config = training.config
        network, suite = config.network, suite_of(config.tasks)
        frames = f" ({config.total_steps * suite.frame_skip:,} emulator frames)" if suite.frames_per_s else ""
        where = f"continuing {folder.path} at step {resumed_at:,}" if resumed_at is not None else f"run {folder.path}"
        spiking = METHOD_TRAITS[network.method].spiking
        steps = f"T={network.timesteps}, {network.encoding} encoding, " if spiking else ""
        self.console.print(
            f"{where}: {network.method} on {', '.join(training.suite.names)}, {steps}"
            f"switching {config.switching.policy}, "
            f"{config.total_steps:,} agent steps{frames}, "
            f"{training.learner.device}",
            highlight=False,
            soft_wrap=True,
        )
        if self.console.is_terminal:
            self._live = Live(self._table(), console=self.console, refresh_per_second=4, transient=False)
            self._live.start()

    def __call__(self, event: Event) -> None:
        """Take an event in; redraw now and then."""
        if isinstance(event, Stepped):
            self._epsilon, self._warming_up = event.epsilon, event.warming_up
            self._show()
        elif isinstance(event, EpisodeEnded):
            self._returns[event.task].append(event.episode_return)
            self._seen.add(event.episode_return)
        elif isinstance(event, Measured):
            self._loss, self._q = event.loss, event.q
            warned = health_warnings(event, self._training.config, self._seen)
            self._warnings = {name: str(warning) for name, warning in warned.items()}
        elif isinstance(event, SwitchDecided) and event.decision.reason != "visit_over":
            self._distance = _distance(event)

    def note(self, text: str) -> None:
        """Print a line (above the live table)."""
        self.console.print(text, highlight=False, soft_wrap=True)

    def stop(self) -> None:
        """Draw the last state and close the live table."""
        if self._live is not None:
            self._live.update(self._table())
            self._live.stop()
            self._live = None
        else:
            self._print_line()

    def _show(self) -> None:
        now = time.monotonic()
        if now - self._shown_at < (LIVE_EVERY_S if self._live else PLAIN_EVERY_S):
            return
        self._shown_at = now
        if self._live is not None:
            self._live.update(self._table())
        else:
            self._print_line()

    def _rate(self) -> tuple[float, str]:
        """Steps per second lately, and the time left."""
        training = self._training
        rate = self._speed.per_second(time.monotonic(), training.steps)
        return rate, duration((training.config.total_steps - training.steps) / rate) if rate else "-"

    def _print_line(self) -> None:
        training = self._training
        rate, left = self._rate()
        tasks = ", ".join(
            f"{'>' if index == training.task else ''}{name} {_mean(self._returns[index])} "
            f"({training.steps_by_task[index]:,})"
            for index, name in enumerate(training.suite.names)
        )
        for name, line in self._health().items():
            if name not in self._said:
                self.console.print(f"  {line}", highlight=False, soft_wrap=True)
                self._said.add(name)
        self.console.print(
            f"step {training.steps:,}/{training.config.total_steps:,} {rate:.0f}/s left {left} "
            f"epsilon {self._epsilon:.3f} return (steps): {tasks}{self._learning()}",
            highlight=False,
            soft_wrap=True,
        )

    def _learning(self) -> str:
        return "" if self._loss is None else f" loss {self._loss:.4g} Q {self._q or 0.0:.3f}"

    def _health(self) -> dict[str, str]:
        lines = {name: f"warning: {text}" for name, text in self._warnings.items()}
        if self._warming_up:
            starts = self._training.config.learning.learning_starts_steps
            task = self._training.suite.names[self._training.task]
            lines[f"filling {task}"] = f"filling the replay of {task}: random actions until {starts:,} transitions"
        return lines

    def _table(self) -> Group:
        training = self._training
        rate, left = self._rate()
        table = Table(title_justify="left", expand=False)
        for name in ("task", "episodes", f"return (last {RETURN_WINDOW_EPISODES})", "steps", "epsilon", "switch"):
            table.add_column(name, justify="left" if name in ("task", "switch") else "right")
        for index, name in enumerate(training.suite.names):
            current = index == training.task
            table.add_row(
                f"> {name}" if current else f"  {name}",
                str(training.episodes_by_task[index]),
                _mean(self._returns[index]),
                f"{training.steps_by_task[index]:,}",
                f"{self._epsilon:.3f}" if current else "",
                f"{training.steps_in_visit:,} steps in visit {training.visit}; {self._distance}" if current else "",
                style="bold" if current else "",
            )
        status = Text(
            f"step {training.steps:,} of {training.config.total_steps:,}, {rate:.0f} steps/s, left {left}, "
            f"updates {training.learner.updates:,}{self._learning()}"
        )
        return Group(table, status, *(Text(line, style="yellow") for line in self._health().values()))


class Speed:
    """Steps per second over the newer half of the time since the start, at most ten minutes.

    A run is faster while its replays fill than afterwards; an average since the start would be wrong for hours.
    """

    LONGEST_S = 600.0

    def __init__(self, now_s: float, steps: int) -> None:
        self._started_s = now_s
        self._seen = deque([(now_s, steps)])

    def per_second(self, now_s: float, steps: int) -> float:
        """The speed at a moment, which becomes one of those that later ones are measured from; 0 at first."""
        oldest_s = now_s - min(self.LONGEST_S, (now_s - self._started_s) / 2)
        while len(self._seen) > 1 and self._seen[1][0] <= oldest_s:
            self._seen.popleft()
        then_s, before = self._seen[0]
        self._seen.append((now_s, steps))
        return (steps - before) / (now_s - then_s) if now_s > then_s else 0.0


def _mean(values: deque[float]) -> str:
    return f"{sum(values) / len(values):.2f}" if values else "-"


def _distance(event: SwitchDecided) -> str:
    """How near the last decision was to a switch: the criterion's summary, else its reason and its numbers."""
    decision = event.decision
    if isinstance(decision, SwitchTo):
        return f"came by {decision.reason}"
    numbers = ", ".join(f"{name} {value:.4g}" for name, value in decision.measured.items())
    reason = decision.reason.replace("_", " ")
    return decision.summary or (f"{reason} ({numbers})" if numbers else reason)
