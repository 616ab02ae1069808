"""Films: what is drawn is what the network did, episodes are those of an evaluation, and files hold every frame."""

from __future__ import annotations

import csv
import importlib.util
import itertools
import json
import signal
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import numpy.typing as npt
import pytest
import torch
from PIL import Image

from switchmt_snn.acting.agent import Agent
from switchmt_snn.acting.evaluation import EvaluationProtocol, evaluate_agent
from switchmt_snn.cli import main
from switchmt_snn.config import EvaluationConfig, TasksConfig
from switchmt_snn.errors import ConfigError, MissingExtraError, RunFolderError
from switchmt_snn.export.folded import fold_agent
from switchmt_snn.export.formats.files import nir_graphs
from switchmt_snn.export.formats.onnx_writer import decision_model, step_model
from switchmt_snn.export.parity.activity import active_neurons
from switchmt_snn.export.runtimes.agents import NirAgent, OnnxAgent, onnx_session
from switchmt_snn.export.watching import Watched, trace_network, tracer_of_nir, tracer_of_onnx
from switchmt_snn.learning.parts import observation_spec
from switchmt_snn.spiking.network import build_network
from switchmt_snn.tasks.play import Play, episode_seed
from switchmt_snn.tasks.registry import make_suite
from switchmt_snn.viewing.film import sinks, window
from switchmt_snn.viewing.film.canvas import SPIKE, number
from switchmt_snn.viewing.film.film import Film, FilmSettings, make_film
from switchmt_snn.viewing.film.layout import layouts
from switchmt_snn.viewing.film.moments import moments, rehearse
from switchmt_snn.viewing.film.panels import raster_boxes
from switchmt_snn.viewing.film.raster import TimeAxis, row_pixels
from tests.conftest import small_config

MINATAR = {"suite": "minatar", "names": ["breakout", "asterix"], "sticky_action_probability": 0.1}
CARTPOLE = {"suite": "gym", "names": ["CartPole-v1", "Acrobot-v1"]}


def watched(tasks: dict[str, Any], **network: Any) -> Watched:
    trunk = {"trunk": "minatar", "threshold": 0.3} if tasks is MINATAR else {"trunk": "mlp", "threshold": 0.1}
    config = small_config(tasks=tasks, network={**trunk, "timesteps": 3, **network})
    suite = make_suite(config.tasks)
    agent = Agent(build_network(config.network, observation_spec(suite), 3), suite, config, torch.device("cpu"), 12)
    return Watched(agent, trace_network, "torch")


def protocol(agent: Watched, **changes: Any) -> EvaluationProtocol:
    settings = {"episodes": 3, "num_envs": 1, "seed": 5, "epsilon": 0.2, **changes}
    return EvaluationProtocol.of(EvaluationConfig(**settings), agent.agent.config.tasks)


def rows_of(film: Film) -> list[dict[str, str]]:
    assert film.path is not None
    path = film.path.with_suffix(".csv") if film.path.suffix else film.path / "film.csv"
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def observed(agent: Watched, task: int, seed: int, rows: list[dict[str, str]]) -> list[npt.NDArray[Any]]:
    """The observations of a film's decisions: its actions, played again."""
    play, seen = Play(agent.suite, task, 1), []
    for row in rows:
        if row["step"] == "0":
            play.begin(np.zeros(1, np.int64), np.asarray([episode_seed(seed, task, int(row["episode"]))]))
        seen.append(play.observations.copy())
        play.step(np.asarray([int(row["action"])]))
    play.close()
    return seen


def drawn_spikes(frame: Path, axis: TimeAxis, raster: Any, rows: int, decisions: int) -> list[npt.NDArray[np.bool_]]:
    """The spikes ``[T, R]`` that a frame shows of a layer, decision by decision, the oldest first, from its pixels."""
    pixels = np.asarray(Image.open(frame))
    high = row_pixels(raster.height)
    found = []
    for back in reversed(range(decisions)):
        columns = [axis.column(back, step) for step in range(axis.timesteps)]
        cells = [[pixels[raster.top + row * high, column] for row in range(rows)] for column in columns]
        found.append((np.asarray(cells) == SPIKE).all(axis=2))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("encoding", ["direct", "rate"])
