"""The engine ``ray``: every trial is the command ``train`` on a node of a Ray cluster that exists already.

All nodes see the study's folder under the same path, and have the same version of this package (docs/studies.md). Ray
(https://docs.ray.io) places the trials; a trial whose node is lost goes on from its last checkpoint on another one.
"""

from __future__ import annotations

import logging
import os
import socket
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from switchmt_snn import __version__
from switchmt_snn.config.checks import require
from switchmt_snn.errors import ConfigError, MissingExtraError
from switchmt_snn.study.engine import Training, training_words
from switchmt_snn.study.folder import StudyFolder
from switchmt_snn.study.grid import Trial
from switchmt_snn.study.local import most_threads
from switchmt_snn.study.processes import ProgramProcess

AUTH_MODE = "RAY_AUTH_MODE"
REACHABLE_S = 10.0
NODE_LOST = -9
"""Exit code of a trial whose node or worker was lost, as of a process that was killed."""


class RayEngine:
    """Trials as actors, each with a core per thread and, if wanted, a part of a GPU."""

    def __init__(self, address: str, gpus_per_trial: float) -> None:
        """Connect to a cluster, with token authentication unless ``RAY_AUTH_MODE`` says otherwise.

        Args:
            address: HOST:PORT, or auto for the cluster that this machine is a node of.
            gpus_per_trial: part of a GPU that Ray reserves for each trial; 0 for none.

        Raises:
            MissingExtraError: Ray is not installed.
            ConfigError: no cluster there, or it does not take our token.
        """
        require(gpus_per_trial >= 0, "--gpus-per-trial", gpus_per_trial, "0 or more")
        os.environ.setdefault(AUTH_MODE, "token")
        try:
            import ray
        except ImportError:
            raise MissingExtraError(
                "--engine ray needs Ray, which is not installed; run: pip install 'switchmt-snn[ray]'"
            ) from None
        self.ray = ray
        self.gpus_per_trial = gpus_per_trial
        if address != "auto":
            _require_reachable(address)
        with _what_is_written_to_stderr() as written:
            try:
                ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, configure_logging=False)
                return
            except (ConnectionError, ValueError, RuntimeError, ray.exceptions.RayError) as error:
                words = " ".join(str(error).split())[:200] or type(error).__name__
            written.seek(0)
            if b"InvalidAuthToken" in written.read():
                words = "it does not take this token"
        raise ConfigError(
            f"--address {address}: no Ray cluster answers ({words}), expected one that is running, and its token in "
            f"RAY_AUTH_TOKEN or ~/.ray/auth_token ({AUTH_MODE} is {os.environ[AUTH_MODE]}; docs/studies.md)"
        )

    def jobs(self, trials: Sequence[Trial], asked: int | None) -> int:
        """As many trials as the nodes have cores, and GPUs, for.

        Raises:
            ConfigError: none fits, or more were asked for.
        """
        threads = most_threads(trials)
        found: list[dict[str, Any]] = self.ray.nodes()
        nodes = [node["Resources"] for node in found if node["Alive"]]
        fit = [int(node.get("CPU", 0.0) // threads) for node in nodes]
        if self.gpus_per_trial > 0:
            on_gpu = [int(node.get("GPU", 0.0) / self.gpus_per_trial + 1e-9) for node in nodes]
            fit = [min(pair) for pair in zip(fit, on_gpu, strict=True)]
        most = sum(fit)
        each = f"{threads} core{'s' * (threads > 1)}" + (
            f" and {self.gpus_per_trial:g} GPU" * bool(self.gpus_per_trial)
        )
        if most == 0:
            raise ConfigError(
                f"no node of the Ray cluster has {each} for a trial, expected one that has; lower the trials' threads "
                "or --gpus-per-trial"
            )
        require(asked is None or 1 <= asked <= most, "--jobs", asked, f"1 to {most}: {each} each on {len(nodes)} nodes")
        return asked or most

    def start(self, trial: Trial, folder: StudyFolder) -> Training:
        """Ask Ray for a place, and begin ``train`` there."""
        threads = trial.config.threads or 1
        placed = self.ray.remote(TrialActor).options(
            num_cpus=threads, num_gpus=self.gpus_per_trial or None, max_restarts=0
        )
        words = training_words(trial, StudyFolder(folder.path.resolve()))
        log = folder.log(trial).resolve()
        actor = placed.remote(words, str(log), threads, os.getcwd(), os.environ.get("PYTHONPATH", ""), __version__)
        return _Placed(self.ray, actor)


class TrialActor:
    """On a node: one trial's process."""

    def __init__(
        self, words: list[str], log: str, threads: int, folder: str, python_path: str, expected_version: str
    ) -> None:
        """Begin the trial in the folder in which the study was begun, if this node has it.

        Raises:
            ConfigError: this node has another version of the package, or does not see the study's folder.
        """
        if __version__ != expected_version:
            raise ConfigError(
                f"this node has switchmt-snn {__version__}, expected {expected_version}; install it there"
            )
        if not Path(log).parent.is_dir():
            raise ConfigError(f"a node does not see {Path(log).parent}, expected the study in a shared folder")
        if Path(folder).is_dir():
            os.chdir(folder)
        import ray

        with Path(log).open("a", encoding="utf-8") as stream:
            stream.write(f"node {ray.get_runtime_context().get_node_id()}\n")
        self.process = ProgramProcess(words, Path(log), threads, python_path)

    def poll(self) -> int | None:
        """The exit code, or None while the process runs."""
        return self.process.poll()

    def ask_to_stop(self) -> None:
        """Let it save a checkpoint and end."""
        self.process.ask_to_stop()

    def kill(self) -> None:
        """End it now."""
        self.process.kill()


class _Placed:
    """The study's side of a ``TrialActor``, which may still wait for its place."""

    def __init__(self, ray: Any, actor: Any) -> None:
        self.ray, self.actor = ray, actor
        self.answer = actor.poll.remote()

    def poll(self) -> int | None:
        answered, _ = self.ray.wait([self.answer], timeout=0)
        if not answered:
            return None
        try:
            code: int | None = self.ray.get(self.answer)
        except self.ray.exceptions.ActorDiedError as error:
            if (reason := refusal(str(error))) is not None:
                raise ConfigError(reason) from None
            return NODE_LOST
        except self.ray.exceptions.RayError:
            return NODE_LOST
        if code is None:
            self.answer = self.actor.poll.remote()
        else:
            self.ray.kill(self.actor)  # its place is free for the next trial
        return code

    def ask_to_stop(self) -> None:
        self.actor.ask_to_stop.remote()

    def kill(self) -> None:
        with suppress(self.ray.exceptions.RayError):  # the node is gone, or the trial never had a place
            self.ray.get(self.actor.kill.remote(), timeout=10)
        self.ray.kill(self.actor)


def _require_reachable(address: str) -> None:
    """Ray itself would try for minutes.

    Raises:
        ConfigError: not HOST:PORT, or nothing listens there.
    """
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal():
        raise ConfigError(f"--address is {address!r}, expected HOST:PORT, as 10.0.0.1:6379, or auto")
    try:
        socket.create_connection((host.strip("[]"), int(port)), REACHABLE_S).close()
    except (OSError, OverflowError) as error:
        raise ConfigError(
            f"--address {address}: nothing answers there ({error}), expected what `ray start --head` printed"
        ) from None


@contextmanager
def _what_is_written_to_stderr() -> Iterator[IO[bytes]]:
    """Catch it, also what C++ code writes: Ray repeats its warnings there every second."""
    sys.stderr.flush()
    own = os.dup(2)
    with tempfile.TemporaryFile() as caught:
        os.dup2(caught.fileno(), 2)
        try:
            yield caught
        finally:
            os.dup2(own, 2)
            os.close(own)


def refusal(death: str) -> str | None:
    """What ``TrialActor`` said when it refused to begin, from Ray's words on its death."""
    marker = "ConfigError: "
    return death.split(marker, 1)[1].splitlines()[0] if marker in death else None
