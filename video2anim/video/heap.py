"""Memory of decoded images: pages of their own instead of the C heap."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_M_MMAP_THRESHOLD = -3
"""Number of the parameter in glibc's malloc.h."""
_PICTURE_BYTES = 256 * 1024
"""Arrays of this size and more are images."""
_USUAL_MAX_BYTES = 32 * 1024 * 1024
"""glibc raises its threshold by itself up to this value."""


@contextmanager
def frames_in_mapped_memory() -> Iterator[None]:
    """Give every array of the size of an image memory pages of its own, which are returned when it is freed.

    glibc raises its threshold when large arrays are freed, and then takes images from its heap. A program that streams
    images and keeps small results of each fills the gaps of freed images with those, so the heap grows with every
    image. On other C libraries nothing is done.
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
