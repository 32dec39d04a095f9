"""Errors a user can act on. Each carries the exit code that the command line documents.

A message says what was wanted, what came, where, and what to do, in one line.
"""

from __future__ import annotations


class Video2AnimError(Exception):
    """Root of all expected failures."""

    exit_code = 5


class UsageError(Video2AnimError):
    """A command, option or configuration value is wrong (exit code 2)."""

    exit_code = 2


class InputError(Video2AnimError):
    """The input file or the output folder cannot be used (exit code 3)."""

    exit_code = 3


class ModelMissingError(Video2AnimError):
    """Weights are absent, unreachable or fail their digest (exit code 4)."""

    exit_code = 4


class StageError(Video2AnimError):
    """A stage could not do its work on this input (exit code 5)."""

    exit_code = 5


class ArtifactError(Video2AnimError):
    """A stage folder is unreadable or incomplete (exit code 5)."""

    exit_code = 5
