"""The C++ sources of ``csrc/`` as a library: compiled by the machine's C++ compiler at its first use, for the
processor at hand, kept in the user's cache, and loaded. Its parallel loops run in PyTorch's own pool of threads.
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

import torch  # also brings the OpenMP that the sources are linked against
from torch import Tensor

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
_KINDS = {"p": ctypes.c_void_p, "i": ctypes.c_int, "l": ctypes.c_long, "f": ctypes.c_float, "d": ctypes.c_double}
_ARGUMENTS = {
    "snn_fire": "ppilppppfppillli",
    "snn_fire_bits": "ppilppppfppllli",
    "snn_fire_mean": "ppilppppfppllli",
    "snn_unfire": "ppilppilpppllli",
    "snn_moments": "pippppflli",
    "snn_images": "pfpillli",
    "snn_channels_last": "pipllli",
    "snn_gains": "pllllipl",
    "snn_gains_gradient": "pllllippl",
    "snn_heads": "plppll",
    "snn_read_out": "ppppllli",
    "snn_heads_gradient": "plpppfpllli",
    "snn_adam": "plddddi",
}
"""Pointers, ints, longs, floats and doubles that the functions take."""
# The next two are there if ``snn_has_products`` and ``snn_has_bfloat16`` say so.
_PRODUCTS = {
    "snn_windows": "pplllllli",
    "snn_flat": "ppllli",
    "snn_transpose": "pplli",
    "snn_multiply": "pipppllli",
    "snn_multiply_transposed": "pipppllli",
}
_BFLOAT16 = {
    "snn_convolve": "ppppllllllli",
    "snn_input_gradient": "pppllllllli",
    "snn_weight_gradient": "ppppllllllli",
    "snn_matrix_product": "pppllli",
}


@functools.cache
def library() -> ctypes.CDLL:
    """The compiled and loaded functions; from the cache, if it has them for this source, compiler and processor.

    Raises:
        OSError: there is no compiler.
        subprocess.SubprocessError: the compiler failed.
    """
    compiler = _compiler()
    kept = _cache() / f"native-{_key(compiler)}.so"
    try:
        loaded = ctypes.CDLL(str(kept))
    except OSError:  # not there, or damaged
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
            built = _build(compiler, Path(scratch))
            loaded = ctypes.CDLL(str(built))
            with suppress(OSError):  # a cache that cannot be written to
                kept.parent.mkdir(parents=True, exist_ok=True)
                handle, beside = tempfile.mkstemp(dir=kept.parent)
                os.close(handle)
                shutil.copyfile(built, beside)
                os.replace(beside, kept)
    products = _PRODUCTS if loaded.snn_has_products() else {}
    bfloat16 = _BFLOAT16 if loaded.snn_has_bfloat16() else {}
    for name, kinds in (_ARGUMENTS | products | bfloat16).items():
        function = getattr(loaded, name)
        function.argtypes, function.restype = [_KINDS[kind] for kind in kinds], None
    return loaded


def problem() -> str | None:
    """One line on why the C++ sources cannot be compiled and loaded here; None if it can."""
    try:
        library()
    except subprocess.CalledProcessError as error:
        return (str(error.stderr).strip() or f"{error.cmd[0]} ends with {error.returncode}").splitlines()[0][:120]
    except (OSError, subprocess.SubprocessError) as error:
        return str(error).splitlines()[0][:120]
    return None


def _compiler() -> list[str]:
    wish = os.environ.get("CXX", "").strip() or "g++"
    try:
        command = shlex.split(wish)
    except ValueError as error:
        raise OSError(f"no C++ compiler {wish!r}: {error}") from error
    if shutil.which(command[0]) is None:
        raise OSError(f"no C++ compiler {command[0]!r}")
    return command


def _key(compiler: list[str]) -> str:
    version = subprocess.run([*compiler, "--version"], capture_output=True, text=True, check=True).stdout
    what = [
        *(source.read_text() for source in (_HEADER, *_SOURCES)),
        *compiler,
        version,
        *_FLAGS,
        platform.machine(),
        _instructions(),
    ]
    return hashlib.sha256("\0".join(what).encode()).hexdigest()[:16]


def _cache() -> Path:
    wish = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (wish if wish.is_absolute() else Path("~/.cache").expanduser()) / "switchmt_snn"


def _build(compiler: list[str], folder: Path) -> Path:
    linked, objects = folder / "native.so", [folder / f"{source.stem}.o" for source in _SOURCES]
    steps = [[*_FLAGS, "-c", str(source), "-o", str(made)] for source, made in zip(_SOURCES, objects, strict=True)]
    # Linked without OpenMP: its symbols are found in the one that PyTorch has loaded.
    for options in (*steps, ["-shared", *map(str, objects), "-o", str(linked)]):
        subprocess.run([*compiler, *options], capture_output=True, text=True, check=True)
    return linked


def _instructions() -> str:
    """What this processor can do, as far as the system tells: homes are shared by machines."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith(("flags", "Features")):
                return line
    return platform.processor()


def typed(tensor: Tensor) -> tuple[int, int]:
    """Where numbers lie, and whether they are bfloat16.

    Raises:
        ValueError: C++ would read them wrongly.
    """
    if not tensor.is_cpu or tensor.dtype not in (torch.float32, torch.bfloat16):
        raise ValueError(f"{tensor.dtype} on {tensor.device}, expected float32 or bfloat16 on the CPU")
    return tensor.data_ptr(), int(tensor.dtype == torch.bfloat16)
