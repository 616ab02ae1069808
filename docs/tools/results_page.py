"""docs/results.md: which switching policy, from the stored runs and studies."""

from __future__ import annotations

import csv
import json
import statistics
from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

from switchmt_snn.config import load_config
from switchmt_snn.study.prize import Split, TaskCurve, best_split, split_of
from switchmt_snn.tasks.atari_scores import PUBLISHED_SCORES

RESULTS = Path(__file__).parents[2] / "results"
ATARI_RUN = "three-held-s3"
WINDOW = 10
"""Episodes of a mean of training returns."""
BUDGETS_STEPS = (150_000, 300_000, 450_000, 600_000, 750_000)
ROWS = ("SwitchMT (paper)", "human (paper)")
"""What counts as 1: the goal of this project, and the paper's human row."""


def results_page() -> str:
    """The page."""
    run = RESULTS / "atari" / ATARI_RUN
    lines = [*INTRODUCTION.strip().splitlines(), "", *_answers(), "", *_prize(run), "", *_decided(run)]
    for folder in sorted(path for path in (RESULTS / "studies").glob("*") if (path / "study.json").exists()):
        lines += ["", *_study(folder)]
    return "\n".join([*lines, "", *CLAIM.strip().splitlines()]) + "\n"


def _prize(folder: Path) -> list[str]:
    games = load_config(folder / "config.yaml", reopen=False).tasks.names
    lines = ["## What a policy could win at most", "", *PRIZE.strip().splitlines()]
    for row in ROWS:
        (published,) = (one.scores for one in PUBLISHED_SCORES if one.policy == row)
        curves = [_curve(folder, game, published[game]) for game in games]
        goals = ", ".join(f"{game} {published[game]:g}" for game in games)
        lines += [
            "",
            f"The score that counts as 1: {row} ({goals}).",
            "",
            _row(["steps", "split", *(f"{game}: steps, share" for game in games), "harmonic mean"]),
            _row(["---:", "---", *["---:"] * (len(games) + 1)]),
        ]
        for budget in BUDGETS_STEPS:
            lines += _splits(folder, games, curves, budget)
    return lines


