"""The command line as a user meets it, on real Atari games."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml

from switchmt_snn.cli import main
from switchmt_snn.cli.parsing import RENAMED
from switchmt_snn.config import METHODS, POLICIES, ExperimentConfig, field_documentation
from tests.cli.surface import SURFACE, options, surface
from tests.spiking.test_network import TABLE_3

ROOT = Path(__file__).parents[2]
SMALL = [
    "--total-steps", "240", "--threads", "1", "--tasks.num-envs", "2", "--learning.learning-starts-steps", "32",
    "--learning.batch-size", "4", "--learning.replay-capacity-steps", "400", "--switching.max-stay-steps", "60",
    "--learning.update-every-steps", "16", "--tasks.max-episode-frames", "120", "--evaluation.episodes", "1",
    "--recording.metrics-every-steps", "80", "--recording.checkpoint-every-steps", "100",
]  # fmt: skip


def call(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    """A command in this process: exit code, stdout, stderr."""
    with pytest.raises(SystemExit) as stop:
        main(list(words))
    out = capsys.readouterr()
    return int(stop.value.code or 0), out.out, out.err


@pytest.mark.slow
def test_describe_gives_the_seven_counts(capsys) -> None:
    code, out, _ = call(capsys, "describe", "--json")
    assert code == 0
    methods = json.loads(out)["methods"]
    assert {name: facts["trainable_parameters"] for name, facts in methods.items()} == TABLE_3
    conv1, conv2 = methods["SwitchMT"]["layers"][:2]
    assert conv1["operations_per_step"] == 32 * 20 * 20 * 4 * 8 * 8
    assert (conv1["steps"], conv2["steps"]) == (1, 4)
    assert methods["SwitchMT"]["neurons"] == 12_800 + 5_184 + 3_136 + 2 * 512
    for facts in methods.values():
        assert sum(layer["parameters"] for layer in facts["layers"]) == facts["trainable_parameters"]


@pytest.mark.slow
def test_describe_shows_the_configs_own_network(capsys) -> None:
    """An ablation is described as it is, and every method under settings that only some can have."""
    _, out, _ = call(capsys, "describe", "--network.dendrites", "none", "--json")
    assert json.loads(out)["methods"]["SwitchMT"]["trainable_parameters"] == TABLE_3["DSQN_D"]
    flags = ["--network.dendrites", "per_neuron", "--network.encoding", "rate", "--network.k-winners", "50"]
    code, out, err = call(capsys, "describe", *flags, "--json")
    assert code == 0, err
    counts = {name: facts["trainable_parameters"] for name, facts in json.loads(out)["methods"].items()}
    assert counts["SwitchMT"] == TABLE_3["DSQN_D"] + 2 * 512 * 9
    assert counts["DQN"] == TABLE_3["DQN"]


@pytest.mark.slow
def test_describe_gives_spiking_methods_their_steps_where_the_configs_method_is_an_ann(capsys, tmp_path: Path) -> None:
    """T is of the method that is described: in the config, by a flag, and from a run's resolved config."""
    _, out, _ = call(capsys, "describe", "--json")
    expected = json.loads(out)["methods"]
    flags = ["--network.method", "DQN"]
    path = tmp_path / "config.yaml"
    path.write_text(call(capsys, "train", *flags, "--print-config")[1])
    for words in (flags, [str(path)]):
        code, out, err = call(capsys, "describe", *words, "--json")
        assert code == 0, err
        methods = json.loads(out)["methods"]
        assert {name: facts["timesteps"] for name, facts in methods.items()} == {
            name: 1 if name in ("DQN", "DQN_D") else 4 for name in METHODS
        }
        keys = ("dense_operations_per_decision", "trainable_parameters", "switching_policy")
        for name in METHODS:
            assert [methods[name][key] for key in keys] == [expected[name][key] for key in keys]


