"""``switchmt-snn doctor``: what this installation has."""

from __future__ import annotations

from dataclasses import dataclass

from switchmt_snn.cli.parsing import parse
from switchmt_snn.config import load_config
from switchmt_snn.viewing import output


@dataclass(frozen=True)
class DoctorOptions:
    """Check this installation."""

    json: bool = False
    """Print the facts as JSON."""


def command(argv: list[str]) -> int:
    """Run the command; returns its exit code."""
    options = parse(DoctorOptions, argv, "doctor", DoctorOptions())
    import torch

    from switchmt_snn.machine.devices import has_bfloat16, select_device
    from switchmt_snn.machine.memory import GIB, available_bytes
    from switchmt_snn.runs.environment import describe_environment
    from switchmt_snn.tasks.registry import SUITES
    from switchmt_snn.updates.engine import ENGINES

    device = select_device("auto")
    facts = describe_environment(load_config("quickstart"), device)
    facts = {key: facts[key] for key in ("versions", "python", "platform", "processor", "cores", "device")}
    facts |= {
        "torch_threads": torch.get_num_threads(),
        "tasks": {name: len(suite.known_tasks()) for name, suite in SUITES.items()},
        "available_memory_gib": round(available_bytes() / GIB, 1),
        "bfloat16_instructions": has_bfloat16(device),
        "update_engines": {name: engine.status() for name, engine in ENGINES.items()},
    }
    if options.json:
        output.print_json(facts)
        return 0
    for key, value in facts.items():
        shown = ", ".join(f"{k} {v or 'not installed'}" for k, v in value.items()) if isinstance(value, dict) else value
        print(f"{key}: {shown}")
    return 0
