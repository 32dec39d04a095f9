"""Losses and validation measures of the scene network."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from video2anim.lab.scene_network.network import RoomAnswer
from video2anim.lab.scene_network.samples import PictureBatch

LOG_SIGMA_RANGE = (-5.0, 0.5)
"""Predicted errors of the camera head are clamped to this range (log radians)."""
NEAREST_INVERSE = 1 / 50
"""Lower limit of inverse depths in 1/m, that is, 50 m."""


def losses(answer: RoomAnswer, batch: PictureBatch) -> dict[str, Tensor]:
    """Weighted loss terms by name, each about 1 for an untrained network."""
    seen = (batch.normal.abs().sum(1) > 0).float()
    disparity = disparity_loss(answer.disparity[:, 0], batch.disparity)
    normal = functional.normalize(answer.normal, dim=1)
    flat = ((1 - (normal * batch.normal).sum(1)) * seen).sum() / seen.sum().clamp_min(1)
    heat, offset, boundary = answer.instance[:, 0], answer.instance[:, 1:3], answer.instance[:, 3]
    known = batch.has_offset
    off = ((offset - batch.offset).abs().sum(1) * known).sum() / known.sum().clamp_min(1)
    center = functional.binary_cross_entropy_with_logits(heat, batch.heat, weight=1 + 8 * batch.heat)
    edge = functional.binary_cross_entropy_with_logits(boundary, batch.boundary, pos_weight=boundary.new_tensor(3.0))
    up = functional.normalize(answer.camera[:, :2], dim=1)
    turned = torch.atan2(
        up[:, 0] * batch.up[:, 1] - up[:, 1] * batch.up[:, 0], (up * batch.up).sum(1).clamp(-1 + 1e-6, 1)
    ).abs()
    off_latitude = (answer.camera[:, 2] - batch.latitude).abs()
    sigma = answer.camera[:, 3:5].clamp(*LOG_SIGMA_RANGE)
    return {
        "disparity": 2.0 * disparity
        + relative_loss(answer.disparity[:, 0], batch.disparity)
        + distance_loss(answer.disparity[:, 0], batch.disparity, batch.instance),
        "normal": 1.0 * flat,
        "classes": 0.6 * functional.cross_entropy(answer.classes, batch.classes)
        + 0.5 * overlap_loss(answer.classes, batch.classes),
        "middle": 3.0 * center,
        "offset": 2.0 * off,
        "boundary": 0.3 * edge,
        # Laplace likelihood of the predicted error.
        "up": 0.15 * (turned * torch.exp(-sigma[:, 0]) + sigma[:, 0]).mean() + 4.0 * turned.mean(),
        "latitude": 0.15 * (off_latitude * torch.exp(-sigma[:, 1]) + sigma[:, 1]).mean() + 6.0 * off_latitude.mean(),
    }


def aligned(disparity: Tensor, truth: Tensor) -> Tensor:
    """Disparity after a least-squares fit of scale and offset to the truth, per image."""
    x, y = disparity.flatten(1), truth.flatten(1)
    mean_x, mean_y = x.mean(1, keepdim=True), y.mean(1, keepdim=True)
    scale = ((x - mean_x) * (y - mean_y)).mean(1, keepdim=True) / ((x - mean_x) ** 2).mean(1, keepdim=True).clamp_min(
        1e-6
    )
    return (mean_y + scale * (x - mean_x)).reshape(disparity.shape)


def disparity_loss(disparity: Tensor, truth: Tensor) -> Tensor:
    """Error against the truth normalized to median 0 and mean deviation 1, plus gradient matching at four scales.

    The scale- and shift-invariant loss of Ranftl et al. (2022), except that the target is normalized and not the
    output, because the alignment of an untrained output has no useful gradient. A second term, after alignment,
    tolerates small errors of scale and offset.
    """
    median = truth.flatten(1).median(1).values[:, None, None]
    goal = (truth - median) / (truth - median).abs().mean((1, 2), keepdim=True).clamp_min(1e-3)
    off = disparity - goal
    total = 0.5 * off.abs().mean()
    with torch.no_grad():
        factor = (aligned(disparity, goal) - goal.mean((1, 2), keepdim=True)).std((1, 2), keepdim=True)
        factor = (factor / disparity.std((1, 2), keepdim=True).clamp_min(1e-2)).clamp(0.5, 2.0)
        offset = (goal - factor * disparity).mean((1, 2), keepdim=True)
    total = total + 0.5 * (factor * disparity + offset - goal).abs().mean()
    for level in range(4):
        part = off[:, :: 2**level, :: 2**level]
        total = total + 0.25 * (part.diff(dim=1).abs().mean() + part.diff(dim=2).abs().mean())
    return total


def relative_loss(disparity: Tensor, truth: Tensor) -> Tensor:
    """Mean absolute error of log depth after alignment; it weights errors relative to depth, as AbsRel does."""
    seen = (truth > 0).float()
    near = aligned(disparity, truth).clamp_min(NEAREST_INVERSE)
    off = (near.log() - truth.clamp_min(NEAREST_INVERSE).log()).abs().clamp_max(1.0)
    return (off * seen).sum() / seen.sum().clamp_min(1)


def distance_loss(disparity: Tensor, truth: Tensor, instance: Tensor) -> Tensor:
    """Mean absolute error, after alignment, of the mean log depth of each piece of furniture.

    Where an object stands is what a scene is made of; errors within it matter less.

    Args:
        disparity: (batch, rows, columns), up to scale and offset per image.
        truth: 1 / depth in 1/m, 0 for the sky.
        instance: Numbers of pieces from 1 in each image, 0 elsewhere.
    """
    near = aligned(disparity, truth).clamp_min(NEAREST_INVERSE)
    off = (near.log() - truth.clamp_min(NEAREST_INVERSE).log()).clamp(-1.0, 1.0) * (truth > 0)
    index = instance.flatten(1)
    empty = off.new_zeros(len(off), int(instance.max()) + 1)
    area = empty.scatter_add(1, index, torch.ones_like(off).flatten(1))[:, 1:]
    mean = empty.scatter_add(1, index, off.flatten(1))[:, 1:] / area.clamp_min(1)
    return (mean.abs() * (area > 0)).sum() / (area > 0).sum().clamp_min(1)


def overlap_loss(logits: Tensor, classes: Tensor) -> Tensor:
    """Mean of 1 - Dice over the classes in an image (Milletari et al. 2016); small and large areas weigh the same."""
    share = logits.softmax(1).flatten(2)
    true = functional.one_hot(classes, logits.shape[1]).permute(0, 3, 1, 2).flatten(2).float()
    dice = 2 * (share * true).sum(2) / (share.sum(2) + true.sum(2)).clamp_min(1)
    shown = (true.sum(2) > 0).float()
    return ((1 - dice) * shown).sum() / shown.sum()


@torch.no_grad()
def measures(answer: RoomAnswer, batch: PictureBatch) -> dict[str, float]:
    """Validation measures by name: AbsRel and delta1 of depth, errors in degrees of normals and camera fields, IoU."""
    truth = batch.disparity
    near = aligned(answer.disparity[:, 0], truth)
    seen = truth > 0
    depth, true_depth = 1 / near.clamp_min(NEAREST_INVERSE), 1 / truth.clamp_min(NEAREST_INVERSE)
    ratio = torch.maximum(depth / true_depth, true_depth / depth)[seen]
    normal = functional.normalize(answer.normal, dim=1)
    turned = torch.arccos((normal * batch.normal).sum(1).clamp(-1, 1))[seen].rad2deg()
    up = functional.normalize(answer.camera[:, :2], dim=1)
    up_off = torch.arccos((up * batch.up).sum(1).clamp(-1, 1)).rad2deg()
    classes = answer.classes.argmax(1)
    scores = {}
    for name, number in (("floor", 1), ("furniture", 4), ("person", 5)):
        mine, theirs = classes == number, batch.classes == number
        either = int((mine | theirs).sum())
        scores[f"iou_{name}"] = float((mine & theirs).sum()) / either if either else 1.0
    return {
        "absrel": float(((depth - true_depth).abs() / true_depth)[seen].mean()),
        "delta1": float((ratio < 1.25).float().mean()),
        "normal_deg": float(turned.mean()),
        "up_deg": float(up_off.mean()),
        "latitude_deg": float((answer.camera[:, 2] - batch.latitude).abs().mean().rad2deg()),
        **scores,
    }
