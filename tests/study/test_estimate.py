"""From what a probe measures to what a study takes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from switchmt_snn.runs.plan import plan
from switchmt_snn.study.estimate import cost_facts, cost_table
from switchmt_snn.study.grid import Study, load_study
from switchmt_snn.study.probe import Cost, Pace, cost_of, kind_of, shortened
from switchmt_snn.viewing.output import console

PACE = Pace(
    start_s=5.0,
    end_s=1.0,
    fill_s=0.001,
    step_s=0.02,
    episode_s=0.5,
    peak_bytes=400_000_000,
    checkpoint_bytes=1_000,
    replay_bytes=4.0,
    log_bytes=2.0,
    other_bytes=70_000,
)


@pytest.fixture
def study(tmp_path: Path) -> Study:
    (tmp_path / "s.yaml").write_text(
        """
base: cartpole
seeds: 3
settings:
  total_steps: 10000
  learning: {learning_starts_steps: 1000, replay_capacity_steps: 4000}
  evaluation: {every_steps: 2500, episodes: 20, stop_at_returns: []}
  recording: {checkpoint_every_steps: 4000, keep_checkpoints: 2}
variants:
  short: {}
  other_policy: {switching.policy: interleave}
  long: {total_steps: 20000}
  wide: {network.hidden_units: 64}
"""
    )
    return load_study(tmp_path / "s.yaml")


def test_the_cost_of_a_trial_by_hand(study: Study) -> None:
    """1,000 steps of filling, 9,000 of learning, two checkpoints and the last, three evaluations and the last."""
    config = study.trials[0].config
    cost = cost_of(config, [PACE])
    # the first evaluation plays the random policy, too; the three others take half as long
    assert cost.seconds == pytest.approx(5 + 1000 * 0.001 + 9000 * 0.02 + 3 * 1.0 + 20 * 0.5 * (1 + 3 / 2))
    assert cost.disk_bytes == 2 * 1_000 + 10_000 * 2 + 4_000 * 4 + 70_000
    assert cost.memory_bytes == pytest.approx(400_000_000 + plan(config).memory.replay_bytes, abs=1)
    twice = cost_of(config, [PACE, replace(PACE, step_s=0.04)])
    assert twice.seconds == pytest.approx(cost.seconds + 9000 * 0.01)


def test_seeds_switching_and_steps_make_no_other_kind(study: Study) -> None:
    kinds = {trial.variant: kind_of(trial) for trial in study.trials}
    assert kinds["short"] == kinds["other_policy"] == kinds["long"] != kinds["wide"]


def test_a_probe_trains_as_the_trial_but_for_what_takes_long(study: Study) -> None:
    config = study.trials[0].config
    short = shortened(config)
    assert short.learning.learning_starts_steps == 200
    assert short.evaluation.every_steps is None
    assert short.recording.metrics_every_steps == config.learning.update_every_steps  # whole rounds of updates
    same = replace(
        short,
        learning=replace(
            short.learning,
            learning_starts_steps=config.learning.learning_starts_steps,
            epsilon_decay_steps=config.learning.epsilon_decay_steps,
        ),
        evaluation=config.evaluation,
        recording=config.recording,
    )
    assert same == config


def test_sums_over_the_trials_that_are_left(study: Study, tmp_path: Path) -> None:
    costs = {trial.name: Cost(100.0 if trial.variant == "long" else 40.0, 10**9, 5) for trial in study.trials}
    left = study.trials[4:]
    facts = cost_facts(study, left, costs, 2, tmp_path / "not" / "there")
    assert (facts["trials"], facts["finished"], facts["disk_bytes"], facts["memory_bytes"]) == (8, 4, 40, 2 * 10**9)
    assert facts["core_seconds"] == 2 * 100 + 6 * 40
    assert facts["seconds"] == 240  # 40, 100 and 100 on one core; 40 five times on the other
    facts["disk_free_bytes"] = 3
    shown = console()
    with shown.capture() as text:
        shown.print(cost_table(facts))
    assert "more disk than there is: name another --folder" in text.get()
    assert "more memory" not in text.get()
