"""``switchmt-snn describe``: what a config would build."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from switchmt_snn.cli.parsing import for_another_suite, for_named_tasks, parse, split_one
from switchmt_snn.config import ExperimentConfig, load_config
from switchmt_snn.errors import RunFolderError, printable
from switchmt_snn.viewing import output


@dataclass(frozen=True)
class DescribeOptions:
    """Describe what a config would build; every setting of the config is an option."""

    experiment: Annotated[ExperimentConfig, tyro.conf.arg(name="")]
    trust: bool = False
    """Import modules that the config of a run folder names, although you did not make it: this runs their code."""
    json: bool = False
    """Print everything as JSON."""


def command(argv: list[str]) -> int:
    """Run the command; returns its exit code."""
    flagless = DescribeOptions(experiment=ExperimentConfig())
    source, rest = split_one(DescribeOptions, argv, "describe", flagless)
    default = for_named_tasks(_config_of(source or "quickstart"), rest)
    options = parse(DescribeOptions, rest, "describe", DescribeOptions(experiment=default))
    from switchmt_snn.machine.memory import available_bytes
    from switchmt_snn.runs.description import describe
    from switchmt_snn.viewing.tables import layers_table, methods_table

    config = options.experiment
    methods = describe(config)
    told = for_another_suite(source, default, config, rest, "describe")
    if told is not None:
        output.console(stderr=options.json).print(told, highlight=False, soft_wrap=True)
    source = source or "quickstart"
    if options.json:
        facts: dict[str, Any] = {"config": config.name, "source": source, "available_memory_bytes": available_bytes()}
        output.print_json({**facts, "methods": {name: method.to_dict() for name, method in methods.items()}})
        return 0
    console = output.console()
    console.print(methods_table(methods, source))
    console.print(layers_table(methods[config.network.method]))
    return 0


def _config_of(source: str) -> ExperimentConfig:
    """The config of a file, a preset, or a run."""
    from switchmt_snn.runs.folder import RunFolder
    from switchmt_snn.runs.packing import is_pretrained, open_run

    is_folder = Path(source).is_dir()
    if is_folder and not RunFolder(Path(source)).is_run:
        raise RunFolderError(
            f"{printable(source)} is a folder without a run, expected a config (YAML file or preset), a run folder, or "
            "pretrained/NAME"
        )
    if is_folder or is_pretrained(source):
        return load_config(open_run(source).path / "config.yaml")
    return load_config(source)