@pytest.mark.slow
def test_describe_says_which_config_and_takes_the_one_that_train_takes(capsys) -> None:
    _, out, _ = call(capsys, "describe")
    assert out.startswith("Methods under the config quickstart")
    _, out, _ = call(capsys, "describe", "--json", "minatar")
    assert (json.loads(out)["config"], json.loads(out)["source"]) == ("minatar", "minatar")


@pytest.mark.slow
def test_describe_takes_runs_and_train_says_what_to_do_with_one(capsys, tmp_path: Path) -> None:
    """A run's config can be described by the run's name; a new run of it needs the file, and going on ``--run``."""
    code, of_a_run, err = call(capsys, "describe", "pretrained/cartpole", "--json")
    assert code == 0, err
    _, of_the_preset, _ = call(capsys, "describe", "cartpole", "--json")
    assert json.loads(of_a_run)["methods"] == json.loads(of_the_preset)["methods"]
    (tmp_path / "config.yaml").write_text("seed: 3\n")
    for words, told in (
        (
            ["describe", str(tmp_path)],
            f"{tmp_path} is a folder without a run, expected a config (YAML file or preset), a",
        ),
        (["describe", "pretrained/x"], "no pretrained run 'x', expected one of"),
        (["train", "pretrained/cartpole"], "pretrained/cartpole comes with the package and holds weights only"),
        (["train", str(tmp_path)], f"is a run folder, expected a config; its config is {tmp_path}/config.yaml; to"),
    ):
        code, out, err = call(capsys, *words)
        assert (code, out) == (2, "")
        assert told in err


@pytest.mark.slow
def test_describe_names_trained_and_deployed_parameters(capsys) -> None:
    """32 quantiles add 31 times the heads in training; what decides has the paper's count."""
    flags = ["describe", "--network.quantiles", "32", "--learning.loss", "huber"]
    _, out, _ = call(capsys, *flags, "--json")
    for name, facts in json.loads(out)["methods"].items():
        heads = 513 * (18 + (TABLE_3[name] > TABLE_3["MTSpark_AD"]))
        assert facts["trainable_parameters"] == TABLE_3[name] + 31 * heads
        assert facts["deployed_parameters"] == TABLE_3[name]
        assert sum(layer["parameters"] for layer in facts["layers"]) == facts["trainable_parameters"]
    _, out, _ = call(capsys, *flags)
    assert "3,602,514 parameters are trained, 3,300,357 decide" in " ".join(out.split())
    _, out, _ = call(capsys, "describe", "--network.heads", "per_task", "--json")
    facts = json.loads(out)["methods"]["SwitchMT"]
    assert facts["trainable_parameters"] == TABLE_3["SwitchMT"] + 19_494
    assert facts["deployed_parameters"] == TABLE_3["SwitchMT"]
    _, out, _ = call(capsys, "describe")
    assert "are trained" not in out


@pytest.mark.slow
def test_describe_table_names_every_method(capsys) -> None:
    _, out, _ = call(capsys, "describe", "minatar")
    for method in METHODS:
        assert method in out


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_every_method_trains_on_atari(method: str, tmp_path: Path, capsys) -> None:
    run = tmp_path / "run"
    code, out, err = call(capsys, "train", "quickstart", "--run", str(run), "--network.method", method, *SMALL)
    assert code == 0, err
    assert "Scores at step 240" in out
    assert "SwitchMT (paper)" in out
    assert "too short to learn pong, breakout, enduro" in out
    assert out.rstrip().endswith(str(run))
    tasks = [
        row["task"]
        for row in csv.DictReader((run / "switches.csv").read_text().splitlines())
        if row["decision"] == "switch"
    ]
    assert tasks[:3] == ["pong", "breakout", "enduro"]


