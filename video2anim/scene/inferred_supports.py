"""Evidence of the motion on the scene: objects that people walk through, and supports that are missing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from video2anim.body.anny_body import shaped_body
from video2anim.body.contact import REACH_M
from video2anim.geometry.scene_mesh import world_mesh
from video2anim.geometry.sdf import build_sdf_grid
from video2anim.scene.free_space import path_length_inside_m
from video2anim.scene.supports import MIN_FRAMES, SUPPORT, Support, rested_places, standing_solid
from video2anim.types import BodyTracks, PlacedObject

_LOW_M = 0.3
"""Heights of single contacts are uncertain by several centimeters, so lower supports are not inferred..."""
_HEIGHT_SIGMA = 0.022
"""...nor those within three standard deviations of the error of distances. It is a share of the camera's height: root
mean square of 13 contacts of feet with level ground, seen from 7 m above (two pieces of OpenCV's `vtest.avi`)."""


def rested_on(bodies: BodyTracks) -> list[tuple[int, Support]]:
    """Surfaces that parts of people rested on, with the person's number."""
    return [(one.person_id, found) for one in bodies.people for found in rested_places(one, shaped_body(one.shape))]


def without_walked_through(
    objects: Sequence[PlacedObject],
    rested: list[tuple[int, Support]],
    bodies: BodyTracks,
    spacing_m: float,
    max_path_m: float,
) -> tuple[list[PlacedObject], list[str]]:
    """Objects without those that somebody walks through and nobody rests on, and a warning for each of these: their
    place is wrong.

    Args:
        rested: By `rested_on`.
        spacing_m: Of the distance field that paths are measured in, at least.
        max_path_m: Longest path of a pelvis inside an object.
    """

    kept: list[PlacedObject] = []
    warnings: list[str] = []
    for item in objects:
        solid = world_mesh(item.mesh, item.T_world_object, item.scale)
        bounds_m = np.stack([solid.vertices_m.min(0) - 0.2, solid.vertices_m.max(0) + 0.2])
        node_m = max(spacing_m, float(np.ptp(bounds_m, axis=0).max()) / 60)
        field = build_sdf_grid([solid], bounds_m, node_m, floor_y_m=None)
        walked_m = max(path_length_inside_m(field, motion) for motion in bodies.people)
        near = [support.gaps_m([solid], reach_m=2 * REACH_M) for _, support in rested if support.top_m > _LOW_M]
        used = any((gap_m < REACH_M).sum() >= MIN_FRAMES for gap_m in near)
        if used or walked_m <= max_path_m:
            kept.append(item)
            continue
        warnings.append(
            f"object {item.object_id} ({item.label}) is left out: somebody walks {walked_m:.1f} m inside it, so its "
            "place is wrong"
        )
    return kept, warnings


def inferred_supports(
    objects: Sequence[PlacedObject], rested: list[tuple[int, Support]], bodies: BodyTracks, last_id: int
) -> tuple[list[PlacedObject], list[str]]:
    """A solid for every place where a part that carries the body rested far from objects and floor and through which
    nobody passes, and a warning for each such place. Their numbers follow `last_id`."""

    people = [(motion, shaped_body(motion.shape)) for motion in bodies.people]
    number = last_id
    low_m = max(_LOW_M, 3 * _HEIGHT_SIGMA * float(bodies.main_view.T_world_camera[1, 3]))
    made: list[PlacedObject] = []
    warnings: list[str] = []
    for person, support in rested:
        solids = [world_mesh(item.mesh, item.T_world_object, item.scale) for item in (*objects, *made)]
        far = int((support.gaps_m(solids, reach_m=2 * REACH_M) > REACH_M).sum())
        if far < MIN_FRAMES or not support.carries or support.top_m < low_m:
            continue
        told = f"the {support.kind} of person {person} rested in {far} frames at {support.top_m:.2f} m"
        solid = standing_solid(support, people)
        if solid is None:
            warnings.append(f"{told} with no surface near, but bodies pass through that place: no support is inferred")
            continue
        number += 1
        made.append(PlacedObject(number, SUPPORT, solid[0], 1.0, solid[1], None, None, True, f"inferred: {told}"))
        warnings.append(f"a support is inferred: {told} with no surface near; its extent is unknown")
    return made, warnings
