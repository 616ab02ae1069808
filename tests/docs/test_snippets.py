"""Every command and every snippet of README, tutorial and extending runs."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from tests.docs.blocks import Block, Reader, blocks, shortened

PAGES = ("README.md", "docs/tutorial.md", "docs/extending.md")
NOT_TESTED: dict[str, list[str]] = {
    "README.md": [],
    "docs/tutorial.md": [".ci/run sets up a fresh environment in the same way"],
    "docs/extending.md": [],
}
"""Reasons of the blocks that no test runs, by page. A new one must be added here, in sight of a reviewer."""


def is_run_elsewhere(block: Block) -> bool:
    """Output, and the set-up commands that .ci/run runs in a fresh environment."""
    return block.language == "text" or block.text.startswith("python3 -m venv ")


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_every_block_of_a_page_runs(page: str, tmp_path: Path) -> None:
    reader = Reader(tmp_path)
    run = [block for block in blocks(page) if not is_run_elsewhere(block) and block.not_tested is None]
    assert {block.language for block in run} >= {"bash", "python"}, page
    for block in run:
        reader.follow(block)


@pytest.mark.parametrize("page", PAGES)
def test_configs_of_a_page_learn_before_they_end(page: str) -> None:
    """A reader copies them. With the defaults of long runs a short one plays at random, and its target never moves."""
    configs = [block for block in blocks(page) if block.language == "yaml" and "total_steps:" in block.text]
    assert configs or page == "README.md"
    for block in configs:
        config = yaml.safe_load(block.text)
        learning, steps = config["learning"], config["total_steps"]
        assert learning.get("epsilon_decay_steps", 1e6) < steps, str(block)
        learned = steps - learning["learning_starts_steps"] * len(config["tasks"]["names"])
        assert 4 * learning.get("target_update_every_steps", 10_000) <= learned, str(block)


@pytest.mark.parametrize("page", PAGES)
def test_blocks_that_are_not_tested_are_listed(page: str) -> None:
    assert [block.not_tested for block in blocks(page) if block.not_tested] == NOT_TESTED[page]


def test_comments_shorten_commands_and_numbers() -> None:
    assert shortened("train x --run a  # tested with --total-steps 9") == "train x --run a --total-steps 9"
    assert shortened("evaluate a --episodes 20 --json  # tested with --episodes 2") == "evaluate a --json --episodes 2"
    assert shortened("f(steps=20_000)  # tested with 50").rstrip() == "f(steps=50)"
    assert shortened("f(1, 20_000)") == "f(1, 20_000)"


@pytest.mark.slow
def test_a_block_that_fails_is_reported_with_its_line(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match=r"page.md:7(.|\n)*unknown"):
        Reader(tmp_path).follow(Block("page.md", 7, "bash", "switchmt-snn train unknown-preset\n"))
