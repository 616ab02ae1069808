"""Every kind of install gives the same package: wheel, sdist, editable, and the clone itself."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow  # environments are made

ROOT = Path(__file__).parents[1]
CHECK = """
import importlib.resources as r, sys
from pathlib import Path
import switchmt_snn, switchmt_snn.export, switchmt_snn.export.chips.fit
import switchmt_snn.native.library as native
from switchmt_snn.config import load_config
expected = sys.argv[1]
assert switchmt_snn.__file__.startswith(expected), switchmt_snn.__file__
assert switchmt_snn.export.__file__.startswith(expected), switchmt_snn.export.__file__
assert load_config("paper").name == "paper"
from switchmt_snn.study.grid import load_study
assert load_study("policies_minatar", seeds=[1]).baseline == "uniform"
assert (Path(native.__file__).parent / "csrc" / "numbers.h").is_file()
assert any(path.name == "loihi-2018.yaml" for path in r.files("switchmt_snn.export.energy.targets").iterdir())
assert any(path.name == "speck.yaml" for path in r.files("switchmt_snn.export.chips.builtin").iterdir())
templates = r.files("switchmt_snn.export.report").joinpath("templates")
assert any(path.name.endswith(".jinja") for path in templates.iterdir())
from switchmt_snn import load_agent
import numpy
assert load_agent("pretrained/cartpole").act(numpy.zeros(4, numpy.float32), "CartPole-v1") in (0, 1)
print("whole")
"""
"""What an install must hold, wherever Python is started."""


def python(*words: str | Path, cwd: Path, path: Path | None = None, interpreter: Path | str = sys.executable) -> str:
    """Standard output of a program that ends well; without ``-O``, which would leave its assertions out."""
    left_out = ("PYTHONPATH", "PYTHONOPTIMIZE")
    environment = {name: value for name, value in os.environ.items() if name not in left_out}
    if path is not None:
        environment["PYTHONPATH"] = str(path)
    done = subprocess.run([interpreter, *words], cwd=cwd, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that git tracks, links as links: what a user clones."""
    target = tmp_path_factory.mktemp("clone")
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, names.split("\0")):
        if name.startswith("results/") or not os.path.lexists(ROOT / name):
            continue
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, target / name, follow_symlinks=False)
    return target


@pytest.fixture(scope="module")
def distributions(clone: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sdist, and the wheel that was built from it."""
    target = tmp_path_factory.mktemp("distributions")
    python("-m", "build", "--no-isolation", "--outdir", target, clone, cwd=target)
    return target


def test_a_wheel_holds_everything_and_nothing_else(distributions: Path, tmp_path: Path) -> None:
    (wheel,) = distributions.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        tops = {name.split("/")[0] for name in archive.namelist()}
        assert tops == {"switchmt_snn", next(top for top in tops if top.endswith(".dist-info"))}
        archive.extractall(tmp_path)
    assert python("-c", CHECK, tmp_path, cwd=tmp_path.parent, path=tmp_path) == "whole\n"


def test_a_source_distribution_holds_real_files(distributions: Path, tmp_path: Path) -> None:
    (sdist,) = distributions.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path, filter="data")
    (source,) = tmp_path.iterdir()
    assert python("-c", CHECK, source, cwd=tmp_path, path=source) == "whole\n"


def test_the_clone_itself_is_importable(clone: Path) -> None:
    """Without any install: ``python -m benchmarks.X`` and the library example are started in the clone."""
    assert python("-c", CHECK, clone, cwd=clone) == "whole\n"
    assert "usage" in python("-m", "benchmarks.update_step", "--help", cwd=clone)


@pytest.mark.parametrize("editable", [False, True])
def test_installs_work_inside_and_outside_of_the_clone(clone: Path, tmp_path: Path, editable: bool) -> None:
    """In an environment of its own that sees this one's other packages."""
    venv.create(tmp_path / "venv", with_pip=False)
    (site,) = (tmp_path / "venv" / "lib").glob("python*/site-packages")
    installer = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "--no-warn-script-location",
    ]
    target = ["-e", str(clone)] if editable else [str(clone)]
    command = [*installer, "--prefix", str(tmp_path / "venv"), "--ignore-installed", *target]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    others = next(path for path in sys.path if path.endswith("site-packages"))
    (site / "others.pth").write_text(f"import sys; sys.path.append({others!r})")
    interpreter = tmp_path / "venv" / "bin" / "python"
    found = str(clone) if editable else str(site)
    for folder, expected in ((tmp_path, found), (clone, str(clone))):
        assert python("-c", CHECK, expected, cwd=folder, interpreter=interpreter) == "whole\n"
