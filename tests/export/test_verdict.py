"""What stands beside the price of a decision."""

from __future__ import annotations

from typing import Any

from switchmt_snn.export.report.verdict import silent_layers, verdict


def task(name: str, better: bool | None, silent: int = 0) -> dict[str, Any]:
    layers = [{"name": "conv1", "neurons": 100, "silent": silent}, {"name": "head", "neurons": 0, "silent": 0}]
    return {"task": name, "evaluation": {"better_than_random": better}, "layers": layers}


def test_an_agent_no_better_than_random_play_is_said_first() -> None:
    text = verdict([task("a", True), task("b", False), task("c", None), {**task("d", None), "evaluation": None}])
    assert text.startswith("NOT clearly better than random play: b.")
    assert "Not known to be better than random play: c, d." in text
    assert text.endswith("Clearly better than random play: a.")
    assert verdict([task("a", True)]) == "Clearly better than random play: a."


def test_a_layer_is_warned_of_when_most_of_it_is_silent() -> None:
    assert silent_layers([task("a", True, 50)], spiking=True) == []
    (text,) = silent_layers([task("a", True, 51)], spiking=True)
    assert text.startswith("51 of 100 neurons never fired in conv1 (a)")
    (text,) = silent_layers([task("a", True, 51)], spiking=False)
    assert "units were never above zero" in text