def _splits(folder: Path, games: Sequence[str], curves: list[TaskCurve], budget: int) -> list[str]:
    """The even split, the run's own, and the best one, as far as the curves know them."""
    even = [budget // len(games)] * len(games)
    own = _own_steps(folder, games, budget)
    found: list[tuple[str, Split]] = []
    for name, steps in (("even", even), ("the run's", own)):
        if steps is not None and all(count <= c.longest_steps for count, c in zip(steps, curves, strict=True)):
            found.append((name, split_of(curves, steps)))
    if not found:
        return []
    found.append(("the best", best_split(curves, budget)))
    return [
        _row(
            [
                f"{budget:,}" if name == found[0][0] else "",
                name,
                *(f"{steps:,}, {share:.2f}" for steps, share in zip(split.steps_K, split.shares_K, strict=True)),
                f"{split.harmonic_mean:.2f}",
            ]
        )
        for name, split in found
    ]


def _curve(folder: Path, game: str, reference: float) -> TaskCurve:
    with (folder / "episodes.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["task"] == game]
    lengths, returns = [int(row["length_steps"]) for row in rows], [float(row["return"]) for row in rows]
    return TaskCurve.of_episodes(lengths, returns, WINDOW, _random_play(folder, game), reference)


def _random_play(folder: Path, game: str) -> float:
    """The mean of random play in the run's last evaluation."""
    stored = max((json.loads(path.read_text()) for path in (folder / "evaluations").glob("*.json")), key=_step)
    (mean,) = (row["mean"] for row in stored["tasks"] if (row["task"], row["policy"]) == (game, "random"))
    return float(mean)


def _step(evaluation: dict[str, Any]) -> int:
    return int(evaluation["step"])


def _own_steps(folder: Path, games: Sequence[str], budget: int) -> list[int] | None:
    """Steps of each game when the run had made so many in all; None before that."""
    for line in (folder / "metrics.jsonl").read_text().splitlines():
        row = json.loads(line)
        if row["step"] >= budget:
            return [int(row["steps_by_task"][game]) for game in games]
    return None


def _decided(folder: Path) -> list[str]:
    """What ended the visits of a run: Eq. 3, or the bound."""
    with (folder / "switches.csv").open() as file:
        rows = list(csv.DictReader(file))
    games = list(dict.fromkeys(row["task"] for row in rows))
    above = {row["visit"] for row in rows if (row["decision"], row["reason"]) == ("stay", "parameter_change")}
    lines = [
        "## What Eq. 3 decided",
        "",
        *DECIDED.strip().splitlines(),
        "",
        _row(["game", "visits", "ended by Eq. 3", "at the first full window", "by the bound", "mean steps of a visit"]),
        _row(["---", *["---:"] * 5]),
    ]
    for game in games:
        ended = [row for row in rows if row["task"] == game and row["decision"] == "switch"]
        by_change = [row for row in ended if row["reason"] == "parameter_change"]
        by_bound = [row for row in ended if row["reason"] == "max_stay_steps"]
        assert len(by_change) + len(by_bound) == len(ended)
        at_once = sum(row["visit"] not in above for row in by_change)
        steps = statistics.mean(int(row["steps_in_visit"]) for row in ended)
        counts = [str(len(ended)), str(len(by_change)), str(at_once), str(len(by_bound)), f"{steps:,.0f}"]
        lines.append(_row([game, *counts]))
    return lines


def _study(folder: Path) -> list[str]:
    """A study's tables, as they stand in its folder, and what it took."""
    made = (folder / "tables.md").read_text().splitlines()
    lines = [
        f"## Study `{folder.name}`",
        "",
        *STUDIES[folder.name].strip().splitlines(),
        "",
        *wrap(_verdict(folder), 118),
        "",
    ]
    lines += [line.replace("## ", "### ") for line in made if not line.startswith("# ")]
    with (folder / "trials.csv").open() as file:
        finished = {row["trial"] for row in csv.DictReader(file)}
    seconds: dict[str, float] = {}
    for line in (folder / "attempts.jsonl").read_text().splitlines():
        attempt = json.loads(line)
        seconds[attempt["trial"]] = seconds.get(attempt["trial"], 0.0) + attempt["seconds"]
    taken = sorted(seconds[trial] / 60 for trial in finished)
    machine = json.loads((folder / "environment.json").read_text())
    stored = f"[results/studies/{folder.name}](../results/studies/{folder.name})"
    lines += [
        "",
        f"`switchmt-snn study {folder.name}`: {statistics.median(taken):.1f} minutes per trial (median; {taken[0]:.1f} "
        f"to {taken[-1]:.1f}) on one core of a machine that also did other work ({machine['processor']}, "
        f"{machine['cores']} cores). {stored} has the numbers as CSV, and in `trials.tar.xz` config, logs and "
        f"evaluations of every trial. Unpacked into `runs/studies/{folder.name}`, beside `trials.json`, the same "
        "command goes on from there.",
    ]
    return lines


def _tables(folder: Path) -> dict[str, dict[str, dict[str, Any]]]:
    """Rows of a study's tables, by table and variant."""
    facts = json.loads((folder / "study.json").read_text())
    return {table["name"]: {row["variant"]: row for row in table["rows"]} for table in facts["tables"]}


def _verdict(folder: Path) -> str:
    """What the rule says of a study's variants, in a sentence or three."""
    tables, baseline = _tables(folder), json.loads((folder / "study.json").read_text())["baseline"]
    rows = tables["decision"]
    preferred = [name for name, row in rows.items() if row["preferred"] == "yes"]
    ahead = [name for name, row in rows.items() if row["interval above 0.5"] == "yes" and name not in preferred]
    chances = {name: tables["shares"][name][f"P(> {baseline})"] for name in rows}
    worse = [name for name, chance in chances.items() if chance["value"] == 0.0]
    said = [f"**Preferred to `{baseline}`: {_names(preferred) or 'none'}.**"]
    if ahead:
        said.append(f"Ahead in most pairs of seeds, but not preferred: {_names(ahead)}.")
    if worse:
        said.append(f"Worse than `{baseline}` in every pair of seeds: {_names(worse)}.")
    return " ".join(said)


def _names(variants: Sequence[str]) -> str:
    return ", ".join(f"`{name}`" for name in variants)


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


INTRODUCTION = """
# Results: which switching policy?

Generated by `python -m docs.generate` from `results/`; do not edit. For whoever has to choose one today.
"""


def _answers() -> list[str]:
    """The short answers, with the numbers of the study that has any by now."""
    tables = _tables(RESULTS / "studies" / "unequal_tasks")

    def harmonic(variant: str) -> str:
        return f"{tables['shares'][variant]['harmonic mean']['value']:.2f}"

    def chance(variant: str) -> str:
        return f"{tables['shares'][variant]['P(> uniform)']['value']:.2f}"

    def p_value(variant: str) -> str:
        return f"{tables['shares'][variant]['p']:.3f}"

    seeds = min(row["harmonic mean"]["seeds"] for row in tables["shares"].values())
    preferred = [name for name, row in tables["decision"].items() if row["preferred"] == "yes"]
    shown = ", ".join(f"`{name}`" for name in preferred)
    counting = ", ".join(f"`{name}` {harmonic(name)}" for name in ("fixed_25", "reward_plateau", "plateau_and_return"))
    study = f"[unequal_tasks](#study-unequal_tasks) ({seeds} seeds)"
    answers = (
        (
            "Which policy?",
            "`fixed_steps`: the same steps for every task, in short visits. It needs no thresholds, and "
            + (f"by the rule only {shown} did better in {study}." if preferred else "by the rule none did better yet."),
        ),
        (
            "Could one be better?",
            "Perhaps, where tasks need different numbers of steps: the first table. With reference scores that you "
            f"know, `harmonic_gain` reached a harmonic mean of {harmonic('harmonic_gain')} and `deficit` "
            f"{harmonic('deficit')} in {study}, `fixed_steps` {harmonic('uniform')}. Each is ahead in more than half "
            f"of the pairs of seeds (P {chance('harmonic_gain')} and {chance('deficit')}), but such differences come "
            f"by chance, too: p is {p_value('harmonic_gain')} and {p_value('deficit')}.",
        ),
        (
            "Which to avoid?",
            f"Policies whose visits or windows are numbers of episodes, where episodes differ in length: {counting} in "
            f"{study}, below `fixed_steps` in every seed (p {p_value('fixed_25')}). Bad play of CartPole has short "
            "episodes, so these policies gave it few steps.",
        ),
        (
            "What does a wrong choice cost?",
            "Steps. A policy that never leaves a task costs all others, so bound the visits "
            "(`switching.max_stay_steps`).",
        ),
        (
            "Does the paper's Eq. 3 help?",
            f"Not shown: harmonic mean {harmonic('eq3_learned')} in {study}. Where it decided on Atari, it decided at "
            "the first moment that it could: the second table.",
        ),
    )
    return [_row(["question", "answer by now"]), _row(["---", "---"]), *(_row(answer) for answer in answers)]


PRIZE = """
If a task's score depends on its own steps only, a policy decides nothing but how many steps each task gets. The best
split of a budget can then be read off the learning curves of one run; an oracle knows them beforehand, a policy does
not. The curves are the best mean so far of 10 successive training returns of
[three-held-s3](../results/atari/README.md) (one seed), from random play at 0 steps. Shares are
min((score - random play) / (goal - random play), 1). No curve is extrapolated: a split that needs more steps of a game
than the run made is left out.
"""

DECIDED = """
The same run. Eq. 3 compares the parameters over a window of five episodes, and a visit lasts 2,000 to 6,000 steps
whatever it says. Where it ended a visit, it did so at the first episode end at which it had a window: nearly always,
the change was below its threshold. So it measured how long five episodes are, not whether learning had ended: games
with short episodes are left early.
"""

STUDIES = {
    "unequal_tasks": """
An easy, a medium and a hard-to-start task, episodes of 10 to 500 steps, and CartPole's left and right swapped after
half of the steps ([the study](../configs/studies/unequal_tasks.yaml)). Every task is learned by some policy; what
differs most is CartPole, which has to be learned twice. Eight of the study's twelve variants have been trained, with
all ten seeds; p is corrected for these eight, and the other four could only make it larger. `deficit` and
`harmonic_gain` are told the scores at which a task counts as solved, the others are not. Visits or windows of
`fixed_25`, `reward_plateau` and `plateau_and_return` are counted in episodes.
""",
    "unequal_tasks_again": """
The two variants that were ahead in `unequal_tasks`, and `uniform`, with seeds 11 to 30 and all else as there
([the study](../configs/studies/unequal_tasks_again.yaml)). Seeds, variants and rule were fixed before the first run,
and the seeds that chose the question do not count. Both variants are told the scores at which a task counts as solved.
""",
}
"""What a reader must know of a study."""

CLAIM = """
## The paper's claim

The paper says that switching when parameters stop changing lets one spiking network learn several games. Its table
shows one seed and five test episodes, and its script switches after a fixed number of episodes
([algorithm.md](algorithm.md)).

- **One spiking network can learn the three games**: [results/atari](../results/atari/README.md). The run there learns
  from all games in every round of updates, which the paper's text does not.
- **That the policy is what makes it work is not shown**, neither by the paper nor here.
- **A fixed number of episodes, as the paper's script has it, is a bad rule where episodes differ in length**
  (`fixed_25` in [unequal_tasks](#study-unequal_tasks): worse than the same steps for every task in every seed).
- **Eq. 3, once it waits for updates, is not told apart from the same steps for every task** (`eq3_learned`, there).

## What is not known

- Which policy wins on Atari: no two policies have been compared at equal steps there, and no three seeds of one. Two
  runs with other seeds and policies differ by some 30 points in Pong
  ([results/atari](../results/atari/README.md#deficit-s1)).
- Whether games help or disturb each other in one network, which the prize above leaves out.
- What the studies say that are not finished: [studies.md](studies.md#studies-of-the-package).
"""
