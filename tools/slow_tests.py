"""Finds the tests that `make fast` leaves out: those with a long CPU time, including their share of fixtures.

This is a pytest plugin that measures CPU time, because wall time on a busy machine is unreliable:

    PYTHONPATH=. python -m pytest -q -n 2 --dist loadfile -p tools.slow_tests

The command writes `tests/slow_tests.txt` anew. With `--fast` only unlisted tests run, and slow ones are added.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

LISTED = Path(__file__).resolve().parents[1] / "tests" / "slow_tests.txt"
SLOW_S = 0.3
"""Limit for a test with all its cases. In 20 of 220 random test files, slower tests took 20 of 27 s (2026-11-25)."""


def cpu_s() -> float:
    """CPU time of this process and of its finished child processes, seconds."""
    return sum(os.times()[:4])


class Worker:
    """Measures the CPU time of each test and each shared fixture."""

    def __init__(self) -> None:
        self.since_s, self.fixtures_s = cpu_s(), dict[str, float]()

    def pytest_runtest_logstart(self) -> None:
        self.since_s = cpu_s()

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        before_s = cpu_s()
        try:
            return (yield)
        finally:
            if fixturedef.scope != "function":
                took_s = cpu_s() - before_s
                self.since_s += took_s
                self.fixtures_s[f"{fixturedef.baseid}::{fixturedef.argname}"] = took_s

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: Any) -> Iterator[None]:
        report: Any = yield
        now_s = cpu_s()
        own_s, self.since_s = now_s - self.since_s, now_s
        known = [fixtures[-1] for fixtures in item._fixtureinfo.name2fixturedefs.values() if fixtures]
        shared = [f"{fixture.baseid}::{fixture.argname}" for fixture in known if fixture.scope != "function"]
        report.user_properties = [("cpu", [own_s, shared, self.fixtures_s])]
        self.fixtures_s = {}
        return report


class Collector:
    """Sums the times that the workers report, and writes the list."""

    def __init__(self, *, keep: bool) -> None:
        self.keep = keep
        self.tests_s, self.fixtures_s = defaultdict[str, float](float), defaultdict[str, float](float)
        self.uses: dict[str, dict[str, None]] = {}

    def pytest_runtest_logreport(self, report: Any) -> None:
        for own_s, shared, fixtures_s in (value for key, value in report.user_properties if key == "cpu"):
            self.tests_s[report.nodeid] += own_s
            self.uses[report.nodeid] = dict.fromkeys(shared)
            for name, took_s in fixtures_s.items():
                self.fixtures_s[name] += took_s

    def pytest_sessionfinish(self) -> None:
        users = defaultdict[str, int](int)
        for used in self.uses.values():
            for name in used:
                users[name] += 1
        whole_s = defaultdict[str, float](float)
        for test, own_s in self.tests_s.items():
            shares_s = sum(self.fixtures_s[name] / users[name] for name in self.uses[test])
            whole_s[test.split("[")[0]] += own_s + shares_s
        lines = LISTED.read_text(encoding="utf-8").splitlines()
        slow = {name for name, took_s in whole_s.items() if took_s >= SLOW_S}
        slow |= {line for line in lines if self.keep and not line.startswith("#")}
        head = [line for line in lines if line.startswith("#")]
        LISTED.write_text("\n".join([*head, *sorted(slow)]) + "\n", encoding="utf-8")
        for name, took_s in sorted(whole_s.items(), key=lambda one: -one[1]):
            print(f"{took_s:8.2f} s  {name}")


def pytest_configure(config: pytest.Config) -> None:
    """Workers of pytest-xdist measure and their parent process collects; without xdist one process does both."""
    worker = hasattr(config, "workerinput")
    if worker or not config.getoption("numprocesses", 0):
        config.pluginmanager.register(Worker())
    if not worker:
        config.pluginmanager.register(Collector(keep=config.getoption("--fast")))
