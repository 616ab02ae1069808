"""docs/gallery.md: a picture of each thing that the commands make. ``python -m docs.gallery`` makes them anew.

A film and pages need the extra ``video``, Atari and a browser (docs.tools.browser). Everything is made from trained
networks of the package and from stored runs under results/, so that anybody gets the same pictures.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from PIL import Image
from rich.console import Console

from docs.tools.browser import Browser, View, find_browser, opened
from switchmt_snn.errors import MissingExtraError, SwitchMTError, TrainingFailed
from switchmt_snn.runs.listing import list_runs
from switchmt_snn.viewing.tables import runs_table

ROOT = Path(__file__).parents[2]
PICTURES = ROOT / "docs" / "pictures"
MOST_BYTES = 4_000_000
"""Of all pictures together, so that a clone stays small."""
MOST_BYTES_OF_A_FILM = 2_000_000
FILM_FRAMES, FILM_FPS = 90, 15
"""Length of a film in decisions, and how many of them pass in a second of real time."""
FILM_WIDTH, FILM_COLOURS = 960, 64
_TEXT_COLUMNS = 96
_COLOURS = 256
"""Of a photograph of a page: few enough for a small file; the rarest colour of a chart is kept."""


@dataclass(frozen=True)
class Film:
    """A part of what ``play`` shows.

    Attributes:
        command: arguments of ``switchmt-snn play``.
        first: the film's first decision.
    """

    command: tuple[str, ...]
    first: int


FILMS = {
    "atari": Film(("pretrained/atari", "--task", "pong", "--task", "breakout", "--task", "enduro", "--seed", "3"), 90),
    "pong": Film(("pretrained/pong",), 160),  # two points won
}


@dataclass(frozen=True)
class Page:
    """Photographs of an HTML page that a command wrote.

    Attributes:
        command: arguments of ``switchmt-snn`` that write it.
        path: where it then lies, from the folder where the command ran.
        shots: file name -> how the page is looked at, and how much of its top is shown, in CSS pixels.
    """

    command: tuple[str, ...]
    path: str
    shots: dict[str, tuple[View, int]]


MINATAR = tuple(f"results/minatar/switchmt-seed{seed}" for seed in (1, 2, 3))
PAGES = {
    "report": Page(
        ("report", MINATAR[0], "--out", "report"),
        "report/report.html",
        {"report.png": (View(1280), 1300), "report_phone.png": (View(400, dark=True, scale=1.5), 1000)},
    ),
    "comparison": Page(
        ("compare", *MINATAR, "--out", "comparison"),
        "comparison/comparison.html",
        {"comparison.png": (View(1280), 1200)},
    ),
    "profile": Page(
        ("profile", "pretrained/pong"),
        "runs/pretrained/pong/profile/report.html",
        {"profile.png": (View(1280), 1300), "profile_phone.png": (View(400, dark=True, scale=1.5), 1000)},
    ),
}


_TEXT = """# Gallery

What the commands make. `python -m docs.gallery` makes the pictures anew (it needs the extra `video`, Atari and
Chromium), `python -m docs.generate` the text; do not edit. The networks come with the package (`pretrained/...`), the
runs lie under `results/`.

## A film: games beside the network's spikes

![One network plays Pong, Breakout and Enduro, beside its spikes, Q-values and dendritic gains](pictures/atari.gif)

`switchmt-snn play pretrained/atari --task pong --task breakout --task enduro`: one spiking network, three games,
{seconds:g} seconds in real time. Its gains are others in each game. Pong alone:

![pretrained/pong wins two points, beside the spikes of its layers and its Q-values](pictures/pong.gif)

`switchmt-snn play pretrained/pong`: {seconds:g} seconds in real time. A frame is a decision. The rasters show neurons
of each layer, a row each; [films.md](films.md) explains every part. The film itself is 1280 x 720 (MP4, GIF, PNG
frames, or a window), with every number as CSV. A frame of `switchmt-snn play pretrained/cartpole`:

![CartPole beside the spikes of a dense spiking network](pictures/cartpole.png)

## The page of a run

`switchmt-snn report {run}`; every training ends with it. Its beginning on a desk, and on a phone in
the dark:

![Report of a run: verdict, cards, health, learning curves, evaluation](pictures/report.png)

![The same page on a phone in the dark](pictures/report_phone.png)

## When the run switched, and why

Two figures of `switchmt-snn report {run} --figures` (each as SVG, PNG and CSV): which task was played,
and the number that decided.

![Timeline of three tasks](pictures/switching.png)

![The parameter change of Eq. 3 at decisions of the policy, with its bound](pictures/deciding.png)

## Several runs side by side

`switchmt-snn compare` with three runs that differ in their seed; bands are over seeds.

![Comparison of runs](pictures/comparison.png)

## What a decision costs

`switchmt-snn profile pretrained/pong`; [energy.md](energy.md) says what is counted, and by whose constants.

![Profile: verdict, spikes and energy per decision](pictures/profile.png)

![The same page on a phone in the dark](pictures/profile_phone.png)

## Which runs there are

`switchmt-snn runs results/classic`:

```text
{runs}
```
"""


def gallery_page() -> str:
    """docs/gallery.md."""
    with contextlib.chdir(ROOT):
        table = runs_table(list_runs(Path("results/classic"))[0])
    stream = io.StringIO()
    Console(file=stream, width=_TEXT_COLUMNS, markup=False).print(table)
    runs = "\n".join(line.rstrip() for line in stream.getvalue().rstrip().splitlines())
    return _TEXT.format(seconds=FILM_FRAMES / FILM_FPS, run=MINATAR[0], runs=runs)


def make_films(folder: Path) -> None:
    """pictures/NAME.gif of ``FILMS``."""
    for name, film in FILMS.items():
        _run(folder, "play", *film.command, "--seconds", f"{(film.first + FILM_FRAMES) / FILM_FPS:g}", "--out", name)
        frames = ("-framerate", f"{FILM_FPS}", "-start_number", f"{film.first}", "-i", f"{name}/frame_%06d.png")
        palette = f"palettegen=max_colors={FILM_COLOURS}[p];[b][p]paletteuse=dither=none:diff_mode=rectangle"
        look = ("-filter_complex", f"scale={FILM_WIDTH}:-2:flags=area,split[a][b];[a]{palette}")
        made = folder / f"{name}.gif"
        words = [_ffmpeg(), "-loglevel", "error", "-y", *frames, "-frames:v", f"{FILM_FRAMES}", *look, str(made)]
        done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
        if done.returncode:
            raise TrainingFailed(f"ffmpeg could not write {made} ({done.stderr.strip()[-160:]}), expected a GIF")
        _keep(made.name, made.read_bytes(), MOST_BYTES_OF_A_FILM)


def make_frame(folder: Path) -> None:
    """pictures/cartpole.png: the last frame of six seconds."""
    _run(folder, "play", "pretrained/cartpole", "--seconds", "6", "--out", "cartpole")
    with Image.open(max((folder / "cartpole").glob("frame_*.png"))) as frame:
        _keep("cartpole.png", _small(frame))


def make_figures(folder: Path) -> None:
    """pictures/switching.png and pictures/deciding.png."""
    _run(folder, "report", MINATAR[0], "--out", "figures", "--figures")
    figures = folder / "figures" / "figures"
    for name, file in (("switching.png", "switching.png"), ("deciding.png", "deciding_parameter_change.png")):
        with Image.open(figures / file) as figure:
            _keep(name, _small(figure))


def make_page(name: str, folder: Path, browser: Browser) -> None:
    """Photographs of one of ``PAGES``.

    Raises:
        TrainingFailed: the page is not sound: it scrolls sideways, complains, or asks the network for something.
    """
    page = PAGES[name]
    _run(folder, *page.command)
    for file, (view, height) in page.shots.items():
        look = browser.look(folder / page.path, view)
        if faults := (*look.too_wide, *look.complaints, *look.requests):
            raise TrainingFailed(f"{page.path} in {view} is not sound ({'; '.join(faults)}), expected nothing of it")
        with Image.open(io.BytesIO(browser.photograph(0, view.width, min(height, look.height)))) as shot:
            _keep(file, _small(shot))


def _small(picture: Image.Image) -> bytes:
    stream = io.BytesIO()
    few = picture.convert("RGB").quantize(_COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(stream, "PNG", optimize=True)
    return stream.getvalue()


def _keep(name: str, data: bytes, most: int = MOST_BYTES) -> None:
    if len(data) > most:
        raise TrainingFailed(f"{name} has {len(data):,} bytes, expected at most {most:,}; show less")
    PICTURES.mkdir(exist_ok=True)
    (PICTURES / name).write_bytes(data)
    print(f"docs/pictures/{name}: {len(data):,} bytes", flush=True)


def _run(folder: Path, *words: str) -> None:
    """A command of ours in a folder where the repository's results lie."""
    print("switchmt-snn", *words, flush=True)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run(
        [sys.executable, "-m", "switchmt_snn", *words], cwd=folder, env=environment, stdout=subprocess.DEVNULL
    )
    if done.returncode:
        raise TrainingFailed(f"switchmt-snn {' '.join(words)} ended with {done.returncode}, expected 0; see above")


def _ffmpeg() -> str:
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise MissingExtraError("films need ffmpeg; run: pip install -c constraints.txt '.[video]'") from error
    return str(imageio_ffmpeg.get_ffmpeg_exe())


MAKERS: dict[str, Callable[[Path], None]] = {"films": make_films, "frame": make_frame, "figures": make_figures}


def main(argv: list[str] | None = None) -> None:
    """Make all pictures, or those that are named, then the page."""
    names = [*MAKERS, *PAGES]
    parser = argparse.ArgumentParser(prog="python -m docs.gallery", description="Make the gallery's pictures anew.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(names)}; default: all")
    parser.add_argument("--browser", help="program that photographs pages; default: a Chromium on the PATH")
    options = parser.parse_args(argv)
    if unknown := [name for name in options.names if name not in names]:
        parser.error(f"no picture {unknown[0]!r}, expected of {', '.join(names)}")
    try:
        _make(options.names or names, options.browser)
    except SwitchMTError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from error
    (ROOT / "docs" / "gallery.md").write_text(gallery_page(), encoding="utf-8")
    print("docs/gallery.md")


def _make(names: list[str], browser: str | None) -> None:
    """What is missing is said before anything is made."""
    pages = [name for name in names if name in PAGES]
    program = (browser or find_browser()) if pages else None
    if "films" in names:
        _ffmpeg()
    with tempfile.TemporaryDirectory(prefix="gallery-") as made:
        folder = Path(made)
        (folder / "results").symlink_to(ROOT / "results")
        for name in names:
            if name in MAKERS:
                MAKERS[name](folder)
        if pages:
            with opened(program) as window:
                for name in pages:
                    make_page(name, folder, window)