@pytest.mark.parametrize("tasks", [("asterix",), ("breakout", "asterix")])
def test_the_spikes_that_are_drawn_are_those_of_activity(tasks: tuple[str, ...], encoding: str, tmp_path: Path) -> None:
    """From the pixels of the frames; of the rate encoding, with the numbers that an evaluation would draw."""
    agent = watched(MINATAR, encoding=encoding)
    agent.suite = replace(agent.suite, scale=0.5)
    agent.agent.network.observation = replace(agent.agent.network.observation, scale=0.5)
    play = protocol(agent)
    film = make_film(agent, play, FilmSettings(tasks, seconds=0.8, fps=15), tmp_path / "frames")
    rows = rows_of(film)
    assert film.frames == 12
    fired = 0
    for place, name in enumerate(tasks):
        task, lane = agent.suite.index(name), film.facts["tasks"][place]
        own = [row for row in rows if row["task"] == name]
        layout = layouts(len(tasks), 2, len(lane["layers"]))[place]
        axis = TimeAxis(layout.spikes.left, layout.spikes.width, 3)
        rasters = raster_boxes(layout.spikes, tuple(lane["layers"]))
        expected: dict[str, list[npt.NDArray[np.bool_]]] = {layer: [] for layer in lane["layers"]}
        for row, observation in zip(own, observed(agent, task, play.seed, own), strict=True):
            drawn = (play.seed, task, int(row["episode"]), int(row["step"]))
            seed = int(np.random.default_rng(drawn).integers(2**62))
            activity = active_neurons(agent.agent, observation, task, seed)
            for layer, values in activity.by_layer.items():
                expected[layer].append(values[:, 0, lane["layers"][layer]["drawn"]])
                assert int(row[f"spikes_{layer}"]) == values.sum()
                assert float(row[f"rate_{layer}"]) == values.mean()
            shown = [float(row[f"q_{action}"] or "-inf") for action in agent.suite.action_names]
            assert np.array_equal(np.asarray(shown, np.float32), activity.q_BA[0])
        for frame in (4, 11):
            path = tmp_path / "frames" / f"frame_{frame:06}.png"
            for layer, raster in rasters.items():
                count = len(lane["layers"][layer]["drawn"])
                seen = drawn_spikes(path, axis, raster, count, frame + 1)
                assert np.array_equal(seen, expected[layer][: frame + 1]), (name, layer, frame)
                fired += int(np.sum(seen))
    assert fired > 100


@pytest.mark.slow
@pytest.mark.parametrize("epsilon", [0.0, 0.3])
def test_episodes_are_those_of_an_evaluation(epsilon: float, tmp_path: Path) -> None:
    agent = watched(CARTPOLE)
    play = protocol(agent, epsilon=epsilon, max_episode_steps=60)
    film = make_film(agent, play, FilmSettings(agent.suite.names, episodes=3), tmp_path / "frames")
    expected = [episode for episode in evaluate_agent(agent.agent, play).episodes if episode.policy == "agent"]
    for lane in film.facts["tasks"]:
        own = [vars(episode) for episode in expected if episode.task == lane["task"]]
        assert lane["episodes"] == own
        assert len(own) == 3
        last = [row for row in rows_of(film) if row["task"] == lane["task"] and row["ended"] == "1"]
        assert [float(row["score"]) for row in last] == [episode["score"] for episode in own]
    assert any(row["random"] == "1" for row in rows_of(film)) == (epsilon > 0)
    assert film.frames == max(sum(e["length_steps"] for e in lane["episodes"]) for lane in film.facts["tasks"])


def test_value_and_advantage_add_up_to_q() -> None:
    agent = watched(CARTPOLE)
    observation = np.asarray([[0.3, -0.2, 0.1, 0.4, 0.0, 0.0]], np.float32)
    q_A = agent.q_values(observation, "CartPole-v1")[0]
    insight = agent.insight
    assert insight.value is not None
    assert insight.advantage_A is not None
    assert np.allclose(insight.value + insight.advantage_A, q_A)
    with torch.inference_mode():
        everything = agent.agent.network(torch.from_numpy(observation), 0).numpy()[0]
    assert insight.value == pytest.approx(everything.mean(), abs=1e-6)  # the mean of V + A - mean(A) is V
    assert abs(insight.value) > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("changes", [{"method": "DQN"}, {"readout": "max_membrane"}])
