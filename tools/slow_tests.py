"""Which tests `make fast` leaves out, from the durations that pytest prints.

python -m pytest -q -n 2 --dist loadfile --durations=2000 --durations-min=0.3 | python tools/slow_tests.py
"""

from __future__ import annotations

import re
import sys
from collections import defaultdict
from pathlib import Path

LISTED = Path(__file__).resolve().parents[1] / "tests" / "slow_tests.txt"
SLOW_S = 0.3
"""Of a test with all its cases; about 4,000 faster ones make a run of four minutes on two cores."""

if __name__ == "__main__":
    seconds: dict[str, float] = defaultdict(float)
    for line in sys.stdin:
        found = re.match(r" *([0-9.]+)s (?:call|setup|teardown) +([^\s\[]+)", line)
        if found:
            seconds[found[2]] += float(found[1])
    head = [line for line in LISTED.read_text(encoding="utf-8").splitlines() if line.startswith("#")]
    slow = sorted(name for name, taken in seconds.items() if taken >= SLOW_S)
    LISTED.write_text("\n".join([*head, *slow]) + "\n", encoding="utf-8")
