"""PyTorch's global settings, as a notebook may have them: they change no run, and a run does not change them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch

from switchmt_snn import evaluate, load_agent, train
from switchmt_snn.machine.torch_settings import as_when_started
from tests.conftest import small_config


@contextmanager
def changed() -> Iterator[None]:
    """Every setting that changes what PyTorch computes, changed."""
    try:
        torch.set_default_dtype(torch.float64)
        torch.set_default_device("meta")
        torch.set_float32_matmul_precision("medium")
        with torch.inference_mode(), torch.autocast("cpu", dtype=torch.bfloat16):
            yield
    finally:
        torch.set_default_dtype(torch.float32)
        torch.set_default_device(None)
        torch.set_float32_matmul_precision("highest")


def settings() -> tuple[object, ...]:
    return (
        torch.get_default_dtype(),
        torch.get_default_device(),
        torch.get_float32_matmul_precision(),
        torch.is_inference_mode_enabled(),
        torch.is_autocast_enabled("cpu"),
        torch.is_grad_enabled(),
        torch.get_num_threads(),
        torch.backends.cudnn.deterministic,
    )


def test_a_run_is_the_same_and_leaves_settings_as_they_were(tmp_path: Path) -> None:
    config = small_config(
        tasks={"names": ["CartPole-v1"]},
        total_steps=60,
        threads=1,
        evaluation={"episodes": 1},
        learning={"engine": "eager"},
    )
    scores = {}
    observation = np.asarray([0.01, -0.02, 0.03, 0.04], np.float32)
    for name in ("plain", "changed"):
        with changed() if name == "changed" else as_when_started():
            before = settings()
            result = train(config, tmp_path / name)
            again = evaluate(result.path, save=False)
            agent = load_agent(result.path)
            q = agent.q_values(observation, 0)
            assert settings() == before, name
        assert result.evaluation is not None
        assert result.evaluation.score("CartPole-v1").mean == again.score("CartPole-v1").mean
        scores[name] = (result.evaluation.score("CartPole-v1").mean, q.tolist(), q.dtype, weights(result.path))
    assert scores["plain"] == scores["changed"]


def weights(run: Path) -> bytes:
    return next(run.glob("checkpoints/step-*/model.safetensors")).read_bytes()


def test_threads_and_cudnn_are_the_callers_again() -> None:
    before = settings()
    with as_when_started():
        torch.set_num_threads(torch.get_num_threads() + 1)
        torch.backends.cudnn.deterministic = not torch.backends.cudnn.deterministic
        assert settings() != before
    assert settings() == before
