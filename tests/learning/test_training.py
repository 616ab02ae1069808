"""Algorithm 1: counting environments, state, golden run, and two tasks that contradict each other."""

from __future__ import annotations

import hashlib
import json
import platform
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from switchmt_snn.config import METHODS, POLICIES, ExperimentConfig
from switchmt_snn.errors import TrainingFailed
from switchmt_snn.learning.clocks import Every, linear_decay
from switchmt_snn.learning.events import EpisodeEnded, Measured, Stepped, SwitchDecided
from switchmt_snn.learning.state import Stateful
from switchmt_snn.learning.switching import SwitchTo
from switchmt_snn.learning.training import Training
from switchmt_snn.replay.ring import Batch, FrameReplay
from switchmt_snn.tasks.play import Play
from tests.conftest import CountingEnvironment, SameObservationEnvironment, small_config, vector_suite
from tests.learning.resuming import assert_continues_exactly

REFERENCE = {"reference_scores": [30.0, 60.0]}  # for the policies that need one
GOLDEN = Path(__file__).parents[1] / "golden" / "update_losses.json"


def counting(config: ExperimentConfig, length: int = 7, stack: int = 3) -> Training:
    suite = vector_suite(lambda task, n: CountingEnvironment(task, n, length), 4, stack=stack)
    return Training(config, suite, torch.device("cpu"))


def run(training: Training) -> list[Any]:
    return list(training.events())


@pytest.mark.slow
@pytest.mark.parametrize("num_envs", [1, 3])
@pytest.mark.parametrize("update_tasks", ["current", "all"])
def test_batches_never_mix_tasks_or_cross_episodes(num_envs: int, update_tasks: str, monkeypatch) -> None:
    """The agent sees contiguous steps of its task; every sampled transition is two neighbours of one episode."""
    config = small_config(
        tasks={"num_envs": num_envs},
        learning={"update_tasks": update_tasks, "update_every_steps": 2, "clip_rewards": False},
    )
    training = counting(config)
    checked = {"batches": 0, "actions": 0, "padded": 0}

    def check_batch(batch: Batch, task: int) -> None:
        now, after = (x.reshape(len(x), 3, 4) for x in (batch.observations, batch.next_observations))
        for frames, following in zip(now, after, strict=True):
            shown = frames[frames.any(axis=1)]
            checked["padded"] += len(shown) < 3
            for stack in (shown, following[following.any(axis=1)]):
                assert (stack[:, 0] == task).all(), "a frame of another task"
                assert len({tuple(frame[1:3]) for frame in stack}) == 1, "frames of two episodes"
                assert (np.diff(stack[:, 3]) == 1).all(), "frames are not neighbours"
            assert following[-1, 3] == frames[-1, 3] + 1, "the next observation is not the next one"
            assert (shown[0, 3] == 0) or len(shown) == 3, "a stack is short although the episode is older"
        steps_after, seeds = after[:, -1, 3], after[:, -1, 2]
        assert np.array_equal(batch.rewards, steps_after)
        assert np.array_equal(batch.terminated, (steps_after == 7) & (seeds % 2 == 1))
        checked["batches"] += 1

    original_update, original_act = training.learner.update, training.learner.act

    def update(batch: Batch, task: int) -> None:
        check_batch(batch, task)
        original_update(batch, task)

    def act(observations: np.ndarray, task: int) -> np.ndarray:
        newest = observations.reshape(num_envs, 3, 4)[:, -1]
        assert (newest[:, 0] == task).all()
        assert (newest[:, 1] == np.arange(num_envs)).all()
        checked["actions"] += 1
        return original_act(observations, task)

    monkeypatch.setattr(training.learner, "update", update)
    monkeypatch.setattr(training.learner, "act", act)
    run(training)
    assert checked["batches"] > 50
    assert checked["actions"] > 10
    assert checked["padded"] > 0
    for replay in training.replays:
        replay.check_valid()


