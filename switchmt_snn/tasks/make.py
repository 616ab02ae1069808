"""From a config to its suite of tasks."""

from __future__ import annotations

from switchmt_snn.config import TasksConfig
from switchmt_snn.tasks.suite import TaskSuite


def make_suite(config: TasksConfig) -> TaskSuite:
    """Build the suite that a config names.

    Raises:
        TaskError: a game or environment id is unknown, or its spaces do not fit a Q-network.
        MissingExtraError: the suite needs an optional package.
    """
    if config.suite == "atari":
        from switchmt_snn.tasks.atari import make_atari_suite

        return make_atari_suite(config)
    if config.suite == "minatar":
        from switchmt_snn.tasks.minatar import make_minatar_suite

        return make_minatar_suite(config)
    from switchmt_snn.tasks.gym import make_gym_suite

    return make_gym_suite(config)
