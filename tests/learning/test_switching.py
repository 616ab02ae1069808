"""Switching policies: bounds that all keep, and each criterion on records made by hand."""

from __future__ import annotations

import math
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from switchmt_snn.config import POLICIES, SwitchingConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.learner import Learner
from switchmt_snn.learning.switching import (
    CRITERIA,
    DECISION_COLUMNS,
    Criterion,
    Deciding,
    EpisodeRecord,
    Stay,
    SwitchingPolicy,
    SwitchTo,
    Verdict,
    check_policy,
    register_criterion,
)
from switchmt_snn.learning.switching.parameter_change import relative_change
from switchmt_snn.learning.switching.reward_plateau import slope_test
from switchmt_snn.replay.ring import Returns
from switchmt_snn.tasks.suite import Reference
from tests.conftest import SameObservationEnvironment, small_config, vector_suite


def record(
    episode: int, steps: int, theta: Tensor, updates: int | None = None, value: float = 0.0, task: int = 0
) -> EpisodeRecord:
    """A record of a visit that began at update 0; default: one update per episode."""
    updates = episode if updates is None else updates
    observations, values = (lambda count: torch.zeros(count, 4)), (lambda seen: theta.mean().expand(len(seen), 2))
    seen = (observations, values, lambda seen: {"value": float((theta > 0.5).float().mean())})
    return EpisodeRecord(task, episode, steps, updates, updates, value, theta.clone, *seen)


REFERENCES = [Reference(random=0.0, human=1.0, source="made up")] * 3


def play(policy: SwitchingPolicy, lengths: list[int], drift: float, values: list[float]) -> list[tuple[int, int, bool]]:
    """Feed episodes; returns (steps and episodes in the visit, left?) for each decision."""
    theta, steps, episodes, log = torch.ones(4), 0, 0, []
    for number, (length, value) in enumerate(zip(lengths, values, strict=True)):
        steps, episodes = steps + length, episodes + 1
        theta = theta * (1 + drift)
        decision = policy.end_of_episode(record(episodes, steps, theta, updates=10 * number, value=value))
        log.append((steps, episodes, isinstance(decision, SwitchTo)))
        if isinstance(decision, SwitchTo):
            steps = episodes = 0
    return log


@pytest.mark.slow
@settings(max_examples=80, deadline=None)
@given(
    policy=st.sampled_from(sorted(CRITERIA)),
    lengths=st.lists(st.integers(1, 60), min_size=1, max_size=80),
    drift=st.floats(0.0, 0.2),
    seed=st.integers(0, 1000),
    min_steps=st.integers(0, 200),
    extra=st.integers(1, 300),
    min_episodes=st.integers(0, 10),
)
def test_every_criterion_keeps_the_bounds(policy, lengths, drift, seed, min_steps, extra, min_episodes) -> None:
    """Never leaves before min_stay, always at the first episode end past max_stay; same records, same decisions."""
    config = SwitchingConfig(
        policy=policy,
        visit_episodes=3,
        visit_steps=50,
        window_episodes=2,
        plateau_window_episodes=4,
        min_stay_steps=min_steps,
        min_stay_episodes=min_episodes,
        max_stay_steps=min_steps + extra,
    )
    values = list(np.random.default_rng(seed).normal(size=len(lengths)))
    logs = [play(SwitchingPolicy(config, 3, REFERENCES), lengths, drift, values) for _ in range(2)]
    assert logs[0] == logs[1]
    for steps, episodes, left in logs[0]:
        past = steps >= min_steps + extra
        if left and not past:
            assert steps >= min_steps
            assert episodes >= min_episodes
        if past:
            assert left


def test_every_criterion_can_leave_and_with_one_task_none_does() -> None:
    for name in CRITERIA:
        config = SwitchingConfig(
            policy=name,
            visit_episodes=3,
            visit_steps=20,
            window_episodes=2,
            plateau_window_episodes=4,
        )
        # The parameters move fast at first and then hardly, the returns are flat.
        theta, outcomes = torch.ones(4), {1: [], 3: []}
        for num_tasks, decisions in outcomes.items():
            policy = SwitchingPolicy(config, num_tasks, REFERENCES[:num_tasks])
            theta = torch.ones(4)
            for episode in range(1, 13):
                theta = theta * (1.5 if episode < 4 else 1.001)
                decisions.append(policy.end_of_episode(record(episode, 10 * episode, theta, 10 * episode)))
        assert any(isinstance(d, SwitchTo) and d.task == 1 for d in outcomes[3]), name
        assert all(isinstance(d, Stay) for d in outcomes[1]), name


