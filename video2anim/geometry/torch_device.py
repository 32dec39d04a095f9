"""The device that PyTorch computes on."""

from __future__ import annotations

from video2anim.errors import UsageError


def device_of(wanted: str) -> str:
    """`cpu` or `cuda` from what a command line wants.

    Args:
        wanted: auto, cpu or cuda.

    Raises:
        UsageError: another word, or no CUDA device.
    """
    if wanted not in ("auto", "cpu", "cuda"):
        raise UsageError(f"--device: want auto, cpu or cuda, got {wanted!r}")
    if wanted == "cpu":
        return "cpu"
    import torch

    if torch.cuda.is_available():
        return "cuda"
    if wanted == "cuda":
        raise UsageError("--device: want cuda, but this PyTorch sees no CUDA device; use --device cpu")
    return "cpu"
