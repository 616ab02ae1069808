"""Atari games through ale-py's vector environment: 84x84 grey frames, frame skip with max-pooling, raw rewards."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from ale_py import Action, roms
from ale_py.vector_env import AtariVectorEnv

from switchmt_snn.config import TasksConfig, resolved_frame_stack
from switchmt_snn.config.suites import SUITE_DEFAULTS
from switchmt_snn.errors import TaskError
from switchmt_snn.tasks.atari_scores import ATARI_REFERENCES, PUBLISHED_SCORES
from switchmt_snn.tasks.changing import all_names
from switchmt_snn.tasks.suite import Picture, Suite, TaskEnvironment, TaskSuite, VectorStep

SIDE_PIXELS = 84
SCREEN_PIXELS = (210, 160)
"""Height and width of the console's screen."""


class AtariCopies:
    """Copies of one game. Frames are single (stacking is done once, in ``switchmt_snn.tasks.play``)."""

    def __init__(self, game: str, num_envs: int, config: TasksConfig, in_colour: bool = False) -> None:
        """Open the game; every option of AtariVectorEnv that changes what is learned is set explicitly.

        ``in_colour`` gives the screen's own size and colours in place of what the network sees.
        """
        self.num_envs = num_envs
        height, width = SCREEN_PIXELS if in_colour else (SIDE_PIXELS, SIDE_PIXELS)
        self._env = AtariVectorEnv(
            game,
            num_envs,
            max_num_frames_per_episode=config.max_episode_frames,
            repeat_action_probability=config.sticky_action_probability,
            full_action_space=config.full_action_space,
            img_height=height,
            img_width=width,
            grayscale=not in_colour,
            stack_num=1,
            frameskip=config.frame_skip,
            maxpool=config.frame_skip > 1,
            noop_max=config.noop_max,
            episodic_life=False,
            reward_clipping=False,
            use_fire_reset=config.fire_on_reset,
        )
        self._started = False
        self._lives = np.zeros(num_envs, np.int32)

    def reset(self, env_ids: npt.NDArray[np.int64], seeds: npt.NDArray[np.int64]) -> npt.NDArray[np.uint8]:
        """Start episodes: no-ops (number drawn from the seed) and FIRE happen inside."""
        order = np.argsort(env_ids)
        if len(env_ids) == self.num_envs:
            observations, info = self._env.reset(seed=seeds[order])
        else:
            if not self._started:
                # The first reset of a vector environment must be whole; the others get a seed of no consequence.
                self._env.reset(seed=np.zeros(self.num_envs, np.int64))
            mask = np.zeros(self.num_envs, np.bool_)
            mask[env_ids] = True
            observations, info = self._env.reset(seed=seeds[order], options={"reset_mask": mask})
        self._started = True
        self._lives = np.array(info["lives"])  # of all copies
        return np.asarray(observations[env_ids], np.uint8)

    def step(self, actions: npt.NDArray[np.int64]) -> VectorStep:
        """Step all copies; a copy whose episode ended in the last step and was not reset returns a fresh start."""
        observations, rewards, terminated, truncated, info = self._env.step(actions)
        before, self._lives = self._lives, np.array(info["lives"])
        return VectorStep(
            observations, rewards.astype(np.float64), terminated.copy(), truncated.copy(), self._lives < before
        )

    def close(self) -> None:
        """Free the emulators."""
        self._env.close()


class PicturedAtariCopies:
    """Copies of one game beside copies in colour that are played by the same seeds and actions.

    ale-py's vector environment shows a game either grey or in colour, so that two are played.
    """

    def __init__(self, game: str, num_envs: int, config: TasksConfig) -> None:
        self.num_envs, self._game = num_envs, game
        self._played = AtariCopies(game, num_envs, config)
        self._shown = AtariCopies(game, num_envs, config, in_colour=True)
        self._pictures = np.zeros((num_envs, *SCREEN_PIXELS, 3), np.uint8)

    def reset(self, env_ids: npt.NDArray[np.int64], seeds: npt.NDArray[np.int64]) -> npt.NDArray[np.uint8]:
        """As ``AtariCopies.reset``."""
        self._pictures[env_ids] = self._shown.reset(env_ids, seeds)[:, 0]
        return self._played.reset(env_ids, seeds)

    def step(self, actions: npt.NDArray[np.int64]) -> VectorStep:
        """As ``AtariCopies.step``.

        Raises:
            TaskError: the copies in colour went another way, so that their pictures are of another game.
        """
        step, shown = self._played.step(actions), self._shown.step(actions)
        if (step.rewards != shown.rewards).any() or (step.terminated != shown.terminated).any():
            raise TaskError(
                f"task {self._game!r} played in colour gave the rewards {shown.rewards.tolist()}, expected "
                f"{step.rewards.tolist()}, those of the same game in grey; its pictures would be of another game"
            )
        self._pictures = np.asarray(shown.frames, np.uint8)[:, 0]
        return step

    def picture(self, env_id: int) -> Picture:
        """The screen in colour, 210 x 160 pixels; with frame skip the brighter of its last two frames."""
        picture: Picture = self._pictures[env_id].copy()
        return picture

    def close(self) -> None:
        """Free the emulators."""
        self._played.close()
        self._shown.close()


