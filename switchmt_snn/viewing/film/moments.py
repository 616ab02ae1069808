"""A task in play, decision by decision: everything that a frame shows of it, and the neurons that are drawn."""

from __future__ import annotations

import itertools
from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from switchmt_snn.acting.episodes import Decided, EpisodeScore, Playing, Stepped, episode_events
from switchmt_snn.acting.evaluation import EvaluationProtocol
from switchmt_snn.acting.watching import Insight, WatchedAgent
from switchmt_snn.tasks.suite import Frames, Picture

REHEARSED_DECISIONS = 64
"""Decisions of each task, played beforehand, by which the drawn neurons are chosen."""


@dataclass(frozen=True)
class Moment:
    """One decision, its circumstances and what it brought.

    Attributes:
        episode: number of the episode, from 0 as in an evaluation.
        step: of the episode, from 0.
        picture: the game that was decided on ``[H, W, 3]``; None if it has none.
        frame: the newest frame of the observation ``[c, ...]``, as the network sees it.
        insight: what the network did.
        action: index of a Q-value.
        random: whether the action was drawn at random.
        reward: raw, of this step.
        score: raw return of the episode, this step included.
        ended: the episode's score, if this was its last step.
    """

    episode: int
    step: int
    picture: Picture | None
    frame: Frames
    insight: Insight
    action: int
    random: bool
    reward: float
    score: float
    ended: EpisodeScore | None

    def spikes(self) -> dict[str, int]:
        """Spikes by layer."""
        return {name: int(active.sum()) for name, active in self.insight.active.items()}

    def rates(self) -> dict[str, float]:
        """Spikes per neuron and simulation step by layer."""
        return {name: float(active.mean()) for name, active in self.insight.active.items()}


def moments(
    agent: WatchedAgent, task: int, protocol: EvaluationProtocol, episodes: int | None = None
) -> Generator[Moment]:
    """Play an evaluation's episodes of a task one after the other, in environments that can be drawn.

    Args:
        agent: who plays.
        task: index.
        protocol: epsilon, seed and longest episode; episode n is the evaluation's.
        episodes: how many; None does not end.
    """
    suite = agent.suite.pictured()
    playing = Playing(
        protocol.seed, protocol.epsilon, protocol.max_episode_steps, reseed=agent.reseed if agent.draws else None
    )
    channels = suite.frame_shape[0]
    for number in itertools.count() if episodes is None else range(episodes):
        moment: Moment | None = None
        for event in episode_events("agent", agent.q_values, suite, task, [number], playing):
            if isinstance(event, Decided):
                before = moment
                # Made before the other is given away: meanwhile the agent may decide for another task.
                moment = Moment(
                    episode=number,
                    step=int(event.play.lengths_steps[0]),
                    picture=event.play.picture(0),
                    frame=event.play.observations[0, -channels:].copy(),
                    insight=agent.insight,
                    action=int(event.actions_n[0]),
                    random=bool(event.random_n[0]),
                    reward=0.0,
                    score=0.0,
                    ended=None,
                )
                if before is not None:
                    yield before
            elif moment is not None and isinstance(event, Stepped):
                score = float(event.play.returns[0])
                moment = replace(moment, reward=float(event.rewards_n[0]), score=score)
            elif moment is not None and isinstance(event, EpisodeScore):
                yield replace(moment, ended=event)
                moment = None


@dataclass(frozen=True)
class Rehearsal:
    """How each layer's neurons behaved in some decisions of every task.

    Attributes:
        order: neurons of each layer, those whose number of spikes varies most between decisions first.
        neurons: of each layer.
        timesteps: simulation steps of a decision.
    """

    order: dict[str, npt.NDArray[np.int64]]
    neurons: dict[str, int]
    timesteps: int

    def rows(self, layer: str, most: int) -> npt.NDArray[np.int64]:
        """The ``most`` neurons of a layer that vary most, in the layer's own order."""
        return np.sort(self.order[layer][:most])


def rehearse(
    agent: WatchedAgent, tasks: tuple[int, ...], protocol: EvaluationProtocol, decisions: int = REHEARSED_DECISIONS
) -> Rehearsal:
    """Play the first decisions of each task, and rank the neurons.

    A neuron that never fires and one that fires at every step show nothing; what counts is the variance of its number
    of spikes per decision, within a task, added up over the tasks. Of equal ones the one that fires more comes first,
    and of those that had the same number of spikes at every decision all but one come after all others.
    """
    layers: dict[str, _Counts] = {}
    timesteps = 0
    for task in tasks:
        for moment in itertools.islice(moments(agent, task, protocol), decisions):
            for name, active_TN in moment.insight.active.items():
                timesteps = len(active_TN)
                layers.setdefault(name, _Counts(active_TN.shape[1])).add(task, active_TN.sum(axis=0))
    return Rehearsal(
        {name: counts.order() for name, counts in layers.items()},
        {name: counts.neurons for name, counts in layers.items()},
        timesteps,
    )


class _Counts:
    """Spikes per decision of a layer's neurons: sums, squares and a fingerprint, no single decision."""

    def __init__(self, neurons: int) -> None:
        self.neurons = neurons
        self._sums: dict[int, npt.NDArray[np.float64]] = {}
        self._squares: dict[int, npt.NDArray[np.float64]] = {}
        self._decisions: dict[int, int] = {}
        self._alike_N = np.zeros(neurons, np.uint64)

    def add(self, task: int, spikes_N: npt.NDArray[np.int64]) -> None:
        self._sums[task] = self._sums.get(task, 0) + spikes_N.astype(np.float64)
        self._squares[task] = self._squares.get(task, 0) + spikes_N.astype(np.float64) ** 2
        self._decisions[task] = self._decisions.get(task, 0) + 1
        self._alike_N = self._alike_N * np.uint64(0x100000001B3) + spikes_N.astype(np.uint64)  # modulo 2^64

    def order(self) -> npt.NDArray[np.int64]:
        variance_N, sum_N = np.zeros(self.neurons), np.zeros(self.neurons)
        for task, count in self._decisions.items():
            variance_N += self._squares[task] / count - (self._sums[task] / count) ** 2
            sum_N += self._sums[task]
        best_first = np.lexsort((-sum_N, -variance_N.round(12)))
        _, firsts = np.unique(self._alike_N[best_first], return_index=True)
        is_first = np.zeros(self.neurons, np.bool_)
        is_first[firsts] = True
        return np.concatenate([best_first[is_first], best_first[~is_first]])
