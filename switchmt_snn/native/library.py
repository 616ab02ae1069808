"""The C++ sources of ``csrc/`` as a library.

The machine's C++ compiler builds it at first use, for this processor. It is kept in the user's cache. Its parallel
loops run in PyTorch's own pool of threads.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import re
import shlex
import shutil
import stat
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch  # noqa: F401  also brings the OpenMP that the sources are linked against

from switchmt_snn.machine.temporary import temporary_beside

_CSRC = Path(__file__).with_name("csrc")
_HEADER = _CSRC / "numbers.h"
_SOURCES = tuple(
    _CSRC / name for name in ("neurons.cpp", "streams.cpp", "products.cpp", "dense_bfloat16.cpp", "adam.cpp")
)
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
_DECLARATION = re.compile(r"^void (snn_\w+)\(([^)]*)\) \{", re.MULTILINE)
"""A function of the ``extern "C"`` parts of the sources; those that say what was compiled return int instead."""
_TYPES = {"int": ctypes.c_int, "long": ctypes.c_long, "float": ctypes.c_float, "double": ctypes.c_double}


@functools.cache
def library() -> ctypes.CDLL:
    """The compiled and loaded functions; from the cache, if it has them for these sources, compiler and processor.

    Raises:
        OSError: no compiler was found.
        subprocess.SubprocessError: the compiler failed.
    """
    compiler = _compiler()
    kept = _cache() / f"native-{_key(compiler)}.so"
    if _is_ours(kept):
        loaded = ctypes.CDLL(str(kept))
    else:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
            built = _build(compiler, Path(scratch))
            loaded = ctypes.CDLL(str(built))
            with suppress(OSError):  # a cache that cannot be written to
                _keep(built.read_bytes(), kept)
    for name, arguments in signatures().items():
        if hasattr(loaded, name):  # products of bits and of bfloat16 are compiled only if the processor has them
            function = getattr(loaded, name)
            function.argtypes, function.restype = arguments, None
    return loaded


def _is_ours(kept: Path) -> bool:
    """Whether a kept library is whole, as its sum says, and nobody but this user can have written it.

    Loading a library runs it: one that is cut off ends the process, one of somebody else's does what they like.
    """
    summed = kept.with_suffix(".sha256")
    try:
        for facts, kind in (
            (kept.parent.stat(), stat.S_ISDIR),
            (kept.lstat(), stat.S_ISREG),
            (summed.lstat(), stat.S_ISREG),
        ):
            if not kind(facts.st_mode) or facts.st_uid != os.getuid() or facts.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
                return False
        return summed.read_text("ascii") == hashlib.sha256(kept.read_bytes()).hexdigest()
    except (OSError, UnicodeDecodeError):
        return False


def _keep(content: bytes, kept: Path) -> None:
    """Put a library and its sum into the cache, readable and writable for this user only."""
    kept.parent.mkdir(parents=True, exist_ok=True)
    kept.parent.chmod(0o700)
    for path, written in ((kept, content), (kept.with_suffix(".sha256"), hashlib.sha256(content).hexdigest().encode())):
        temporary = temporary_beside(path)
        try:
            with os.fdopen(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as stream:
                stream.write(written)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def signatures() -> dict[str, list[type[Any]]]:
    """The ctypes of the arguments of every C++ function, read from the sources."""
    found = {}
    for source in _SOURCES:
        text = source.read_text("utf-8")
        for name, parameters in _DECLARATION.findall(text.replace('extern "C" void', "void")):
            found[name] = [_argument_type(parameter.split()) for parameter in parameters.split(",")]
    return found


def _argument_type(words: list[str]) -> type[Any]:
    """Of a parameter such as ``const float* x`` or ``long rows``."""
    return ctypes.c_void_p if any("*" in word for word in words) else _TYPES[words[0]]


def problem() -> str | None:
    """One line on why the C++ sources cannot be compiled and loaded here; None if they can."""
    try:
        library()
    except subprocess.CalledProcessError as error:
        return (str(error.stderr).strip() or f"{error.cmd[0]} ends with {error.returncode}").splitlines()[0][:120]
    except (OSError, subprocess.SubprocessError) as error:
        return str(error).splitlines()[0][:120]
    return None


def _compiler() -> list[str]:
    requested = os.environ.get("CXX", "").strip() or "g++"
    try:
        command = shlex.split(requested)
    except ValueError as error:
        raise OSError(f"no C++ compiler {requested!r}: {error}") from error
    if shutil.which(command[0]) is None:
        raise OSError(f"no C++ compiler {command[0]!r}")
    return command


def _key(compiler: list[str]) -> str:
    version = subprocess.run([*compiler, "--version"], capture_output=True, text=True, check=True).stdout
    parts = [
        *(source.read_text("utf-8") for source in (_HEADER, *_SOURCES)),
        *compiler,
        version,
        *_FLAGS,
        platform.machine(),
        _instructions(),
    ]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]


def _cache() -> Path:
    requested = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (requested if requested.is_absolute() else Path("~/.cache").expanduser()) / "switchmt_snn"


def _build(compiler: list[str], folder: Path) -> Path:
    linked, objects = folder / "native.so", [folder / f"{source.stem}.o" for source in _SOURCES]
    compilations = [[*_FLAGS, "-c", str(source), "-o", str(to)] for source, to in zip(_SOURCES, objects, strict=True)]
    # Linked without OpenMP: its symbols are found in the library that PyTorch has loaded.
    for options in (*compilations, ["-shared", *map(str, objects), "-o", str(linked)]):
        subprocess.run([*compiler, *options], capture_output=True, text=True, check=True)
    return linked


def _instructions() -> str:
    """The processor's instruction sets, as far as the system tells: machines may share a home folder."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith(("flags", "Features")):
                return line
    return platform.processor()
