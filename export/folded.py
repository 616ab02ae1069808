"""An agent's network, folded, and what a host must know to use its export."""

from __future__ import annotations

from typing import Any

import numpy as np

from switchmt_snn.acting.agent import Agent
from switchmt_snn.spiking.folding import FoldedNetwork, fold


def fold_agent(agent: Agent) -> FoldedNetwork:
    """Fold an agent's network for all its tasks, with the names that its suite gives them.

    Raises:
        ExportError: a weight is not finite, or a module has no node.
    """
    suite = agent.suite
    return fold(
        agent.network,
        suite.names,
        suite.action_names,
        suite.valid_actions_KA,
        suite.frame_dtype,
        step=agent.step,
        first_actions=suite.first_actions,
    )


def metadata(network: FoldedNetwork) -> dict[str, Any]:
    """What a host must know to use an export, as plain values (strings, numbers, lists, dicts)."""
    settings, seen = network.settings, network.observation
    # Every layer's neurons have the network's reset, which is said once.
    facts = {layer.name: layer.neurons.facts() for layer in network.layers}
    neurons = {name: {key: of[key] for key in of if key != "reset"} for name, of in facts.items()}
    return {
        "method": settings.method,
        "timesteps": settings.timesteps,
        "encoding": settings.encoding,
        "event_threshold": settings.event_threshold,
        "readout": network.readout.kind,
        "readout_beta": network.readout.beta,
        "reset": settings.reset if network.spiking else "none",
        "fires_when": "membrane > threshold" if network.spiking else "never",
        "neurons": neurons,
        "tasks": list(network.tasks),
        "actions": list(network.actions),
        "valid_actions": {
            name: np.flatnonzero(network.valid_actions_KA[k]).tolist() for k, name in enumerate(network.tasks)
        },
        # What an environment adds to the index of the largest Q-value.
        "first_actions": dict(zip(network.tasks, network.first_actions or (0,) * len(network.tasks), strict=True)),
        "observation_shape": list(seen.shape),
        "frame_stack": seen.frame_stack,
        "scale": seen.scale,
        "layers": [node.name for node in network.synapses],
        "training_step": network.step,
    }
