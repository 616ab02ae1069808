"""Runs to give away: a run without its replay, and the ones that come with the package (``pretrained/NAME``)."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

from switchmt_snn.config.trust import SIGNATURE
from switchmt_snn.errors import RunFolderError, nearest
from switchmt_snn.machine.temporary import temporary_folder
from switchmt_snn.runs.files import json_text, write_atomically, writing
from switchmt_snn.runs.folder import RunFolder, latest_run, read_environment
from switchmt_snn.runs.model_card import CARD, model_card

PRETRAINED = Path(__file__).parents[1] / "pretrained"
"""Packed runs of the package: one folder each."""

_PREFIX = "pretrained"
_FILES = (
    "config.yaml",
    "environment.json",
    "code_changes.jsonl",
    "metrics.jsonl",
    "episodes.csv",
    "switches.csv",
    "profile/profile.json",
)


def pretrained_names() -> list[str]:
    """What can follow ``pretrained/``."""
    return sorted(path.parent.name for path in PRETRAINED.glob("*/environment.json"))


def open_run(run: str | Path | None = None, to_write: bool = False, trust: bool = False) -> RunFolder:
    """The run that a user names: a folder, ``pretrained/NAME`` of the package, or None for the newest under ``runs/``.

    Args:
        run: a folder of that name comes before a pretrained run.
        to_write: files will be added to the run. A pretrained run is then copied to ``runs/pretrained/NAME`` the first
            time, and opened there from then on: the package's own files stay as they are. Open a run without it until
            nothing can be refused any more, then ``open_run(folder.path, to_write=True)``.
        trust: let modules that the run names be imported, whoever made it (SECURITY.md).

    Raises:
        RunFolderError: no such run, or it cannot be copied.
    """
    folder = _opened(run, to_write)
    if trust:
        folder.config(trust)
    return folder


def _opened(run: str | Path | None, to_write: bool) -> RunFolder:
    if run is None:
        return RunFolder(latest_run()).require()
    path = Path(run)
    name = _pretrained_name(path)
    if name is None:
        return RunFolder(path).require()
    if name not in pretrained_names():
        raise RunFolderError(
            f"no pretrained run {name!r}, expected one of {', '.join(pretrained_names())}"
            f"{nearest(name, pretrained_names())}"
        )
    copied = RunFolder(Path("runs") / _PREFIX / name)
    if copied.is_run:
        return copied
    if not to_write:
        return RunFolder(PRETRAINED / name)
    _whole_copy(PRETRAINED / name, copied.path)
    return copied


def is_pretrained(run: str | Path) -> bool:
    """Whether ``run`` is ``pretrained/NAME``, with any NAME, and no folder of one's own."""
    return _pretrained_name(Path(run)) is not None


def refuse_pretrained(run: str | Path) -> None:
    """Refuse to train in a run that comes with the package, or under its name.

    Raises:
        RunFolderError: ``run`` is ``pretrained/NAME``, and no folder of one's own.
    """
    name = _pretrained_name(Path(run))
    if name in pretrained_names():
        config = shlex.quote(str(PRETRAINED / name / "config.yaml"))
        raise RunFolderError(
            f"{run} comes with the package and holds weights only, expected a run with its replay; it can be "
            f"evaluated, exported and profiled; training needs a new run: switchmt-snn train {config} "
            f"--initial-weights pretrained/{name} --run NEW_FOLDER"
        )


def _pretrained_name(path: Path) -> str | None:
    """NAME of ``pretrained/NAME``, or of its folder within the package; None for any other folder."""
    if path.exists():
        return path.name if path.resolve().parent == PRETRAINED.resolve() else None
    return path.parts[1] if len(path.parts) == 2 and path.parts[0] == _PREFIX else None


def pack(run: str | Path | None, out: str | Path, checkpoint: str = "last") -> Path:
    """Copy what others need of a run: config, logs, evaluations and the weights of one checkpoint, without the replay.

    A model card (``MODEL_CARD.md``) says what it is; its energy comes from the run's profile.

    The copy is a run folder for every command that reads one. Modules that it names need ``--trust``, of its maker
    too: the proof of who made the run (``switchmt_snn.config.trust``) is not given away. Training cannot be continued
    from it: that needs the replay, the optimizer's moments and the environments' states.

    Args:
        run: as for ``open_run``.
        out: the new folder.
        checkpoint: which weights, ``last`` or ``best``.

    Returns:
        ``out``.

    Raises:
        RunFolderError: no such run; ``out`` exists or cannot be written.
        CheckpointError: no whole checkpoint.
    """
    folder, out = open_run(run), Path(out)
    if out.exists():
        raise RunFolderError(f"{out} exists, expected a new folder; name another with --out")
    step, weights = folder.checkpoints().load_model(checkpoint)
    with writing(out, "--out", whole=True):
        out.parent.mkdir(parents=True, exist_ok=True)
        with temporary_folder(out) as unfinished:
            packed = RunFolder(unfinished)
            for name in _FILES:
                if (folder.path / name).is_file():
                    (packed.path / name).parent.mkdir(exist_ok=True)
                    write_atomically(packed.path / name, _given_away(folder.path / name))
            for path in sorted(folder.evaluations.folder.glob(f"step-{step:012d}_*")):
                (packed.path / "evaluations").mkdir(exist_ok=True)
                write_atomically(packed.path / "evaluations" / path.name, path.read_bytes())
            packed.checkpoints().save_weights(step, weights)
            write_atomically(packed.path / CARD, model_card(packed).encode())
            packed.path.rename(out)
    return out


def _given_away(path: Path) -> bytes:
    """A file's content without this user's signature."""
    content = path.read_bytes()
    if path.name != "environment.json" or SIGNATURE not in (facts := read_environment(path.parent)):
        return content
    del facts[SIGNATURE]
    return json_text(facts, indent=1).encode()


def _whole_copy(source: Path, target: Path) -> None:
    """Copy a folder so that it is whole or absent; of two processes that do it at once, one wins."""
    with writing(target, whole=True):
        target.parent.mkdir(parents=True, exist_ok=True)
        with temporary_folder(target) as unfinished:
            shutil.copytree(source, unfinished, copy_function=shutil.copyfile, dirs_exist_ok=True)
            try:
                unfinished.rename(target)
            except OSError:
                if not RunFolder(target).is_run:
                    raise
