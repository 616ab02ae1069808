"""The YAML of a study: its trials, and that what it does not know is refused by name."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from switchmt_snn.config import load_config, resolve
from switchmt_snn.errors import ConfigError
from switchmt_snn.study.grid import Study, load_study, studies

Write = Callable[[str], Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def written(text: str) -> Path:
        path = tmp_path / "mine.yaml"
        path.write_text(text)
        return path

    return written


def names(study: Study) -> list[str]:
    return [trial.name for trial in study.trials]


def test_variants_times_grid_times_seeds_seed_by_seed(write: Write) -> None:
    study = load_study(
        write("""
base: cartpole
settings: {total_steps: 900, switching: {window_episodes: 3}}
variants:
  plain:
  slow: {network.timesteps: 8, switching: {window_episodes: 4}}
vary:
  learning.learning_rate: [1e-4, 0.01]
seeds: [7, 3]
""")
    )
    assert study.name == "mine"
    assert study.variants == (
        "plain_learning_rate-1e-4",
        "plain_learning_rate-0.01",
        "slow_learning_rate-1e-4",
        "slow_learning_rate-0.01",
    )
    assert names(study) == [f"{variant}_seed{seed}" for seed in (7, 3) for variant in study.variants]
    config = next(one for one in study.trials if one.name == "slow_learning_rate-1e-4_seed3").config
    assert (config.seed, config.name, config.total_steps) == (3, "slow_learning_rate-1e-4", 900)
    assert (config.network.timesteps, config.switching.window_episodes) == (8, 4)
    assert config.learning.learning_rate == 1e-4
    untouched = load_config("cartpole")
    assert config.evaluation == untouched.evaluation
    assert study.trials[0].config.network == untouched.network
    assert study.baseline == study.variants[0]


def test_overrides_and_seeds_of_the_command_come_last(write: Write) -> None:
    path = write("base: cartpole\nvariants: {a: {total_steps: 5000}, b: {network.timesteps: 2}}\nseeds: 2\n")
    study = load_study(path, ["total_steps=700", "tasks.names=[Acrobot-v1]", "evaluation.stop_at_returns=[-100]"], [9])
    assert names(study) == ["a_seed9", "b_seed9"]
    assert {trial.config.total_steps for trial in study.trials} == {700}
    assert {trial.config.tasks.names for trial in study.trials} == {("Acrobot-v1",)}


def test_keys_with_the_same_last_part_are_named_in_full(write: Write) -> None:
    study = load_study(write("base: cartpole\nvary: {tasks.num_envs: [1, 2], evaluation.num_envs: [3]}\n"))
    assert study.variants == (
        "tasks.num_envs-1_evaluation.num_envs-3",
        "tasks.num_envs-2_evaluation.num_envs-3",
    )


def test_a_base_beside_the_study_is_found_from_anywhere(
    write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "base.yaml").write_text("total_steps: 77\ntasks: {suite: gym, names: [CartPole-v1]}\n")
    monkeypatch.chdir(tmp_path / "elsewhere")
    study = load_study(write("base: base.yaml\n"))
    assert [(trial.name, trial.config.total_steps) for trial in study.trials] == [("mine_seed1", 77)]


def test_a_reference_is_a_number_or_a_variant(write: Write) -> None:
    study = load_study(
        write("""
