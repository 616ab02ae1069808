"""Films of trained agents of each suite: frames in order, the spikes of ``activity``, files that a browser plays."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from docs.tools.browser import View, find_browser, opened
from switchmt_snn.cli import main
from switchmt_snn.errors import MissingExtraError
from switchmt_snn.export.parity.activity import active_neurons
from switchmt_snn.runs.packing import open_run
from switchmt_snn.runs.trained import load_agent
from tests.viewing.test_film import observed

ROOT = Path(__file__).parents[2]
SUITES = {
    "atari": (ROOT / "results" / "atari" / "three-held-s2", "breakout"),
    "minatar": (ROOT / "tests" / "fixtures" / "runs" / "minatar", "asterix"),
    "gym": ("pretrained/cartpole", "CartPole-v1"),
}
SECONDS, FPS, SIZE = 1.5, 10, (1280, 720)
PLAYED = """(async () => {
  const video = document.querySelector("video");
  const ended = new Promise((done, fail) => { video.onended = done; video.onerror = () => fail(video.error.message); });
  await video.play();
  await ended;
  return [video.videoWidth, video.videoHeight, video.duration];
})()"""
SOUGHT = """new Promise(done => {
  const video = document.querySelector("video");
  video.onseeked = () => requestAnimationFrame(() => requestAnimationFrame(() => done(video.currentTime)));
  video.currentTime = %f;
})"""


@pytest.mark.slow
@pytest.mark.parametrize("suite", SUITES)
def test_a_film_of_a_trained_agent_plays_in_a_browser_and_shows_its_spikes(suite: str, tmp_path: Path) -> None:
    run, task = SUITES[suite]
    words = ["play", str(run), "--task", task, "--seconds", str(SECONDS), "--fps", str(FPS), "--seed", "3", "--out"]
    for out in ("film.mp4", "frames"):
        with pytest.raises(SystemExit) as ended:
            main([*words, str(tmp_path / out)])
        assert ended.value.code == 0
    assert (tmp_path / "film.csv").read_text() == (tmp_path / "frames" / "film.csv").read_text()
    with (tmp_path / "film.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == SECONDS * FPS
    agent = load_agent(open_run(run).path, "last", "cpu")
    index, fired = agent.suite.index(task), 0
    for row, observation in zip(rows, observed(agent, index, 3, rows), strict=True):
        drawn = (3, index, int(row["episode"]), int(row["step"]))
        seed = int(np.random.default_rng(drawn).integers(2**62))
        for layer, values in active_neurons(agent, observation, index, seed).by_layer.items():
            assert int(row[f"spikes_{layer}"]) == values.sum()
            fired += int(values.sum())
    assert fired > 100
    assert_browser_plays(tmp_path)


def assert_browser_plays(folder: Path) -> None:
    """``film.mp4`` plays to its end; at each time, the frame of that time is seen and no other."""
    try:
        find_browser()
    except MissingExtraError as error:
        pytest.skip(str(error))
    page = folder / "page.html"
    style = "margin:0;display:block;width:1280px;height:720px"
    page.write_text(f'<!doctype html><body style="margin:0"><video muted src="film.mp4" style="{style}"></video>')
    frames = [_small(Image.open(path)) for path in sorted((folder / "frames").glob("frame_*.png"))]
    with opened() as window:
        window.look(page, View(1280))
        assert window.evaluate(PLAYED) == [*SIZE, pytest.approx(SECONDS, abs=0.01)]
        for index in range(len(frames)):
            window.evaluate(SOUGHT % ((index + 0.5) / FPS))
            seen = _small(Image.open(io.BytesIO(window.photograph(0, *SIZE))))
            distances = [float(np.abs(seen - frame).mean()) for frame in frames]
            assert distances[index] == min(distances)
            assert distances[index] < 3.0


def _small(picture: Image.Image) -> npt.NDArray[np.int16]:
    return np.asarray(picture.convert("RGB")).astype(np.int16)
