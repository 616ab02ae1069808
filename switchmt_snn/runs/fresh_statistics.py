"""A trained network with re-estimated normalisation statistics: what it forgot, apart from what only looks so."""

from __future__ import annotations

from switchmt_snn.acting.agent import Agent
from switchmt_snn.config.bounds import LARGEST
from switchmt_snn.errors import ConfigError, RunFolderError
from switchmt_snn.learning.parts import make_replay
from switchmt_snn.learning.statistics import reestimate_from_replay
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.spiking.normalization import TaskBatchNorm


def with_fresh_statistics(agent: Agent, folder: RunFolder, batches: int) -> Agent:
    """The agent with statistics re-estimated from the replay of its run; the weights stay as they are.

    A task whose replay is smaller than a batch keeps its statistics.

    Args:
        agent: of the run's newest checkpoint.
        folder: its run.
        batches: of each task's replay, of ``learning.batch_size`` observations.

    Returns:
        ``agent``.

    Raises:
        ConfigError: a number of batches out of range; the network has no normalisation, or one whose statistics all
            tasks share.
        CheckpointError: the newest checkpoint holds no replay, or none is whole.
        RunFolderError: the agent's weights are of an earlier step than the replay.
    """
    config = agent.config
    most = LARGEST["learning.reestimate_statistics_batches"]
    if not 1 <= batches <= most:
        raise ConfigError(f"statistics are to be re-estimated from {batches} batches, expected 1 to {most:,}")
    if not any(isinstance(module, TaskBatchNorm) for module in agent.network.modules()):
        raise ConfigError(
            "the network has no normalisation, expected one whose statistics can be re-estimated "
            "(network.mlp_normalization or stream_normalization: batch); evaluate it as it is"
        )
    if config.network.normalization != "per_task":
        raise ConfigError(
            f"network.normalization is {config.network.normalization}, expected per_task: the statistics of one task "
            "would take the place of all tasks'; evaluate it as it is"
        )
    replays = [make_replay(config, agent.suite, agent.device) for _ in agent.suite.names]
    step = folder.checkpoints().load(replays).step
    if step != agent.step:
        raise RunFolderError(
            f"the weights are of step {agent.step:,} and the replay is of step {step:,}, expected those of one step; "
            "take the last checkpoint"
        )
    for task, replay in enumerate(replays):
        if replay.transitions_added >= config.learning.batch_size:
            seed = (config.seed, step, task)
            reestimate_from_replay(agent.network, task, replay, batches, config.learning.batch_size, seed)
    return agent
