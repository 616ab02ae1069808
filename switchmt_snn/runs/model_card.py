"""``MODEL_CARD.md``: what a trained network is, learned, scores and costs, from the files of its run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from switchmt_snn import __version__
from switchmt_snn.acting.evaluation import EvaluationProtocol
from switchmt_snn.config import METHOD_TRAITS, ExperimentConfig
from switchmt_snn.drawing.numbers import bytes_of, digits, duration, percent, whole
from switchmt_snn.runs.evaluations import better_than_random
from switchmt_snn.runs.files import parsed_json, sha256
from switchmt_snn.runs.folder import RunFolder, read_environment
from switchmt_snn.runs.history import History, read_history

CARD = "MODEL_CARD.md"


def model_card(
    run: RunFolder,
    checkpoint: str = "last",
    files: Mapping[str, Path] | None = None,
    parity: Mapping[str, Any] | None = None,
) -> str:
    """The card of a run's network as Markdown, or of the files that were exported from it.

    Args:
        run: the run.
        checkpoint: which weights, ``last`` or ``best``.
        files: exported files by name, whose hashes are listed; None for the run itself.
        parity: ``weights`` (``float32`` or ``int8``) and ``recorded``, as in ``parity.json`` of these files.

    Raises:
        CheckpointError: no whole checkpoint.
        RunFolderError: a log or an evaluation cannot be read.
    """
    config = run.config()
    step, weights = run.checkpoints().load_model(checkpoint)
    environment = read_environment(run.path)
    history = read_history(run.path, config.tasks.names)
    scores = _scores(run, step)
    profile = _profile(run, step)
    stored = sum(tensor.numel() for tensor in weights.values())
    return "\n".join(
        [
            f"# Model card: {config.name}, step {step:,}",
            "",
            f"Written by switchmt-snn {__version__} from the files of the run; do not edit.",
            "",
            *_what(config, stored),
            *_training(config, step, history, environment),
            *_score_lines(config, scores),
            *_parity_lines(parity),
            *_energy_lines(profile, METHOD_TRAITS[config.network.method].spiking),
            *_limits(config, scores, profile, parity),
            *_hash_lines(run, step, environment, files or {}),
        ]
    )


def _what(config: ExperimentConfig, stored: int) -> list[str]:
    network, spiking = config.network, METHOD_TRAITS[config.network.method].spiking
    settings = [f"method {network.method}", f"trunk `{network.trunk}`"]
    if spiking:
        settings += [f"neurons `{network.neuron}`", f"T = {network.timesteps} simulation steps per decision"]
        settings += [f"{network.encoding} encoding", f"readout `{network.readout}`"]
    return [
        "## What it is",
        "",
        f"{'A spiking' if spiking else 'An ANN'} Q-network: an observation in, a Q-value for each action out; "
        "the largest one's action is taken.",
        "",
        f"- {', '.join(settings)}",
        f"- {stored:,} stored numbers (weights and statistics of normalisation)",
        f"- tasks, by number: {', '.join(f'{k} `{name}`' for k, name in enumerate(config.tasks.names))} "
        f"(suite `{config.tasks.suite}`)",
        "",
    ]


def _training(config: ExperimentConfig, step: int, history: History, environment: Mapping[str, Any]) -> list[str]:
    shares = history.measured[-1].steps_by_task if history.measured else ()
    played = ", ".join(f"{name} {count:,}" for name, count in zip(config.tasks.names, shares, strict=False))
    versions = environment.get("versions", {})
    conditions = EvaluationProtocol.of(config.evaluation, config.tasks, step).environment
    return [
        "## What it was trained on, and how long",
        "",
        f"- {step:,} of {config.total_steps:,} agent steps"
        + (f" (at the newest measurement: {played})" if played and len(config.tasks.names) > 1 else ""),
        f"- the run so far: {history.updates:,} updates in {duration(history.wall_s)} (h:m:s), seed {config.seed}",
        f"- conditions of play: {', '.join(conditions) or 'none'}",
        f"- on: {environment.get('device_name') or environment.get('processor')}, "
        f"{environment.get('torch_threads')} threads, "
        f"{', '.join(f'{name} {version}' for name, version in versions.items() if version)}",
        f"- command: `{environment.get('command')}`; every setting: `config.yaml` of the run",
        "",
    ]


def _scores(run: RunFolder, step: int) -> list[tuple[dict[str, Any], EvaluationProtocol]]:
    """The evaluations of these weights."""
    found = [stored for stored in run.evaluations.all() if stored["step"] == step]
    return [(stored, EvaluationProtocol.from_dict(stored["protocol"])) for stored in found]


def _score_lines(config: ExperimentConfig, scores: list[tuple[dict[str, Any], EvaluationProtocol]]) -> list[str]:
    lines = ["## Scores", ""]
    if not scores:
        return [*lines, "Not evaluated at this step: nothing is known about what it is worth.", ""]
    lines += [
        "Mean raw return ± standard error of the mean.",
        "",
        "| task | agent | random play | human-normalised | protocol |",
        "|---|---:|---:|---:|---|",
    ]
    for stored, protocol in scores:
        rows = {(row["task"], row["policy"]): row for row in stored["tasks"]}
        for task in config.tasks.names:
            if (agent := rows.get((task, "agent"))) is None:
                continue
            human = agent.get("human_normalized")
            lines.append(
                f"| {task} | {_mean(agent)} | {_mean(rows.get((task, 'random')))} | "
                f"{'' if human is None else f'{human:.0%}'} | {protocol} |"
            )
    return [*lines, ""]


def _mean(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return ""
    error = row.get("standard_error")
    return f"{digits(row['mean'])}{'' if error is None else f' ± {digits(error)}'}"


def _parity_lines(parity: Mapping[str, Any] | None) -> list[str]:
    if parity is None:
        return []
    rows = [
        f"| {row['task']} | {row['runtime']} | {row['decisions']:,} | {percent(row['equal_actions_share'])} | "
        f"{row['largest_q_difference']:.1e} |"
        for row in parity["recorded"]
    ]
    return [
        "## The files against the trained network",
        "",
        f"Weights: {parity['weights']}. On recorded play; `parity.json` has all of it.",
        "",
        "| task | played by | decisions | same action | largest Q difference |",
        "|---|---|---:|---:|---:|",
        *rows,
        "",
    ]


def _profile(run: RunFolder, step: int) -> dict[str, Any] | None:
    """The run's profile, if it is of these weights."""
    path = run.path / "profile" / "profile.json"
    if not path.is_file():
        return None
    facts = dict(parsed_json(path.read_bytes()))
    return facts if facts.get("training_step") == step else None


