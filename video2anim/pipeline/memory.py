"""Peak memory of a piece of work."""

from __future__ import annotations

import contextlib
from pathlib import Path

_PROC = Path("/proc/self")


def reset_peak() -> bool:
    """Start a new measurement; False where the kernel does not allow it (other systems than Linux, some containers)."""
    try:
        (_PROC / "clear_refs").write_text("5")
    except OSError:
        return False
    return True


def peak_mb() -> float | None:
    """Largest resident set since `reset_peak` in MB (10^6 bytes), and start a new measurement.

    None where none can be started: the peak there is that of the process's whole life.
    """
    peak = None
    with contextlib.suppress(OSError):
        for line in (_PROC / "status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                peak = float(line.split()[1]) * 1024 / 1e6
    return peak if reset_peak() else None