@pytest.mark.slow
@pytest.mark.parametrize("policy", POLICIES)
def test_every_policy_trains_on_atari_and_logs_its_numbers(policy: str, tmp_path: Path, capsys) -> None:
    run = tmp_path / "run"
    flags = [
        *SMALL,
        "--switching.policy",
        policy,
        "--switching.window-episodes",
        "1",
        "--tasks.names",
        "pong",
        "breakout",
    ]
    flags += ["--switching.plateau-window-episodes", "3", "--switching.visit-episodes", "2"]
    flags += ["--switching.check-every-steps", "60", "--switching.check-episodes", "1"]
    flags += ["--switching.visit-steps", "50", "--switching.max-stay-steps", "200"]
    code, _, err = call(capsys, "train", "quickstart", "--run", str(run), *flags)
    assert code == 0, err
    rows = list(csv.DictReader((run / "switches.csv").read_text().splitlines()))
    assert rows
    numbers = {
        "fixed_episodes": ["visit_episodes"],
        "fixed_steps": ["visit_steps"],
        "interleave": [],
        "parameter_change": ["parameter_change", "change_threshold"],
        "parameter_change_per_update": ["parameter_change", "updates_in_window"],
        "reward_plateau": ["reward_slope", "reward_t", "flat_episodes"],
        "parameter_and_reward": ["parameter_change", "reward_slope", "parameter_says_leave"],
        "value_change": ["value_change", "updates_in_window", "value_change_per_update"],
        "deficit": ["score", "deficit", "share", "owed_steps", "most_owed_steps"],
        "learning_progress": ["progress", "median_return", "share", "owed_steps"],
        "plateau_and_return": ["reward_slope", "reward_t", "flat_episodes"],
        "harmonic_gain": ["score", "progress", "share", "owed_steps"],
        "dormancy_guard": ["silent_share", "silent_rise", "silent_rise_bound", "visit_steps"],
    }
    assert any(all(row[column] for column in numbers[policy]) for row in rows), rows


