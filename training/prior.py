"""Trains the package's networks in one run that can be stopped and continued at any time.

    python training/prior.py run --motion DIR [--minutes 30] [--threads 1]     in the foreground
    python training/prior.py start --motion DIR [...]                          the same in the background
    python training/prior.py progress                                          one line on each network
    python training/prior.py stop
    python training/prior.py weights --motion DIR --cool 2000 --out FILE       averaged weights of the prior (fp16)

The prior (`scenemi train`) and the temporal lifter (`training/lifter.py run`) take turns, with two thirds of the time
for the prior, until the lifter stops improving. State is in the user's cache and written atomically. Motion is the
freely licensed part of `DIR` (`split.json`, `*.npz`) and procedural clips (`acted.npz` in the cache).
"""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import IO

from video2anim.networks.fetch import cache_dir

ARCHIVES = ("cmu.npz", "deepmimic.npz", "more.npz")
PROCEDURAL, PROCEDURAL_SEED = 600, 50
PRIOR_MINUTES, LIFTER_MINUTES = 20.0, 10.0
ERROR_WINDOWS = 100
"""Number of windows with errors of the pipeline, measured after the prior's first turn; about 5 s per window."""
LIFTER_PATIENCE_HOURS = 2.0
"""Training time of the lifter without a better validation after which it gets no more turns."""
REPOSITORY = Path(__file__).resolve().parents[1]


def cache() -> Path:
    """Folder with the state of the run."""
    return cache_dir() / "training"


def errors_path() -> Path:
    """File with the errors of the video pipeline (`training/pipeline_errors.py`)."""
    return cache() / "pipeline_errors.npz"


def main() -> None:
    """Run one of the five commands."""
    options = arguments()
    cache().mkdir(parents=True, exist_ok=True)
    match options.command:
        case "run":
            run(options)
        case "start":
            start()
        case "stop":
            stop()
        case "progress":
            sys.stdout.write(progress() + "\n")
        case _:
            held = locked()
            words = ["--minutes", "0.01", "--cool-steps", str(options.cool)]
            subprocess.run(prior_command(options, *words), check=True, env=environment(options))
            shutil.copyfile(cache() / "prior" / "weights.safetensors", options.out)
            held.close()


def run(options: argparse.Namespace) -> None:
    """Alternate between the two trainings until the time is over."""
    _held = locked()
    (cache() / "pid").write_text(str(os.getpid()))
    os.nice(10)
    until = time.monotonic() + 60 * (options.minutes or 1e9)
    if not (cache() / "acted.npz").is_file():
        words = ["synth", "--motion-only", "--count", str(PROCEDURAL), "--seed", str(PROCEDURAL_SEED)]
        command = [sys.executable, "-m", "video2anim.cli.main", *words, "--out", str(cache() / "acted.npz")]
        turn(command, options)
    while (left := (until - time.monotonic()) / 60) > 0.05:
        turn(prior_command(options, "--minutes", f"{min(PRIOR_MINUTES, left):.2f}"), options)
        left = (until - time.monotonic()) / 60
        if left > 0.05 and not errors_path().is_file():
            words = ["--motion", str(options.motion), "--windows", str(ERROR_WINDOWS), "--out", str(errors_path())]
            words += ["--cache", str(cache() / "lifter")]
            turn([sys.executable, str(REPOSITORY / "training" / "pipeline_errors.py"), *words], options)
            left = (until - time.monotonic()) / 60
        if left > 0.05 and lifter_improves():
            words = ["run", "--motion", str(options.motion), "--minutes", f"{min(LIFTER_MINUTES, left):.2f}"]
            words += ["--threads", str(options.threads), "--cache", str(cache() / "lifter")]
            turn([sys.executable, str(REPOSITORY / "training" / "lifter.py"), *words], options)


def locked() -> IO[str]:
    """The lock file that a run holds until its process ends."""
    lock = (cache() / "lock").open("a")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        raise SystemExit("training/prior.py: a run is under way already; see `progress`, or `stop` it") from None
    return lock


