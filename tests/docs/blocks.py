"""The fenced blocks of a page, and how each is run.

The conventions are visible to readers:

- ``text`` blocks are output; blocks that set up a virtual environment are run by .ci/run.
- a block whose first line is ``# NAME.py`` or ``# NAME.yaml`` is saved as that file in the page's folder; a script
  ``train_*.py`` is then run.
- ``bash`` blocks are run line by line, ``python`` blocks as scripts, all blocks of a page in order in one folder.
- a command that ends with ``# tested with OPTIONS`` gets the options, in place of its own; a Python line that ends with
  ``# tested with NUMBER`` gets the number in place of its last one.
- a block whose first line is ``# not tested: REASON`` is not run; the test lists it.

Commands and scripts run in processes that are forked from one that has imported PyTorch, which takes longer than most
of them do; lines that need a shell run in one.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import runpy
import shlex
import stat
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

ROOT = Path(__file__).parents[2]
_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_FILE = re.compile(r"# ([\w./-]+\.(?:py|yaml))")
_NOT_TESTED = re.compile(r"# not tested: (.+)")
_SHELL = re.compile(r"[|&;<>$*`]")
_IMPORTED = ["torch._dynamo", "switchmt_snn.runs.run", "switchmt_snn.export.export_run", "switchmt_snn.cli.entry"]
_LINKED = ("examples", "configs", "results", "benchmarks", "tests")


@dataclass(frozen=True)
class Block:
    """A fenced block and the line of the page where it starts."""

    page: str
    line: int
    language: str
    text: str

    @property
    def file_name(self) -> str | None:
        """The file that the block is, by its first line."""
        match = _FILE.fullmatch(self.text.splitlines()[0])
        return match.group(1) if match else None

    @property
    def not_tested(self) -> str | None:
        """Why the block is not run, or None."""
        match = _NOT_TESTED.fullmatch(self.text.splitlines()[0])
        return match.group(1) if match else None

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"


def blocks(page: str) -> list[Block]:
    """All fenced blocks of a page of the repository."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return [
        Block(page, text.count("\n", 0, match.start()) + 1, match.group(1), match.group(2))
        for match in _BLOCK.finditer(text)
    ]


def shortened(line: str) -> str:
    """A line with what its ``# tested with`` comment says."""
    code, mark, instead = line.partition("# tested with ")
    if not mark:
        return line
    if re.fullmatch(r"[\d_]+", instead):
        return re.sub(r"[\d_]*\d(?=\D*$)", instead, code)
    for option, value in re.findall(r"(--\S+) (\S+)", instead):
        code = re.sub(rf"{option} \S+\s*", "", code).rstrip() + f" {option} {value}"
    return code


class Reader:
    """Someone who follows a page in an empty folder that holds the repository's folders."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name in _LINKED:
            (folder / name).symlink_to(ROOT / name)
        programs = folder / ".bin"
        programs.mkdir()
        command = programs / "switchmt-snn"  # as pip makes it: the current folder is not on the module path by itself
        command.write_text(f"#!{sys.executable}\nimport sys\nfrom switchmt_snn.cli import run_program\nrun_program()\n")
        command.chmod(command.stat().st_mode | stat.S_IEXEC)
        path = f"{programs}{os.pathsep}{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        self.environment = {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}

    def follow(self, block: Block) -> None:
        """Save or run a block.

        Raises:
            AssertionError: the block fails, or the conventions do not say what to do with it.
        """
        text = "\n".join(map(shortened, block.text.splitlines())).replace(".venv/bin/", "") + "\n"
        if block.file_name is not None:
            (self.folder / block.file_name).write_text(text)
            if block.file_name.startswith("train_"):
                self._fork([block.file_name], block)
        elif block.language == "bash":
            for line in text.replace("\\\n", " ").splitlines():
                words = shlex.split(line, comments=True)
                if words[:1] == ["switchmt-snn"] and not _SHELL.search(line):
                    self._fork(words, block)
                else:
                    self._shell(line, block)
        elif block.language == "python":
            (self.folder / "snippet.py").write_text(text)
            self._fork(["snippet.py"], block)
        else:
            raise AssertionError(f"{block}: a {block.language or 'plain'} block that is no file and no command")

    def _shell(self, line: str, block: Block) -> None:
        command = ["bash", "-euo", "pipefail", "-c", line]
        done = subprocess.run(command, cwd=self.folder, env=self.environment, capture_output=True, text=True)
        assert done.returncode == 0, f"{block}\n{line}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"

    def _fork(self, words: list[str], block: Block) -> None:
        printed = self.folder / ".printed"
        importing = {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
        with mock.patch.dict(os.environ, importing):  # of the process that imports
            context = multiprocessing.get_context("forkserver")
            context.set_forkserver_preload(_IMPORTED)
            process = context.Process(target=_run_here, args=(words, self.folder, self.environment, printed))
            process.start()
        process.join()
        assert process.exitcode == 0, f"{block}\n{shlex.join(words)}\n{printed.read_text()[-6000:]}"


def _run_here(words: list[str], folder: Path, environment: dict[str, str], printed: Path) -> None:
    """What a process of its own does with a command or a script: its folder, environment and output are set here."""
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    with printed.open("wb") as stream:
        os.dup2(stream.fileno(), 1)
        os.dup2(stream.fileno(), 2)
    sys.argv = list(words)
    if words[0].endswith(".py"):
        sys.path.insert(0, str(folder))
        runpy.run_path(words[0], run_name="__main__")
    else:
        from switchmt_snn.cli import run_program

        run_program()
