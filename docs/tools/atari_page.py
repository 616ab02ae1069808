"""results/atari/README.md: several Atari games in one network, from the stored runs."""

from __future__ import annotations

import csv
import json
import statistics
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

from docs.tools.commands import UNCHECKED, commands
from switchmt_snn.acting.evaluation import EvaluationProtocol
from switchmt_snn.config import load_config
from switchmt_snn.tasks.atari_scores import PUBLISHED_SCORES

NOTES = {
    "deficit-s1": """\
The settings of three-held-s3 with seed 1 and the policy `deficit`, which is told the goals (SwitchMT's scores of the
paper) and gives the next visit to the game that is furthest from its own. The first trial of the study
`policies_atari`, stopped after 544,944 of 1,000,000 steps; its end is not known.
**In Pong the agent learns to return the ball, and not to score: -18.5 after 500,000 steps (205,408 of its own), where
three-held-s3 had 12.3 after 400,000.** Breakout (6.0) and Enduro (206.3) come as there. Seed and policy differ, so
which of them it is cannot be told; but the scores of three-held-s3 are those of one seed, and a seed can be slower.
`checkpoints/` holds the last weights.
""",
    "held-enduro-s1": """\
`strong` with seed 1 and random actions that last in Enduro only (`learning.longest_random_action_steps_by_task: [1, 1,
100]`), stopped after 200,000 of 1,000,000 steps. The question was whether random actions that last delay Pong.
**They do not explain it: without them Pong's return stays at -20 for 83,480 steps of its own**, longer than in any run
with them. The preset stays as it is. The first table of this page says what is missing: the agent returns the ball as
in the other runs, and does not score. Alone, the same network with the same seed scores after half of these steps
(pong-float32-s1, pong-bfloat16-s1).
""",
    "lagging-s1": """\
Stopped: **Pong diverged.** Its mean Q rises to 8 while it loses every game, because the network that acts and gives
targets is another one than the network that learns. The background of Pong is a bright constant, 0.42 of the range, so
one Adam step moves the mean current of a channel of the first layer by a good part of its standard deviation, and
BatchNorm's running mean stays behind (`off_conv1` below: 0.21 standard deviations; Breakout's background is black). The
target then chooses and values actions by chance, and the largest of some random values is too large. The preset
`strong` has four settings against it: `double_q`, `reestimate_statistics_batches`, `next_statistics` and
`acting_network`.
""",
    "low-rate-s1": """\
`strong` with a quarter of its learning rate (2.5e-5) and seed 1, stored while it went on. **In Pong it scores by
100,000 of its own steps as three-held-s3 did, and as deficit-s1 and held-enduro-s1, of the same seed and the whole
rate, did not** (first table); **after that it stays at -13 to -17**, where three-held-s3 went on to -2 by 160,000.
Breakout is not behind; Enduro is, after 125,000 of its own steps (64 in training where deficit-s1 had 99). One seed:
whether it is the rate is to be seen with others, and rate-quarter-s1 shows no such difference in a network that does
not score.
`checkpoints/` holds the last weights.
""",
    "pong-bfloat16-s1": """\
pong-float32-s1 with updates and training's actions in bfloat16, stopped when the comparison was made. **Pong alone is
learned in bfloat16, too**, as in pong-s1 (float32) and some 10,000 steps later than in pong-float32-s1; one seed each
cannot tell whether that is the precision.
""",
    "pong-float32-s1": """\
The preset `pong` with seed 1, and native updates and actions in float32; those of pong-s1 were compiled and eager,
which rounds otherwise. Stopped when the comparison with pong-bfloat16-s1 was made.
""",
    "pong-s1": """\
Pong alone, the preset `pong`: half the paper's channels (981,334 parameters as deployed), two simulation steps.
**It learns.** Targets of ten steps, batches of 32 and 16 samples per agent step (the three-game runs had targets of one
to three steps, batches of 64 and 4 samples) were changed at once: which of them it needs is not measured, nor is the
ANN twin. The run was stopped for lack of machine time, not because it had stopped learning. It was recorded under the
trunk's name `nature` with the channels of `nature_half` written into the table of trunks; the preset gave bitwise the
same weights after 2,400 steps.

**Which network is evaluated matters.** The scores below are of the network that learns, which evaluations took then.
The one after 139,528 steps was saved between two estimates of its BatchNorm statistics, and plays far below the
training returns. The target network of the same checkpoint, which acts in training and has statistics of its own
weights, scores **15.3 ± 0.7** (30 episodes, the same protocol; a human: 14.6): `pretrained/pong`. Evaluations and
exports take it now.
At 100,000 steps statistics were fresh.
""",
    "rate-quarter-s1": """\
Is it the learning rate that keeps deficit-s1 from scoring in Pong? Two runs begin with its last weights, an empty
replay and an optimizer without history: this one with a quarter of its learning rate (2.5e-5), rate-same-s1 with the
same (1e-4); epsilon falls from 0.05 to 0.01. Evaluated after 60,000 steps each; this one went on to 75,312.
**Pong does not tell them apart (-16.2 ± 0.8 and -17.5 ± 0.7), Breakout neither; Enduro does: 178.5 ± 9.6 where the
whole rate falls to 58.6 ± 5.3** (deficit-s1 had 206.3 ± 14.0 after 500,000 steps). A new start with the whole rate
loses what was learned. One seed.
""",
    "rate-same-s1": """\
The control of rate-quarter-s1: the same start, with the learning rate of `strong`.
""",
    "three-half-s1": """\
Three games in one network: `strong` with the preset `pong`'s channels and 16 samples per agent step (n_steps 10,
batches of 32). One seed, stopped after 141,432 of 1,000,000 steps for lack of machine time. It was continued once,
after 100,000 steps, by a newer version, which evaluates the network that acts; both evaluations below are of that
network, the first of 10 episodes.
**Pong is being learned, step for step of its own as in the network that learns Pong alone (pong-s1); Breakout was
above the paper's 5.6 once and did not stay there; Enduro is not learned.** Random play meets no reward in Enduro: not
one in the first 50,632 stored transitions. Holding the accelerator would, and `learning.longest_random_action_steps:
100` finds some (16 in 5,200 steps of random play): three-held-s1 trains with it.
""",
    "three-held-s1": """\
three-half-s1 with `learning.longest_random_action_steps: 100` (random actions that last), otherwise the same settings
and seed; stopped after 160,160 of 1,000,000 steps, because its machine was lost. The evaluation is that of 100,000
steps.
**Enduro is being learned**: 3.5 ± 1.0 after 38,900 steps of its own, where three-half-s1 has 0 of 30 episodes with a
car passed, and episodes of 2 to 36 in training at 131,000 steps. Pong is where it was in three-half-s1 (-19.0 against
-20.2), Breakout below (3.0 ± 0.3 against 6.8 ± 1.0, after 21,700 steps of its own). One seed each: no word on whether
that difference is the setting's.
""",
    "three-held-s2": """\
three-held-s1 with seed 2, on a processor with AVX-512, where updates are native: some 45 agent steps per second of
training on one core beside other work, where three-held-s1 had 27. Stopped after 265,320 of 1,000,000 steps for lack of
machine time; the hours below hold 27 minutes in which it was paused.
**Enduro is being learned: 0 by random play, then 6.9, 34.7 and 87.5** (103,808 steps of its own at the end); SwitchMT
of the paper has 355. Breakout reaches the paper's 5.6 (5.7 ± 0.3). Pong begins after 100,000 steps of its own, later
than in three-held-s1 (one seed each). All three games rise between the last two evaluations.
`checkpoints/` holds the last weights: `switchmt-snn evaluate results/atari/three-held-s2`, or begin a run with them
(`--initial-weights`).
""",
    "three-held-s3": """\
three-held-s2 with seed 3, in bfloat16 on a processor with AVX-512, trained to its end in three sittings. The hours
below hold 14 minutes in which it was paused.
**One spiking network plays three games: Pong 14.8 ± 1.2 (random -20.2, SwitchMT of the paper -8.8), Breakout 10.0 ± 0.5
(1.2, 5.6), Enduro 406.8 ± 11.4 (0, 355).** It is above every network of the paper's table in every game, and above its
human row in Pong and Enduro (-3, 368), not in Breakout (31). Enduro comes last: 124.4 after 177,624 steps of its own,
and past the first day (200 cars) after some 350,000. **One seed.** Evaluations during training are of 10 episodes,
those after 455,856 and 1,000,000 steps of 30, too. The weights come with the package: `pretrained/atari`.
""",
}
"""What a reader must know of a run."""

