"""A film of a run's agent: it plays, and every decision becomes a frame and a row of numbers."""

from __future__ import annotations

import contextlib
import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from PIL import Image

from switchmt_snn.acting.episodes import EpisodeScore
from switchmt_snn.acting.evaluation import EvaluationProtocol
from switchmt_snn.acting.watching import WatchedAgent, gains_of
from switchmt_snn.errors import ConfigError
from switchmt_snn.machine.torch_settings import as_when_started
from switchmt_snn.runs.signals import stop_requests
from switchmt_snn.tasks.registry import suite_of
from switchmt_snn.viewing.film import panels
from switchmt_snn.viewing.film.canvas import MUTED, SMALL, Canvas
from switchmt_snn.viewing.film.layout import FOOT, MARGIN, Layout, canvas_size, layouts
from switchmt_snn.viewing.film.moments import Moment, Rehearsal, moments, rehearse
from switchmt_snn.viewing.film.panels import Names, Past, Seen
from switchmt_snn.viewing.film.raster import TimeAxis, rows_that_fit
from switchmt_snn.viewing.film.record import Record
from switchmt_snn.viewing.film.sinks import Sink, StopFilm, check_sink, open_sink

DEFAULT_SECONDS = 60.0
DEFAULT_FPS = 15.0
MOST_TASKS = 4
SAY_EVERY_S = 5.0


@dataclass(frozen=True)
class FilmSettings:
    """What is filmed.

    Attributes:
        tasks: names, side by side; empty takes the run's first.
        episodes: of each task; None takes as many as fit into ``seconds``.
        seconds: longest film; None ends with the episodes. With neither: one episode, at most ``DEFAULT_SECONDS``.
        fps: frames per second of the film; None takes real time where the tasks have a clock, else ``DEFAULT_FPS``.
    """

    tasks: tuple[str, ...] = ()
    episodes: int | None = None
    seconds: float | None = None
    fps: float | None = None

    def require(self) -> FilmSettings:
        """These settings.

        Raises:
            ConfigError: a number out of range, or too many tasks.
        """
        if self.episodes is not None and self.episodes < 1:
            raise ConfigError(f"--episodes is {self.episodes}, expected at least 1")
        for name, value, most in (("seconds", self.seconds, 86_400), ("fps", self.fps, 240)):
            if value is not None and not 0 < value <= most:  # NaN is refused, too
                raise ConfigError(f"--{name} is {value:g}, expected more than 0 and at most {most:,}")
        if len(self.tasks) > MOST_TASKS or len(set(self.tasks)) < len(self.tasks):
            raise ConfigError(f"--task names {', '.join(self.tasks)}, expected at most {MOST_TASKS}, each once")
        return self

    def bounds(self, fps: float) -> tuple[int | None, int | None]:
        """Episodes of each task, and frames."""
        episodes, seconds = self.episodes, self.seconds
        if episodes is None and seconds is None:
            episodes, seconds = 1, DEFAULT_SECONDS
        return episodes, None if seconds is None else max(1, round(seconds * fps))


@dataclass(frozen=True)
class Film:
    """A film that was made.

    Attributes:
        path: the video, or the folder of frames; None if it was only shown.
        frames: how many.
        stopped: whether Ctrl-C ended it early; what was filmed by then is kept.
        facts: the content of its JSON file.
    """

    path: Path | None
    frames: int
    stopped: bool
    facts: dict[str, Any]


