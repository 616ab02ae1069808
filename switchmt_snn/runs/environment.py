"""What a reader of a run's numbers must know of the machine: versions, processor, device, files, command."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
import shlex
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

import torch

from switchmt_snn.config import ExperimentConfig, to_dict
from switchmt_snn.config.plugins import is_plugin, plugin_file
from switchmt_snn.config.trust import SIGNATURE, modules_in, signature_of
from switchmt_snn.errors import reason_of
from switchmt_snn.machine.program import NAME, is_module
from switchmt_snn.tasks.registry import SUITES, suite_of

_PACKAGES = ("switchmt-snn", "torch", "snntorch", "numpy", "safetensors", "zstandard")
"""Distributions whose versions a run stores, with those that suites name."""


def describe_environment(config: ExperimentConfig, device: torch.device) -> dict[str, Any]:
    """Facts that a reader of the run's numbers needs: versions, machine, device, files, command."""
    suite = suite_of(config.tasks)
    suites = (*SUITES.values(), type(suite))
    versions: dict[str, str | None] = {}
    for package in dict.fromkeys((*_PACKAGES, *(package for each in suites for package in each.packages))):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = None
    return {
        "program": "switchmt-snn",
        "command": command_line(),
        "created": datetime.now().astimezone().isoformat(timespec="microseconds"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processor": processor(),
        "cores": os.cpu_count(),
        "torch_threads": torch.get_num_threads(),
        "device": str(device),
        "device_name": torch.cuda.get_device_name(device) if device.type == "cuda" else None,
        "versions": versions,
        "files_sha256": files_sha256(config),
    }


def files_sha256(config: ExperimentConfig) -> dict[str, str]:
    """SHA-256 of the suite's files and of the modules of all classes from outside the package, by a short name."""
    files = dict(suite_of(config.tasks).files)
    for plugin in (config.network.neuron, config.network.encoding, config.switching.policy):
        path = plugin_file(plugin) if is_plugin(plugin) else None
        if path is not None and path.is_file():
            files[plugin.partition(":")[0]] = path
    return {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in files.items()}


def signature_facts(config: ExperimentConfig) -> tuple[dict[str, str], tuple[str, ...]]:
    """What a new run stores so that its modules are known as this user's, and a note if there can be nothing."""
    modules = modules_in(to_dict(config))
    if not modules:
        return {}, ()
    try:
        return {SIGNATURE: signature_of(modules)}, ()
    except OSError as error:
        note = f"this run names modules ({', '.join(modules)}), but no key of yours can be kept ({reason_of(error)})"
        return {}, (f"{note}: later commands on it need --trust",)


def command_line() -> str:
    """The command line without the folder in which the program lies; ``python`` for a library call."""
    called = Path(sys.argv[0])
    ours = called.name == NAME or is_module(called)
    return shlex.join([NAME, *sys.argv[1:]]) if ours else f"python {called.name}"


def processor() -> str:
    """The processor's name, as the system tells it."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor()
