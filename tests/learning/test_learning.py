"""That a spiking network learns a task, with the preset that users try first."""

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