def _energy_lines(profile: Mapping[str, Any] | None, spiking: bool) -> list[str]:
    lines = ["## Energy", ""]
    if profile is None:
        counted = "spikes" if spiking else "operations"
        return [
            *lines,
            f"Not profiled at this step; `switchmt-snn profile RUN` counts {counted} and estimates energy.",
            "",
        ]
    lines += [
        f"Estimates from exact counts on recorded play ({profile['tool']}), not measurements of a chip. "
        f"{profile['headline']}",
        "",
        "| task | target | spikes per decision | energy per decision (µJ) | by the ANN | per episode (J) |",
        "|---|---|---:|---:|---:|---:|",
    ]
    for task in profile["tasks"]:
        for energy in task["energy"]:
            ratio, episode = energy["by_ann"], energy["per_episode_pj"]
            lines.append(
                f"| {task['task']} | `{energy['target']}`{'*' if energy['not_included'] else ''} | "
                f"{whole(task['per_decision']['spikes'])} | {digits(energy['total_pj'] / 1e6)} | "
                f"{'' if ratio is None else digits(ratio)} | {'' if episode is None else digits(episode / 1e12)} |"
            )
    return [*lines, "", "\\* something that was counted has no price there.", ""]


def _limits(
    config: ExperimentConfig,
    scores: list[tuple[dict[str, Any], EvaluationProtocol]],
    profile: Mapping[str, Any] | None,
    parity: Mapping[str, Any] | None,
) -> list[str]:
    lines = ["One seed: another one may learn more, less or nothing."]
    lines += ["It plays these tasks under these conditions of play; nothing is known about others."]
    for task in config.tasks.names:
        verdicts = [verdict for stored, _ in scores if (verdict := better_than_random(stored, task)) is not None]
        if verdicts and not any(verdicts):
            lines.append(f"In {task} it is not clearly better than random play.")
        elif not verdicts and scores:
            lines.append(f"In {task} it was not evaluated.")
    if parity is not None and parity["weights"] == "int8":
        lines.append("The scores are those of the float32 weights, not of these 8-bit ones.")
    elif parity is not None:
        lines.append(
            "The scores are the trained network's; `switchmt-snn evaluate RUN --runtime onnx` plays the files."
        )
    for task in profile["tasks"] if profile is not None else ():
        for effect in task.get("precision", ()):
            lines.append(
                f"With {effect['bits']}-bit weights the same action in {percent(effect['equal_actions_share'])} of "
                f"{effect['decisions']:,} decisions of {task['task']}."
            )
        for layer in task["layers"]:
            if layer["neurons"] and 2 * layer["silent"] > layer["neurons"]:
                silent = f"{layer['silent']:,} of {layer['neurons']:,} neurons of {layer['name']} fire in none of "
                silent += f"{task['decisions']:,} decisions"
                lines.append(f"In {task['task']} {silent}: low energy then says little.")
    return ["## Limits", "", *(f"- {line}" for line in lines), ""]


def _hash_lines(run: RunFolder, step: int, environment: Mapping[str, Any], files: Mapping[str, Path]) -> list[str]:
    lines = ["## Hashes", "", "| file | size | SHA-256 |", "|---|---:|---|"]
    for name, path in files.items():
        lines.append(_hash_line(name, path.read_bytes()))
    lines.append(_hash_line("config.yaml of the run", (run.path / "config.yaml").read_bytes()))
    checkpoints = run.path / "checkpoints"
    for folder in (checkpoints / f"step-{step:012d}", checkpoints / "best"):
        weights = folder / "model.safetensors"
        if weights.is_file() and parsed_json((folder / "manifest.json").read_bytes())["step"] == step:
            name = weights.relative_to(run.path).as_posix()
            lines.append(_hash_line(f"{name} (trained weights)", weights.read_bytes()))
            break
    for name, digest in environment.get("files_sha256", {}).items():
        lines.append(f"| {name} (trained with) | | `{digest}` |")
    return [*lines, ""]


def _hash_line(name: str, content: bytes) -> str:
    return f"| {name} | {bytes_of(len(content))} | `{sha256(content)}` |"
