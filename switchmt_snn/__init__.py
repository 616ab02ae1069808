"""switchmt-snn: multi-task spiking Q-networks with adaptive task switching.

from switchmt_snn import train, evaluate, load_agent

result = train("minatar", run="runs/mine")
print(evaluate(result.path, episodes=10).score("breakout").mean)
action = load_agent(result.path).act(observation, task="breakout")
"""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False  # not typing's: its import takes 2 ms, in which nothing of ours can answer a Ctrl-C yet
if TYPE_CHECKING:
    from typing import Any

    from switchmt_snn.config import ExperimentConfig
    from switchmt_snn.config.yaml_io import load_config
    from switchmt_snn.runs.run import train
    from switchmt_snn.runs.trained import evaluate, load_agent
    from switchmt_snn.tasks.registry import register_suite
    from switchmt_snn.tasks.report import check_env

__version__ = "0.1.0"
__all__ = [
    "ExperimentConfig",
    "__version__",
    "check_env",
    "evaluate",
    "load_agent",
    "load_config",
    "register_suite",
    "train",
]

_HOMES = {
    "ExperimentConfig": "switchmt_snn.config",
    "load_config": "switchmt_snn.config.yaml_io",
    "evaluate": "switchmt_snn.runs.trained",
    "load_agent": "switchmt_snn.runs.trained",
    "register_suite": "switchmt_snn.tasks.registry",
    "check_env": "switchmt_snn.tasks.report",
    "train": "switchmt_snn.runs.run",
}


def __getattr__(name: str) -> Any:
    """Load the library's names when they are first used: ``import switchmt_snn`` stays free of torch."""
    if name not in _HOMES:
        raise AttributeError(f"module 'switchmt_snn' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
