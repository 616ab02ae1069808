"""A run that is stopped at some steps and continued in a new ``Training`` ends bitwise as the whole one."""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection
from typing import Any

import torch

from switchmt_snn.learning.events import Stepped
from switchmt_snn.learning.training import Training


def assert_continues_exactly(make: Callable[[], Training], at_steps: Collection[int]) -> Training:
    """Run one training whole, and again from its state at each of these steps; returns the whole one."""
    whole, log = make(), []
    states: dict[int, tuple[dict[str, Any], list[dict[tuple[int, int], Any]], int]] = {}
    for event in whole.events():
        log.append(event)
        if isinstance(event, Stepped) and event.step in at_steps:
            frames = [{(s.lane, s.number): r.read_segment(s).copy() for s in r.segments()} for r in whole.replays]
            states[event.step] = (copy.deepcopy(whole.state_dict()), frames, len(log))
    assert set(states) == set(at_steps), "every step is one of the run"
    for step, (state, frames, position) in states.items():
        again = make()
        again.load_state_dict(state)
        for replay, stored in zip(again.replays, frames, strict=True):
            for segment in replay.segments():
                replay.load_segment(segment, stored[segment.lane, segment.number])
        assert again.reproducible
        rest = list(again.events())
        assert rest == log[position:], f"events differ after {step}"
        for network in ("network", "target"):
            ours, theirs = (getattr(each.learner, network).state_dict() for each in (again, whole))
            for name, tensor in theirs.items():
                assert torch.equal(ours[name], tensor), f"{network} {name} differs after {step}"
    return whole
