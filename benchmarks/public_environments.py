"""Whether each command works with environments that nobody here wrote, or refuses them in one line.

``python -m benchmarks.public_environments ID ... [--wrappers NAME ...] [--out FILE]``, in an interpreter in which the
environments are installed; an ID is Gymnasium's, or module:ID where a module must be imported first (the modules of
examples/ are found, too). Each ID goes through ``check-env``, ``train``, ``evaluate``, ``export`` and ``profile``, a
few hundred steps each: this says that they run, not that something was learned. Where a refusal names a wrapper (one of
``tasks.wrappers``, or one of the environment's package), the ID is tried again with it; ``--wrappers`` takes the place
of what refusals name. What happened is added to FILE (results/environments/environments.json), and README.md beside it
is made of that.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.measure import environment

OUT = Path(__file__).parents[1] / "results" / "environments" / "environments.json"
EXAMPLES = Path(__file__).parents[1] / "examples"
LONGEST_S = 240
STEPS = 600
DECISIONS = 100
TRAINING = (
    f"--total-steps={STEPS}",
    "--learning.learning-starts-steps=100",
    "--learning.replay-capacity-steps=5000",
    "--evaluation.episodes=2",
    "--evaluation.max-episode-steps=200",
    "--threads=1",
    "--device=cpu",
)
PACKAGES = {
    "flappy_bird_gymnasium": "flappy-bird-gymnasium",
    "minigrid": "minigrid",
    "popgym": "popgym",
    "memory_gym": "memory-gym",
    "highway_env": "highway-env",
    "tetris_gymnasium": "tetris-gymnasium",
    "mo_gymnasium": "mo-gymnasium",
    "miniworld": "miniworld",
    "crafter": "crafter",
}
"""Distributions of modules."""
BOX2D = ("LunarLander", "BipedalWalker", "CarRacing")
"""Gymnasium's ids that need the package box2d."""


def command(words: list[str], folder: str) -> dict[str, Any]:
    """Run a command: its exit code, and the last line that it wrote where it did not end with 0."""
    paths = os.pathsep.join(filter(None, (os.environ.get("PYTHONPATH"), str(EXAMPLES))))
    env = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
    env |= {"SDL_VIDEODRIVER": "dummy", "SDL_AUDIODRIVER": "dummy", "PYGLET_HEADLESS": "true"}
    whole = [sys.executable, "-m", "switchmt_snn", *words]
    try:
        done = subprocess.run(whole, capture_output=True, text=True, timeout=LONGEST_S, env=env, cwd=folder)
    except subprocess.TimeoutExpired:
        return {"exit_code": None, "last_line": f"not over after {LONGEST_S} s", "traceback": False}
    lines = done.stderr.strip().splitlines() or [""]
    return {
        "exit_code": done.returncode,
        "last_line": None if done.returncode == 0 else lines[-1],
        "traceback": "Traceback (most recent call last)" in done.stderr,
    }


def tried(name: str, wrappers: tuple[str, ...] = ()) -> dict[str, Any]:
    """Every command with one environment; nothing after a command that refuses it, except after ``check-env``."""
    found: dict[str, Any] = {"id": name, "wrappers": list(wrappers), "commands": {}}
    wrapped = ["--wrappers", *wrappers] if wrappers else []
    with tempfile.TemporaryDirectory() as folder:
        run = str(Path(folder) / "run")
        training = ["train", "cartpole", "--run", run, "--tasks.names", name, *TRAINING]
        if wrappers:
            training += ["--tasks.wrappers", *wrappers]
        for words in (
            ["check-env", name, "--steps=300", "--seconds=20", *wrapped],
            training,
            ["evaluate", run, "--episodes=2", "--max-episode-steps=200"],
            ["export", run, f"--parity-decisions={DECISIONS}"],
            ["profile", run, f"--decisions={DECISIONS}"],
        ):
            result = found["commands"][words[0]] = command(words, folder)
            shown = " ".join((name, *wrappers, words[0]))
            print(f"{shown}: {result['exit_code']} {result['last_line'] or ''}", flush=True)
            if words[0] == "train" and result["exit_code"] != 0:
                break
    return found


def named_wrapper(name: str, result: dict[str, Any]) -> str | None:
    """The wrapper that a refusal tells the user to set, if it can be set as it is named."""
    said = result["last_line"] or ""
    named = re.search(r"tasks\.wrappers=\[(?:[^]]*,)?(\w+)\]", said) or re.search(r"such as ([\w.]+:\w+)", said)
    if named is None or (":" in named[1] and named[1].partition(".")[0] != name.partition(":")[0]):
        return None
    return named[1]


def versions(names: list[str]) -> dict[str, str]:
    """Of the packages that the environments come from."""
    modules = {name.partition(":")[0].partition(".")[0] for name in names}
    packages = {"gymnasium"} | {PACKAGES[module] for module in modules if module in PACKAGES}
    if any(name.startswith(BOX2D) for name in names):
        packages.add("box2d")
    return {package: importlib.metadata.version(package) for package in sorted(packages)}


def page(stored: dict[str, Any]) -> str:
    """README.md: a row for each environment and list of wrappers."""
    lines = [
        "# Public environments",
        "",
        "Made by `python -m benchmarks.public_environments` from environments.json: the preset cartpole,",
        f'{STEPS} agent steps. "works" says that the command ended with exit code 0, not that something was learned.',
        "A refusal ends with code 2 and one line, which is given.",
        "",
        "| environment | packages | check-env | train | evaluate | export | profile |",
        "|---|---|---|---|---|---|---|",
    ]
    refusals = []
    for one in stored["tried"]:
        name = f"`{one['id']}`" + (f" with `{' '.join(one['wrappers'])}`" if one["wrappers"] else "")
        cells = []
        for step in ("check-env", "train", "evaluate", "export", "profile"):
            result = one["commands"].get(step)
            cells.append("-" if result is None else {0: "works", 2: "refused"}.get(result["exit_code"], "fails"))
        packages = ", ".join(f"{package} {number}" for package, number in one["versions"].items())
        lines.append(f"| {name} | {packages} | {' | '.join(cells)} |")
        said = dict.fromkeys(each["last_line"] for each in one["commands"].values() if each["last_line"])
        refusals += [f"- {name}: `{line.removeprefix('switchmt-snn: ')}`" for line in said]
    return "\n".join([*lines, "", "## What the refusals say", "", *refusals]) + "\n"


def main() -> None:
    """Try environments, and add them to the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ids", nargs="+")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--wrappers", nargs="+", default=())
    options = parser.parse_args()
    for name in options.ids:
        results = [tried(name)]
        named: str | None = None
        wrappers: tuple[str, ...] = tuple(options.wrappers)
        if not wrappers and (named := named_wrapper(name, results[0]["commands"]["check-env"])) is not None:
            wrappers = (named,)
        while wrappers:
            results.append(tried(name, wrappers))
            named = named_wrapper(name, results[-1]["commands"]["check-env"])  # actions, after observations
            wrappers = (*wrappers, named) if named is not None and named not in wrappers else ()
        stored = json.loads(options.out.read_text()) if options.out.exists() else {"tried": []}
        stored["tried"] = [one for one in stored["tried"] if one["id"] != name]
        stored["tried"] += [{**one, "versions": versions([name])} for one in results]
        stored["environment"] = {**environment(), "command": "python -m benchmarks.public_environments ID ..."}
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(stored, indent=1) + "\n")
        (options.out.parent / "README.md").write_text(page(stored))


if __name__ == "__main__":
    main()
