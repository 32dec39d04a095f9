"""Pictures kept out of the C heap."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_M_MMAP_THRESHOLD = -3
_PICTURE_BYTES = 256 * 1024
_USUAL_MAX_BYTES = 32 * 1024 * 1024
"""glibc raises its threshold by itself up to this value."""


@contextmanager
def frames_in_mapped_memory() -> Iterator[None]:
    """Give every array the size of a picture its own memory pages, which go back when it is freed.

    glibc takes arrays of several megabytes from its heap once a few have come and gone. Whoever streams pictures and
    keeps a few small results of each then fills the holes that freed pictures leave, and the heap grows by a good part
    of each picture. Elsewhere than on glibc nothing is done.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is None:
        yield
        return
    mallopt(_M_MMAP_THRESHOLD, _PICTURE_BYTES)
    try:
        yield
    finally:
        mallopt(_M_MMAP_THRESHOLD, _USUAL_MAX_BYTES)
