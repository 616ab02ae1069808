"""Files that may come from strangers are parsed in a child process with limits of time and memory first."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import nir
import numpy as np
import onnxruntime

from switchmt_snn.errors import ExportError
from switchmt_snn.export.runtimes import guarded_child
from switchmt_snn.export.runtimes.guarded_child import MOST_CPU_S, REFUSED, plain_tree

MOST_FILE_BYTES = 256 * 1024**2
"""Of a file that is read."""
MOST_WALL_S = 120
"""Of the child: a multiple of its processor time, for a busy machine."""


def read_file(path: Path, expected: str) -> bytes:
    """The content of a plain file.

    Raises:
        ExportError: it is missing, no plain file (a pipe, a device), or too large.
    """
    try:
        if not path.is_file():
            raise ValueError("no such file" if not path.exists() else "it is no plain file")
        size = path.stat().st_size
        if size > MOST_FILE_BYTES:
            raise ValueError(f"it has {size:,} bytes, expected at most {MOST_FILE_BYTES:,}")
        return path.read_bytes()
    except (OSError, ValueError) as error:
        raise ExportError(f"{path} cannot be read ({error}), expected {expected}; export again") from error


def nir_tree(content: bytes) -> dict[str, Any]:
    """The content of a NIR file (HDF5) as ``nir.dict2NIRNode`` takes it.

    Raises:
        ValueError: it is no such file, or takes too much time or memory.
    """
    output = _run("read_hdf5", content)
    size = int.from_bytes(output[:8], "little")
    return plain_tree(json.loads(output[8 : 8 + size]), memoryview(output)[8 + size :])


def require_runnable(content: bytes) -> None:
    """Try an ONNX model once in a child process.

    Raises:
        ValueError: it cannot be loaded or run, or takes too much time or memory.
    """
    _run("try_onnx", content)


def _run(job: str, content: bytes) -> bytes:
    code, output, refusal = _start(job, content)
    if code == 0:
        return output
    if code == REFUSED:
        raise ValueError(refusal.decode("utf-8", "replace"))
    if -code in (signal.SIGXCPU, signal.SIGKILL):
        raise ValueError(f"it takes more than {MOST_CPU_S} s of processor time, or too much memory")
    raise ValueError(f"its parser fails with {signal.Signals(-code).name if code < 0 else f'exit code {code}'}")


def _start(job: str, content: bytes) -> tuple[int, bytes, bytes]:
    """Run a job in a fresh interpreter: exit code, stdout, stderr."""
    folders = {str(Path(str(module.__file__)).parent.parent) for module in (h5py, nir, np, onnxruntime)}
    # -I: nothing of the folder or of the environment that the command was started in is imported.
    command = [sys.executable, "-I", guarded_child.__file__, job, *sorted(folders)]
    alone = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "HDF5_PLUGIN_PRELOAD": "::"}
    try:
        ended = subprocess.run(
            command, input=content, capture_output=True, timeout=MOST_WALL_S, env={**os.environ, **alone}, check=False
        )
    except subprocess.TimeoutExpired:
        return -signal.SIGXCPU, b"", b""
    return ended.returncode, ended.stdout, ended.stderr