def test_eq_3_spans_k_episodes() -> None:
    """K = 2: three snapshots; the first decision with a number comes at the third episode end."""
    policy = SwitchingPolicy(SwitchingConfig(policy="parameter_change", window_episodes=2), 2)
    thetas = [torch.tensor([3.0, 4.0]), torch.tensor([3.0, 4.0]), torch.tensor([3.0, 4.0 + 1.0])]
    first, second, third = (policy.end_of_episode(record(n, n, theta)) for n, theta in enumerate(thetas, start=1))
    assert "parameter_change" not in first.measured
    assert "parameter_change" not in second.measured
    assert third.measured["parameter_change"] == pytest.approx(1 / 5)  # |(0, 1)| / |(3, 4)|
    assert isinstance(third, Stay)
    fourth = policy.end_of_episode(record(4, 4, torch.tensor([3.0, 4.0 + 0.4])))
    # now against the second snapshot (3, 4): 0.4 / 5 = 8 % < 10 %
    assert fourth.measured["parameter_change"] == pytest.approx(0.08)
    assert fourth == SwitchTo(1, "parameter_change", fourth.measured)
    fifth = policy.end_of_episode(record(1, 1, torch.ones(2)))
    assert "parameter_change" not in fifth.measured, "H_i was emptied"


LEARNING_POLICIES = (
    "parameter_change",
    "parameter_change_per_update",
    "reward_plateau",
    "parameter_and_reward",
    "value_change",
    "plateau_and_return",
)


@pytest.mark.parametrize("policy", POLICIES)
def test_a_policy_that_judges_learning_waits_for_the_first_update_of_the_visit(policy: str) -> None:
    """Parameters that no update moved, and the returns of random play, are no sign of convergence."""
    config = SwitchingConfig(policy=policy, window_episodes=2, plateau_window_episodes=3, visit_episodes=4)
    still = [record(n, 9_000 * n, torch.ones(4), updates=0) for n in range(1, 20)]
    learning = policy in LEARNING_POLICIES
    for judge, waits in (("after_updates", learning), ("auto", learning), ("always", False)):
        asked = SwitchingPolicy(replace(config, judge_learning=judge), 2, REFERENCES[:2])  # type: ignore[arg-type]
        answers = [asked.end_of_episode(each) for each in still]
        if waits:
            assert {answer.reason for answer in answers} == {"no_updates_yet"}
            assert all(isinstance(answer, Stay) for answer in answers)
        elif policy not in ("parameter_change_per_update", "value_change"):  # they judge no window without updates
            assert any(isinstance(answer, SwitchTo) for answer in answers)
    bounded = SwitchingPolicy(replace(config, max_stay_steps=10_000), 2, REFERENCES[:2])
    assert isinstance(bounded.end_of_episode(still[1]), SwitchTo), "the bounds hold while it waits"


def test_the_window_of_eq_3_begins_with_the_first_update_and_decides_nothing_without_one() -> None:
    policy = SwitchingPolicy(SwitchingConfig(policy="parameter_change", window_episodes=2), 2)
    updates = [0, 0, 0, 5, 5, 5, 6]
    thetas = [torch.full((4,), 1.0 + count / 100) for count in updates]
    answers = [policy.end_of_episode(record(n, n, theta, updates[n])) for n, theta in enumerate(thetas)]
    assert [answer.reason for answer in answers] == [
        *["no_updates_yet"] * 3, "window_fills", "window_fills", "no_updates_in_window", "parameter_change",
    ]  # fmt: skip
    assert answers[5].measured["parameter_change"] == 0.0
    assert answers[6].measured["parameter_change"] == pytest.approx(0.01 / 1.05)
    assert [isinstance(answer, SwitchTo) for answer in answers] == [False] * 6 + [True]


def test_a_state_from_before_updates_were_kept_goes_on() -> None:
    config = SwitchingConfig(policy="parameter_change", window_episodes=1, judge_learning="always")
    policy = SwitchingPolicy(config, 2)
    policy.load_state_dict({"criterion": {"history": [torch.ones(4)]}})
    assert isinstance(policy.end_of_episode(record(2, 2, torch.ones(4), updates=0)), SwitchTo)


