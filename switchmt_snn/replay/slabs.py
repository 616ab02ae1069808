"""Pages of their own for small contents that stay long: compressed frames.

In the C library's heap a block of 2 kB that stays for hours is cut out of an area of megabytes that an update's
activations or a checkpoint's segment have just left. The area is then too small for the next such use, and the heap
grows: by the size of the plain frames (docs/performance.md, "Replay memory").
"""

from __future__ import annotations

import mmap
from typing import NamedTuple

SLAB_BYTES = 256 * 1024
"""Of one request to the system. Its pages are taken as they are written."""


class Place(NamedTuple):
    """Where a content lies."""

    slab: int
    start: int
    length: int


class Slabs:
    """Contents one behind the other in slabs; a slab goes back to the system when its last content was removed."""

    def __init__(self) -> None:
        self._maps: dict[int, mmap.mmap] = {}
        self._contents: dict[int, int] = {}  # of each slab, how many are held
        self._newest = -1
        self._end = 0  # of the contents of the newest slab
        self.content_bytes = 0

    @property
    def slab_bytes(self) -> int:
        """Bytes of all slabs, filled or not."""
        return sum(map(len, self._maps.values()))

    def add(self, content: bytes) -> Place:
        """Keep a copy of a content. What is longer than a slab gets one of its size."""
        newest = self._maps.get(self._newest)
        if newest is None or self._end + len(content) > len(newest):
            self._newest, self._end = self._newest + 1, 0
            newest = mmap.mmap(-1, max(SLAB_BYTES, len(content)), access=mmap.ACCESS_COPY)  # shared with no child
            self._maps[self._newest], self._contents[self._newest] = newest, 0
        place = Place(self._newest, self._end, len(content))
        newest[place.start : place.start + place.length] = content
        self._end += len(content)
        self._contents[place.slab] += 1
        self.content_bytes += place.length
        return place

    def remove(self, place: Place) -> None:
        """Forget a content that was added."""
        self.content_bytes -= place.length
        self._contents[place.slab] -= 1
        if self._contents[place.slab] == 0:
            del self._maps[place.slab], self._contents[place.slab]

    def view(self, place: Place) -> memoryview:
        """A content that was added and not removed."""
        return memoryview(self._maps[place.slab])[place.start : place.start + place.length]