def turn(command: list[str], options: argparse.Namespace) -> None:
    """Run one command. The run ends if the command fails, and stops the command if it is stopped itself."""
    with (cache() / "log.txt").open("a") as log:
        child = subprocess.Popen(command, stdout=log, stderr=log, env=environment(options))

        def end(*_: object) -> None:
            child.terminate()
            raise SystemExit(0)

        signal.signal(signal.SIGTERM, end)
        signal.signal(signal.SIGINT, end)
        if child.wait() != 0:
            raise SystemExit(f"training/prior.py: {command[1:4]} failed, see {cache() / 'log.txt'}")


def prior_command(options: argparse.Namespace, *words: str) -> list[str]:
    """`scenemi train` on the free archives and the procedural clips."""
    command = [sys.executable, "-m", "scenemi.cli.main", "train", "--split", str(options.motion / "split.json")]
    for path in (*(options.motion / name for name in ARCHIVES), cache() / "acted.npz"):
        command += ["--motion", str(path)]
    if errors_path().is_file():
        command += ["--errors", str(errors_path())]
    shipped = REPOSITORY / "scenemi" / "weights" / "small.safetensors"
    return [
        *command, "--out", str(cache() / "prior"), "--cache", str(cache() / "motion"), "--start", str(shipped), *words
    ]  # fmt: skip


def environment(options: argparse.Namespace) -> dict[str, str]:
    """Environment of the child processes: number of threads, and idle threads that sleep."""
    return {**os.environ, "OMP_NUM_THREADS": str(options.threads), "OMP_WAIT_POLICY": "passive"}


def lifter_improves() -> bool:
    """Whether the validation of the lifter still improves."""
    try:
        state = json.loads((cache() / "lifter" / "progress.json").read_text())
        return state["hours"] - state["improved_at_hours"] < LIFTER_PATIENCE_HOURS
    except (OSError, ValueError, KeyError):
        return True


def start() -> None:
    """Start `run` in the background with the options of this command."""
    words = [sys.executable, __file__, "run", *sys.argv[2:]]
    log = (cache() / "log.txt").open("a")
    subprocess.Popen(words, stdout=log, stderr=log, stdin=subprocess.DEVNULL, start_new_session=True)
    sys.stdout.write(f"started; progress: python {sys.argv[0]} progress; log: {cache() / 'log.txt'}\n")


def stop() -> None:
    """Stop the run, which saves its state."""
    lock = (cache() / "lock").open("a")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        pass  # held by a run
    else:
        raise SystemExit("training/prior.py: no run is under way")
    try:
        os.kill(int((cache() / "pid").read_text()), signal.SIGTERM)
    except (OSError, ValueError):
        raise SystemExit("training/prior.py: no run is under way") from None


def progress() -> str:
    """Steps, windows, hours, last and best numbers of each network, as text."""
    lines = []
    for name in ("prior", "lifter"):
        try:
            state = json.loads((cache() / name / "progress.json").read_text())
        except (OSError, ValueError):
            lines.append(f"{name}: not begun")
            continue
        rows = state.get("validation", {})
        if isinstance(rows, list):
            rows = {
                f"r{row['interval']}{'s' if row['scene'] else ''}": f"{row['mjpe_ratio']:.3f}"
                + (f"/{row['inside']:.3f}" if row["inside"] == row["inside"] else "")
                for row in rows
            }
        rest = ", ".join(f"{key} {value}" for key, value in rows.items())
        lines.append(
            f"{name}: {state.get('windows', 0)} windows, {state['hours']:.2f} h, {state.get('date', '')}; {rest}"
        )
    return "\n".join(lines)


def arguments() -> argparse.Namespace:
    """Options of the commands."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    of = {name: commands.add_parser(name) for name in ("run", "start", "stop", "progress", "weights")}
    for name in ("run", "start", "weights"):
        of[name].add_argument("--motion", type=Path, required=True)
        of[name].add_argument("--threads", type=int, default=1)
    for name in ("run", "start"):
        of[name].add_argument("--minutes", type=float)
    of["weights"].add_argument("--cool", type=int, default=2000)
    of["weights"].add_argument("--out", type=Path, required=True)
    return parser.parse_args()


if __name__ == "__main__":
    main()