def test_snapshots_are_copies() -> None:
    """The released script's snapshot aliases the live parameters, so its change is always 0. One update must show."""
    from switchmt_snn.learning.training import Training

    suite = vector_suite(SameObservationEnvironment, 3)  # type: ignore[arg-type]
    training = Training(small_config(total_steps=30), suite, torch.device("cpu"))
    learner: Learner = training.learner
    for event in training.events():
        del event
    before = learner.parameters()
    kept = before.clone()
    learner.update(training.replays[0].sample(8, np.random.default_rng(0), Returns()), 0)
    assert torch.equal(before, kept), "the snapshot moved with the network"
    assert relative_change(before, learner.parameters()) > 0


def test_slope_test_equals_least_squares() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        values = list(rng.normal(size=12) + 0.1 * np.arange(12))
        (slope, _), covariance = np.polyfit(np.arange(12), values, 1, cov="unscaled")
        residual = np.asarray(values) - np.polyval(np.polyfit(np.arange(12), values, 1), np.arange(12))
        error = math.sqrt((residual**2).sum() / 10 * covariance[0, 0])
        ours, t = slope_test(values)
        assert ours == pytest.approx(slope)
        assert t == pytest.approx(slope / error)
    assert slope_test([2.0] * 5) == (0.0, 0.0)
    assert slope_test([1.0, 2.0, 3.0, 4.0])[1] == math.inf


def test_reward_plateau_needs_patience() -> None:
    config = SwitchingConfig(policy="reward_plateau", plateau_window_episodes=4, plateau_patience_episodes=3)
    policy = SwitchingPolicy(config, 2)
    rising = [policy.end_of_episode(record(n, n, torch.ones(1), value=float(n))) for n in range(1, 9)]
    assert all(isinstance(d, Stay) for d in rising)
    flat = [policy.end_of_episode(record(n, n, torch.ones(1), value=8.0)) for n in range(9, 20)]
    left = next(index for index, d in enumerate(flat) if isinstance(d, SwitchTo))
    assert flat[left].measured["flat_episodes"] == 3
    assert [d.measured["flat_episodes"] for d in flat[left - 2 : left]] == [1, 2]


def test_the_config_names_every_criterion_and_no_other() -> None:
    assert set(CRITERIA) == set(POLICIES)


@pytest.mark.parametrize("name", sorted(CRITERIA))
def test_every_criterion_reports_its_columns_and_keeps_no_more_snapshots_than_it_declares(name: str) -> None:
    config = SwitchingConfig(
        policy=name, window_episodes=2, plateau_window_episodes=4, check_every_steps=20, check_episodes=2
    )
    policy = SwitchingPolicy(config, 3, REFERENCES)
    seen: set[str] = set()
    alive: list[weakref.ref[Tensor]] = []
    most = 0

    def parameters() -> Tensor:
        nonlocal most
        theta = torch.rand(4)
        alive.append(weakref.ref(theta))
        most = max(most, sum(reference() is not None for reference in alive))
        return theta

    task = in_visit = 0
    for episode in range(1, 60):
        updates, in_visit = 0 if episode < 5 else 10 * episode, in_visit + 1
        made = record(in_visit, 10 * in_visit, torch.rand(4), updates, float(min(episode, 20)), task)
        decision = policy.end_of_episode(replace(made, updates_in_visit=1, parameters=parameters))
        seen |= set(decision.measured)
        if isinstance(decision, SwitchTo):
            task, in_visit = decision.task, 0
    assert seen == set(policy.columns)
    assert most <= policy.criterion.snapshots(config)
    assert not seen & set(DECISION_COLUMNS)


class ReturnAbove(Criterion):
    """Leaves when the mean return of the visit is above a bound."""

    columns = ("mean_return",)
    SAVED = ("returns",)
    DERIVED = ("bound",)

    def __init__(self, config: SwitchingConfig, bound: float = 1.0) -> None:
        self.bound = bound
        self.returns: list[float] = []

    def start_visit(self) -> None:
        self.returns = []

    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        self.returns.append(record.episode_return)
        mean = sum(self.returns) / len(self.returns)
        return Verdict(mean > self.bound, "return_above", {"mean_return": mean})


