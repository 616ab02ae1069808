"""The one reader of ``.npz`` files: recordings, and the inputs of NIR files, also those of strangers."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from switchmt_snn.errors import ExportError, reason_of
from switchmt_snn.machine.memory import available_bytes

Array = npt.NDArray[Any]
_METHODS = {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}
"""Of compression: those that NumPy writes."""


def read_npz(path: Path, keys: Sequence[str], expected: str) -> dict[str, Array]:
    """Some arrays of an archive, those that it has; all are finite numbers or truth values.

    An array is read only if its header agrees with the archive's table and it fits into half of the free memory.

    Args:
        path: the file.
        keys: names of the arrays that are wanted; others are not read.
        expected: what the file should be and what to do, for the error.

    Raises:
        ExportError: it is no such archive, is damaged or encrypted, or an array holds something else.
    """
    try:
        if not path.is_file():
            raise ValueError("No such file" if not path.exists() else "it is no file")
        with path.open("rb") as stream:
            if stream.read(6) == b"\x93NUMPY":
                raise ValueError("it is a single array")
        with zipfile.ZipFile(path) as archive:
            members = {info.filename: info for info in archive.infolist()}
            wanted = {key: members[f"{key}.npy"] for key in keys if f"{key}.npy" in members}
            _require_room(sum(info.file_size for info in wanted.values()))
            stored = {key: _array(archive, info) for key, info in wanted.items()}
    except Exception as error:  # zipfile and NumPy's headers raise whatever their parsers meet
        reason = reason_of(error)
        raise ExportError(f"{path} cannot be read ({reason:.120}), expected {expected}") from error
    if not stored:
        names = ", ".join(member.removesuffix(".npy") for member in members)
        raise ExportError(f"{path} holds {names!r:.80}, expected {expected}")
    for key, values in stored.items():
        if values.dtype.kind not in "buif":
            raise ExportError(f"{path}: {key} has values of type {values.dtype}, expected numbers; {expected}")
        if not np.isfinite(values).all():
            raise ExportError(f"{path}: {key} holds {not_finite(values)}, expected finite numbers")
    return stored


def not_finite(values: Array) -> str:
    """The first value that is no number, and where it is."""
    where = tuple(map(int, np.unravel_index(int(np.argmax(~np.isfinite(values))), values.shape)))
    return f"{values[where]} at {list(where)}"


def _require_room(needed: int) -> None:
    room = available_bytes() // 2
    if needed > room:
        raise ValueError(f"its arrays have {needed:,} bytes, expected at most {room:,}, half of the free memory")


def _array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> Array:
    if info.flag_bits & 1:
        raise ValueError("it is encrypted")
    if info.compress_type not in _METHODS:
        raise ValueError(f"its compression has the number {info.compress_type}, expected stored or deflated")
    with archive.open(info) as stream:
        shape, fortran, dtype = _header(stream)
        if dtype.hasobject:
            raise ValueError(f"{info.filename} holds objects")
        size = math.prod(shape) * dtype.itemsize
        content = bytearray(stream.read(size + 1))  # arrays that can be written to, as NumPy gives them
        if len(content) != size or stream.tell() != info.file_size:
            raise ValueError(f"{info.filename} has {len(content):,} bytes or more, its header says {size:,}")
    return np.frombuffer(content, dtype).reshape(shape, order="F" if fortran else "C")


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"an array of format {version}, expected (1, 0) or (2, 0)")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read(stream)
    if any(side < 0 for side in shape):
        raise ValueError(f"an array of shape {shape}")
    return shape, fortran, dtype