class Lane:
    """A task of the film: its play, what is remembered of it, and where it is drawn."""

    def __init__(
        self, agent: WatchedAgent, task: int, play: Iterator[Moment], layout: Layout, rehearsal: Rehearsal
    ) -> None:
        suite, settings = agent.suite, agent.agent.config.network
        self.play, self.layout = play, layout
        self.over = False
        self.episodes: list[EpisodeScore] = []
        self.axis = TimeAxis(layout.spikes.left, layout.spikes.width, max(1, rehearsal.timesteps))
        boxes = panels.raster_boxes(layout.spikes, tuple(rehearsal.order)) if rehearsal.order else {}
        self.names = Names(
            task=suite.names[task],
            actions=suite.action_names,
            valid_A=suite.valid_actions_KA[task],
            about=(settings.method, f"step {agent.step:,}", f"T = {settings.timesteps}, {agent.runtime}"),
            gains=gains_of(agent.agent, task),
            rows={name: rehearsal.rows(name, rows_that_fit(box.height)) for name, box in boxes.items()},
            neurons=rehearsal.neurons,
            spiking=agent.agent.network.spiking,
        )
        self.seen: Seen | None = None

    def advance(self) -> Moment | None:
        """Play a decision; None if the play is over, and what was last seen stays."""
        moment = next(self.play, None)
        if moment is None:
            self.over = True
            return None
        if self.seen is None:
            self.seen = Seen(moment, deque(maxlen=self.axis.decisions))
        insight = moment.insight
        self.seen.moment = moment
        self.seen.past.append(
            Past(
                drawn={name: insight.active[name][:, rows] for name, rows in self.names.rows.items()},
                rates=moment.rates(),
                q_A=insight.q_A,
                value=insight.value,
                reward=moment.reward,
                begins=moment.step == 0,
            )
        )
        if moment.ended is not None:
            self.episodes.append(moment.ended)
        return moment

    def draw(self, canvas: Canvas) -> None:
        """Draw what is seen."""
        layout, names, seen = self.layout, self.names, self.seen
        assert seen is not None, "drawn before the first decision"
        panels.draw_head(canvas, layout.head, names, seen.moment, layout.compact)
        panels.draw_game(canvas, layout.game, seen.moment)
        if names.gains:
            panels.draw_gains(canvas, layout.gains, names, layout.compact)
        panels.draw_values(canvas, layout.values, names, seen, layout.compact)
        if layout.rates is not None:
            panels.draw_rates(canvas, layout.rates, names, seen)
        panels.draw_spikes(canvas, layout.spikes, names, seen, self.axis, layout.compact)
        panels.draw_trace(canvas, layout.trace, seen, self.axis, layout.compact)


@as_when_started()
def make_film(
    agent: WatchedAgent,
    protocol: EvaluationProtocol,
    settings: FilmSettings,
    out: Path | None,
    shown: Callable[[tuple[int, int], float], Sink] | None = None,
    note: Callable[[str], None] = lambda text: None,
) -> Film:
    """Play a run's agent and film it.

    Args:
        agent: who plays, watched.
        protocol: epsilon, seed and longest episode; episodes are those of an evaluation.
        settings: tasks, length and speed.
        out: ``.mp4``, ``.gif``, or a name without ending for a folder of PNG frames; numbers go beside it. None keeps
            nothing.
        shown: opens what also gets every frame, from the frames' size and the speed: a window.
        note: told in a line what goes on.

    Raises:
        ConfigError: settings out of range, or another ending of ``out``.
        MissingExtraError: a package that videos or pictures need is not installed.
    """
    suite = agent.suite
    names = settings.require().tasks or suite.names[:1]
    tasks = tuple(suite.index(name) for name in names)
    if out is not None:
        check_sink(out)
    fps = settings.fps or suite_of(agent.agent.config.tasks).decisions_per_s or DEFAULT_FPS
    episodes, most_frames = settings.bounds(fps)
    rehearsal = rehearse(agent, tasks, protocol)
    streams = len(gains_of(agent.agent, tasks[0]))
    with contextlib.ExitStack() as closing:
        lanes = []
        for task, layout in zip(tasks, layouts(len(tasks), streams, len(rehearsal.order)), strict=True):
            play = closing.enter_context(contextlib.closing(moments(agent, task, protocol, episodes)))
            lanes.append(Lane(agent, task, play, layout, rehearsal))
        size = canvas_size(len(tasks))
        unfinished = closing.enter_context(contextlib.ExitStack())
        window = sink = record = None
        if shown is not None:
            window = shown(size, fps)
            unfinished.callback(window.discard)
        if out is not None:
            sink = open_sink(out, size, fps)
            unfinished.callback(sink.discard)
            record = Record(*_beside(out), suite.action_names, tuple(rehearsal.order))
            unfinished.callback(record.discard)
        director = _Director(lanes, protocol, window, sink, record, note)
        with stop_requests() as stop:
            director.run(most_frames, stop)
        film = _finish(director, agent, out, fps)
        unfinished.pop_all()
        return film