def test_networks_without_one_value_have_none(changes: dict[str, str], tmp_path: Path) -> None:
    agent = watched(CARTPOLE, **changes)
    film = make_film(agent, protocol(agent), FilmSettings(seconds=0.2), tmp_path / "frames")
    assert all(row["value"] == "" and row["advantage_action_0"] == "" for row in rows_of(film))
    assert film.frames == 3


def decoded(path: Path, size: tuple[int, int]) -> npt.NDArray[np.uint8]:
    """All frames ``[n, H, W, 3]`` as ffmpeg reads them."""
    words = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i", path]
    done = subprocess.run([*words, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"], capture_output=True, check=True)
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, size[1], size[0], 3)


@pytest.mark.slow
@pytest.mark.parametrize("ending", [".mp4", ".gif"])
def test_a_video_has_every_frame_in_order(ending: str, tmp_path: Path) -> None:
    """Each decoded frame is nearer to its own PNG frame than to every other one."""
    agent = watched(MINATAR)
    settings = FilmSettings(("asterix",), seconds=0.8, fps=10)
    film = make_film(agent, protocol(agent), settings, tmp_path / f"film{ending}")
    make_film(agent, protocol(agent), settings, tmp_path / "frames")
    assert film.frames == 8
    pictures = [np.asarray(Image.open(path)).astype(np.int16) for path in sorted((tmp_path / "frames").glob("*.png"))]
    seen = decoded(tmp_path / f"film{ending}", (1280, 720))
    assert len(seen) == len(pictures) == 8
    for index, frame in enumerate(seen):
        distances = [float(np.abs(frame - picture).mean()) for picture in pictures]
        assert int(np.argmin(distances)) == index
        assert distances[index] < 2.0
    assert {path.name for path in tmp_path.iterdir()} == {"film.csv", f"film{ending}", "film.json", "frames"}
    assert (tmp_path / "film.csv").read_text() == (tmp_path / "frames" / "film.csv").read_text()
    facts = json.loads((tmp_path / "film.json").read_text())
    assert (facts["frames"], facts["fps"], facts["size"]) == (8, 10, [1280, 720])
    assert [len(gains) for gains in facts["tasks"][0]["gains"].values()] == [1, 1]


@pytest.mark.slow
def test_the_neurons_that_are_drawn_vary_and_differ() -> None:
    agent = watched(MINATAR)
    play = protocol(agent)
    rehearsal = rehearse(agent, (0, 1), play, decisions=20)
    spikes_KDN = np.asarray(
        [
            [moment.insight.active["conv1"].sum(axis=0) for moment in itertools.islice(moments(agent, task, play), 20)]
            for task in (0, 1)
        ]
    )
    variance_N = spikes_KDN.var(axis=1).sum(axis=0)
    kinds = {tuple(spikes) for spikes in spikes_KDN.reshape(40, -1).T}
    drawn = rehearsal.rows("conv1", 10)
    assert drawn.tolist() == sorted(drawn)
    assert len({tuple(spikes_KDN[:, :, neuron].ravel()) for neuron in drawn}) == 10 < len(kinds)
    assert (rehearsal.timesteps, rehearsal.neurons["conv1"]) == (3, 1024)
    best = sorted({(-variance_N[neuron], tuple(spikes_KDN[:, :, neuron].ravel())) for neuron in range(1024)})
    assert np.allclose(sorted(-variance_N[drawn]), [variance for variance, _ in best[:10]])


def test_what_is_missing_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        sinks.importlib.util, "find_spec", lambda name: None if name == "imageio_ffmpeg" else find(name)
    )
    agent = watched(CARTPOLE)
    with pytest.raises(MissingExtraError, match=r"run: pip install 'switchmt-snn\[video\]'"):
        make_film(agent, protocol(agent), FilmSettings(seconds=1), tmp_path / "film.mp4")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("settings", "out", "error", "text"),
    [
        (FilmSettings(), "film.avi", ConfigError, "ends in .mp4 or .gif"),
        (FilmSettings(seconds=0), "film.mp4", ConfigError, "--seconds is 0"),
        (FilmSettings(seconds=float("nan")), "film.mp4", ConfigError, "--seconds is nan"),
        (FilmSettings(fps=1000), "film.mp4", ConfigError, "--fps is 1000"),
        (FilmSettings(episodes=0), "film.mp4", ConfigError, "--episodes is 0"),
        (FilmSettings(("Acrobot-v1",) * 2), "film.mp4", ConfigError, "each once"),
        (FilmSettings(seconds=1), ".", RunFolderError, "is not an empty folder"),
    ],
)
def test_what_cannot_be_filmed_is_refused(
    settings: FilmSettings, out: str, error: type[Exception], text: str, tmp_path: Path
) -> None:
    (tmp_path / "somebody's.txt").touch()
    agent = watched(CARTPOLE)
    with pytest.raises(error, match=text):
        make_film(agent, protocol(agent), settings, tmp_path / out)
    assert [path.name for path in tmp_path.iterdir()] == ["somebody's.txt"]


