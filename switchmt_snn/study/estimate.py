"""What the trials of a study will take together."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from switchmt_snn.drawing.numbers import bytes_of, duration
from switchmt_snn.machine.memory import available_bytes
from switchmt_snn.study.grid import Study, Trial
from switchmt_snn.study.probe import Cost
from switchmt_snn.study.timing import makespan


def cost_facts(
    study: Study, trials: Sequence[Trial], costs: dict[str, Cost], jobs: int, folder: Path
) -> dict[str, Any]:
    """Sums by variant and over all trials, beside what this machine has.

    Args:
        study: for its name.
        trials: those that have not finished.
        costs: of each of them, by name.
        jobs: how many train at a time.
        folder: where they will be written; it need not exist.
    """
    variants = []
    for name in dict.fromkeys(trial.variant for trial in trials):
        own = [trial for trial in trials if trial.variant == name]
        cost = costs[own[0].name]
        variants.append(
            {"variant": name, "trials": len(own), "steps": own[0].config.total_steps, **vars(cost)},
        )
    # The most that trials which run at the same time can need.
    memory = sorted((cost.memory_bytes for cost in costs.values()), reverse=True)[:jobs]
    return {
        "study": study.name,
        "trials": len(trials),
        "finished": len(study.trials) - len(trials),
        "jobs": jobs,
        "variants": variants,
        "seconds": makespan([costs[trial.name].seconds for trial in trials], jobs),
        "core_seconds": sum(costs[trial.name].seconds for trial in trials),
        "memory_bytes": sum(memory),
        "memory_available_bytes": available_bytes(),
        "disk_bytes": sum(costs[trial.name].disk_bytes for trial in trials),
        "disk_free_bytes": shutil.disk_usage(_existing(folder)).free,
    }


def _existing(folder: Path) -> Path:
    """The nearest folder above that exists."""
    return next(one for one in (folder.absolute(), *folder.absolute().parents) if one.exists())


def cost_table(facts: dict[str, Any]) -> Table:
    """The facts as a table."""
    lacks = [
        f"more {what} than there is: {remedy}"
        for what, needed, there, remedy in (
            ("memory", facts["memory_bytes"], facts["memory_available_bytes"], "lower --jobs"),
            ("disk", facts["disk_bytes"], facts["disk_free_bytes"], "name another --folder"),
        )
        if needed > there
    ]
    table = Table(
        title=f"{facts['study']}: {facts['trials']} trials to train, {facts['finished']} finished",
        caption=Text(
            f"time: about {duration(facts['seconds'])}, {facts['jobs']} at a time (h:m:s; "
            f"{facts['core_seconds'] / 3600:,.2g} hours of one trial at a time)\n"
            f"memory: up to {bytes_of(facts['memory_bytes'])} of {bytes_of(facts['memory_available_bytes'])}\n"
            f"disk: {bytes_of(facts['disk_bytes'])} of {bytes_of(facts['disk_free_bytes'])}"
            + "".join(f"\n{lack}" for lack in lacks)
        ),
        title_justify="left",
        caption_justify="left",
    )
    table.add_column("variant", no_wrap=True)
    for name in ("trials", "steps", "time each", "memory each", "disk each"):
        table.add_column(name, justify="right")
    for row in facts["variants"]:
        table.add_row(
            row["variant"],
            str(row["trials"]),
            f"{row['steps']:,}",
            duration(row["seconds"]),
            bytes_of(row["memory_bytes"]),
            bytes_of(row["disk_bytes"]),
        )
    return table
