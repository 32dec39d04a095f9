"""The paper's descriptors (3.1) of training scenes: occupancy around the first frame, offsets at points of skin."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from scenemi.features import decode
from scenemi.model.conditions import Descriptors
from scenemi.model.config import PaperConfig
from scenemi.scene.basis_points import anchor_vertices, shortened
from scenemi.scene.voxels import GridSpec
from scenemi.training.batches import Batch
from video2anim.body.shaped_body import ShapedBody
from video2anim.types.skeleton import forward_kinematics


def descriptors_of(
    batch: Batch, keys: Float[Tensor, "batch frames 201"], bodies: Sequence[ShapedBody], config: PaperConfig
) -> Descriptors | None:
    """Of the windows that are shown their scene; None where no window is.

    Args:
        batch: windows with their solids.
        keys: keyframes with their noise, not normalized: anchors lie on the skin as it is given.
        bodies: that `batch.body` numbers.
        config: of the denoiser.
    """
    shown = torch.nonzero((batch.scene_known > 0) | (batch.local_known > 0))[:, 0].tolist()
    if not shown:
        return None
    grid = GridSpec(config.grid, config.voxel_m)
    occupancy = np.zeros((len(batch.mask), *config.grid), np.float32)
    local_m = np.zeros((*batch.mask.shape, config.bps_anchors, 3), np.float32)
    for i in shown:
        occupancy[i] = batch.scene.occupancy(i, grid)
        if not config.use_local:
            continue
        given, body = (batch.mask[i] > 0).cpu().numpy(), bodies[int(batch.body[i])]
        R, translation_m = decode(keys[i].cpu().double().numpy()[given])
        joints_m, R_world = forward_kinematics(R, translation_m, body.rest_joints_m)
        anchors_m = body.vertices(R_world, joints_m, anchor_vertices(body, config.bps_anchors))
        local_m[i, given] = shortened(batch.scene.offsets(i, anchors_m.reshape(-1, 3)).reshape(anchors_m.shape))
    device = batch.mask.device
    return Descriptors(
        torch.from_numpy(occupancy).to(device), torch.from_numpy(local_m).to(device), batch.scene_known,
        batch.local_known,
    )  # fmt: skip