@pytest.mark.slow
def test_a_film_that_fails_leaves_nothing(tmp_path: Path) -> None:
    agent = watched(CARTPOLE)
    decide: Callable[..., Any] = agent.q_values
    calls = 0

    def fails(*arguments: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls > 80:
            raise ConfigError("no more")
        return decide(*arguments)

    agent.q_values = fails  # type: ignore[method-assign]
    for out in ("film.mp4", "frames"):
        calls = 60
        with pytest.raises(ConfigError, match="no more"):
            make_film(agent, protocol(agent), FilmSettings(episodes=9), tmp_path / out)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


@pytest.mark.slow
def test_the_game_in_colour_is_the_game_that_is_played() -> None:
    """Atari: a second copy in colour; sticky actions are drawn alike in both."""
    suite = make_suite(TasksConfig(suite="atari", names=("pong",), frame_stack=4, sticky_action_probability=0.25))
    plain, pictured = Play(suite, 0, 2), Play(suite.pictured(), 0, 2)
    seeds = np.asarray([3, 4])
    rng = np.random.default_rng(0)
    for play in (plain, pictured):
        play.begin(np.arange(2), seeds)
    pictures = []
    for _ in range(150):
        actions = rng.integers(0, suite.num_actions, 2)
        for play in (plain, pictured):
            play.step(actions)
        assert np.array_equal(plain.observations, pictured.observations)
        picture = pictured.picture(1)
        assert picture is not None
        grey = np.asarray(Image.fromarray(picture).convert("L").resize((84, 84), Image.Resampling.BOX), np.float64)
        assert np.abs(grey - pictured.observations[1, -1]).mean() < 3
        pictures.append(picture)
    assert pictures[0].shape == (210, 160, 3)
    assert len({picture.tobytes() for picture in pictures}) > 100
    assert plain.picture(0) is None
    assert np.array_equal(plain.returns, pictured.returns)


@pytest.mark.parametrize(("tasks", "shape"), [(MINATAR, (10, 10, 3)), (CARTPOLE, (400, 600, 3))])
def test_pictures_change_nothing_that_is_played(tasks: dict[str, Any], shape: tuple[int, ...]) -> None:
    suite = watched(tasks).suite
    plain, pictured = Play(suite, 0, 1), Play(suite.pictured(), 0, 1)
    seen = set()
    for play in (plain, pictured):
        play.begin(np.zeros(1, np.int64), np.asarray([7]))
    for step in range(8):
        picture = pictured.picture(0)
        assert picture is not None
        assert picture.shape == shape
        seen.add(picture.tobytes())
        for play in (plain, pictured):
            play.step(np.asarray([step % 2]))
        assert np.array_equal(plain.observations, pictured.observations)
    assert len(seen) > 4


def exported(agent: Watched, runtime: str) -> Watched:
    network = fold_agent(agent.agent)
    if runtime == "nir":
        nir_agent = NirAgent(nir_graphs(network), agent.suite, agent.agent.config)
        return Watched(agent.agent, lambda own: tracer_of_nir(own, network, nir_agent), runtime)
    onnx_agent = OnnxAgent(decision_model(network).SerializeToString(), agent.suite, agent.agent.config)
    step = onnx_session(step_model(network).SerializeToString())
    return Watched(agent.agent, lambda own: tracer_of_onnx(own, network, onnx_agent, step), runtime)


@pytest.mark.slow
@pytest.mark.parametrize("runtime", ["onnx", "nir"])
@pytest.mark.parametrize("encoding", ["direct", "rate"])
def test_exported_files_play_and_fire_like_the_network(runtime: str, encoding: str, tmp_path: Path) -> None:
    agent = watched(MINATAR, encoding=encoding)
    settings = FilmSettings(("asterix",), seconds=0.4)
    rows = []
    for one, folder in ((agent, "torch"), (exported(agent, runtime), runtime)):
        rows.append(rows_of(make_film(one, protocol(agent), settings, tmp_path / folder)))
    assert len(rows[0]) == len(rows[1]) == 6
    for expected, seen in zip(*rows, strict=True):
        for name in expected:
            if name.startswith(("q_", "advantage_")):
                assert float(seen[name]) == pytest.approx(float(expected[name]), abs=1e-4), name
            else:
                assert seen[name] == expected[name], name
    assert sum(int(row[f"spikes_{layer}"]) for row in rows[1] for layer in ("conv1", "hidden")) > 20


def test_without_a_screen_a_window_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in window.SCREENS:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(window.sys, "platform", "linux")
    with pytest.raises(SystemExit) as stop:
        main(["play", "runs/none", "--live"])
    assert stop.value.code == 2
    err = capsys.readouterr().err
    assert err.startswith(
        "switchmt-snn: --live found no screen (DISPLAY and WAYLAND_DISPLAY are not set), expected one"
    )
    assert err.count("\n") == 1


@pytest.mark.slow
def test_a_window_shows_every_frame_until_it_is_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SDL's dummy driver is a screen without anybody who looks."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    import pygame

    shown: list[npt.NDArray[np.uint8]] = []

    class Watched3(window.Window):
        def add(self, image: Image.Image) -> None:
            if len(shown) == 2:
                pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_q))
            try:
                super().add(image)
            finally:
                shown.append(pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1))

    agent = watched(CARTPOLE)
    film = make_film(agent, protocol(agent), FilmSettings(seconds=2, fps=100), tmp_path / "frames", Watched3)
    assert film.frames == len(rows_of(film)) == len(shown) == 3
    assert not film.stopped
    for index, pixels in enumerate(shown):
        assert np.array_equal(pixels, np.asarray(Image.open(tmp_path / "frames" / f"frame_{index:06}.png")))
    only_shown = make_film(agent, protocol(agent), FilmSettings(seconds=0.05, fps=60), None, window.Window)
    assert (only_shown.path, only_shown.frames) == (None, 3)


