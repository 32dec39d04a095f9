"""Peak memory of a piece of work."""

from __future__ import annotations

import contextlib
from pathlib import Path

_PROC = Path("/proc/self")
_SLACK_KB = 4096
"""The kernel counts pages of each thread in batches, so that two counters read together differ by some."""


def reset_peak() -> bool:
    """Start a new measurement.

    Returns:
        False where that is not possible (other systems than Linux, some containers), also where the kernel takes the
        request and keeps the peak.
    """
    try:
        (_PROC / "clear_refs").write_text("5")
    except OSError:
        return False
    peak, now = _status_kb("VmHWM"), _status_kb("VmRSS")
    return peak is not None and now is not None and peak <= now + _SLACK_KB


def peak_mb() -> float | None:
    """Largest resident set since `reset_peak` in MB (10^6 bytes), and start a new measurement.

    None where none can be started: the peak there is that of the process's whole life.
    """
    peak = _status_kb("VmHWM")
    return peak * 1024 / 1e6 if reset_peak() and peak is not None else None


def _status_kb(key: str) -> float | None:
    """A number of the kernel's report on this process."""
    with contextlib.suppress(OSError):
        for line in (_PROC / "status").read_text().splitlines():
            if line.startswith(f"{key}:"):
                return float(line.split()[1])
    return None
