"""How far a study is, by variant."""

from __future__ import annotations

from collections import Counter
from typing import Any

from rich.table import Table
from rich.text import Text

from switchmt_snn.drawing.numbers import bytes_of, duration
from switchmt_snn.runs.listing import folder_bytes
from switchmt_snn.study.engine import last_words
from switchmt_snn.study.folder import StudyFolder
from switchmt_snn.study.grid import Study
from switchmt_snn.study.local import free_cores
from switchmt_snn.study.timing import Clock

STATUSES = ("finished", "running", "stopped", "waiting", "failed")


def status_facts(study: Study, folder: StudyFolder) -> dict[str, Any]:
    """Counts by variant, failed trials with their last words, and the time left.

    Raises:
        RunFolderError: the study has not been begun.
    """
    progress = folder.require().progress(study)
    clock = Clock(study, folder.attempts())
    running = [(one.trial, one.steps) for one in progress if one.status == "running"]
    others = [(one.trial, one.steps) for one in progress if one.status in ("stopped", "waiting", "failed")]
    jobs = max(len(running), 1) if running else free_cores()
    return {
        "study": study.name,
        "folder": str(folder.path),
        "trials": len(study.trials),
        "counts": {status: sum(one.status == status for one in progress) for status in STATUSES},
        "variants": [
            {
                "variant": name,
                **Counter(dict.fromkeys(STATUSES, 0)),
                **Counter(one.status for one in progress if one.trial.variant == name),
                "steps": sum(one.steps for one in progress if one.trial.variant == name),
                "total_steps": sum(one.trial.config.total_steps for one in progress if one.trial.variant == name),
                "seconds_per_step": clock.seconds_per_step(name),
            }
            for name in study.variants
        ],
        "failed": [
            {"trial": one.trial.name, "said": last_words(folder.log(one.trial)), "log": str(folder.log(one.trial))}
            for one in progress
            if one.status == "failed"
        ],
        "jobs": jobs,
        "seconds_left": clock.left(running, others, jobs) if running or others else 0.0,
        "bytes": folder_bytes(folder.path),
    }


def status_table(facts: dict[str, Any]) -> Table:
    """The facts as a table."""
    left = facts["seconds_left"]
    time_left = "unknown before a trial has run" if left is None else f"{duration(left)}, {facts['jobs']} at a time"
    said = "".join(f"\nfailed {one['trial']}: {one['said']} [{one['log']}]" for one in facts["failed"])
    table = Table(
        title=f"{facts['study']}: {facts['counts']['finished']} of {facts['trials']} trials finished",
        caption=Text(f"left: {time_left}; {bytes_of(facts['bytes'])} in {facts['folder']}{said}"),
        title_justify="left",
        caption_justify="left",
    )
    table.add_column("variant", no_wrap=True)
    for name in (*STATUSES, "steps", "ms per step"):
        table.add_column(name, justify="right")
    for row in facts["variants"]:
        pace = row["seconds_per_step"]
        table.add_row(
            row["variant"],
            *(str(row[status] or "") for status in STATUSES),
            f"{row['steps'] / row['total_steps']:.0%}",
            "" if pace is None else f"{pace * 1e3:.3g}",
        )
    return table