class _Director:
    """Advances every lane by a decision per frame, until all are over or the film is long enough."""

    def __init__(
        self,
        lanes: list[Lane],
        protocol: EvaluationProtocol,
        window: Sink | None,
        sink: Sink | None,
        record: Record | None,
        note: Callable[[str], None],
    ) -> None:
        self.lanes, self.protocol = lanes, protocol
        self.window, self.sink, self.record, self.note = window, sink, record, note
        self.frames = 0
        self.stopped = False

    def run(self, most_frames: int | None, stop: Callable[[], bool]) -> None:
        """Make the frames; ``stop`` is asked before each."""
        began = said = time.monotonic()
        while self.frames != most_frames and not stop():
            moments_now = [(lane, lane.advance()) for lane in self.lanes if not lane.over]
            if all(moment is None for _, moment in moments_now):
                return
            image = self._drawn()
            if self.sink is not None:
                self.sink.add(image)
            for lane, moment in moments_now:
                if moment is not None and self.record is not None:
                    self.record.add(self.frames, lane.names, moment)
            self.frames += 1
            if self.window is not None:
                try:
                    self.window.add(image)
                except StopFilm:
                    return
            if time.monotonic() - said > SAY_EVERY_S:
                said = time.monotonic()
                self.note(_progress(self.frames, most_frames, said - began))
        self.stopped = stop()

    def _drawn(self) -> Image.Image:
        canvas = Canvas(*canvas_size(len(self.lanes)))
        for lane in self.lanes:
            lane.draw(canvas)
        _draw_foot(canvas, self.protocol)
        return canvas.image


def _progress(frames: int, most: int | None, wall_s: float) -> str:
    speed = frames / wall_s
    left = "" if most is None else f", at most {math.ceil((most - frames) / speed):,} s left"
    of = "" if most is None else f" of at most {most:,}"
    return f"frame {frames:,}{of}, {speed:.0f} frames/s{left}"


def _draw_foot(canvas: Canvas, protocol: EvaluationProtocol) -> None:
    width, height = canvas.image.size
    played = f"epsilon {protocol.epsilon:g}, seed {protocol.seed}, {', '.join(protocol.environment) or protocol.suite}"
    text = f"{played} · a frame is a decision; rows: the neurons whose spikes vary most"
    canvas.text((MARGIN, height - FOOT), text, SMALL, MUTED, width=width - 2 * MARGIN)


def _beside(out: Path) -> tuple[Path, Path]:
    """The CSV and the JSON of a film: of a folder of frames, within it."""
    base = out if out.suffix else out / "film"
    return base.with_suffix(".csv"), base.with_suffix(".json")


def _finish(director: _Director, agent: WatchedAgent, out: Path | None, fps: float) -> Film:
    """Close the files and say what they hold."""
    config = agent.agent.config
    lanes = [
        {
            "task": lane.names.task,
            "episodes": [asdict(episode) for episode in lane.episodes],
            "gains": {name: gains.tolist() for name, gains in lane.names.gains.items()},
            "layers": {
                name: {"neurons": lane.names.neurons[name], "drawn": rows.tolist()}
                for name, rows in lane.names.rows.items()
            },
        }
        for lane in director.lanes
    ]
    facts = {
        "run": config.name,
        "method": config.network.method,
        "timesteps": config.network.timesteps,
        "training_step": agent.step,
        "runtime": agent.runtime,
        "protocol": asdict(director.protocol),
        "fps": fps,
        "frames": director.frames,
        "size": list(canvas_size(len(director.lanes))),
        "actions": list(agent.suite.action_names),
        "tasks": lanes,
    }
    for sink in (director.window, director.sink):
        if sink is not None:
            sink.close()
    if director.record is not None:
        director.record.close(facts)
    return Film(out, director.frames, director.stopped, facts)