class AtariSuite(Suite):
    """ALE games by ROM name (``pong``, ``space_invaders``)."""

    name = "atari"
    defaults = SUITE_DEFAULTS["atari"]
    examples = ("pong", "breakout")
    packages = ("ale-py", "gymnasium")
    frames_per_s = 60.0
    # Rainbow stays near random play in most games for this many steps (Kaiser et al. 2020, arXiv 1903.00374).
    steps_to_learn = 100_000
    process_bytes = 20 * 1024**2  # emulators
    masks_actions = True
    references = ATARI_REFERENCES
    published = PUBLISHED_SCORES

    @classmethod
    def known_tasks(cls) -> tuple[str, ...]:
        """Games whose ROMs come with ale-py."""
        return tuple(roms.get_all_rom_ids())

    @property
    def frame_skip(self) -> int:
        """Emulator frames per agent step."""
        return self.config.frame_skip

    @property
    def tasks_with_lives(self) -> tuple[str, ...]:
        """Games that begin with lives."""
        return tuple(name for name in self.config.names if _facts(name).lives > 0)

    @property
    def protocol(self) -> tuple[str, ...]:
        """Actions, sticky actions, how an episode starts, frame skip, and the longest episode."""
        config = self.config
        return (
            "all 18 actions" if config.full_action_space and not config.minimal_action_mask else "minimal actions",
            f"sticky actions {config.sticky_action_probability:g}",
            f"fire on reset {'on' if config.fire_on_reset else 'off'}",
            f"no-ops <= {config.noop_max}",
            f"frame skip {config.frame_skip}",
            f"frame cap {config.max_episode_frames:,}",
        )

    @property
    def files(self) -> dict[str, Path]:
        """The ROMs."""
        return {name: Path(roms.get_rom_path(name)) for name in all_names(self.config)}

    def make(self) -> TaskSuite:
        """Make the games.

        Raises:
            TaskError: games of different action counts without ``full_action_space``.
        """
        config = self.config
        action_names = _action_names(config)

        def make(task: int, num_envs: int) -> TaskEnvironment:
            return AtariCopies(config.names[task], num_envs, config)

        return TaskSuite(
            names=config.names,
            frame_shape=(1, SIDE_PIXELS, SIDE_PIXELS),
            frame_dtype=np.uint8,
            frame_stack=resolved_frame_stack(config),
            scale=1.0 / 255.0,
            in_unit_range=True,
            action_names=action_names,
            valid_actions_KA=_valid_actions(config, action_names),
            references={name: self.references[name] for name in config.names if name in self.references},
            make=make,
            thread_safe=True,
            versioned=True,
            make_pictured=lambda task, num_envs: PicturedAtariCopies(config.names[task], num_envs, config),
        )


def _action_names(config: TasksConfig) -> tuple[str, ...]:
    """One meaning per action: all 18, or the minimal set if the games agree on it."""
    if config.full_action_space:
        return tuple(action.name for action in Action.__members__.values())[:18]
    counts = {name: _facts(name).minimal_actions for name in config.names}
    if len(set(counts.values())) > 1:
        shown = ", ".join(f"{name} {len(actions)}" for name, actions in counts.items())
        raise TaskError(
            f"tasks.full_action_space is false and the games' minimal action sets differ ({shown}), "
            "expected one meaning per action; set tasks.full_action_space to true (and tasks.minimal_action_mask)"
        )
    return next(iter(counts.values()))


def _valid_actions(config: TasksConfig, action_names: tuple[str, ...]) -> npt.NDArray[np.bool_]:
    """``[K, A]``: every action, or those of each game's minimal set with ``minimal_action_mask``."""
    if not config.minimal_action_mask:
        return np.ones((len(config.names), len(action_names)), np.bool_)
    return np.stack([np.isin(action_names, _facts(name).minimal_actions) for name in config.names])


@dataclass(frozen=True)
class _Facts:
    """What a game says of itself when it is opened."""

    minimal_actions: tuple[str, ...]
    lives: int


@functools.cache
def _facts(game: str) -> _Facts:
    env = AtariVectorEnv(game, 1, full_action_space=False)
    _, info = env.reset(seed=0)
    facts = _Facts(tuple(action.name for action in env.ale.get_action_set()), int(info["lives"][0]))
    env.close()
    return facts
