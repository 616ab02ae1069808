"""The page of a run: self-contained, its numbers those of the logs and of report.json; comparisons over seeds."""

from __future__ import annotations

import csv
import json
import re
import shutil
import statistics
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from switchmt_snn.cli import main
from switchmt_snn.viewing.report.page import write_report
from tests.pages import assert_sound

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results"
LAGGING = RESULTS / "atari" / "lagging-s1"
SEEDS = [RESULTS / "minatar" / f"switchmt-seed{seed}" for seed in (1, 2, 3)]
DQN = RESULTS / "minatar" / "dqn-breakout-seed1"


class Page(HTMLParser):
    """Addresses, visible text, and whether every element is closed."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.ids: list[str] = []
        self.text: list[str] = []
        self.open: list[str] = []
        self.feed(page)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in {"meta", "link", "img", "br"}:
            self.open.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]
        self.ids += [value or "" for name, value in attrs if name == "id"]

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """``<rect ... />`` opens nothing."""

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, f"{tag} closes another element"

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("style", "script"):
            self.text.append(data)


def written(page: Path) -> tuple[Page, dict[str, Any]]:
    return Page(page.read_text(encoding="utf-8")), json.loads(page.with_suffix(".json").read_text())


@pytest.fixture(scope="module")
def lagging(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_report([LAGGING], tmp_path_factory.mktemp("lagging"), figures=True)


def test_the_page_is_whole_and_needs_nothing_else(lagging: Path) -> None:
    page, _ = written(lagging)
    assert all(address.startswith(("#", "data:")) or address == "report.json" for address in page.addresses)
    assert {address[1:] for address in page.addresses if address.startswith("#")} <= set(page.ids)
    assert len(page.ids) == len(set(page.ids))
    text = lagging.read_text()
    assert set(re.findall(r"https?://[^\"' <]+", text)) <= {"http://www.w3.org/2000/svg"}
    assert "prefers-color-scheme: dark" in text
    assert "@media print" in text


def test_the_facts_are_those_of_the_logs(lagging: Path) -> None:
    _, facts = written(lagging)
    with (LAGGING / "episodes.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    pong = [float(row["return"]) for row in rows if row["task"] == "pong"]
    assert facts["returns"][0] | {"task": "pong", "episodes": len(pong)} == facts["returns"][0]
    assert facts["returns"][0]["first_mean"] == pytest.approx(statistics.fmean(pong[:20]))
    assert facts["returns"][0]["newest_mean"] == pytest.approx(statistics.fmean(pong[-20:]))
    curve = next(one for one in facts["figures"]["learning"] if one["title"] == "Raw return in pong")
    smooth = next(one for one in curve["series"] if one["name"] == "mean of 20 episodes")
    assert smooth["y"][-1] == pytest.approx(statistics.fmean(pong[-20:]))
    evaluations = next(one for one in curve["series"] if one["name"] == "evaluation (mean)")
    assert (evaluations["x"], evaluations["y"]) == ([300_000, 600_000, 900_000], [-21.0, -21.0, -20.9])
    assert {one["name"] for one in curve["references"]} >= {"random, measured", "human (Wang 2016)", "SwitchMT (paper)"}
    with (LAGGING / "switches.csv").open() as stream:
        switches = [row for row in csv.DictReader(stream) if row["decision"] == "switch"]
    begins = [begin for begin in (0, *(int(row["step"]) for row in switches)) if begin < facts["steps"]]
    assert facts["switching"]["visits"] == len(begins)
    assert sum(one["switches"] for one in facts["switching"]["reasons"]) == len(switches)
    assert sum(one["steps"] for one in facts["switching"]["tasks"]) == facts["steps"]
    timeline = facts["figures"]["switching"][0]
    assert [span["begin"] for span in timeline["spans"]] == begins
    deciding = facts["figures"]["switching"][1]
    bound = next(one for one in deciding["series"] if one["name"] == "bound: change_threshold")
    assert set(bound["y"]) == {0.1}


def test_an_agent_that_is_no_better_than_random_play_is_said_so_first(lagging: Path) -> None:
    _, facts = written(lagging)
    verdicts = {one["task"]: one["verdict"] for one in facts["verdicts"]}
    assert verdicts == {
        "pong": "worse than random play",
        "breakout": "no better than random play",
        "enduro": "better than random play",
    }
    assert "breakout: no better than random play" in facts["headline"]
    assert facts["headline"].startswith("Stopped at 930,536 of 3,000,000 agent steps")


def test_warnings_have_their_remedy_and_when_they_were_seen(lagging: Path) -> None:
    page, facts = written(lagging)
    saturated = next(one for one in facts["warnings"] if one["name"] == "saturated advantage")
    assert saturated["of"] == 186
    assert saturated["times"] < 186
    assert not saturated["lasts"]
    assert "lower network.stream_current_thresholds" in "".join(page.text)


NUMBER = re.compile(r"\d+(?:,\d{3})*(?:\.\d+)?")


def leaves(value: Any) -> list[Any]:
    if isinstance(value, dict):
        return [*value, *(leaf for inner in value.values() for leaf in leaves(inner))]
    if isinstance(value, list):
        return [leaf for inner in value for leaf in leaves(inner)]
    return [value]


@pytest.mark.slow
@pytest.mark.parametrize("runs", [[LAGGING], [RESULTS / "cartpole" / "cartpole-s1"], [*SEEDS[:2], DQN]], ids=len)
def test_every_number_of_the_page_is_in_the_json_beside_it(runs: list[Path], tmp_path: Path) -> None:
    from switchmt_snn.drawing.numbers import duration
    from switchmt_snn.drawing.page import FILTERS

    page = write_report(runs, tmp_path)
    facts = json.loads(page.with_suffix(".json").read_text())
    shown = Page(re.sub(r"<svg.*?</svg>", "", page.read_text(), flags=re.S)).text
    templates = (ROOT / "switchmt_snn" / "viewing" / "report" / "templates").glob("*.jinja")
    prose = re.sub(r"\{\{.*?\}\}|\{%.*?%\}|\{#.*?#\}", " ", " ".join(one.read_text() for one in templates), flags=re.S)
    allowed = set(NUMBER.findall(prose)) | {str(len(runs)), str(len(facts.get("evaluations", [])) - 1)}
    for leaf in leaves({key: value for key, value in facts.items() if key != "figures"}):
        allowed |= set(NUMBER.findall(str(leaf)))
        if isinstance(leaf, int | float):
            allowed |= {text for show in (*FILTERS.values(), duration) for text in NUMBER.findall(show(leaf))}
    figures = [one for ones in facts["figures"].values() for one in ones]
    words = [(one["title"], one["note"], [series["name"] for series in one["series"]]) for one in figures]
    allowed |= set(NUMBER.findall(str(words)))
    for one in (reference for figure in figures for reference in figure.get("references", [])):
        allowed |= set(NUMBER.findall(one["name"])) | set(NUMBER.findall(FILTERS["digits"](one["y"])))
    assert not set(NUMBER.findall(" ".join(shown))) - allowed


@pytest.mark.slow
def test_the_pages_are_sound_in_a_browser(lagging: Path, tmp_path: Path) -> None:
    assert_sound(lagging)
    assert_sound(write_report([*SEEDS[:2], DQN], tmp_path))


def test_figures_are_files_in_three_formats_with_their_data(lagging: Path) -> None:
    _, facts = written(lagging)
    names = [figure["name"] for figures in facts["figures"].values() for figure in figures]
    assert len(names) == len(set(names))
    files = {path.name for path in (lagging.parent / "figures").iterdir()}
    assert files == {f"{name}.{kind}" for name in names for kind in ("svg", "png", "csv")}
    loss = facts["figures"]["training"][1]["series"][0]
    with (lagging.parent / "figures" / "loss.csv").open() as stream:
        rows = [(float(row["x"]), float(row["y"])) for row in csv.DictReader(stream) if row["y"]]
    assert rows == [(x, y) for x, y in zip(loss["x"], loss["y"], strict=True) if y is not None]


@pytest.mark.slow
def test_runs_that_differ_in_their_seed_are_a_group_with_a_band(tmp_path: Path) -> None:
    _, facts = written(write_report([*SEEDS, DQN], tmp_path))
    assert [len(group["runs"]) for group in facts["groups"]] == [3, 1]
    assert facts["differing"]["network.method"] == ["SwitchMT", "DQN"]
    breakout = facts["figures"]["learning"][0]
    band, alone = breakout["series"]
    inside = zip(band["low"], band["y"], band["high"], strict=True)
    assert all(low <= y <= high for low, y, high in inside)
    assert any(low < high for low, high in zip(band["low"], band["high"], strict=True))
    assert alone["low"] == []
    scores = [run_score(run, "breakout") for run in SEEDS]
    row = facts["scores"][0]
    assert (row["task"], row["seeds"], row["of"]) == ("breakout", 3, "evaluation")
    assert row["mean"] == pytest.approx(statistics.fmean(scores))
    assert row["standard_error"] == pytest.approx(statistics.stdev(scores) / 3**0.5)
    assert (row["smallest"], row["largest"]) == (min(scores), max(scores))


def run_score(run: Path, task: str) -> float:
    (path,) = (run / "evaluations").glob("*.json")
    rows = json.loads(path.read_text())["tasks"]
    return next(row["mean"] for row in rows if (row["policy"], row["task"]) == ("agent", task))


def test_a_run_without_any_episode_has_a_page(tmp_path: Path) -> None:
    for name in ("config.yaml", "environment.json"):
        shutil.copy(LAGGING / name, tmp_path)
    page, facts = written(write_report([tmp_path]))
    assert facts["steps"] == 0
    text = "".join(page.text)
    assert f"Not evaluated yet: switchmt-snn evaluate {tmp_path}" in text
    assert f"Make more with switchmt-snn profile {tmp_path} (" in text
    assert "No episode has ended yet" in text


@pytest.mark.slow
def test_links_go_to_what_is_there(tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(ROOT / "tests" / "fixtures" / "runs" / "minatar", run)
    (run / "play.gif").write_bytes(b"")
    for out in (run, tmp_path / "elsewhere"):
        page, facts = written(write_report([run], out))
        links = [link["href"] for link in facts["links"]]
        assert links
        assert all((out / link).exists() for link in links)
        assert set(links) <= set(page.addresses)
        assert any(link.endswith("play.gif") for link in links)


@pytest.mark.slow
def test_wrong_folders_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    for words, said in (
        (["report", str(tmp_path / "nowhere")], "no run folder"),
        (["compare", str(LAGGING), str(tmp_path / "nowhere")], "no run folder"),
        (["compare", str(LAGGING)], f"compare got {LAGGING}, expected two runs or more; switchmt-snn report shows one"),
        (["compare"], "compare got no RUN, expected two runs or more"),
        (["report", str(LAGGING), str(DQN)], "report got 2 runs, expected one; switchmt-snn compare shows several"),
        (
            ["report", str(LAGGING), "--out", str(tmp_path / "file")],
            "expected a writable folder; name another with --out",
        ),
    ):
        with pytest.raises(SystemExit) as stop:
            main(words)
        error = capsys.readouterr().err
        assert stop.value.code == 2
        assert said in error
        assert error.count("\n") == 1


@pytest.mark.slow
def test_compare_writes_the_page_of_several(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["compare", str(LAGGING), str(DQN), "--out", str(tmp_path)])
    assert stop.value.code == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "comparison.html")
    assert (tmp_path / "comparison.html").is_file()


@pytest.mark.slow
def test_every_training_ends_with_its_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run"
    flags = ["--run", str(run), "--total-steps", "400", "--evaluation.episodes", "1", "--threads", "1"]
    with pytest.raises(SystemExit) as stop:
        main(["train", "cartpole", *flags, "--recording.metrics-every-steps", "100"])
    assert stop.value.code == 0
    assert f"report: {run / 'report.html'}" in capsys.readouterr().out.replace("\n", "")
    _, facts = written(run / "report.html")
    assert (facts["status"], facts["steps"]) == ("finished", 400)
    assert facts["peak_memory_bytes"]["process"] > 50 * 1024**2


def test_the_page_of_an_ann_has_no_simulation_steps(tmp_path: Path) -> None:
    page, facts = written(write_report([DQN], tmp_path))
    assert facts["timesteps"] is facts["encoding"] is None
    text = " ".join(page.text).partition("Settings")[0]
    assert "DQN on breakout; switching" in text
    assert not re.search(r"spike|T=|encoding", text)
