"""Networks with every setting that an export must express, with trained-looking statistics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from switchmt_snn.acting.agent import Agent
from switchmt_snn.config import METHODS, resolve
from switchmt_snn.config.yaml_io import from_dict
from switchmt_snn.learning.parts import observation_spec
from switchmt_snn.spiking.network import build_network
from switchmt_snn.spiking.normalization import TaskBatchNorm
from switchmt_snn.tasks.registry import make_suite

RunCommand = Callable[..., tuple[str, str]]
"""See ``tests.export.conftest.run_command``."""

STACKED = {"frame_stack": 4}
VARIANTS: dict[str, dict[str, Any]] = {
    **{method: {"method": method} for method in METHODS},
    "rate": {"encoding": "rate", "tasks": STACKED},
    "latency": {"encoding": "latency", "tasks": STACKED},
    "frames": {"encoding": "frames", "tasks": STACKED},
    "events": {"encoding": "events", "tasks": STACKED},
    "last_membrane": {"readout": "last_membrane", "readout_beta": 0.5},
    "max_membrane": {"readout": "max_membrane"},
    "quantiles": {"quantiles": 5},
    "quantiles last_membrane": {"quantiles": 8, "readout": "last_membrane", "method": "MTSpark_AD"},
    "heads per task": {"heads": "per_task"},
    "heads per task, quantiles": {"heads": "per_task", "quantiles": 4, "readout": "last_membrane"},
    "DQN_D heads per task": {"method": "DQN_D", "heads": "per_task"},
    "subtract": {"reset": "subtract"},
    "LIF": {"neuron": "LIF"},
    "LIF subtract": {"neuron": "LIF", "beta": 0.75, "reset": "subtract"},
    "per_neuron": {"dendrites": "per_neuron", "dendritic_gating": "absolute_max"},
    "Synaptic": {"neuron": "Synaptic"},
    "Synaptic subtract": {"neuron": "Synaptic", "alpha": 0.5, "beta": 0.75, "reset": "subtract"},
    "ALIF": {"neuron": "ALIF"},
    "ALIF subtract": {"neuron": "ALIF", "adaptation_strength": 0.5, "reset": "subtract"},
    "learned": {"neuron": "LIF", "learn_beta": True, "learn_threshold": True},
    "shared statistics": {"normalization": "shared"},
    "stream normalization": {"stream_normalization": "batch", "stream_current_thresholds": 0.75},
    "mlp": {"trunk": "mlp"},
    "mlp normalized": {"trunk": "mlp", "mlp_normalization": "batch"},
    "T 7": {"timesteps": 7},
    "T 1": {"timesteps": 1},
    "k winners": {"k_winners": 9},
    "missing actions": {"tasks": {"minimal_action_mask": True}},
    "missing actions, heads per task": {
        "tasks": {"minimal_action_mask": True},
        "heads": "per_task",
        "readout": "max_membrane",
    },
}


def make_agent(seed: int = 0, **network: Any) -> Agent:
    """An agent on three MinAtar games; ``tasks`` changes its tasks, everything else its network."""
    tasks = {"suite": "minatar", "names": ["breakout", "asterix", "space_invaders"], **network.pop("tasks", {})}
    settings = {"hidden_units": 32, "threshold": 0.5, **network}
    learning = {"loss": "huber"} if "quantiles" in network else {}
    config = resolve(from_dict({"name": "export", "tasks": tasks, "network": settings, "learning": learning}))
    suite = make_suite(config.tasks)
    built = build_network(config.network, observation_spec(suite), seed)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for module in built.modules():
            if isinstance(module, TaskBatchNorm):
                shape = module.running_mean_KC.shape
                module.running_mean_KC.copy_(torch.randn(shape, generator=generator) * 0.1)
                module.running_var_KC.copy_(torch.rand(shape, generator=generator) * 0.2 + 0.02)
                if isinstance(module.weight, torch.nn.Parameter):  # else fixed
                    module.weight.copy_(torch.randn(shape[1], generator=generator))
                    module.bias.copy_(torch.randn(shape[1], generator=generator) * 0.5)
    return Agent(built, suite, config, torch.device("cpu"), 1234)


def observations(agent: Agent, count: int, seed: int = 0) -> np.ndarray:
    """Random frames with the density of MinAtar's."""
    rng = np.random.default_rng(seed)
    return (rng.random((count, *agent.suite.observation_shape)) < 0.2).astype(agent.suite.frame_dtype)
