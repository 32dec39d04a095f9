"""The command line as a user has it: in this process for speed, or as a process of its own."""

from __future__ import annotations

import contextlib
import io
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from video2anim.artifacts.folder import folder_digest

REPOSITORY = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Answer:
    """What a command said and how it ended."""

    code: int
    out: str
    err: str

    @property
    def states(self) -> dict[str, str]:
        """Stage -> state, from the table that `run`, `stage` and `status` print."""
        return dict(re.findall(r"^(\w+) +(cached|edited|ran|stale|missing)\b", self.out, re.MULTILINE))

    @property
    def errors(self) -> list[str]:
        """Lines on stderr that are neither progress, warnings, nor what is said of changed settings."""
        usual = re.compile(r"^(\w+ +[\d.]+ s|warning \w+: .*|changed: .*)$")
        return [line for line in self.err.splitlines() if line.strip() and not usual.match(line)]


def video2anim(*words: str | Path) -> Answer:
    """Run a command in this process."""
    from video2anim.cli import main

    out, err = io.StringIO(), io.StringIO()
    before, code = sys.argv, 0
    sys.argv = ["video2anim", *map(str, words)]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main.run()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(bool(end.code))
    finally:
        sys.argv = before
    return Answer(code, out.getvalue(), err.getvalue())


def command_line(*words: str | Path) -> tuple[list[str], dict[str, str]]:
    """Argument vector and environment of a command as a process."""
    # One thread: the same result whatever else the machine does, and faster where many tests share it.
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    return [sys.executable, "-m", "video2anim.cli.main", *map(str, words)], environment


def process(*words: str | Path, timeout_s: float = 400) -> Answer:
    """Run a command as a process of its own."""
    command, environment = command_line(*words)
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=timeout_s, check=False)
    return Answer(done.returncode, done.stdout, done.stderr)


def payload_digests(scene_dir: Path) -> dict[str, str]:
    """Digest of every stage's payload."""
    return {path.name: folder_digest(path) for path in sorted((scene_dir / "stages").iterdir())}