FOLDER = Path(__file__).parents[2] / "results" / "atari"
BIN_STEPS = 25_000
PONG_BIN_STEPS = 20_000
PONG_BINS = 5


def atari_page() -> str:
    """The page."""
    lines = [
        "# Several Atari games in one spiking network",
        "",
        "Generated by `python -m docs.generate` from the folders here; do not edit. Each folder is a run:",
        "`config.yaml`, `environment.json`, `episodes.csv`, `metrics.jsonl`, `switches.csv`, `evaluations/`. One seed",
        "each, and unfinished where the text says so: **first looks, not results.**",
    ]
    runs = sorted(path for path in FOLDER.iterdir() if path.is_dir())
    lines += [*_pong(runs), *_changed_actions()]
    for folder in runs:
        lines += _run(folder)
    lines += ["", *commands(runs, UNCHECKED)]
    return "\n".join(lines) + "\n"


def _pong(runs: list[Path]) -> list[str]:
    """How long episodes of Pong are, beside their returns, by the steps of Pong."""
    lines = [
        "",
        "## Pong is learned in two steps",
        "",
        "An episode of Pong ends when one side has 21 points. An agent that returns the ball and never scores plays",
        "longer episodes for the same return, so the return hides the first step. In each cell: mean length of the",
        "episodes in agent steps, mean training return; random play has 941 and -20.2. **Every run of three games",
        "returns the ball after some 60,000 steps of Pong, except lagging-s1 and strong-s1; to score comes with it in",
        "some runs, and late or not at all in others.** What decides that is not known.",
        "",
    ]
    starts = range(0, PONG_BINS * PONG_BIN_STEPS, PONG_BIN_STEPS)
    columns = [f"{start // 1000} to {(start + PONG_BIN_STEPS) // 1000}" for start in starts]
    lines += [
        _row(["run", "games", *(f"{column} thousand steps" for column in columns)]),
        _row(["---", "---:", *["---:"] * len(columns)]),
    ]
    for folder in runs:
        config = load_config(folder / "config.yaml", reopen=False)
        if config.initial_weights is not None:
            continue  # it begins with what another run learned
        games = config.tasks.names
        bins: dict[int, list[tuple[int, float]]] = {}
        played = 0
        for row in _episodes(folder):
            if row["task"] == "pong":
                played += int(row["length_steps"])
                found = bins.setdefault(played // PONG_BIN_STEPS * PONG_BIN_STEPS, [])
                found.append((int(row["length_steps"]), float(row["return"])))
        lines.append(_row([folder.name, str(len(games)), *(_length_and_return(bins.get(start)) for start in starts)]))
    return lines


def _changed_actions() -> list[str]:
    """The table of ``benchmarks.changed_actions``, with the words around it."""
    with (FOLDER / "changed_actions.csv").open(newline="") as stream:
        found = list(csv.DictReader(stream))
    changes = list(dict.fromkeys(row["change"] for row in found))
    lines = [
        "",
        "## A small change of the weights changes many decisions",
        "",
        "Share of 512 observations from the replay whose greedy action is another one after a change: all products",
        "rounded to bfloat16; noise on every weight, relative to the weights' root mean square in each tensor (mean of",
        "three draws); so many rounds of the run's own updates of all games (`python -m benchmarks.changed_actions`).",
        "BatchNorm's statistics were re-estimated after each change. From 0.01 % to 1 %, a hundred times the noise",
        "changes 6 to 18 times the actions, not a hundred times: a spike is there or not. Actions of training are",
        "chosen in float32 since this was",
        "measured; the runs of this page in bfloat16 chose them in bfloat16.",
        "",
        _row(["run", "method", "game", *changes]),
        _row(["---", "---", "---", *["---:"] * len(changes)]),
    ]
    for run, method, task in dict.fromkeys((row["run"], row["method"], row["task"]) for row in found):
        cells = []
        for change in changes:
            shares = [
                float(row["changed_actions"])
                for row in found
                if (row["run"], row["task"], row["change"]) == (run, task, change)
            ]
            cells.append(f"{100 * statistics.mean(shares):.1f} %")
        lines.append(_row([run, method, task, *cells]))
    return lines


def _length_and_return(episodes: list[tuple[int, float]] | None) -> str:
    if not episodes:
        return ""
    return f"{statistics.mean(e[0] for e in episodes):,.0f}, {statistics.mean(e[1] for e in episodes):.1f}"


def _episodes(folder: Path) -> Iterator[dict[str, str]]:
    with (folder / "episodes.csv").open(newline="") as stream:
        yield from csv.DictReader(stream)


def _run(folder: Path) -> list[str]:
    config = load_config(folder / "config.yaml", reopen=False)
    games = config.tasks.names
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    last = rows[-1]
    # The clock starts anew at every resume, so each part ends where the next row's time is shorter.
    ends = [row for row, following in pairwise(rows) if following["wall_s"] < row["wall_s"]]
    hours = sum(row["wall_s"] for row in [*ends, last]) / 3600
    environment = json.loads((folder / "environment.json").read_text())
    state = "finished" if last["step"] >= config.total_steps else f"so far, of {config.total_steps:,}"
    by_game = ", ".join(f"{game} {count:,}" for game, count in last["steps_by_task"].items())
    lines = [
        "",
        f"## {folder.name}",
        "",
        *NOTES.get(folder.name, "").splitlines(),
        "",
        f"{last['step']:,} steps {state}, in {hours:.1f} h on one core of a machine that also did "
        f"other work ({environment['processor']}, {environment['cores']} cores): {by_game}.",
        "",
        "Mean training return by steps of the game itself (episodes):",
        "",
        _row(["steps of the game", *games]),
        _row(["---:"] * (len(games) + 1)),
    ]
    returns = _returns(folder, games)
    for start in sorted({start for bins in returns.values() for start in bins}):
        cells = [_mean(returns[game].get(start)) for game in games]
        lines.append(_row([f"{start:,} to {start + BIN_STEPS:,}", *cells]))
    lines += ["", _row(["score", *games]), _row(["---", *["---:"] * len(games)])]
    protocol = ""
    for path in sorted((folder / "evaluations").glob("*.json")):
        stored = json.loads(path.read_text())
        protocol = str(EvaluationProtocol.from_dict(stored["protocol"]))
        scores = {row["task"]: row for row in stored["tasks"] if row["policy"] == "agent"}
        cells = [f"{scores[game]['mean']:.1f} ± {scores[game]['standard_error']:.1f}" for game in games]
        played = f"{stored['protocol']['episodes']} episodes, epsilon {stored['protocol']['epsilon']:g}"
        lines.append(_row([f"after {stored['step']:,} steps ({played})", *cells]))
    for published in PUBLISHED_SCORES:
        lines.append(_row([published.policy, *(f"{published.scores[game]:g}" for game in games)]))
    if protocol:
        conditions = ", ".join(protocol.split(", ")[2:])  # after episodes and epsilon, which stand in the rows
        lines += ["", f"Ours: mean ± standard error; {conditions}."]
    return [*lines, *_statistics(folder)]


def _statistics(folder: Path) -> list[str]:
    """The comparison of ``benchmarks/running_statistics.py``, where it was made."""
    path = folder / "running_statistics.csv"
    if not path.exists():
        return []
    with path.open(newline="") as stream:
        found = list(csv.DictReader(stream))
    lines = [
        "",
        "The network that acts against the same network with BatchNorm statistics re-estimated from the replay",
        "(`python -m benchmarks.running_statistics RUN`): correlation of the largest Q-values, how often both choose",
        "the same action, mean largest Q-value, and how far a layer's running means are off in standard deviations",
        "(median).",
        "",
    ]
    columns = [name for name in found[0] if name not in ("run", "q_fresh")]
    lines += [_row(columns), _row(["---:"] * len(columns))]
    return [*lines, *(_row([f"{int(row['step']):,}", *(row[name] for name in columns[1:])]) for row in found)]


def _returns(folder: Path, games: tuple[str, ...]) -> dict[str, dict[int, list[float]]]:
    """Returns of the episodes of each game, by the first step of their interval of the game's own steps."""
    found: dict[str, dict[int, list[float]]] = {game: {} for game in games}
    played = dict.fromkeys(games, 0)
    for row in _episodes(folder):
        game = row["task"]
        played[game] += int(row["length_steps"])
        found[game].setdefault(played[game] // BIN_STEPS * BIN_STEPS, []).append(float(row["return"]))
    return found


def _mean(values: list[float] | None) -> str:
    return "" if not values else f"{statistics.mean(values):.2f} ({len(values)})"


def _row(cells: list[Any]) -> str:
    return "| " + " | ".join(cells) + " |"
