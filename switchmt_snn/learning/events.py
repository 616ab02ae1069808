"""What the training loop reports. Observers (files, progress, TensorBoard) read events; the loop knows none of them."""

from __future__ import annotations

from dataclasses import dataclass

from switchmt_snn.learning.switching import Stay, SwitchTo


@dataclass(frozen=True)
class Stepped:
    """One vector step is over and the run's state is whole: the moment to save or stop."""

    step: int
    task: int
    epsilon: float
    warming_up: bool


@dataclass(frozen=True)
class EpisodeEnded:
    """An episode ended by itself (not by leaving the task)."""

    step: int
    task: int
    episode: int
    episode_return: float
    length_steps: int
    truncated: bool
    epsilon: float
    updates: int


@dataclass(frozen=True)
class SwitchDecided:
    """A switching policy decided; ``decision.measured`` holds every number that it used."""

    step: int
    task: int
    visit: int
    episodes_in_visit: int
    steps_in_visit: int
    decision: Stay | SwitchTo


@dataclass(frozen=True)
class LayerHealth:
    """Activity of a neuron layer over a batch of the current task.

    Attributes:
        rate: mean activity (spikes per neuron and simulation step).
        dead: share of neurons that fired in none of the observations (``HEALTH_BATCH``). A neuron that fires rarely is
            among them by chance: a profile, over more decisions, counts fewer.
        saturated: share of neurons that fired at every step.
    """

    rate: float
    dead: float
    saturated: float


@dataclass(frozen=True)
class Measured:
    """Means since the last report."""

    step: int
    task: int
    updates: int
    loss: float | None
    q: float | None
    steps_by_task: tuple[int, ...]
    layers: dict[str, LayerHealth]


Event = Stepped | EpisodeEnded | SwitchDecided | Measured