class UndeclaredNumber(ReturnAbove):
    columns = ()


class UndeclaredSnapshot(ReturnAbove):
    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        return Verdict(False, "never", {"mean_return": float(record.parameters().sum())})


class LostAttribute(ReturnAbove):
    SAVED = ()


class LateAttribute(ReturnAbove):
    def start_visit(self) -> None:
        self.visits = 1
        super().start_visit()


class NoColumns(Criterion):
    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        return Verdict(False, "never", {})


class NoRule(Criterion):
    columns = ()


class TextAsColumns(ReturnAbove):
    columns = "mean_return"  # type: ignore[assignment]


class TakenColumn(ReturnAbove):
    columns = ("step",)


class NoCriterion:
    columns = ()


def own(criterion: type, **changes: object) -> SwitchingPolicy:
    return SwitchingPolicy(SwitchingConfig(policy=f"{__name__}:{criterion.__name__}", **changes), 2)  # type: ignore[arg-type]


def test_a_criterion_from_outside_decides_with_its_options() -> None:
    for options, leaves in (((), True), (("bound=5",), False), (("bound=1e0",), True)):
        policy = own(ReturnAbove, options=options)
        assert policy.columns == ("mean_return",)
        decision = policy.end_of_episode(record(1, 1, torch.ones(1), value=3.0))
        assert isinstance(decision, SwitchTo) == leaves
        assert decision.measured == {"mean_return": 3.0}


@pytest.mark.parametrize(
    ("criterion", "complaint"),
    [
        (NoCriterion, "is no criterion, expected a subclass of switchmt_snn.learning.switching.Criterion"),
        (NoRule, "defines no end_of_episode"),
        (NoColumns, "columns are None, expected a tuple"),
        (TextAsColumns, "columns are 'mean_return', expected a tuple"),
        (TakenColumn, "has a column 'step', expected plain names"),
        (LostAttribute, "LostAttribute has the attribute 'returns', expected it in SAVED"),
    ],
)
def test_a_class_that_is_no_whole_criterion_is_refused_in_one_line(criterion: type, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint) as caught:
        own(criterion)
    assert "\n" not in str(caught.value)


def test_what_a_criterion_does_not_declare_is_refused_when_it_shows() -> None:
    with pytest.raises(ConfigError, match=r"criterion UndeclaredNumber measured 'mean_return', expected .* \(none\)"):
        own(UndeclaredNumber).end_of_episode(record(1, 1, torch.ones(1)))
    with pytest.raises(ConfigError, match="UndeclaredSnapshot asks for the parameters but declares 0 snapshots"):
        own(UndeclaredSnapshot).end_of_episode(record(1, 1, torch.ones(1)))
    policy = own(LateAttribute)
    policy.state_dict()
    policy.end_of_episode(record(1, 1, torch.ones(1), value=3.0))
    with pytest.raises(ConfigError, match="LateAttribute has the attribute 'visits'"):
        policy.state_dict()


class TruthValue(ReturnAbove):
    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        return True  # type: ignore[return-value]


class Nothing(ReturnAbove):
    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        return None  # type: ignore[return-value]


class NoReason(ReturnAbove):
    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        return Verdict(True, {}, {})  # type: ignore[arg-type]


class WordMeasured(ReturnAbove):
    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        return Verdict(False, "never", {"mean_return": "high"})  # type: ignore[dict-item]


class NaNMeasured(ReturnAbove):
    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        return Verdict(False, "never", {"mean_return": float("nan")})


class NoComma(ReturnAbove):
    SAVED = "returns"  # type: ignore[assignment]


class DerivedAsText(ReturnAbove):
    DERIVED = "bound"  # type: ignore[assignment]


class JudgesInWords(ReturnAbove):
    judges_learning = "no"  # type: ignore[assignment]


class DecidingText(ReturnAbove):
    deciding = ("mean_return",)  # type: ignore[assignment]


class DecidingUnknown(ReturnAbove):
    deciding = (Deciding("mean_return", ("target",)),)


class TextSnapshots(ReturnAbove):
    @classmethod
    def snapshots(cls, config: SwitchingConfig) -> int:
        return "one"  # type: ignore[return-value]


