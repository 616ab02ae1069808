"""Progress of commands other than training: what is told, to whom, and how it looks."""

from __future__ import annotations

import io
import threading
from pathlib import Path

import pytest
from rich.console import Console

from switchmt_snn.machine.progress import Work, listening, progress_of
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.runs.listing import list_runs
from switchmt_snn.study.replayed import replay_policies
from switchmt_snn.viewing.progress_bar import FIRST_LINE_S, LINES_EVERY_S, ProgressBars
from switchmt_snn.viewing.report.page import write_report

RUNS = Path(__file__).parents[1] / "fixtures" / "runs"


class Clock:
    """A time that only the test moves."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def plain() -> Console:
    """A console that is no terminal."""
    return Console(file=io.StringIO(), width=100)


def written(console: Console) -> list[str]:
    """The lines on it."""
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue().splitlines()


def test_nobody_listens_in_a_library(capfd: pytest.CaptureFixture[str]) -> None:
    with progress_of("counting", 3, "decisions") as work:
        work.advance(3)
    assert capfd.readouterr() == ("", "")


def test_a_plain_log_gets_a_line_now_and_then() -> None:
    clock, console = Clock(), plain()
    with ProgressBars(console, clock), progress_of("playing pong", 40, "episodes") as work:
        work.advance()  # too early for a line
        clock.now_s = FIRST_LINE_S
        work.advance(9)
        clock.now_s += LINES_EVERY_S - 1
        work.advance(5)
        clock.now_s += 1
        work.advance(5)
    assert written(console) == [
        "playing pong: 10 of 40 episodes, left 00:00:06",
        "playing pong: 20 of 40 episodes, left 00:00:17",
    ]


def test_short_and_finished_work_says_nothing() -> None:
    clock, console = Clock(), plain()
    with ProgressBars(console, clock), progress_of("playing pong", 2, "episodes") as work:
        work.advance()
        clock.now_s = 60.0
        work.advance()
    assert written(console) == []


def test_a_terminal_gets_bars_and_is_clean_afterwards() -> None:
    console = Console(file=io.StringIO(), width=100, force_terminal=True)
    with (
        ProgressBars(console),
        progress_of("recording [pong]", 4, "decisions") as outer,
        progress_of("comparing", 2, "decisions") as inner,
    ):
        outer.advance(2)
        inner.advance()
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "recording [pong]" in text
    assert "comparing" in text
    assert text.rstrip("\r").endswith("\x1b[2K\x1b[?25h")  # the last line is emptied, and the cursor is back


def test_it_advances_from_many_threads_and_never_beyond_its_end() -> None:
    class Heard:
        seen: list[int] = []  # noqa: RUF012

        def begun(self, work: Work) -> None:
            pass

        def advanced(self, work: Work) -> None:
            self.seen.append(work.done)

        def ended(self, work: Work) -> None:
            self.seen.append(-1)

    with listening(Heard()), progress_of("counting", 100, "decisions") as work:
        threads = [threading.Thread(target=lambda: [work.advance() for _ in range(60)]) for _ in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert Heard.seen == [*range(1, 101), *[100] * 20, -1]


def test_a_failure_ends_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    console = plain()
    with pytest.raises(ZeroDivisionError), ProgressBars(console), progress_of("counting", 2, "decisions"):
        raise ZeroDivisionError
    with progress_of("counting", 2, "decisions") as work:  # nobody listens any more
        assert work.listener is None


def test_reports_lists_and_replayed_policies_tell_how_far_they_are(tmp_path: Path) -> None:
    ended: list[tuple[str, int, int]] = []

    class Heard:
        def begun(self, work: Work) -> None:
            assert work.done == 0

        def advanced(self, work: Work) -> None:
            assert work.done <= work.total

        def ended(self, work: Work) -> None:
            ended.append((work.what, work.done, work.total))

    with listening(Heard()):
        page = write_report([RUNS / "gym", RUNS / "minatar"], tmp_path, figures=True)
        replay_policies(RunFolder(RUNS / "gym"), ("fixed_episodes", "fixed_steps"))
        list_runs(RUNS)
    figures = len(list((tmp_path / "comparison_figures").glob("*.csv")))
    assert page.is_file()
    assert [(done, total) for _, done, total in ended] == [(2, 2), (figures, figures), (2, 2), (2, 2)]
    assert ended[0][0] == "reading logs"
    assert ended[1][0] == "drawing"
