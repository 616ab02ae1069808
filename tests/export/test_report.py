"""The report: self-contained, every number from profile.json, sound in a browser."""

from __future__ import annotations

import csv
import io
import json
import re
import shutil
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from switchmt_snn import train
from switchmt_snn.config import from_dict
from switchmt_snn.export import profile
from switchmt_snn.export.report.page import FILTERS, chip_rows, energies, render_report
from switchmt_snn.viewing.tables import comparison_table, energy_table, profile_table
from tests.export.export_cases import RunCommand
from tests.pages import assert_sound

TEMPLATE = Path(__file__).parents[2] / "export" / "report" / "templates" / "report.html.jinja"
NUMBER = re.compile(r"\d+(?:,\d{3})*(?:\.\d+)?(?:e[-+]\d+)?%?")
VOID = {"meta", "link", "img", "br"}


class Page(HTMLParser):
    """Visible text, addresses, and whether every element is closed."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.text: list[str] = []
        self.addresses: list[str] = []
        self.axis: list[str] = []
        self.open: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]
        self.text += [value or "" for name, value in attrs if name in ("title", "alt")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, f"{tag} closes another element"

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "text":  # of a drawing: the numbers of its axis
            self.axis.append(data)
        elif self.open and self.open[-1] == "title" and data.startswith("near "):  # a place on the axis, then values
            self.text += data.splitlines()[1:]
        elif self.open and self.open[-1] != "style":
            self.text.append(data)


def leaves(value: Any) -> Iterator[Any]:
    """All keys and plain values."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield key
            yield from leaves(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from leaves(inner)
    else:
        yield value


def numbers_that_may_stand(facts: Any) -> set[str]:
    """The numbers of profile.json in every format of the report, those in its texts, and those of the prose."""
    allowed: set[str] = set()
    for leaf in leaves(facts):
        if isinstance(leaf, str):
            allowed |= set(NUMBER.findall(leaf))
        elif leaf is not None and not isinstance(leaf, bool):
            allowed |= {text for show in FILTERS.values() for text in NUMBER.findall(show(leaf))}
            allowed |= {str(leaf), f"{leaf:.1%}"}
    prose = re.sub(r"<style>.*?</style>|\{\{.*?\}\}|\{%.*?%\}|\{#.*?#\}|<[^>]*>", " ", TEMPLATE.read_text(), flags=re.S)
    return allowed | set(NUMBER.findall(prose))


def check(path: Path, facts: Any) -> Page:
    page = Page(path.read_text())
    assert page.open == []
    assert all(address.startswith(("data:", "#")) for address in page.addresses), "an address outside the page"
    allowed = numbers_that_may_stand(facts) | {str(sum(1 for _ in facts.get("runs", [1])))}
    strange = {number for text in page.text for number in NUMBER.findall(text)} - allowed
    # A list of neurons is told by its length.
    lengths = {str(len(leaf)) for leaf in all_lists(facts)}
    assert strange <= lengths, strange - lengths
    return page


def all_lists(value: Any) -> Iterator[list[Any]]:
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    if isinstance(value, list):
        yield value
    for one in inner:
        yield from all_lists(one)


@pytest.fixture(scope="module")
def profiled(trained_once: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = shutil.copytree(trained_once, tmp_path_factory.mktemp("profiled") / "run")
    return profile(run, decisions=40).folder


@pytest.mark.slow
def test_every_number_is_in_profile_json(trained_run: Path, run_command: RunCommand) -> None:
    out, _ = run_command("profile", trained_run, "--decisions", 40)
    folder = trained_run / "profile"
    facts = json.loads((folder / "profile.json").read_text())
    page = check(folder / "report.html", facts)
    text = " ".join(page.text)
    assert facts["headline"] in text
    assert facts["headline"] in " ".join(out.split())
    for task in facts["tasks"]:
        assert FILTERS["whole"](task["per_decision"]["acs"]) in text
    frames_and_rasters = [address for address in page.addresses if address.startswith("data:image/png")]
    samples = [task["sample"] for task in facts["tasks"]]
    expected = sum(len(s["actions"]) + sum(bool(layer["neurons"]) for layer in s["layers"]) for s in samples)
    assert len(frames_and_rasters) == expected


def test_a_number_that_is_not_in_profile_json_would_be_noticed(profiled: Path, tmp_path: Path) -> None:
    facts = json.loads((profiled / "profile.json").read_text())
    page = (profiled / "report.html").read_text()
    (tmp_path / "changed.html").write_text(page.replace("</article>", "<p>987,654.321</p></article>"))
    with pytest.raises(AssertionError, match="987,654"):
        check(tmp_path / "changed.html", facts)


@pytest.mark.slow
def test_several_runs_in_one_report(trained_run: Path, tmp_path: Path, run_command: RunCommand) -> None:
    shutil.rmtree(trained_run / "profile", ignore_errors=True)
    _, err = run_command("profile", trained_run, tmp_path / "nothing", code=2)
    assert "no run folder" in err
    assert not (trained_run / "profile").exists(), "nothing is profiled before all are found"
    out, _ = run_command(
        "profile", trained_run, trained_run, "--decisions", 20, "--target", "cmos45-int8", "--out", tmp_path
    )
    assert "Per decision, smallest to largest" in out
    facts = json.loads((tmp_path / "comparison.json").read_text())
    assert len(facts["runs"]) == 2
    text = " ".join(check(tmp_path / "comparison.html", facts).text)
    assert "2 runs side by side" in text
    assert (trained_run / "profile" / "report.html").exists()
    out, _ = run_command("profile", trained_run, trained_run, "--decisions", 20, "--out", tmp_path, "--json")
    assert json.loads(out) == json.loads((tmp_path / "comparison.json").read_text())


@pytest.mark.slow
def test_names_are_escaped(profiled: Path) -> None:
    facts = json.loads((profiled / "profile.json").read_text())
    facts["run"] = "<script>alert(1)</script>"
    frames = [np.zeros((8, *(1, 10, 10)), np.uint8) for _ in facts["tasks"]]
    assert "<script>" not in render_report([facts], [frames], "x")


@pytest.mark.slow
def test_the_page_is_sound_in_a_browser(profiled: Path) -> None:
    assert_sound(profiled / "report.html")


@pytest.fixture(scope="module")
def ann_and_spiking(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """Profiles of an ANN and of a spiking network on CartPole."""
    folder, found = tmp_path_factory.mktemp("ann"), []
    for method in ("DQN", "SwitchMT"):
        data: dict[str, Any] = {
            "total_steps": 60,
            "threads": 1,
            "tasks": {"suite": "gym", "names": ["CartPole-v1", "Acrobot-v1"]},
            "network": {"method": method, "hidden_units": 8},
            "learning": {"batch_size": 8, "learning_starts_steps": 20, "replay_capacity_steps": 100},
            "evaluation": {"episodes": 1},
        }
        train(from_dict(data), folder / method)
        found.append(profile(folder / method, 20).facts)
    return found


def words_of(facts: dict[str, Any]) -> str:
    """The visible text of a report, without what targets say of themselves."""
    page = Page(render_report([facts], [[np.zeros((0, 4), np.float32)] * 2], "command"))
    return " ".join(line for line in page.text if not re.search(r"pJ|Source:|Memory after|Neuron updates cost", line))


@pytest.mark.slow
def test_the_report_of_an_ann_speaks_of_no_spikes(ann_and_spiking: list[dict[str, Any]]) -> None:
    ann, spiking = map(words_of, ann_and_spiking)
    for word in ("spike", "Spikes", "fired", "Firing", "simulation step", "1 bits", "break-even", "quantised"):
        assert word not in ann, ann[max(0, ann.index(word) - 80) : ann.index(word) + 80]
    for word in ("spikes", "Firing rates", "simulation steps", "break-even", "quantised ANN"):
        assert word in spiking
    facts = ann_and_spiking[0]
    assert facts["tasks"][0]["twins"]["quantised_ann"] is None
    assert {row["by_quantised_ann"] for task in facts["tasks"] for row in task["energy"]} == {None}


def test_the_tables_of_an_ann_speak_of_no_spikes(ann_and_spiking: list[dict[str, Any]]) -> None:
    ann, spiking = ann_and_spiking
    console = Console(file=(stream := io.StringIO()), width=100)
    for table in (profile_table(ann["tasks"][0]), energy_table(ann), comparison_table([ann])):
        console.print(table)
    assert not [word for word in ("spik", "twin", "QANN", "step") if word in stream.getvalue().split("Energy per")[0]]
    assert "QANN" not in stream.getvalue()
    assert "active units (ANN)" in stream.getvalue()
    columns = comparison_table([ann, spiking]).columns
    cells = {label: (one, two) for label, one, two in zip(*(column.cells for column in columns), strict=True)}
    assert cells["spikes"][0] == "" != cells["spikes"][1]
    assert cells["active units (ANN)"][0] != "" == cells["active units (ANN)"][1]


def test_the_first_screen_says_what_a_decision_costs_where_and_whether_the_chip_holds_it(profiled: Path) -> None:
    facts = json.loads((profiled / "profile.json").read_text())
    rows = {row["name"]: row for row in chip_rows(facts)}
    assert set(rows) == {target["chip"] for target in facts["targets"].values()} | {
        chip["title"] for chip in facts["chips"]
    }
    on_loihi = [
        energy["total_pj"]
        for task in facts["tasks"]
        for energy in task["energy"]
        if energy["target"].startswith("loihi")
    ]
    loihi = rows["Loihi"]
    assert (loihi["cost"]["smallest"], loihi["cost"]["largest"]) == (min(on_loihi), max(on_loihi))
    shares = [task["precision"][0]["equal_actions_share"] for task in facts["tasks"]]
    assert loihi["fit"]["fits"]
    assert loihi["same_actions"] == {"smallest": min(shares), "largest": max(shares)}
    assert (rows["Speck 2e/2f"]["cost"], rows["45 nm CMOS"]["fit"]) == (None, None)
    page = (profiled / "report.html").read_text()
    beginning = page[: page.index("<section>")]
    assert f"{energies(min(on_loihi), max(on_loihi))}*</td>" in beginning, "multiplications of conv1 have no price"


def test_the_ann_is_drawn_beside_the_spiking_network(profiled: Path) -> None:
    facts = json.loads((profiled / "profile.json").read_text())
    page = (profiled / "report.html").read_text()
    largest = max(
        energy for task in facts["tasks"] for energy in (task["energy"][0]["total_pj"], task["energy"][0]["ann_pj"])
    )
    for task in facts["tasks"]:
        energy = task["energy"][0]
        assert sum(energy["ann_layers_pj"]) == pytest.approx(energy["ann_pj"])
        bar = page[page.index(f"{task['task']}, ANN</span>") :]
        widths = re.findall(r"width:([\d.]+)%", bar[: bar.index("</div>")])
        assert [float(width) for width in widths] == pytest.approx(
            [100 * part / largest for part in energy["ann_layers_pj"]]
        )


def test_actions_and_rewards_stand_under_their_frames(profiled: Path) -> None:
    facts = json.loads((profiled / "profile.json").read_text())
    page = (profiled / "report.html").read_text()
    for task in facts["tasks"]:
        sample, name = task["sample"], task["task"]
        with np.load(next((profiled.parent / "recordings").glob(f"{name}-step-*.npz"))) as stored:
            first = sample["first_decision"]
            assert sample["rewards"] == stored["rewards"][first : first + len(sample["actions"])].tolist()
        under = re.findall(rf'alt="a frame of {name}"><span>(.*?)</span><span>(.*?)</span>', page)
        rewards = map(FILTERS["digits"], sample["rewards"])
        assert under == list(zip(sample["actions"], rewards, strict=True))


def test_figures_show_what_profile_json_says(profiled: Path) -> None:
    facts = json.loads((profiled / "profile.json").read_text())
    rates = [f"rates_{task['task']}" for task in facts["tasks"]]
    assert [figure["name"] for figure in facts["figures"]] == ["energy", "spikes", *rates]
    for kind in ("svg", "png", "csv"):
        assert {path.stem for path in (profiled / "figures").glob(f"*.{kind}")} == {"energy", "spikes", *rates}
    with (profiled / "figures" / "energy.csv").open(newline="") as stream:
        rows = {(row["row"], row["series"]): row for row in csv.DictReader(stream)}
    for index, target in enumerate(facts["targets"]):
        totals_pj = [task["energy"][index]["total_pj"] for task in facts["tasks"]]
        row = rows[target, "whole network"]
        assert float(row["value"]) == pytest.approx(sum(totals_pj) / len(totals_pj) / 1e6)
        assert float(row["low"]) == pytest.approx(min(totals_pj) / 1e6)
        assert float(row["high"]) == pytest.approx(max(totals_pj) / 1e6)
        names = [layer["name"] for layer in facts["tasks"][0]["layers"]]
        parts = [float(rows[target, name]["value"]) for name in names]
        assert sum(parts) == pytest.approx(float(row["value"]))
    scales = [figure["y_range"] for figure in facts["figures"] if figure["name"] in rates]
    assert all(scale == scales[0] for scale in scales), "one scale for all tasks"
    for task in facts["tasks"]:
        with (profiled / "figures" / f"rates_{task['task']}.csv").open(newline="") as stream:
            points = list(csv.DictReader(stream))
        for layer in (layer for layer in task["layers"] if layer["neurons"]):
            of_layer = [float(point["y"]) for point in points if point["series"] == layer["name"]]
            assert of_layer[::2] == of_layer[1::2] == [count / layer["neurons"] for count in layer["rate_histogram"]]
            assert sum(of_layer[::2]) == pytest.approx(1 - layer["silent"] / layer["neurons"])
    with (profiled / "figures" / "spikes.csv").open(newline="") as stream:
        seen = list(csv.DictReader(stream))
    for layer in (layer for layer in facts["tasks"][0]["layers"] if layer["neurons"]):
        by_step = [float(row["value"]) for row in seen if row["row"] == layer["name"]]
        assert len(by_step) == facts["timesteps"]
        total = sum(
            of_task["spikes_per_decision"]
            for task in facts["tasks"]
            for of_task in task["layers"]
            if of_task["name"] == layer["name"]
        )
        assert sum(by_step) == pytest.approx(total / len(facts["tasks"]))