@pytest.mark.slow
def test_train_then_evaluate_without_arguments(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, _ = call(capsys, "train", "--json", *SMALL)
    assert code == 0
    trained = json.loads(out)
    assert trained["status"] == "finished"
    code, out, _ = call(capsys, "evaluate", "--episodes", "2", "--task", "pong", "--json")
    assert code == 0
    result = json.loads(out)
    assert result["run"] == trained["run"]
    assert {row["task"] for row in result["tasks"]} == {"pong"}
    files = {path.suffix for path in (tmp_path / trained["run"] / "evaluations").iterdir()}
    assert files == {".csv", ".json"}
    code, _, err = call(capsys, "evaluate", "--episodes", "0")
    assert (code, err.count("\n")) == (2, 1)
    assert "evaluation.episodes is 0, expected at least 1" in err
    code, _, err = call(capsys, "evaluate", "--task", "pog")
    assert (code, err.count("\n")) == (2, 1)
    assert "did you mean 'pong'" in err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["trian"], "unknown command 'trian'; did you mean 'train'?"),
        (["train", "nothing.yaml"], "no config file or preset 'nothing.yaml'"),
        (["train", "--learning.batchsize", "3"], "--learning.batch-size"),
        (["train", "--learning.batch-size", "many"], "'many' is not a whole number such as 1000000 or 1e6"),
        (["train", "--threads", "x"], "Error parsing --threads: 'x' is not a whole number such as 1000000 or 1e6;"),
        (["evaluate", "--epsilon", "x"], "Error parsing --epsilon: 'x' is not a number;"),
        (["check-env", "CartPole-v1", "--seconds", "x"], "Error parsing --seconds: 'x' is not a number;"),
        (
            ["train", "--evaluation.stop-at-returns", "1", "x"],
            "--evaluation.stop-at-returns: 'x' is not a number;",
        ),
        (
            ["study", "policies_minatar", "--seeds", "1", "x"],
            "Error parsing --seeds: 'x' is not a whole number",
        ),
        (["study", "policies_minatar", "--seeds"], "study got --seeds without a number, expected seeds"),
        (["train", "--recording.tensorboard=false"], "an option that is on or off takes no value"),
        (
            ["train", "cartpole", "--tasks.no-subprocesses", "false"],
            "an option that is on or off takes no value: --tasks.subprocesses, or --tasks.no-subprocesses;",
        ),
        (["train", "--run", "pretrained/pong"], "pretrained/pong comes with the package and holds weights only"),
        (["train", "pong", "--run", "pretrained/pong"], "training needs a new run: switchmt-snn train"),
        (["play", "pretrained/cartpole", "--task", "pong"], "unknown task 'pong'; known: CartPole-v1"),
        (["evaluate", "pretrained/cartpole", "--task", "pong"], "unknown task 'pong'; known: CartPole-v1"),
        (["export", "pretrained/cartpole", "--onnx", "--task", "pong"], "unknown task 'pong'; known: CartPole-v1"),
        (["profile", "pretrained/cartpole", "--checkpoint", "best"], "no whole best checkpoint"),
        (["train", "--network.timesteps", "0"], "network.timesteps is 0, expected at least 1"),
        (["train", "--total-steps", "-1"], "total_steps is -1, expected at least 1"),
        (["train", "--tasks.names", "pongg"], "did you mean 'pong'"),
        (["train", "--tasks.suite", "gym", "--tasks.names", "Pendulum-v1"], "expected Discrete"),
        (["train", "--learning.replay-capacity-steps", "999999999"], "lower learning.replay_capacity_steps to at most"),
        (["train", "--network.method", "best"], "invalid choice 'best'"),
        (["evaluate"], "expected one; run switchmt-snn train"),
        (
            ["train", "--run", "runs/typo", "--total-steps", "100"],
            "no run folder runs/typo, expected one; a new run needs a config: "
            "switchmt-snn train quickstart --run runs/typo --total-steps 100\n",
        ),
        (["train", "--run=runs/typo", "--print-config"], "no run folder runs/typo"),
        (
            ["train", "--tasks.suite", "gym", "--tasks.names", "A-v0", "B-v0", "--run", "runs/my typo"],
            "switchmt-snn train classic --tasks.suite gym --tasks.names A-v0 B-v0 --run 'runs/my typo'\n",
        ),
        (["export", "runs/my typo"], "switchmt-snn train quickstart --run 'runs/my typo'"),
        (["describe", "--network.trunk", "minatar", "--tasks.names", "nope"], "unknown atari task"),
    ],
)
def test_wrong_use_is_one_line_and_exit_2(words: list[str], message: str, capsys, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = call(capsys, *words)
    assert code == 2
    assert out == ""
    assert err.count("\n") == 1
    assert message in err
    assert list(tmp_path.iterdir()) == [], "a refused command leaves nothing behind"


@pytest.mark.slow
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_device_that_is_not_there(capsys, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, err = call(capsys, "train", "--device", "cuda")
    assert code == 2
    assert "device is 'cuda', expected one that this machine has" in err


@pytest.mark.slow
def test_print_config_is_the_resolved_config(capsys) -> None:
    code, out, _ = call(capsys, "train", "paper", "--print-config", "--seed", "5")
    assert code == 0
    data = yaml.safe_load(out)
    assert data["seed"] == 5
    assert data["switching"]["policy"] == "parameter_change"
    assert data["network"]["trunk"] == "nature"


@pytest.mark.slow
def test_command_line_surface_is_frozen() -> None:
    """Every option of every command with its values: an added, removed or changed one fails."""
    assert surface().splitlines() == SURFACE.read_text().splitlines(), "meant so? python -m tests.cli.surface"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            ("train", "--total-timesteps", "100"),
            "train has no option --total-timesteps (did you mean --total-steps?); see",
        ),
        (("train", "--lr", "0.1"), "train has no option --lr (did you mean --learning.learning-rate?); see"),
        (("train", "--xyz=3", "--seeed", "4"), "train has no option --xyz, --seeed (did you mean --seed?); see"),
        (("evaluate", "--episode", "3"), "evaluate has no option --episode (did you mean --episodes?); see"),
    ],
)
def test_an_unknown_option_is_one_short_line_with_the_option_that_was_meant(words, told: str, capsys) -> None:
    code, out, err = call(capsys, *words)
    assert (code, out) == (2, "")
    assert err.startswith(f"switchmt-snn: {told}")
    assert err.count("\n") == 1
    assert len(err) < 160


