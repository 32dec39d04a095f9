"""Files beside an ONNX graph in which it keeps weights.

A graph names them in its tensors; the runtime takes only such as lie in or below the graph's folder. The graph need not
be understood for their names: each is the value of an entry with the key `location`, which every exporter writes as the
same bytes. The usual names count in any case.
"""

from __future__ import annotations

import mmap
import re
from pathlib import Path, PurePosixPath

_LOCATION = re.compile(rb"\x0a\x08location\x12([\x01-\x7f]|[\x80-\xff][\x01-\x1f])")
"""Field 1 of 8 bytes, `location`; then field 2, of the length that follows in seven bits a byte, low first."""
_USUAL_TAILS = ("_data", ".data")
"""What exporters append to the graph's name."""


def data_files(graph: Path) -> tuple[Path, ...]:
    """The files that an `.onnx` graph may keep weights in, as far as they are there; sorted by name."""
    if graph.stat().st_size == 0:
        return ()
    names = {f"{graph.name}{tail}" for tail in _USUAL_TAILS}
    with graph.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
        for found in _LOCATION.finditer(content):
            low, *high = found[1]
            length = (low & 0x7F) + (high[0] << 7 if high else 0)
            names.add(content[found.end() : found.end() + length].decode(errors="surrogateescape"))
    inside = (name for name in sorted(names) if "\0" not in name and _is_below(PurePosixPath(name)))
    return tuple(path for path in (graph.parent / name for name in inside) if _is_file(path))


def _is_below(name: PurePosixPath) -> bool:
    return not name.is_absolute() and ".." not in name.parts


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name longer than the system allows
        return False
