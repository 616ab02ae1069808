"""What runs in a child process on a file that may come from a stranger: limits, then HDF5's or onnxruntime's parser.

A program of its own that imports nothing of this package (``switchmt_snn.export.runtimes.guarded`` starts it): content
on stdin, result on stdout. A refusal is one line on stderr and the exit code ``REFUSED``.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from typing import Any

REFUSED = 3
MOST_CPU_S = 10
"""Processor time of the child; the system ends it."""
MOST_GROWTH_BYTES = 2**30
"""Memory that the child may take in addition to its imports."""
MOST_STORED_BYTES = 256 * 1024**2
"""Of all values in an HDF5 file, uncompressed."""
MOST_OBJECTS = 10_000
"""Groups and values of an HDF5 file."""
MOST_LEVELS = 8
TRIED_BATCH = 8
"""Rows of the batch on which an ONNX model is tried."""
_FILTERS = {1: "gzip", 2: "shuffle", 3: "fletcher32"}
"""Of HDF5, by number: those in the library itself. Others could be loaded from plugins."""


class Refused(Exception):
    """Why a file is not taken."""


def limit_resources() -> None:
    """Limit this process. A system that lacks a limit goes without it."""
    try:
        import resource
    except ImportError:
        return
    limits = [(resource.RLIMIT_CPU, MOST_CPU_S), (resource.RLIMIT_CORE, 0)]
    try:
        with open("/proc/self/statm", encoding="ascii") as stream:
            present = int(stream.read().split()[0]) * resource.getpagesize()
        limits.append((resource.RLIMIT_AS, present + MOST_GROWTH_BYTES))
    except OSError:
        pass
    for kind, most in limits:
        try:
            resource.setrlimit(kind, (most, most))
        except (OSError, ValueError):
            continue


def read_hdf5(content: bytes) -> bytes:
    """The group ``node`` of an HDF5 file: a tree as JSON, its length in 8 bytes before it, the arrays' bytes after it.

    No link to another place or file is followed, and no value is read that lies outside the file. The NIR graph is
    built here, too, so that a content that it cannot be built from does its harm in this process.

    Raises:
        Refused: the file holds something else, or too much.
    """
    import h5py
    import nir

    arrays: list[bytes] = []
    with h5py.File(h5py.h5f.open_file_image(content), "r") as file:
        tree = _Walk(arrays).group(file, 0, only="node").get("node")
    if not isinstance(tree, dict):
        raise Refused("it has no group 'node'")
    nir.dict2NIRNode(plain_tree(tree, memoryview(b"".join(arrays))))
    head = json.dumps(tree).encode()
    return b"".join([len(head).to_bytes(8, "little"), head, *arrays])


class _Walk:
    """Reads groups and values of an HDF5 file within the bounds."""

    def __init__(self, arrays: list[bytes]) -> None:
        self.arrays = arrays
        self.objects, self.stored = 0, 0

    def group(self, group: Any, level: int, only: str | None = None) -> dict[str, Any]:
        import h5py

        if level > MOST_LEVELS:
            raise Refused(f"its groups have more than {MOST_LEVELS} levels")
        tree: dict[str, Any] = {}
        for name in group:
            self.objects += 1
            if self.objects > MOST_OBJECTS:
                raise Refused(f"it has more than {MOST_OBJECTS:,} groups and values")
            if only is not None and name != only:
                continue
            link = group.get(name, getlink=True)
            if not isinstance(link, h5py.HardLink):
                raise Refused(f"{name!r:.60} is a {type(link).__name__} to another place, expected the value itself")
            item = group[name]
            if isinstance(item, h5py.Group):
                tree[name] = self.group(item, level + 1)
            elif isinstance(item, h5py.Dataset):
                tree[name] = self.value(name, item)
            else:
                raise Refused(f"{name!r:.60} is neither a group nor a value")
        return tree

    def value(self, name: str, item: Any) -> dict[str, Any]:
        import h5py
        import numpy as np

        if item.is_virtual or item.external:
            raise Refused(f"the values of {name!r:.60} lie in other files")
        plist = item.id.get_create_plist()
        filters = {plist.get_filter(index)[0] for index in range(plist.get_nfilters())} - _FILTERS.keys()
        if filters:
            raise Refused(f"{name!r:.60} has the filter {min(filters)}, expected {', '.join(_FILTERS.values())}")
        if item.shape is None:
            raise Refused(f"{name!r:.60} holds nothing")
        self.stored += item.size * item.dtype.itemsize
        if self.stored > MOST_STORED_BYTES:
            raise Refused(f"its values have {self.stored:,} bytes or more, expected at most {MOST_STORED_BYTES:,}")
        if h5py.check_string_dtype(item.dtype) is not None:
            texts = [text.decode() for text in np.ravel(np.asarray(item[()], object)).tolist()]
            return {"$texts": texts, "shape": list(item.shape)}
        if item.dtype.kind not in "biuf" or item.dtype.itemsize > 8:
            raise Refused(f"{name!r:.60} has values of type {item.dtype!s:.40}, expected numbers or text")
        values = np.ascontiguousarray(item[()])
        start = sum(map(len, self.arrays))
        self.arrays.append(values.tobytes())
        return {"$values": values.dtype.str, "shape": list(item.shape), "start": start}


def plain_tree(tree: dict[str, Any], arrays: memoryview) -> dict[str, Any]:
    """The values that a tree stands for, as ``nir.read`` gives them."""
    import numpy as np

    values: dict[str, Any] = {}
    for name, item in tree.items():
        if "$texts" in item and isinstance(item["$texts"], list):
            texts = np.array([text.encode() for text in item["$texts"]], object).reshape(item["shape"])
            values[name] = texts if item["shape"] else item["$texts"][0]
        elif "$values" in item and isinstance(item["$values"], str):
            size = int(np.prod(item["shape"], dtype=np.int64))
            array = (
                np.frombuffer(arrays, item["$values"], size, item["start"]) if size else np.empty(0, item["$values"])
            )
            values[name] = array.reshape(item["shape"]).copy()[()]
        else:
            values[name] = plain_tree(item, arrays)
    return values


def try_onnx(content: bytes) -> bytes:
    """Load an ONNX model and run it once on zeros, a batch of ``TRIED_BATCH``.

    Raises:
        Refused: its inputs are not of known sizes.
    """
    import numpy as np
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    fed = {}
    for value in session.get_inputs():
        name = value.type.removeprefix("tensor(").removesuffix(")")
        dtype = {"float": "float32", "double": "float64"}.get(name, name)
        if value.type == dtype or not hasattr(np, dtype):
            raise Refused(f"its input {value.name!r:.60} is a {value.type}, expected numbers")
        shape = [side if isinstance(side, int) else TRIED_BATCH for side in value.shape]
        fed[value.name] = np.zeros(shape, dtype)
    session.run(None, fed)
    return b""


JOBS: dict[str, Callable[[bytes], bytes]] = {"read_hdf5": read_hdf5, "try_onnx": try_onnx}


def answer(job: str, content: bytes) -> tuple[int, bytes]:
    """Exit code and output of a job: the result, or the line that says why not."""
    limit_resources()
    try:
        return 0, JOBS[job](content)
    except MemoryError:
        return REFUSED, b"it needs too much memory"
    except Exception as error:  # the parsers raise whatever they meet
        reason = " ".join(str(error).split()) or type(error).__name__
        return REFUSED, reason.encode("utf-8", "replace")[:2000]


def main() -> int:
    """Run a job: its name, then folders of packages."""
    job, *folders = sys.argv[1:]
    sys.path += folders
    code, output = answer(job, sys.stdin.buffer.read())
    stream = sys.stderr if code else sys.stdout
    stream.buffer.write(output)
    stream.buffer.flush()
    os._exit(code)  # without the destructors of a parser that has seen a damaged file


if __name__ == "__main__":
    main()
