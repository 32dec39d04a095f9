"""Gradients of batches in processes of their own: on a CPU, Python threads of one process wait for each other."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Sequence
from multiprocessing.connection import Connection

import torch
from torch import Tensor, multiprocessing

from scenemi.training.batches import Batch
from scenemi.training.losses import Losses, TrainingLoss
from video2anim.errors import StageError
from video2anim.geometry.torch_threads import one_thread


class Helpers:
    """Processes that hold the loss and share the weights of its denoiser. They end with this one."""

    def __init__(self, loss: TrainingLoss, count: int) -> None:
        self.loss = loss.share_memory()
        context = multiprocessing.get_context("spawn")
        self._helpers: list[tuple[Connection, list[Tensor]]] = []
        for _ in range(count):
            here, there = context.Pipe()
            grads = [torch.zeros_like(p).share_memory_() for p in learned(loss)]
            context.Process(target=_help, args=(there, loss, grads), daemon=True).start()
            there.close()
            self._helpers.append((here, grads))

    def of_batches(self, batches: Sequence[Batch]) -> list[tuple[Losses, list[Tensor | None]]]:
        """Losses and gradients of one batch more than there are helpers; the gradients hold until the next call.

        Raises:
            StageError: a helper has died.
        """
        for (pipe, _), batch in zip(self._helpers, batches[1:], strict=True):
            with contextlib.suppress(OSError):  # reported below
                pipe.send(batch)
        with one_thread():
            found = [gradients(self.loss, batches[0])]
        for pipe, grads in self._helpers:
            try:
                losses, told = pipe.recv()
            except (EOFError, OSError):
                raise StageError("training: a process beside this one has ended; start again, it goes on") from None
            found.append((losses, [grad if has else None for grad, has in zip(grads, told, strict=True)]))
        return found


def gradients(loss: TrainingLoss, batch: Batch) -> tuple[Losses, list[Tensor | None]]:
    """Losses of a batch, and of the total the gradients by `learned(loss)`; None where it does not depend on one."""
    losses: Losses = loss(batch)
    grads = torch.autograd.grad(losses.total, learned(loss), allow_unused=True)
    return Losses(*(getattr(losses, name).detach() for name in Losses.__slots__)), list(grads)


def learned(loss: TrainingLoss) -> list[Tensor]:
    """Parameters that training changes, in order."""
    return [p for p in loss.denoiser.parameters() if p.requires_grad]


def _help(pipe: Connection, loss: TrainingLoss, grads: list[Tensor]) -> None:
    """Answer batches until the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    while True:
        try:
            batch: Batch = pipe.recv()
        except (EOFError, OSError):
            return
        losses, made = gradients(loss, batch)
        for held, grad in zip(grads, made, strict=True):
            if grad is not None:
                held.copy_(grad)
        pipe.send((losses, [grad is not None for grad in made]))