@pytest.mark.slow
def test_ctrl_c_keeps_the_film_so_far(tmp_path: Path) -> None:
    agent = watched(CARTPOLE)

    class Interrupting:
        def __init__(self, size: tuple[int, int], fps: float) -> None:
            self.frames = 0

        def add(self, image: Image.Image) -> None:
            self.frames += 1
            if self.frames == 3:
                signal.raise_signal(signal.SIGINT)

        def close(self) -> None:
            pass

        discard = close

    film = make_film(agent, protocol(agent), FilmSettings(seconds=60), tmp_path / "film.mp4", Interrupting)
    assert film.stopped
    assert film.frames == len(rows_of(film)) == len(decoded(tmp_path / "film.mp4", (1280, 720))) == 3


def test_numbers_are_short() -> None:
    alone = {
        0.0: "0",
        30.0: "30",
        -21.0: "-21",
        12345.0: "12,345",
        0.0123: "0.012",
        1.234: "1.23",
        98.23: "98.2",
    }
    assert {value: number(value) for value in alone} == alone
    beside = [(98.234, 7.0, "98.23"), (0.5, 0.031, "0.5000"), (1234.5, 400.0, "1,234"), (0.1, 0.0, "0.100")]
    assert [number(value, span) for value, span, _ in beside] == [text for _, _, text in beside]
    assert (number(1e-5), number(-0.0)) == ("1e-05", "0")
