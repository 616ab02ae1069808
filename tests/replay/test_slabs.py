"""Slabs give back what was put in, hold nothing that was removed, and keep a replay out of the C library's heap."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from switchmt_snn.replay.slabs import SLAB_BYTES, Place, Slabs

LENGTHS = (1, 7, 1000, SLAB_BYTES // 3, SLAB_BYTES // 2, SLAB_BYTES, SLAB_BYTES + 1, 3 * SLAB_BYTES)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 10**6)), max_size=60))
def test_slabs_against_a_dict(operations: list[tuple[int, int]]) -> None:
    slabs, held = Slabs(), {}
    for number, (kind, draw) in enumerate(operations):
        if kind == 0 and held:
            place = sorted(held)[draw % len(held)]
            slabs.remove(place)
            del held[place]
        else:
            content = bytes([number % 251 + 1]) * LENGTHS[draw % len(LENGTHS)]
            held[slabs.add(content)] = content
        assert all(bytes(slabs.view(place)) == content for place, content in held.items())
        assert slabs.content_bytes == sum(map(len, held.values()))
    for place in held:
        slabs.remove(place)
    assert slabs.content_bytes == slabs.slab_bytes == 0


def test_contents_that_leave_in_the_order_they_came_leave_no_slab_behind() -> None:
    slabs = Slabs()
    places: list[Place] = []
    for number in range(5000):
        places.append(slabs.add(bytes(2000 + number % 500)))
        if len(places) > 1000:
            slabs.remove(places.pop(0))
        assert slabs.slab_bytes <= slabs.content_bytes * 1.02 + 2 * SLAB_BYTES


_LOADING = """
import numpy as np, psutil, zstandard
from switchmt_snn.machine.devices import keep_freed_memory
from switchmt_snn.replay.ring import SEGMENT_SLOTS, FrameReplay, Segment

keep_freed_memory()
replay = FrameReplay(40 * SEGMENT_SLOTS, 1, (1, 84, 84), np.uint8, 4, compressed=True)
stored = zstandard.compress(np.arange(SEGMENT_SLOTS * 84 * 84, dtype=np.uint32).astype(np.uint8).tobytes(), 3)
replay._written[:] = 16 * SEGMENT_SLOTS
resident, process = [], psutil.Process()
for number in range(16):
    frames = np.frombuffer(zstandard.decompress(stored), np.uint8).reshape(-1, 1, 84, 84)
    replay.load_segment(Segment(0, number, complete=True), frames)
    resident.append(process.memory_info().rss - replay.nbytes)
print(resident[-1] - resident[3])
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="measures the heap of glibc")
def test_blocks_do_not_break_the_areas_that_segments_leave() -> None:
    """Loading a replay grew the process by every segment's plain 7.2 MB, twelve times here."""
    done = subprocess.run([sys.executable, "-c", _LOADING], env=os.environ, capture_output=True, text=True, check=True)
    assert int(done.stdout) < 2 * 1024 * 84 * 84, f"{int(done.stdout) / 1e6:.1f} MB for 12 segments of 7.2 MB"
