"""``MODEL_CARD.md`` says what the files of a run say, and nothing that they do not."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from pathlib import Path

import pytest

from switchmt_snn.export import ExportSettings, export
from switchmt_snn.runs.evaluations import better_than_random
from switchmt_snn.runs.model_card import CARD, model_card
from switchmt_snn.runs.packing import PRETRAINED, open_run, pretrained_names


def section(card: str, title: str) -> str:
    return card.split(f"## {title}\n")[1].split("\n## ")[0]


@pytest.fixture
def cartpole(tmp_path: Path) -> Path:
    return Path(shutil.copytree(PRETRAINED / "cartpole", tmp_path / "cartpole"))


@pytest.mark.parametrize("name", pretrained_names())
def test_a_trained_network_of_the_package_has_its_numbers(name: str) -> None:
    card = (PRETRAINED / name / CARD).read_text("utf-8")
    evaluation = json.loads(min((PRETRAINED / name / "evaluations").glob("*.json")).read_bytes())
    profile = json.loads((PRETRAINED / name / "profile" / "profile.json").read_bytes())
    agent = evaluation["tasks"][0]
    assert agent["policy"] == "agent"
    assert f"| {agent['task']} | {agent['mean']:.3g} ± " in section(card, "Scores")
    assert f"{evaluation['step']:,} of " in section(card, "What it was trained on, and how long")
    assert profile["headline"] in section(card, "Energy")
    rows = [line for line in section(card, "Energy").splitlines() if line.startswith(f"| {agent['task']} ")]
    joules = [row["per_episode_pj"] / 1e12 for row in profile["tasks"][0]["energy"]]
    assert [float(row.split("|")[-2].replace(",", "")) for row in rows] == pytest.approx(joules, rel=0.05)
    weights = next((PRETRAINED / name).glob("checkpoints/step-*/model.safetensors")).read_bytes()
    assert hashlib.sha256(weights).hexdigest() in section(card, "Hashes")
    same = profile["tasks"][0]["precision"][0]["equal_actions_share"]
    assert f"With 8-bit weights the same action in {same:.2%}" in section(card, "Limits")


def test_what_is_not_known_is_said(cartpole: Path) -> None:
    shutil.rmtree(cartpole / "evaluations")
    profile = cartpole / "profile" / "profile.json"
    facts = json.loads(profile.read_bytes())
    profile.write_text(json.dumps(facts | {"training_step": facts["training_step"] - 1}))
    card = model_card(open_run(cartpole))
    assert "nothing is known about what it is worth" in section(card, "Scores")
    assert "Not profiled at this step" in section(card, "Energy")


def test_an_agent_no_better_than_random_play_and_a_silent_layer_are_limits(cartpole: Path) -> None:
    for path in (cartpole / "evaluations").glob("*.json"):
        stored = json.loads(path.read_bytes())
        rows = {row["policy"]: row for row in stored["tasks"]}
        assert better_than_random(stored, "CartPole-v1") is True
        rows["agent"]["mean"] = rows["random"]["mean"] + rows["random"]["standard_error"]
        assert better_than_random(stored, "CartPole-v1") is False
        path.write_text(json.dumps(stored))
    path = cartpole / "profile" / "profile.json"
    facts = json.loads(path.read_bytes())
    layer = facts["tasks"][0]["layers"][0]
    layer["silent"] = layer["neurons"] - 1
    path.write_text(json.dumps(facts))
    limits = section(model_card(open_run(cartpole)), "Limits")
    assert "In CartPole-v1 it is not clearly better than random play." in limits
    assert f"{layer['silent']} of {layer['neurons']} neurons of {layer['name']} fire in none of " in limits


@pytest.mark.slow
def test_an_export_has_a_card_with_the_hash_of_every_file(cartpole: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    export(cartpole, ExportSettings(int8=True, parity_decisions=16), out=out)
    card = (out / CARD).read_text("utf-8")
    listed = dict(re.findall(r"^\| (\S+) \| [^|]+ \| `([0-9a-f]{64})` \|$", section(card, "Hashes"), re.MULTILINE))
    written = {path.name for path in out.iterdir()} - {CARD}
    assert listed == {name: hashlib.sha256((out / name).read_bytes()).hexdigest() for name in written}
    assert "Weights: int8" in section(card, "The files against the trained network")
    assert "not of these 8-bit ones" in section(card, "Limits")
