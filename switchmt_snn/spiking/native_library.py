"""``native.cpp`` as a library: compiled by the machine's C++ compiler at its first use, for the processor at hand, kept
in the user's cache, and loaded. Its parallel loops run in PyTorch's own pool of threads.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path

_SOURCE = Path(__file__).with_name("native.cpp")
# No contraction of a*b+c into one rounding: spikes shall be those of PyTorch's operations.
_FLAGS = (
    "-std=c++17",
    "-O3",
    "-march=native",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fopenmp",
    "-fPIC",
)
_KINDS = {"p": ctypes.c_void_p, "i": ctypes.c_int, "l": ctypes.c_long, "f": ctypes.c_float}
_ARGUMENTS = {
    "snn_fire": "ppilpppillli",
    "snn_unfire": "ppilppppilppllli",
    "snn_combine": "ppippppplli",
    "snn_moments": "pipplli",
    "snn_images": "pfpillli",
}
"""Pointers, ints, longs and floats that the functions of ``native.cpp`` take."""


@functools.cache
def library() -> ctypes.CDLL:
    """The compiled and loaded functions.

    Raises:
        OSError: no compiler, nowhere to write, or a file that cannot be loaded.
        subprocess.SubprocessError: the compiler failed.
    """
    loaded = ctypes.CDLL(str(compiled()))
    for name, kinds in _ARGUMENTS.items():
        function = getattr(loaded, name)
        function.argtypes, function.restype = [_KINDS[kind] for kind in kinds], None
    return loaded


def problem() -> str | None:
    """One line on why ``native.cpp`` cannot be compiled and loaded here; None if it can."""
    try:
        library()
    except (OSError, subprocess.SubprocessError) as error:
        output = getattr(error, "stderr", None) or str(error)
        return str(output).strip().splitlines()[0][:120]
    return None


def compiled() -> Path:
    """The library's file, made if the cache has none for this source, compiler and processor.

    Raises:
        OSError: no compiler, or nowhere to write.
        subprocess.SubprocessError: the compiler failed.
    """
    compiler = shlex.split(os.environ.get("CXX") or "g++")
    if shutil.which(compiler[0]) is None:
        raise OSError(f"no C++ compiler {compiler[0]!r}")
    version = subprocess.run([*compiler, "--version"], capture_output=True, text=True, check=True).stdout
    what = [_SOURCE.read_text(), version, " ".join(_FLAGS), platform.machine(), _instructions()]
    name = f"native-{hashlib.sha256(chr(0).join(what).encode()).hexdigest()[:16]}.so"
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "switchmt_snn"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / name).exists():
            return folder / name
        scratch = Path(tempfile.mkdtemp(dir=folder))
    except OSError:  # no home to write to
        folder = scratch = Path(tempfile.mkdtemp())
    try:
        unlinked, linked = scratch / "native.o", scratch / name
        for command in ([*_FLAGS, "-c", str(_SOURCE), "-o", str(unlinked)], ["-shared", str(unlinked), "-o", linked]):
            # Linked without OpenMP: its symbols are found in the one that PyTorch has loaded.
            subprocess.run([*compiler, *command], capture_output=True, text=True, check=True)
        os.replace(linked, folder / name)
    finally:
        if scratch != folder:
            shutil.rmtree(scratch, ignore_errors=True)
    return folder / name


def _instructions() -> str:
    """What this processor can do, as far as the system tells: homes are shared by machines."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith(("flags", "Features")):
                return line
    return platform.processor()