@pytest.mark.slow
def test_steps_episodes_and_updates_add_up() -> None:
    training = counting(small_config(total_steps=402, tasks={"num_envs": 3}, learning={"update_every_steps": 4}))
    events = run(training)
    stepped = [e for e in events if isinstance(e, Stepped)]
    assert [e.step for e in stepped] == list(range(3, 403, 3))
    assert sum(training.steps_by_task) == training.steps == 402
    ended = [e for e in events if isinstance(e, EpisodeEnded)]
    assert all(e.length_steps == 7 for e in ended)
    assert all(e.episode_return == 28 for e in ended)  # 1 + 2 + ... + 7
    assert [e.episode for e in ended if e.task == 0] == list(range(1, training.episodes_by_task[0] + 1))
    switches = [e for e in events if isinstance(e, SwitchDecided) and isinstance(e.decision, SwitchTo)]
    assert switches, "max_stay_steps must end a visit"
    assert all(e.steps_in_visit <= 60 + 2 for e in switches)
    # The clock ticks every 4 steps; a task's first 20 steps are random and make no update.
    due = 402 // 4
    assert due - 2 * -(-21 // 3) <= training.learner.updates < due


@pytest.mark.slow
@pytest.mark.parametrize("update_tasks", ["current", "all"])
def test_no_task_is_left_by_a_judgement_on_learning_before_its_own_first_update(update_tasks: str) -> None:
    """Episodes of 7 steps, a replay that is sampled from 40 transitions on, windows of 2 episodes."""
    config = small_config(
        total_steps=300,
        learning={"learning_starts_steps": 40, "update_tasks": update_tasks, "learning_rate": 1e-9},
        switching={"max_stay_steps": None},
    )
    switches = [e for e in run(counting(config)) if isinstance(e, SwitchDecided)]
    for task in range(2):
        first = [e for e in switches if e.visit == task + 1]
        waiting = [e.decision.reason for e in first if e.episodes_in_visit * 7 <= 39]
        assert waiting == ["no_updates_yet"] * 5
        assert [e.decision.reason for e in first[5:]] == ["window_fills"] * 2 + ["parameter_change"]
        assert isinstance(first[-1].decision, SwitchTo)


@pytest.mark.slow
def test_a_task_that_is_left_pauses_and_goes_on() -> None:
    """Visits of 4 steps, episodes of 7: each one ends in a later visit than it began in, and none is lost."""
    training = counting(small_config(tasks={"num_envs": 3}, switching={"max_stay_steps": 12}))
    ended = [e for e in run(training) if isinstance(e, EpisodeEnded)]
    assert {e.length_steps for e in ended} == {7}
    assert {e.episode_return for e in ended} == {28.0}
    for task in range(2):
        assert training.episodes_by_task[task] == 3 * (training.steps_by_task[task] // 3 // 7) > 0
        assert training.starts_by_task[task] - training.episodes_by_task[task] in (0, 3), "only running ones are open"


@pytest.mark.slow
def test_epsilon_counts_the_steps_it_is_told_to() -> None:
    for clock, expected in (("total", 0.1), ("task", 0.19)):
        training = counting(small_config(total_steps=200, learning={"epsilon_clock": clock}))
        run(training)
        if clock == "total":
            assert training.epsilon() == pytest.approx(expected)
        else:
            steps = training.steps_by_task[training.task]
            assert training.epsilon() == pytest.approx(linear_decay(1.0, 0.1, 200, steps))
    assert linear_decay(1.0, 0.1, 100, 50) == pytest.approx(0.55)
    assert linear_decay(1.0, 0.1, 100, 500) == pytest.approx(0.1)


def test_clocks_survive_any_step_size() -> None:
    rng, clock, total, rounds = np.random.default_rng(0), Every(7), 0, 0
    for steps in rng.integers(1, 30, 200):
        total += int(steps)
        rounds += clock.advance(int(steps))
        assert rounds == total // 7


@pytest.mark.slow
def test_every_attribute_is_saved_or_declared_derived() -> None:
    """Walks all parts of a run: an attribute that is neither would be lost by a resume."""
    seen = set()

    def walk(part: Any) -> None:
        if isinstance(part, (FrameReplay, Play)):
            return  # their own round-trip tests compare contents
        if isinstance(part, Stateful):
            seen.add(type(part).__name__)
            declared = set(part.SAVED) | set(part.DERIVED)
            assert set(vars(part)) <= declared, f"{type(part).__name__}: {set(vars(part)) - declared}"
            for name in part.SAVED:
                walk(getattr(part, name))
        elif isinstance(part, list):
            for item in part:
                walk(item)

    for policy in POLICIES:
        training = counting(small_config(total_steps=150, switching={"policy": policy, **REFERENCE}))
        run(training)
        walk(training)
    parts = {"Training", "Learner", "SwitchingPolicy", "Exploration", "Every", "ParameterChange", "RewardPlateau"}
    assert parts <= seen
    assert len(seen) == 6 + len(POLICIES)


@pytest.mark.slow
@pytest.mark.parametrize("policy", POLICIES)
def test_state_dict_continues_exactly(policy: str) -> None:
    """At any step: a new Training with the state of an old one goes on bitwise the same."""
    often = {"visit_steps": 20, "check_every_steps": 30, "check_episodes": 2, "plateau_window_episodes": 3}
    switching = {"policy": policy, "max_stay_steps": 45, **REFERENCE, **often}
    config = small_config(total_steps=300, switching=switching, network={"encoding": "direct"})
    assert_continues_exactly(lambda: counting(config), at_steps=(33, 201))


def contradiction(method: str, dendrites: str, seed: int, heads: str = "shared") -> float:
    """Share of right actions after training on two tasks with one observation and opposite right actions."""
    config = small_config(
        seed=seed,
        total_steps=2500,
        network={"method": method, "dendrites": dendrites, "timesteps": 4, "hidden_units": 32, "heads": heads},
        learning={"epsilon_decay_steps": 1000, "update_every_steps": 2, "discount": 0.0, "batch_size": 16},
        switching={"policy": "fixed_episodes", "visit_episodes": 25},
    )
    suite = vector_suite(SameObservationEnvironment, 3)  # type: ignore[arg-type]
    training = Training(config, suite, torch.device("cpu"))
    run(training)
    observation = np.asarray([[1.0, 0.5, -0.5]], np.float32)
    return float(np.mean([training.learner.act(observation, task)[0] == task for task in range(2)]))


@pytest.mark.slow
@pytest.mark.parametrize(("dendrites", "seed"), [("shared", 1), ("per_neuron", 2)])
def test_contradicting_tasks_are_solved_with_dendrites(dendrites: str, seed: int) -> None:
    assert contradiction("SwitchMT", dendrites, seed) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize(("method", "seed"), [("DSQN", 1), ("DSQN_D", 2), ("DQN_D", 3)])
def test_contradicting_tasks_stay_at_chance_without_dendrites(method: str, seed: int) -> None:
    assert contradiction(method, "auto", seed) == 0.5


@pytest.mark.slow
@pytest.mark.parametrize(("method", "seed"), [("DSQN_D", 1), ("DQN_D", 2)])
def test_contradicting_tasks_are_solved_with_heads_per_task(method: str, seed: int) -> None:
    assert contradiction(method, "auto", seed, heads="per_task") == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_every_method_learns_the_identity_task(method: str) -> None:
    """One task, the observation says the action."""

    class Identity(SameObservationEnvironment):
        def __init__(self, task: int, num_envs: int) -> None:
            super().__init__(task, num_envs)
            self._rng = np.random.default_rng(0)
            self._right = np.zeros(num_envs, np.int64)

        def reset(self, env_ids, seeds):  # type: ignore[no-untyped-def]
            self._right[env_ids] = seeds % 3
            self._frame[env_ids] = np.eye(3, dtype=np.float32)[self._right[env_ids]]
            return self._frame[env_ids]

        def step(self, actions):  # type: ignore[no-untyped-def]
            result = super().step(actions)
            return type(result)(result.frames, (actions == self._right) * 1.0, result.terminated, result.truncated)

    suite = vector_suite(Identity, 3, num_tasks=1, num_actions=3)  # type: ignore[arg-type]
    config = small_config(
        total_steps=1500,
        tasks={"names": ["a"]},
        network={"method": method, "timesteps": 4, "hidden_units": 32},
        learning={"discount": 0.0, "epsilon_decay_steps": 700},
    )
    training = Training(config, suite, torch.device("cpu"))
    run(training)
    assert training.learner.act(np.eye(3, dtype=np.float32), 0).tolist() == [0, 1, 2]


@pytest.mark.slow
@pytest.mark.parametrize("max_stay_steps", [None, 30])
def test_the_policy_sees_every_episode_end_of_a_step_in_which_it_leaves(
    max_stay_steps: int | None, monkeypatch
) -> None:
    """Four copies end their episodes in one step, the policy leaves at the second: the visit is forgotten after all."""
    config = small_config(
        total_steps=168,
        tasks={"num_envs": 4},
        switching={
            "policy": "fixed_episodes",
            "visit_episodes": 2,
            "max_stay_steps": max_stay_steps,
            "min_stay_episodes": 2,
        },
    )
    training = counting(config)
    criterion, seen = training.policy.criterion, []
    judged = criterion.end_of_episode

    def end_of_episode(record):  # type: ignore[no-untyped-def]
        seen.append((record.task, record.episodes_in_visit, record.episode_return))
        return judged(record)

    monkeypatch.setattr(criterion, "end_of_episode", end_of_episode)
    monkeypatch.setattr(criterion, "start_visit", lambda: seen.append("forgotten"))
    events = run(training)
    ended = [event for event in events if isinstance(event, EpisodeEnded)]
    decided = [event for event in events if isinstance(event, SwitchDecided)]
    assert len(ended) == 168 // 7, "all copies, at every seventh step"
    assert [(event.step, event.task) for event in decided] == [(event.step, event.task) for event in ended]
    expected = []
    for visit in range(168 // 28):
        expected += [*((visit % 2, number, 28.0) for number in range(1, 5)), "forgotten"]
    assert seen == expected
    reasons = [event.decision.reason for event in decided]
    assert reasons == ["visit_episodes", "visit_episodes", "visit_over", "visit_over"] * 6
    assert sum(isinstance(event.decision, SwitchTo) for event in decided) == 6


@pytest.mark.slow
def test_a_loss_that_is_not_finite_stops_the_run() -> None:
    training = counting(small_config(learning={"learning_rate": 1e30, "clip_rewards": False}))
    with pytest.raises(TrainingFailed, match=r"not finite .* try a lower learning\.learning_rate"):
        run(training)


def golden_run() -> dict[str, Any]:
    """200 updates of the SwitchMT network (small trunk) on recorded random frames: losses and spike counts."""
    from switchmt_snn.learning.learner import Learner
    from switchmt_snn.spiking.network import ObservationSpec, build_network

    config = small_config(
        network={"trunk": "minatar", "hidden_units": 32, "timesteps": 4, "threshold": 0.5},
        learning={"learning_rate": 1e-3, "gradient_clip": "norm"},
    )
    network = build_network(config.network, ObservationSpec((4, 10, 10), 1, 1.0, True, 6, 3), 11)
    learner = Learner(network, config.learning, np.ones((3, 6), np.bool_), torch.device("cpu"), 0)
    rng, discounts = np.random.default_rng(5), np.full(16, 0.99, np.float32)
    losses, spikes = [], {}
    for update in range(200):
        task = update // 20 % 3
        x = (rng.random((2, 16, 4, 10, 10)) < 0.2 + 0.1 * task).astype(np.uint8)
        batch = Batch(
            x[0], rng.integers(0, 6, 16), x[0, :, 0, 0, 0].astype(np.float32), x[1], rng.random(16) < 0.1, discounts
        )
        learner.update(batch, task)
        losses.append(learner.take_means()["loss"])
        if update % 50 == 49:
            learner.copy_target()
            activity: dict[str, torch.Tensor] = {}
            with torch.no_grad():
                network.eval()(torch.from_numpy(x[0]), task, activity=activity)
            spikes[str(update + 1)] = {name: int(value.sum()) for name, value in activity.items()}
    return {"losses": losses, "spikes": spikes}


@pytest.mark.slow
def test_golden_run() -> None:
    """On a processor that recorded it: bitwise. Elsewhere sums round differently, and soon a spike is another one."""
    now = golden_run()
    for golden in json.loads(GOLDEN.read_text()):
        if golden["recorded_on"] == recorded_on():
            assert now == {key: golden[key] for key in ("losses", "spikes")}
        assert now["losses"][:3] == pytest.approx(golden["losses"][:3], rel=1e-5)
        assert np.mean(now["losses"][150:]) == pytest.approx(np.mean(golden["losses"][150:]), rel=0.2)


def recorded_on() -> dict[str, str]:
    """What rounding may depend on: the kernels that torch chooses for a processor."""
    info = Path("/proc/cpuinfo")
    keys = ("model name", "cpu family", "model\t", "stepping", "cache size", "flags")
    lines = info.read_text().splitlines() if info.exists() else [platform.processor()]
    chip = sorted({line for line in lines if line.startswith(keys)})
    return {
        "processor": hashlib.sha256("\n".join(chip).encode()).hexdigest()[:16],
        "capability": torch.backends.cpu.get_cpu_capability(),
        "torch": torch.__version__,
    }


@pytest.mark.slow
def test_measured_names_every_layer() -> None:
    measured = [e for e in run(counting(small_config())) if isinstance(e, Measured)]
    assert len(measured) == 8
    assert set(measured[-1].layers) == {"linear1", "value", "advantage"}


if __name__ == "__main__":  # python -m tests.learning.test_training records the golden run of this processor anew
    torch.set_num_threads(1)
    others = [one for one in json.loads(GOLDEN.read_text()) if one["recorded_on"] != recorded_on()]
    GOLDEN.write_text(json.dumps([*others, {"recorded_on": recorded_on(), **golden_run()}], indent=1) + "\n")
