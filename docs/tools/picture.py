"""docs/picture.svg: what the toolkit does, over measured learning curves (results/minatar, three seeds)."""

from __future__ import annotations

import csv
import statistics
from pathlib import Path

ROOT = Path(__file__).parents[2]
GAMES = ("breakout", "asterix", "space_invaders")
COLOURS = {"breakout": "#0f766e", "asterix": "#b45309", "space_invaders": "#6d28d9"}
BINS = 30
WIDTH, HEIGHT = 960, 440
BOXES = (
    ("Tasks", "Atari, MinAtar,", "any Gymnasium id"),
    ("Spiking Q-network", "T steps, active dendrites", "one network for all tasks"),
    ("Algorithm 1", "learn, measure Eq. 3,", "switch to the next task"),
    ("Run folder", "config, logs, checkpoints,", "scores with protocol"),
    ("Export, profile", "ONNX, NIR, proved equal;", "spikes, energy, chips"),
)


def curve(run: Path, game: str, total: int) -> list[float]:
    """Mean training return in equal bins of the run's steps; an empty bin repeats the one before."""
    sums = [[0.0, 0] for _ in range(BINS)]
    with (run / "episodes.csv").open(newline="") as stream:
        for row in csv.DictReader(stream):
            if row["task"] == game:
                cell = sums[min(BINS - 1, int(row["step"]) * BINS // total)]
                cell[0] += float(row["return"])
                cell[1] += 1
    means: list[float] = []
    for value, count in sums:
        means.append(value / count if count else (means[-1] if means else 0.0))
    return means


def random_score(run: Path, game: str) -> float:
    """Mean score of the random policy in the run's evaluation."""
    with max(run.glob("evaluations/*.csv")).open(newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if (row["policy"], row["task"]) == ("random", game)]
    return statistics.fmean(float(row["score"]) for row in rows)


def text(x: float, y: float, words: str, size: int = 13, kind: str = "ink", anchor: str = "middle") -> str:
    """One line of text."""
    return f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" text-anchor="{anchor}" class="{kind}">{words}</text>'


def flow() -> list[str]:
    """The row of boxes and arrows."""
    width, gap = 168, 24
    lines = []
    for index, (title, *words) in enumerate(BOXES):
        x = 12 + index * (width + gap)
        lines.append(f'<rect x="{x}" y="16" width="{width}" height="88" rx="8" class="box"/>')
        lines.append(text(x + width / 2, 44, title, 15, "title"))
        lines += [text(x + width / 2, 68 + 18 * row, word, 12, "soft") for row, word in enumerate(words)]
        if index:
            lines.append(f'<path d="M{x - gap + 3} 60 h{gap - 10} m-5 -5 l6 5 l-6 5" class="arrow"/>')
    return lines


def panel(x: float, game: str, runs: list[Path], total: int) -> list[str]:
    """Learning curves of one game: every seed thin, the mean thick, random play dashed."""
    left, top, width, height = x, 190, 270, 180
    curves = [curve(run, game, total) for run in runs]
    mean = [statistics.fmean(values) for values in zip(*curves, strict=True)]
    random = random_score(runs[0], game)
    highest = max(max(values) for values in curves) * 1.08

    def point(index: int, value: float) -> str:
        return f"{left + (index + 0.5) / BINS * width:.1f},{top + height * (1 - value / highest):.1f}"

    def line(values: list[float], style: str) -> str:
        points = " ".join(point(index, value) for index, value in enumerate(values))
        return f'<polyline points="{points}" fill="none" stroke="{COLOURS[game]}" {style}/>'

    y = top + height * (1 - random / highest)
    return [
        text(left, top - 14, game.replace("_", " "), 14, "title", "start"),
        f'<path d="M{left} {top} v{height} h{width}" class="axis"/>',
        *(line(values, 'stroke-width="1" opacity="0.35"') for values in curves),
        line(mean, 'stroke-width="2.5"'),
        f'<path d="M{left} {y:.1f} h{width}" class="random"/>',
        text(left + width, y - 5, "random play", 11, "soft", "end"),
        text(left - 6, top + 10, f"{highest / 1.08:.0f}", 11, "soft", "end"),
        text(left - 6, top + height, "0", 11, "soft", "end"),
        text(left + width, top + height + 16, f"{total // 1000}k steps", 11, "soft", "end"),
    ]


def picture() -> str:
    """The SVG's text."""
    runs = sorted((ROOT / "results" / "minatar").glob("switchmt-seed*"))
    total = 600_000
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
        'font-family="system-ui, sans-serif">',
        "<title>From tasks to a checked export, and measured learning curves of one network on three games</title>",
        "<style>.paper{fill:#fff}.ink,.title{fill:#1f2937}.title{font-weight:600}.soft{fill:#4b5563}"
        ".box{fill:#f0fdfa;stroke:#0f766e}.arrow{fill:none;stroke:#0f766e;stroke-width:1.5}"
        ".axis{fill:none;stroke:#9ca3af}.random{stroke:#6b7280;stroke-dasharray:5 4}</style>",
        f'<rect width="{WIDTH}" height="{HEIGHT}" class="paper"/>',
        *flow(),
        text(12, 146, "Measured: one spiking network learns three MinAtar games", 15, "title", "start"),
    ]
    for index, game in enumerate(GAMES):
        lines += panel(36 + index * 316, game, runs, total)
    caption = "Training return (mean per 20,000 steps). Thin: three seeds; thick: their mean. Data: results/minatar."
    return "\n".join([*lines, text(12, HEIGHT - 14, caption, 12, "soft", "start"), "</svg>"]) + "\n"
