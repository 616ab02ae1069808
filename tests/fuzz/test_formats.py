"""Mutants of every format are taken or refused by one line: a short budget here, the long one by ``tests.fuzz.run``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from switchmt_snn.config import from_dict, load_config
from switchmt_snn.config.strict_yaml import MOST_BYTES, MOST_LEVELS, parse_yaml, read_text
from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.training import Training
from switchmt_snn.replay.ring import FrameReplay
from switchmt_snn.runs.files import file_name
from tests.fuzz.formats import FORMATS, mutant_of, outcome
from tests.fuzz.run import campaign

CORPUS = Path(__file__).parent / "corpus"
EXPECTED: dict[str, dict[str, str]] = json.loads((CORPUS / "expected.json").read_text())
"""By format and file: how the line of its refusal begins, or ``taken``."""
BUDGET = {"config": 150, "study": 40, "target": 100, "task-id": 200, "manifest": 200, "weights": 200, "recording": 150}
"""Mutants of a format here; 40 of the others, which take a run's folder or a child process each."""


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_mutants_are_taken_or_refused_by_one_line(name: str, tmp_path: Path) -> None:
    @settings(max_examples=BUDGET.get(name, 40), deadline=None, suppress_health_check=list(HealthCheck))
    @given(number=st.integers(0, 10**9))
    def one(number: int) -> None:
        outcome(name, tmp_path, mutant_of(name, number), number)

    one()


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_good_files_are_taken(name: str, tmp_path: Path) -> None:
    taken = {seed: outcome(name, tmp_path, content) for seed, content in FORMATS[name].seeds.items()}
    if name == "task-id":
        assert [seed for seed, line in taken.items() if line == "taken"][:1] == ["CartPole-v1"]
    else:
        # A built-in target that is read from a file of one's own is the same one.
        assert set(taken.values()) == {"taken"}, taken


@pytest.mark.slow
@pytest.mark.parametrize(("name", "file"), [(name, file) for name, files in EXPECTED.items() for file in files])
def test_every_fault_that_was_found_stays_mended(name: str, file: str, tmp_path: Path) -> None:
    line = outcome(name, tmp_path, (CORPUS / name / file).read_bytes())
    assert line.startswith(EXPECTED[name][file]), line


@pytest.mark.slow
def test_a_fault_of_ours_is_not_taken_for_a_damaged_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise KeyError("a fault of ours")

    for part, name in ((FrameReplay, "require_fits"), (Training, "load_state_dict")):
        with monkeypatch.context() as patched:
            patched.setattr(part, name, fails)
            with pytest.raises(KeyError, match="a fault of ours"):
                outcome("state", tmp_path, FORMATS["state"].seeds["gym"])


def test_every_file_of_the_corpus_has_its_line() -> None:
    for name in FORMATS:
        assert {path.name for path in (CORPUS / name).iterdir()} == set(EXPECTED[name])


@pytest.mark.slow
def test_the_campaign_counts_and_keeps_a_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader that raises anything but an error of ours is a fault: the fuzzer can fail."""
    from tests.fuzz import formats

    def broken(folder: Path, content: bytes, number: int) -> None:
        content.decode("ascii")
        if b"\x00" in content:
            raise RecursionError("deep")

    monkeypatch.setitem(formats.FORMATS, "config", formats.Format({"a": b"name: a"}, broken))
    counts = campaign("config", 60, 1, tmp_path / "kept")
    assert counts["fault"] == len(list((tmp_path / "kept").iterdir())) > 0
    assert counts["fault"] + counts["taken"] == 60


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("", None),
        ("a: 1\nb: [x, 2.5, ~, no]", {"a": 1, "b": ["x", 2.5, None, False]}),
        ("a: '1'", {"a": "1"}),
        ("a: 1_000", {"a": 1000}),
        ("a: 1e-4", {"a": "1e-4"}),
        ("a: 2024-01-01", {"a": "2024-01-01"}),
        ("a: 1:30", {"a": "1:30"}),
        ("a: 0x10", {"a": "0x10"}),
        ("8: 1.0e+3", {8: 1000.0}),
        ("a: |\n  b\n  c\n", {"a": "b\nc\n"}),
    ],
)
def test_plain_values_of_yaml(text: str, value: object) -> None:
    assert parse_yaml(text, "f", "a config") == value


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a: &x 1\nb: *x", "an anchor or alias at line 1"),
        ("a: !!python/name:os.system x", "the tag 'tag:yaml.org,2002:python/name:os.system at line 1"),
        ("a: !!timestamp x", "the tag"),
        ("a: 1\na: 2", "the key 'a' is written twice"),
        ("a: 1\n---\nb: 2", "several documents"),
        ("? [a]\n: 1", r"the key \['a'\]"),
        ('"\\e[31m": 1', r"the key '\\x1b\[31m'"),
        (f"a: {'9' * 20}", "a whole number of 20 digits, expected at most 19"),
        ("[" * (MOST_LEVELS + 1) + "]" * (MOST_LEVELS + 1), f"more than {MOST_LEVELS} levels at line 1"),
        ("a: \x07", "special characters are not allowed"),
    ],
)
def test_what_yaml_may_hold_and_we_do_not_take(text: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason) as refused:
        parse_yaml(text, "f.yaml", "a config")
    assert str(refused.value).startswith("f.yaml is not YAML that is taken here (")


def test_files_that_are_no_text_of_ours(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    for content, reason in (
        ("a: 1\n".encode("utf-16"), "is not UTF-8"),
        (b" " * (MOST_BYTES + 1), "65,536 bytes"),
    ):
        path.write_bytes(content)
        with pytest.raises(ConfigError, match=reason):
            read_text(path, "a config")
    for odd in (tmp_path, "/dev/zero", "x" * 5000, "a\0b"):
        with pytest.raises(ConfigError, match="cannot be read"):
            read_text(odd, "a config")
        with pytest.raises(ConfigError):
            load_config(odd)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("threads", 10**6),
        ("seed", 2**63),
        ("seed", 1e300),
        ("total_steps", 10**16),
        ("network.hidden_units", 10**9),
        ("network.timesteps", 10**6),
        ("network.dendritic_segments", 10**6),
        ("network.threshold", 1e300),
        ("learning.replay_max_gib", 1e300),
        ("evaluation.episodes", 10**19),
        ("evaluation.num_envs", 10**6),
        ("tasks.noop_max", 10**9),
        ("tasks.names", [str(number) for number in range(300)]),
        ("name", "x" * 300),
        ("learning.batch_size", 10**400),
        ("learning.batch_size", "9" * 400),
    ],
)
def test_values_have_an_upper_bound(key: str, value: object) -> None:
    section, _, name = key.rpartition(".")
    with pytest.raises(ConfigError, match=rf"{name} is .*, expected (at most|a whole number)") as refused:
        from_dict({section: {name: value}} if section else {name: value})
    assert len(str(refused.value)) < 400


@pytest.mark.parametrize("name", ["ALE/Pong-v5", "a/" * 60 + "b", "é" * 120, "..", "a:b", "con", "x" * 120, "parity"])
def test_files_of_any_task_can_be_written(name: str, tmp_path: Path) -> None:
    (tmp_path / f"step-000000000400_{file_name(name)}_n100_seed10000_epsilon0.05_envs8.json").write_text("")
    assert len(list(tmp_path.iterdir())) == 1