class Fails(ReturnAbove):
    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        return Verdict(record.reward > 1, "never", {})  # type: ignore[attr-defined]


class FailsInSecondVisit(ReturnAbove):
    def start_visit(self) -> None:
        self.returns = None  # type: ignore[assignment]


class SavesSet(ReturnAbove):
    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        self.returns = {record.episode_return}  # type: ignore[assignment]
        return Verdict(False, "never", {})


class SavesNumbersAsKeys(ReturnAbove):
    def end_of_episode(self, record: EpisodeRecord) -> Verdict:
        self.returns = {record.task: 1.0}  # type: ignore[assignment]
        return Verdict(False, "never", {})


class WithoutConfig(ReturnAbove):
    def __init__(self, bound: float) -> None:
        super().__init__(SwitchingConfig(), bound)


@pytest.mark.parametrize(
    ("criterion", "complaint"),
    [
        (TruthValue, r"TruthValue returned True from end_of_episode, expected Verdict\(leave"),
        (Nothing, "Nothing returned None from end_of_episode"),
        (NoReason, "expected leave True or False, reason a text"),
        (WordMeasured, "WordMeasured measured 'mean_return' as 'high', expected a number"),
        (NaNMeasured, "NaNMeasured measured 'mean_return' as nan, expected a number; leave it out of measured"),
        (NoComma, r"whose SAVED is 'returns', expected a tuple of names, as \(\"returns\",\) with its comma"),
        (DerivedAsText, r"whose DERIVED is 'bound', expected a tuple of names"),
        (JudgesInWords, "whose judges_learning is 'no', expected True or False"),
        (DecidingText, r"whose deciding is \('mean_return',\), expected a tuple of Deciding"),
        (DecidingUnknown, "whose deciding names 'target', expected one of mean_return, episodes_in_visit"),
        (TextSnapshots, "whose snapshots gave 'one', expected a whole number from 0"),
        (Fails, r"fails in end_of_episode \(AttributeError: 'EpisodeRecord' .* at test_switching.py, line"),
        (FailsInSecondVisit, r"fails in end_of_episode \(AttributeError: 'NoneType'"),
        (SavesSet, "SavesSet.returns is a set, expected what a checkpoint can hold"),
        (SavesNumbersAsKeys, "SavesNumbersAsKeys.returns has the key 0, expected keys that are texts"),
        (WithoutConfig, r"whose constructor takes \(bound: .*expected __init__\(self, config, ...\)"),
    ],
)
def test_a_mistake_in_a_criterion_shows_before_training(criterion: type, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint) as caught:
        check_policy(SwitchingConfig(policy=f"{__name__}:{criterion.__name__}", options=("bound=2",)))  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_every_whole_criterion_passes_the_check() -> None:
    check_policy(SwitchingConfig(policy=f"{__name__}:ReturnAbove", options=("bound=2",)))  # type: ignore[arg-type]
    for name in CRITERIA:
        check_policy(SwitchingConfig(policy=name))  # type: ignore[arg-type]


@pytest.mark.parametrize("option", ["bound=two", "bound=true"])
def test_an_option_of_another_type_than_its_parameter_is_refused(option: str) -> None:
    with pytest.raises(ConfigError, match=r"switching.options has bound=.*, expected a number, as its default 1.0"):
        own(ReturnAbove, options=(option,))


def test_wrong_options_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"switching.options has 'bund', expected .* did you mean 'bound'"):
        own(ReturnAbove, options=("bund=1",))
    for option in ("bound", "=1", "bound=[1]", "two words=1"):
        with pytest.raises(ConfigError, match="expected name=value"):
            own(ReturnAbove, options=(option,))
    with pytest.raises(ConfigError, match="expected none for policy interleave"):
        SwitchingConfig(policy="interleave", options=("bound=1",))


def test_a_registered_name_is_one_that_the_config_takes_and_that_is_free() -> None:
    with pytest.raises(ConfigError, match="'return_above' is not a value"):
        register_criterion("return_above")(ReturnAbove)
    with pytest.raises(ConfigError, match="'interleave' is Interleave, expected a name that is free"):
        register_criterion("interleave")(ReturnAbove)


def test_unresolved_policy_is_refused() -> None:
    with pytest.raises(ConfigError, match="expected one of"):
        SwitchingPolicy(SwitchingConfig(policy="auto"), 2)
