"""Benchmarks, training programs and tools find what they import."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
FOLDERS = ("benchmarks", "benchmarks/scenemi", "training", "tools")
OPTIONAL = {"pycolmap", "bpy"}
"""Libraries that single benchmarks ask their users to install."""
IMPORT_ALL = """
import importlib, pathlib, sys
sys.path.insert(0, sys.argv[1])
for path in sorted(pathlib.Path(sys.argv[1]).glob("*.py")):
    try:
        importlib.import_module(path.stem)
    except ImportError as error:
        print(path, error.name, error, sep="|")
"""


@pytest.mark.parametrize("folder", FOLDERS)
def test_every_program_finds_what_it_imports(folder: str) -> None:
    words = [sys.executable, "-B", "-c", IMPORT_ALL, folder]
    done = subprocess.run(words, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    missing = [line.split("|") for line in done.stdout.splitlines()]
    assert [parts for parts in missing if parts[1] not in OPTIONAL] == []