@pytest.mark.slow
def test_every_setting_of_the_config_is_an_option_of_train_and_describe() -> None:
    for command in ("train", "describe"):
        flags = {flag for option in options(command) for flag in option.split() if flag.startswith("--")}
        fields = {"--" + key.replace("_", "-") for _, _, rows in field_documentation() for key, *_ in rows}
        assert fields <= flags, fields - flags


@pytest.mark.parametrize(("command", "renamed"), RENAMED.items())
@pytest.mark.parametrize("joined", [True, False])
def test_older_spellings_of_flags_still_work(command: str, renamed: dict[str, str], joined: bool, capsys) -> None:
    assert renamed
    for old, new in renamed.items():
        code, _, err = call(capsys, command, *([f"{old}=nothing"] if joined else [old, "nothing"]))
        assert code == 2
        assert f"invalid choice 'nothing' for argument '{new}'" in err


def test_help_version_doctor(capsys) -> None:
    assert call(capsys)[0] == 2
    for words in (["--help"], ["--version"], ["doctor"], ["doctor", "--json"]):
        code, out, _ = call(capsys, *words)
        assert code == 0
        assert out


@pytest.mark.slow
def test_importing_the_package_is_light() -> None:
    code = (
        "import sys, switchmt_snn; assert 'torch' not in sys.modules; switchmt_snn.train; assert 'torch' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.slow
def test_gym_tasks_from_a_file(tmp_path: Path, capsys) -> None:
    """Two Gymnasium ids of different shapes and action counts in one spiking network."""
    path = tmp_path / "two.yaml"
    path.write_text(
        "name: two\ntotal_steps: 600\ntasks: {suite: gym, names: [CartPole-v1, Acrobot-v1]}\n"
        "learning: {batch_size: 8, learning_starts_steps: 50, replay_capacity_steps: 500, update_every_steps: 4}\n"
        "switching: {max_stay_steps: 150}\nevaluation: {episodes: 1}\n"
    )
    code, out, err = call(capsys, "train", str(path), "--run", str(tmp_path / "run"))
    assert code == 0, err
    assert "Acrobot-v1" in out


@pytest.mark.slow
def test_best_weights_are_kept_and_can_be_evaluated(tmp_path: Path, capsys) -> None:
    run = tmp_path / "run"
    flags = [word if word != "240" else "900" for word in SMALL]
    flags += ["--tasks.suite", "gym", "--tasks.names", "CartPole-v1"]
    assert call(capsys, "train", "quickstart", "--run", str(run), *flags)[0] == 0
    manifest = json.loads((run / "checkpoints" / "best" / "manifest.json").read_text())
    code, out, _ = call(capsys, "evaluate", str(run), "--checkpoint", "best", "--episodes", "2", "--json")
    assert code == 0
    assert json.loads(out)["step"] == manifest["step"]


@pytest.mark.slow
def test_tensorboard_is_one_more_view(tmp_path: Path, capsys) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    run = tmp_path / "run"
    flags = ["--tasks.suite", "gym", "--tasks.names", "CartPole-v1", "--recording.tensorboard"]
    code, _, err = call(capsys, "train", "quickstart", "--run", str(run), *SMALL, *flags)
    assert code == 0, err
    events = EventAccumulator(str(run / "tensorboard")).Reload()
    returns = [(point.step, point.value) for point in events.Scalars("return/CartPole-v1")]
    rows = list(csv.DictReader((run / "episodes.csv").read_text().splitlines()))
    assert returns == [(int(row["step"]), float(row["return"])) for row in rows]


def test_default_config_has_no_private_fields() -> None:
    names = vars(ExperimentConfig())
    assert {"network", "learning", "tasks"} <= names.keys()
    assert all(not name.startswith("_") for name in names)
