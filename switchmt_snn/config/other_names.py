"""What other reinforcement-learning libraries call our settings, so that an error can name ours."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

OTHER_NAMES = {
    "adam_eps": "learning.adam_epsilon",
    "batch": "learning.batch_size",
    "buffer_size": "learning.replay_capacity_steps",
    "env": "tasks.names",
    "env_id": "tasks.names",
    "env_ids": "tasks.names",
    "envs": "tasks.names",
    "eval_episodes": "evaluation.episodes",
    "eval_freq": "evaluation.every_steps",
    "exploration_final_eps": "learning.epsilon_end",
    "exploration_fraction": "learning.epsilon_decay_steps",
    "exploration_initial_eps": "learning.epsilon_start",
    "game": "tasks.names",
    "games": "tasks.names",
    "gamma": "learning.discount",
    "gradient_steps": "learning.updates_per_round",
    "hidden_size": "network.hidden_units",
    "learning_starts": "learning.learning_starts_steps",
    "log_interval": "recording.metrics_every_steps",
    "lr": "learning.learning_rate",
    "max_grad_norm": "learning.gradient_clip_at",
    "max_steps": "total_steps",
    "model": "network.method",
    "n_envs": "tasks.num_envs",
    "n_eval_episodes": "evaluation.episodes",
    "n_step": "learning.n_steps",
    "neuron_model": "network.neuron",
    "num_steps": "network.timesteps",
    "save_freq": "recording.checkpoint_every_steps",
    "steps": "total_steps",
    "t": "network.timesteps",
    "target_network_frequency": "learning.target_update_every_steps",
    "target_update_interval": "learning.target_update_every_steps",
    "tasks": "tasks.names",
    "tb_log": "recording.tensorboard",
    "tensorboard_log": "recording.tensorboard",
    "time_steps": "network.timesteps",
    "total_timesteps": "total_steps",
    "track": "recording.trackio",
    "train_freq": "learning.update_every_steps",
    "train_frequency": "learning.update_every_steps",
}
"""Names of Stable-Baselines3, RL Zoo, CleanRL and snnTorch's examples; the nearest of our settings."""

_MOST = 3


def meant(seen: str, known: Iterable[str]) -> list[str]:
    """Settings that an unknown name probably means, at most three; the likeliest first.

    Args:
        seen: the unknown name, with its sections: ``learning.lr``.
        known: the names that there are, in the same spelling.

    Examples:
        >>> meant("lr", ["total_steps", "learning.learning_rate"])
        ['learning.learning_rate']
        >>> meant("batch_size", ["learning.batch_size", "tasks.num_envs"])
        ['learning.batch_size']
    """
    names = sorted(known)
    last = seen.rpartition(".")[2]
    if OTHER_NAMES.get(last.lower()) in names:
        return [OTHER_NAMES[last.lower()]]
    elsewhere = [name for name in names if name.rpartition(".")[2] == last]
    if elsewhere:
        return elsewhere[:_MOST]
    spelled = {name.rpartition(".")[2]: name for name in reversed(names)} | {name: name for name in names}
    near = difflib.get_close_matches(seen, spelled, n=_MOST, cutoff=0.7)
    return list(dict.fromkeys(spelled[name] for name in near))
