"""``switchmt-snn export``: write a run's network as files, and compare them with it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from switchmt_snn.cli.parsing import parse, split_one
from switchmt_snn.viewing import output


@dataclass(frozen=True)
class ExportOptions:
    """Write a run's network as ONNX and NIR files, and compare them with it. Default: every format that fits."""

    onnx: bool = False
    """decision.onnx (all tasks, frames in, Q-values out) and step.onnx (one simulation step, membranes outside)."""
    nir: bool = False
    """One NIR graph and one JSON file per task."""
    task: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Also decision_TASK.onnx for this task alone. May be repeated."""
    unroll: bool = False
    """Also unrolled.onnx: decision.onnx with its steps one after the other, for OpenVINO, tract and OpenCV."""
    int8: bool = False
    """Weights as 8-bit integers, symmetric per output channel. The effect on decisions is measured."""
    nir_dialect: Literal["portable", "spikingjelly", "exact", "legacy"] = "portable"
    """portable: most importers. spikingjelly: SpikingJelly with its default dt, and snnTorch. exact: also reset by
    subtraction (uses loops). legacy: nir 1.0.5 and older."""
    parity_decisions: int = 1000
    """Recorded decisions per task on which the files are compared with the network."""
    checkpoint: Literal["last", "best"] = "last"
    """Which weights."""
    out: Path | None = None
    """Folder to write to. Default: the run's export/."""
    trust: bool = False
    """Import modules that the run names, although you did not make it: this runs their code."""
    json: bool = False
    """Print files and parity as JSON."""


def command(argv: list[str]) -> int:
    """Run the command; returns its exit code."""
    run, rest = split_one(ExportOptions, argv, "export", ExportOptions())
    options = parse(ExportOptions, rest, "export", ExportOptions())
    from switchmt_snn.export.export_run import ExportSettings, export
    from switchmt_snn.viewing.progress_bar import ProgressBars
    from switchmt_snn.viewing.tables import parity_table

    settings = ExportSettings(
        onnx=options.onnx,
        nir=options.nir,
        tasks=options.task,
        unroll=options.unroll,
        int8=options.int8,
        nir_dialect=options.nir_dialect,
        parity_decisions=options.parity_decisions,
    )
    console = output.console(stderr=options.json)
    with ProgressBars():
        result = export(
            Path(run) if run is not None else None,
            settings,
            options.checkpoint,
            options.out,
            lambda text: console.print(text, highlight=False, soft_wrap=True),
        )
    if options.json:
        files = {name: str(path) for name, path in result.files.items()}
        output.print_json({"folder": str(result.folder), "files": files, "parity": result.parity})
        return 0
    console.print(parity_table(result.parity))
    print(result.folder)
    return 0
