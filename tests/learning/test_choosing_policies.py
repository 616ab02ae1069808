"""Policies that choose the next task, or look at Q-values: on made-up tasks, and by hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from switchmt_snn.config import SwitchingConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.switching import (
    Criterion,
    EpisodeRecord,
    Stay,
    SwitchingPolicy,
    SwitchTo,
    Verdict,
    check_policy,
)
from switchmt_snn.learning.switching.plateau_and_return import fall_errors
from switchmt_snn.learning.switching.shares import Shares
from switchmt_snn.tasks.suite import Reference
from tests.conftest import SameObservationEnvironment, small_config, vector_suite


def record(task: int, episode: int, steps: int, value: float, updates: int = 10) -> EpisodeRecord:
    return EpisodeRecord(task, episode, steps, updates, 1, value, lambda: torch.ones(2))


class Played:
    """A policy on tasks whose returns are functions of the steps played in them so far."""

    def __init__(self, policy: SwitchingPolicy, lengths: list[int], returns: list[Callable[[int], float]]) -> None:
        self.policy, self.lengths, self.returns = policy, lengths, returns
        self.steps = [0] * len(lengths)
        self.task = self.episodes = self.in_visit = 0
        self.log: list[tuple[int, str]] = []  # the task of every episode, and what was decided at its end
        self.left: list[tuple[int, str]] = []  # those at whose end the task was left

    def run(self, episodes: int) -> Played:
        for _ in range(episodes):
            task, length = self.task, self.lengths[self.task]
            self.steps[task] += length
            self.episodes, self.in_visit = self.episodes + 1, self.in_visit + length
            decision = self.policy.end_of_episode(
                record(task, self.episodes, self.in_visit, self.returns[task](self.steps[task]))
            )
            self.log.append((task, decision.reason))
            if isinstance(decision, SwitchTo):
                self.left.append(self.log[-1])
                self.task, self.episodes, self.in_visit = decision.task, 0, 0
        return self

    def shares(self) -> list[float]:
        return [steps / sum(self.steps) for steps in self.steps]


def deficit_policy(**settings: object) -> SwitchingPolicy:
    base = {"reference_scores": (10.0, 10.0, 10.0), "visit_steps": 100, "uniform_share": 0.0}
    return SwitchingPolicy(SwitchingConfig(policy="deficit", **(base | settings)), 3)  # type: ignore[arg-type]


@pytest.mark.slow
def test_steps_follow_the_shares_whatever_the_lengths_of_episodes() -> None:
    """Deficits 0.9, 0.5, 0 with temperature 0.5: shares as exp(1.8), exp(1), exp(0)."""
    policy = deficit_policy(deficit_temperature=0.5)
    played = Played(policy, [7, 90, 1000], [lambda _: 1.0, lambda _: 5.0, lambda _: 12.0]).run(9_000)
    weights = np.exp([0.9 / 0.5, 0.5 / 0.5, 0.0])
    assert played.shares() == pytest.approx(list(weights / weights.sum()), abs=0.01)


@pytest.mark.slow
def test_uniform_share_is_a_floor() -> None:
    policy = deficit_policy(uniform_share=0.3, deficit_temperature=0.01)
    played = Played(policy, [10, 10, 10], [lambda _: 0.0, lambda _: 10.0, lambda _: 10.0]).run(3_000)
    assert played.shares() == pytest.approx([0.8, 0.1, 0.1], abs=0.01)


def test_the_deficit_is_within_floor_and_reference_of_each_task() -> None:
    """Pong's scores are below 0: the published floor and a reference of one's own."""
    published = (Reference(-20.7, 14.6, "x"), Reference(1.7, 30.5, "x"))
    config = SwitchingConfig(policy="deficit", score_episodes=2, reference_scores=(-13.9, 18.9))
    for settings, expected in (
        (config, [0.5, 1.0]),
        (replace(config, reference_scores=()), [(14.6 + 17.3) / 35.3, 1.0]),
        (replace(config, floor_scores=(-21.0, 0.0)), [(-13.9 + 17.3) / 7.1, 1.0]),
    ):
        policy = SwitchingPolicy(settings, 2, published)
        policy.end_of_episode(record(0, 1, 10, -50.0))
        policy.end_of_episode(record(0, 2, 20, -17.3))
        decision = policy.end_of_episode(record(0, 3, 30, -17.3))
        assert policy.criterion.deficits() == pytest.approx(expected)
        assert decision.measured["score"] == pytest.approx(-17.3), "the mean of the two newest"


def test_a_visit_that_ends_within_an_episode_is_paid_in_full() -> None:
    policy = deficit_policy(max_stay_steps=500)
    shares: Shares = policy.criterion.shares
    assert policy.must_leave(510)
    assert policy.leave(0, 510).task == 1
    assert shares.steps_by_task == [510, 0, 0]
    assert shares.owed_steps == pytest.approx([-340.0, 170.0, 170.0])


def test_deficit_without_references_is_refused_with_what_to_set() -> None:
    config = SwitchingConfig(policy="deficit")
    with pytest.raises(ConfigError, match=r"expected switching.reference_scores, 2 numbers"):
        SwitchingPolicy(config, 2, [None, Reference(0.0, 1.0, "x")])
    with pytest.raises(ConfigError, match="reference_scores has 3 scores, expected 2, one for each task"):
        SwitchingPolicy(replace(config, reference_scores=(1.0, 2.0, 3.0)), 2)
    with pytest.raises(ConfigError, match=r"reference score -13.9 and the floor 0, .*floor_scores \(what random play"):
        SwitchingPolicy(replace(config, reference_scores=(-13.9, 1.0)), 2)


def progress_policy(**settings: object) -> SwitchingPolicy:
    base = {"visit_steps": 100, "progress_window_steps": 400, "uniform_share": 0.2}
    return SwitchingPolicy(SwitchingConfig(policy="learning_progress", **(base | settings)), 3)  # type: ignore[arg-type]


@pytest.mark.slow
def test_learning_progress_plays_what_changes_up_or_down() -> None:
    """A task that rises, one that falls at half the speed, a constant one: 2 : 1 : 0 beside 20 % for all."""
    policy = progress_policy(reference_scores=(100.0, 100.0, 100.0))
    played = Played(policy, [10, 10, 10], [lambda n: n / 1000, lambda n: 50 - n / 2000, lambda _: 5.0]).run(4_000)
    third = 0.2 / 3
    assert played.shares() == pytest.approx([third + 0.8 * 2 / 3, third + 0.8 / 3, third], abs=0.02)


def test_progress_is_the_slope_over_equal_steps_of_the_tasks_own() -> None:
    """Return = step / 100: over a window of 400 steps it rises by 4, of a range of 8; short episodes or long ones."""
    for length in (10, 50):
        criterion = progress_policy(reference_scores=(8.0, 8.0, 8.0)).criterion
        for episode in range(1, 1000 // length):
            criterion.end_of_episode(record(0, episode, length * episode, length * episode / 100))
        assert criterion.progress(0) == pytest.approx(0.5)
        assert criterion.progress(1) == 1.0, "not known yet"
    rare = progress_policy(reference_scores=(8.0, 8.0, 8.0)).criterion
    assert rare.progress(0) == 1.0
    rare.end_of_episode(record(0, 1, 5_000, 3.0))
    rare.end_of_episode(record(0, 2, 10_000, 3.0))
    assert rare.progress(0) == 1.0, "one episode per window says nothing of a slope"


def test_without_references_progress_is_relative_to_the_range_seen() -> None:
    criterion = progress_policy().criterion
    for episode in range(1, 201):
        criterion.end_of_episode(record(0, episode, 10 * episode, min(10.0 * episode, 1000.0) / 100))
    assert criterion.progress(0) == 0.0
    assert criterion.highest[0] == 10.0
    for episode in range(201, 241):  # falls by 5 in a window of 400 steps
        criterion.end_of_episode(record(0, episode, 10 * episode, 10.0 - (episode - 200) / 8))
    assert criterion.progress(0) == pytest.approx(5.0 / (10.0 - criterion.lowest[0]), rel=0.05)


def gain_policy(**settings: object) -> SwitchingPolicy:
    base = {"visit_steps": 100, "progress_window_steps": 400, "uniform_share": 0.0, "reference_scores": (10.0,) * 3}
    return SwitchingPolicy(SwitchingConfig(policy="harmonic_gain", **(base | settings)), 3)  # type: ignore[arg-type]


def test_harmonic_gain_follows_what_a_step_adds_to_the_harmonic_mean() -> None:
    """Compared with the mean's own differences, at scores of 0.2 and 0.5 of the references and different slopes."""
    criterion = gain_policy(score_episodes=2).criterion
    criterion.returns = [[9.0, 1.0, 3.0], [5.0], [4.0, 4.0]]
    criterion.progresses = [0.1, 0.4, 0.0]
    scores, small = np.array([0.2, 0.5, 0.4]), 1e-6
    assert [criterion.score(task) for task in range(3)] == pytest.approx(list(scores))

    def mean_after(steps: np.ndarray) -> float:
        return float(3 / (1 / (scores + steps * criterion.progresses)).sum())

    gains = [(mean_after(small * np.eye(3)[task]) - mean_after(np.zeros(3))) / small for task in range(3)]
    assert criterion.wanted() == pytest.approx(np.array(gains) / sum(gains), rel=1e-4)
    assert criterion.wanted()[2] == 0.0, "it does not move"
    criterion.returns[0] = [10.0, 12.0]
    assert criterion.wanted() == pytest.approx([0.0, 1.0, 0.0]), "it has reached its reference"
    criterion.returns[1] = [11.0]
    assert criterion.wanted() == pytest.approx([1 / 3] * 3), "nothing to gain: equal steps"


