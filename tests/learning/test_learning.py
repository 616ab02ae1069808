"""That a spiking network learns, with the presets that users try first."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from switchmt_snn import load_config, train


@pytest.mark.slow
def test_the_cartpole_preset_learns_to_balance(tmp_path: Path) -> None:
    """A shorter form: ten times random play. To 485 it takes 7,500 to 20,000 steps (results/cartpole)."""
    config = load_config("cartpole")
    shorter = replace(config.evaluation, stop_at_returns=(230.0,), episodes=50)
    result = train(replace(config, evaluation=shorter), tmp_path / "run")
    assert result.evaluation is not None
    trained, random = (result.evaluation.score("CartPole-v1", policy) for policy in ("agent", "random"))
    assert random.mean < 30.0
    assert trained.mean > 180.0  # other episodes than those that reached 230
    assert result.step < config.total_steps


@pytest.mark.slow
def test_the_classic_preset_learns_both_tasks_in_one_network(tmp_path: Path) -> None:
    """A shorter form: five times random CartPole, and half of random Acrobot (every episode -500)."""
    config = load_config("classic")
    shorter = replace(config.evaluation, stop_at_returns=(110.0, -250.0), every_steps=4000, episodes=50)
    result = train(replace(config, evaluation=shorter), tmp_path / "run")
    assert result.evaluation is not None
    trained = {name: result.evaluation.score(name).mean for name in config.tasks.names}
    assert result.evaluation.score("Acrobot-v1", "random").mean < -490.0
    assert trained["CartPole-v1"] > 80.0  # other episodes than those that ended the training
    assert trained["Acrobot-v1"] > -300.0
    assert result.step < config.total_steps
