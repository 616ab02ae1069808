"""What stands beside the price of a decision: whether the agent is worth it, and what makes a low price worthless."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

MOST_SILENT = 0.5
"""Share of silent neurons of a layer above which a profile warns."""


def verdict(tasks: Sequence[Mapping[str, Any]]) -> str:
    """Whether the agent is clearly better than random play, worst news first.

    Args:
        tasks: ``tasks`` of ``profile.json``.
    """
    answers: dict[str, list[str]] = {"no": [], "unknown": [], "yes": []}
    for task in tasks:
        evaluation = task["evaluation"]
        better = None if evaluation is None else evaluation["better_than_random"]
        answers["unknown" if better is None else "yes" if better else "no"].append(task["task"])
    sentences = []
    if answers["no"]:
        sentences.append(
            f"NOT clearly better than random play: {', '.join(answers['no'])}. A low price buys nothing there."
        )
    if answers["unknown"]:
        sentences.append(f"Not known to be better than random play: {', '.join(answers['unknown'])}.")
    if answers["yes"]:
        sentences.append(f"Clearly better than random play: {', '.join(answers['yes'])}.")
    return " ".join(sentences)


def silent_layers(tasks: Sequence[Mapping[str, Any]], spiking: bool) -> list[str]:
    """A warning for each layer and task in which most neurons are silent.

    Args:
        tasks: ``tasks`` of ``profile.json``.
        spiking: False for an ANN, whose units are silent if they were never above zero.
    """
    what = "neurons never fired" if spiking else "units were never above zero"
    return [
        f"{layer['silent']:,} of {layer['neurons']:,} {what} in {layer['name']} ({task['task']}): low energy may "
        "mean a dead layer, not an efficient one."
        for task in tasks
        for layer in task["layers"]
        if layer["neurons"] and layer["silent"] > MOST_SILENT * layer["neurons"]
    ]