def test_harmonic_gain_plays_the_task_that_can_be_learned() -> None:
    """One task has reached its reference, one rises slowly, one stays at random play: most steps go to the second."""
    policy = gain_policy(uniform_share=0.3)
    played = Played(policy, [10, 10, 10], [lambda _: 10.0, lambda n: min(n / 4000, 9.0), lambda _: 0.0]).run(3_000)
    assert played.shares() == pytest.approx([0.1, 0.8, 0.1], abs=0.02)
    reasons = {reason for _, reason in played.left}
    assert reasons == {"harmonic_gain"}


def test_harmonic_gain_without_references_is_refused() -> None:
    with pytest.raises(
        ConfigError, match=r"policy is harmonic_gain, .* expected switching.reference_scores, 3 numbers"
    ):
        gain_policy(reference_scores=())


def test_the_guard_leaves_a_task_on_which_a_layers_neurons_fell_silent() -> None:
    policy = SwitchingPolicy(SwitchingConfig(policy="dormancy_guard", visit_steps=100, silent_rise=0.2), 2)
    asked: list[int] = []

    def judged(steps: int, silent: dict[str, float], updates: int = 1) -> Stay | SwitchTo:
        made = replace(
            record(0, steps // 10, steps, 0.0),
            updates_in_visit=updates,
            observations=lambda count: asked.append(count) or torch.zeros(count, 4),
            silent_shares=lambda seen: silent,
        )
        return policy.end_of_episode(made)

    assert judged(10, {}, updates=0).measured == {"visit_steps": 100.0}, "nothing was learned yet"
    shares = [{"conv": 0.5, "value": 0.6}, {"conv": 0.4, "value": 0.6}, {"conv": 0.55, "value": 0.7}]
    assert all(isinstance(judged(20 + 10 * at, each), Stay) for at, each in enumerate(shares))
    decision = judged(50, {"conv": 0.61, "value": 0.6})
    assert isinstance(decision, SwitchTo)
    assert decision.reason == "neurons_fell_silent"
    assert decision.measured["silent_share"] == 0.61
    assert decision.measured["silent_rise"] == pytest.approx(0.21), "from the smallest share of the visit"
    assert asked == [64], "one probe for the visit"
    assert isinstance(judged(90, {"conv": 0.9}), Stay), "another visit"
    assert judged(100, {"conv": 0.9}).reason == "visit_steps"


def resting_policy(**settings: object) -> SwitchingPolicy:
    base = {
        "plateau_window_episodes": 4,
        "plateau_patience_episodes": 2,
        "check_every_steps": 1000,
        "check_episodes": 3,
    }
    return SwitchingPolicy(SwitchingConfig(policy="plateau_and_return", **(base | settings)), 3)  # type: ignore[arg-type]


def test_a_plateaued_task_is_checked_and_played_again_when_its_score_fell() -> None:
    """Task 0 is flat until it has fallen; task 1 rises for ever; task 2 is never reached."""
    fallen = False
    policy = resting_policy()
    played = Played(
        policy, [10, 10, 10], [lambda n: (4.0 if fallen else 8.0) + (n // 10) % 2, lambda n: float(n), lambda _: 0.0]
    )
    played.run(220)
    tasks = [task for task, _ in played.log]
    assert set(tasks) == {0, 1}
    assert played.left.count((0, "reward_plateau")) == 1
    first = next(index for index, (task, _) in enumerate(played.log) if task == 1)
    checks = [index for index, task in enumerate(tasks) if task == 0 and index > first]
    assert played.log[checks[0] - 1] == (1, "check_due")
    assert checks[:3] == [checks[0], checks[0] + 1, checks[0] + 2], "a check of three episodes"
    assert played.log[checks[2]] == (0, "still_on_plateau")
    assert tasks[checks[2] + 1] == 1, "the task that was interrupted goes on"
    assert checks[3] - checks[2] - 1 == pytest.approx(1000 / 10, abs=1), "and is not disturbed for 1,000 steps"

    fallen, before = True, len(played.log)
    played.run(200)
    after = played.log[before:]
    fell = after.index((0, "score_fell"))
    assert [task for task, _ in after[fell - 2 : fell + 3]] == [0] * 5, "it stays"
    assert (0, "reward_plateau") in after[fell:], "until it is on a plateau again"


def test_when_all_tasks_rest_a_new_round_begins() -> None:
    played = Played(resting_policy(check_every_steps=10**9), [10] * 3, [lambda _: 1.0] * 3).run(60)
    left = [task for task, reason in played.left if reason == "reward_plateau"]
    assert left == [0, 1, 2] * (len(left) // 3) + [0, 1, 2][: len(left) % 3]
    assert len(left) >= 6


def test_a_task_that_rises_is_left_by_max_stay_only_and_is_no_plateau() -> None:
    rising = [lambda n: float(n)] * 3
    played = Played(resting_policy(max_stay_steps=50), [10] * 3, rising).run(60)
    assert [task for task, _ in played.log] == ([0] * 5 + [1] * 5 + [2] * 5) * 4
    assert played.policy.criterion.rests == [False] * 3


def test_a_plateau_within_the_minimal_stay_is_not_yet_left() -> None:
    played = Played(resting_policy(min_stay_steps=200), [10] * 3, [lambda _: 1.0] * 3).run(20)
    assert [task for task, _ in played.log] == [0] * 20
    assert played.log[-1] == (0, "reward_plateau")
    assert played.log[-2] == (0, "min_stay")
    assert played.policy.criterion.rests == [True, False, False]


def test_episodes_of_the_step_in_which_a_task_was_left_do_not_count_as_a_check() -> None:
    policy = resting_policy()
    for episode in range(1, 10):
        decision = policy.judge(record(0, episode, 10 * episode, 1.0))
        if isinstance(decision, SwitchTo):
            break
    assert isinstance(policy.judge(record(0, episode + 1, 10 * episode, -99.0), left=True), Stay)
    assert policy.criterion.checks == []
    policy.start_visit()
    assert not policy.criterion.is_over


def test_a_fall_is_counted_in_standard_errors_of_the_plateau() -> None:
    before = [8.0, 10.0, 8.0, 10.0]
    error = np.std(before, ddof=1) * math.sqrt(1 / 4 + 1 / 2)
    assert fall_errors(before, [5.0, 6.0]) == pytest.approx(3.5 / error)
    assert fall_errors(before, [11.0, 11.0]) < 0
    assert fall_errors([1.0, 1.0], [0.9]) == math.inf
    assert fall_errors([1.0, 1.0], [1.0]) == 0.0


def test_value_change_counts_neither_updates_nor_parameters() -> None:
    """Q moves by 1 per update at first, then by 0.4; window of two episodes, fraction 1/2."""
    policy = SwitchingPolicy(SwitchingConfig(policy="value_change", window_episodes=2, probe_observations=3), 2)
    asked: list[int] = []
    q, updates, decisions = 0.0, 0, []
    for episode, (more, per_update) in enumerate([(0, 0.0), (5, 1.0), (50, 1.0), (8, 0.4), (2, 0.4)], start=1):
        updates, q = updates + more, q + more * per_update
        made = replace(
            record(0, episode, 10 * episode, 0.0, updates + 1),
            observations=lambda count: asked.append(count) or torch.zeros(count, 4),
            values=lambda seen, value=q: torch.full((len(seen), 2), value),
        )
        decisions.append(policy.end_of_episode(made))
    assert asked == [3], "one probe for the visit"
    assert [decision.reason for decision in decisions[:2]] == ["window_fills"] * 2
    rates = [decision.measured.get("value_change_per_update") for decision in decisions[2:]]
    assert rates == pytest.approx([1.0, (50 + 3.2) / 58, 0.4])
    assert isinstance(decisions[3], Stay)
    assert isinstance(decisions[4], SwitchTo)
    assert policy.criterion.probe is None, "a new probe in the next visit"


@pytest.mark.slow
def test_the_values_of_a_training_are_its_networks_and_looking_changes_nothing() -> None:
    from switchmt_snn.learning.training import Training

    suite = vector_suite(SameObservationEnvironment, 3)  # type: ignore[arg-type]
    trainings = [Training(small_config(total_steps=60), suite, torch.device("cpu")) for _ in range(2)]
    looks = 0

    def judge(asked: EpisodeRecord, left: bool = False) -> Stay:
        nonlocal looks
        looks += 1
        seen = asked.observations(5)
        assert torch.equal(seen, asked.observations(5)), "the same step gives the same draw"
        values = asked.values(seen)
        learner = trainings[0].learner
        with torch.no_grad():
            expected = learner.network.eval()(seen, asked.task)
        valid = suite.valid_actions_KA[asked.task]
        assert torch.equal(values, expected[:, valid])
        for layer, rates in learner.firing_rates(seen, asked.task).items():
            assert asked.silent_shares(seen)[layer] == pytest.approx(int((rates == 0).sum()) / len(rates))
        return Stay("looked", {})

    trainings[0].policy.judge = judge  # type: ignore[method-assign]
    trainings[1].policy.judge = lambda asked, left=False: Stay("looked", {})  # type: ignore[method-assign]
    for training in trainings:
        for event in training.events():
            del event
    assert looks > 3
    assert torch.equal(trainings[0].learner.parameters(), trainings[1].learner.parameters())


def test_a_record_without_a_network_says_so() -> None:
    with pytest.raises(ConfigError, match=r"no network to ask .* cannot judge recorded episodes"):
        record(0, 1, 1, 0.0).observations(3)


class Chooses(Criterion):
    """Always goes to the task that its option names."""

    columns = ()
    judges_learning = False
    DERIVED = ("favourite", "num_tasks")

    def __init__(self, config: SwitchingConfig, favourite: int = 1) -> None:
        self.favourite = favourite

    def meet_tasks(self, num_tasks: int, references: tuple[Reference | None, ...]) -> None:
        self.num_tasks = num_tasks

    def next_task(self, task: int, num_tasks: int, steps_in_visit: int) -> int:
        assert num_tasks == self.num_tasks
        return self.favourite if task != self.favourite else 0

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        return Verdict(True, "favourite", {})


class ChoosesNothing(Chooses):
    def next_task(self, task: int, num_tasks: int, steps_in_visit: int) -> int:
        return self.favourite


class MeetsTooMuch(Chooses):
    def meet_tasks(self, num_tasks: int, references: tuple[Reference | None, ...]) -> None:
        self.names = references


def own(criterion: type[Criterion], favourite: int) -> SwitchingConfig:
    return SwitchingConfig(policy=f"{__name__}:{criterion.__name__}", options=(f"favourite={favourite}",))  # type: ignore[arg-type]


def test_a_criterion_from_outside_chooses_the_next_task() -> None:
    check_policy(own(Chooses, 1))
    policy = SwitchingPolicy(own(Chooses, 2), 4)
    assert policy.end_of_episode(record(0, 1, 1, 0.0)) == SwitchTo(2, "favourite", {})
    assert policy.leave(2, 5) == SwitchTo(0, "max_stay_steps", {})


@pytest.mark.parametrize(
    ("criterion", "favourite", "complaint"),
    [
        (ChoosesNothing, 0, "ChoosesNothing returned 0 from next_task, expected the index of another task than 0"),
        (ChoosesNothing, 7, "returned 7 from next_task, .* from 0 to 1"),
        (MeetsTooMuch, 1, "MeetsTooMuch has the attribute 'names', expected it in SAVED"),
    ],
)
def test_a_choice_that_is_no_other_task_shows_before_training(
    criterion: type[Criterion], favourite: int, complaint: str
) -> None:
    with pytest.raises(ConfigError, match=complaint):
        check_policy(own(criterion, favourite))