base: classic
variants: {both: {}, alone: {tasks.names: [CartPole-v1], evaluation.stop_at_returns: []}}
references: {CartPole-v1: alone, Acrobot-v1: -100}
baseline: both
""")
    )
    assert study.references == {"CartPole-v1": "alone", "Acrobot-v1": -100.0}


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(studies()))
def test_studies_of_the_package_can_be_run(name: str) -> None:
    study = load_study(name, ["total_steps=2000"], [1])
    assert len(study.variants) == len(study.trials) >= 3
    for trial in study.trials:
        resolve(trial.config)
    assert len(studies()[name]) > 20


REFUSED = {
    "unknown key": ("base: cartpole\nseed: 3\n", "unknown key seed; did you mean 'seeds'?"),
    "unknown setting": ("base: cartpole\nsettings: {swiching.policy: interleave}\n", "unknown key swiching; did you"),
    "unknown nested": (
        "base: cartpole\nvariants: {a: {switching: {polcy: interleave}}}\n",
        "variant a: unknown key switching.polcy; did you mean 'policy'?",
    ),
    "unknown in vary": (
        "base: cartpole\nvary: {network.timestep: [1]}\n",
        "unknown key network.timestep; did you mean",
    ),
    "wrong value": (
        "base: cartpole\nvary: {network.timesteps: [many]}\n",
        "network.timesteps is 'many', expected a whole",
    ),
    "below a leaf": (
        "base: cartpole\nsettings: {total_steps.x: 1}\n",
        "total_steps is {'x': 1}, expected a whole number",
    ),
    "no base": ("seeds: 2\n", "base is missing, expected a preset or a config file"),
    "unknown base": ("base: cartpol\n", "no config file or preset 'cartpol'; did you mean 'cartpole'?"),
    "no mapping": ("- a\n", "expected a study"),
    "vary of one value": ("base: cartpole\nvary: {network.timesteps: 4}\n", "is 4, expected a list of values"),
    "vary of nothing": ("base: cartpole\nvary: {network.timesteps: []}\n", "is [], expected a list of values"),
    "vary of mappings": ("base: cartpole\nvary: {switching: [{policy: interleave}]}\n", "expected a list of values"),
    "empty section": ("base: cartpole\nsettings: {switching: {}}\n", "switching is {}, expected a value"),
    "twice": (
        "base: cartpole\nsettings: {network.timesteps: 1, network: {timesteps: 2}}\n",
        "network.timesteps is given twice",
    ),
    "vary and variant": (
        "base: cartpole\nvary: {network.timesteps: [1]}\nvariants: {a: {network.timesteps: 2}}\n",
        "network.timesteps is in vary and in variant a",
    ),
    "seed in settings": (
        "base: cartpole\nsettings: {seed: 4}\n",
        "seed is 4, expected none: seeds of the study set it",
    ),
    "name in a variant": ("base: cartpole\nvariants: {a: {name: b}}\n", "name is 'b', expected none"),
    "same variants": (
        "base: cartpole\nvariants: {a: {}, b: {network.timesteps: 4}}\n",
        "a and b have the same settings",
    ),
    "same names": ('base: cartpole\nvary: {switching.options: [["a=1"], ["a-1"]]}\n', "two variants are called"),
    "odd name": ("base: cartpole\nvariants: {a/b: {}}\n", "variants is 'a/b', expected letters, digits"),
    "seeds twice": ("base: cartpole\nseeds: [1, 1]\n", "seeds is [1, 1], expected each seed once"),
    "no seed": ("base: cartpole\nseeds: 0\n", "seeds is 0, expected a number from 1"),
    "truth as seeds": ("base: cartpole\nseeds: true\n", "seeds is True, expected a number of seeds"),
    "too many": (
        "base: cartpole\nvary: {total_steps: [1, 2]}\nseeds: 9000\n",
        "the number of trials is 18000, expected",
    ),
    "unknown reference": (
        "base: cartpole\nreferences: {pong: 3}\n",
        "references is 'pong', expected a task of the study",
    ),
    "reference of another task": (
        "base: classic\nvariants: {a: {}, b: {tasks.names: [Acrobot-v1], evaluation.stop_at_returns: []}}\n"
        "references: {CartPole-v1: b}\n",
        "references.CartPole-v1 is 'b', expected a number, or a variant that plays this task",
    ),
    "reference that is no number": (
        "base: cartpole\nreferences: {CartPole-v1: .nan}\n",
        "references.CartPole-v1 is nan, expected a finite number",
    ),
    "endless reference": (
        "base: cartpole\nreferences: {CartPole-v1: .inf}\n",
        "references.CartPole-v1 is inf, expected a finite number",
    ),
    "no name": ("base: cartpole\nvariants: {'': {}, b: {}}\n", "variants is '', expected letters, digits"),
    "unknown baseline": ("base: cartpole\nbaseline: x\n", "baseline is 'x', expected one of mine"),
    "wrong type": ("base: cartpole\nvariants: [a]\n", "variants is ['a'], expected a mapping"),
    "endless base": (f"base: {'9' * 500}x\n", "no config file or preset '999"),
    "tag": ("base: !!python/name:os.system cartpole\n", "is not YAML that is taken here"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_a_study_does_not_take_is_refused_in_one_line(case: str, write: Write) -> None:
    text, expected = REFUSED[case]
    with pytest.raises(ConfigError) as refused:
        load_study(write(text))
    assert expected in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("total_steps", "--set has 'total_steps', expected KEY=VALUE"),
        ("total_step=3", "unknown key total_step; did you mean 'total_steps'?"),
        ("seed=3", "seed is 3, expected none"),
        ("total_steps=-1", "total_steps is -1, expected at least 1"),
    ],
)
def test_an_override_is_refused_as_in_the_file(word: str, expected: str, write: Write) -> None:
    with pytest.raises(ConfigError) as refused:
        load_study(write("base: cartpole\n"), [word])
    assert expected in str(refused.value)


def test_an_unknown_study_is_named_with_the_nearest() -> None:
    with pytest.raises(
        ConfigError, match="no study 'policies_minata', expected a YAML file or a study's name; did you"
    ):
        load_study("policies_minata")
    with pytest.raises(ConfigError, match="no study 'xxx"):
        load_study("x" * 5000)


def test_the_docs_name_the_studies_of_the_package_with_their_sizes() -> None:
    text = (Path(__file__).parents[2] / "docs" / "studies.md").read_text()
    stated = {name: (int(variants), int(seeds)) for name, variants, seeds in _SIZES.findall(text)}
    found = {name: load_study(name) for name in studies()}
    assert stated == {
        name: (len(study.variants), len({trial.seed for trial in study.trials})) for name, study in found.items()
    }


_SIZES = re.compile(r"^\| `(\w+)` \| .* \| (\d+) variants, (\d+) seeds \|$", re.MULTILINE)
