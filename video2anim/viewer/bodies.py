"""Skinned bodies over time, for drawing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float, UInt8

from video2anim.body.anny_body import shaped_body
from video2anim.body.shaped_body import CHUNK_FRAMES, ShapedBody
from video2anim.scene.contact_graph import BODY_PARTS
from video2anim.types import BodyMotion, Contact
from video2anim.types.skeleton import forward_kinematics
from video2anim.viewer.contacts import contacts_at, touched_rgb
from video2anim.viewer.drawing import draw_body
from video2anim.viewer.raster import Canvas
from video2anim.viewer.viewpoint import Viewpoint

PERSON_RGB = ((214, 164, 134), (134, 176, 214), (168, 206, 140), (206, 150, 200))
UNMEASURED_RGB = (160, 160, 160)
"""Bodies at frames without a measurement are gray."""
CONTACT_RGB = (205, 48, 38)
"""Parts of the body in contact (probability 1)."""


class PosedBodies:
    """Skinned meshes of all people, made a few frames at a time."""

    def __init__(self, people: tuple[BodyMotion, ...], contacts: Sequence[Contact] = ()) -> None:
        self.people = people
        self.contacts = contacts
        self.bodies: tuple[ShapedBody, ...] = tuple(shaped_body(motion.shape) for motion in people)

    def frames(self, start: int, stop: int) -> Iterator[tuple[Float[np.ndarray, "vertices 3"], ...]]:
        """World vertices of every person at frames start..stop-1."""
        for first in range(start, stop, CHUNK_FRAMES):
            chunk = slice(first, min(first + CHUNK_FRAMES, stop))
            meshes = []
            for motion, body in zip(self.people, self.bodies, strict=True):
                joints_m, R_world_joint = forward_kinematics(
                    motion.R_parent_joint[chunk], motion.T_world_root[chunk, :3, 3], motion.rest_joints_m
                )
                meshes.append(body.vertices(R_world_joint, joints_m))
            yield from zip(*meshes, strict=True)

    def colors(self, person: int, frame: int) -> UInt8[np.ndarray, "vertices 3"]:
        """Color of each vertex: the person's own, red towards where the body probably touches something, gray where
        the frame was not measured; parts whose contacts are known in the color of what they touch."""
        motion, body = self.people[person], self.bodies[person]
        own = PERSON_RGB[person % len(PERSON_RGB)] if motion.valid[frame] else UNMEASURED_RGB
        touches = np.clip(motion.contact[frame], 0.0, 1.0)[body.vertex_part, None]
        rgb = np.rint((1.0 - touches) * np.array(own) + touches * np.array(CONTACT_RGB)).astype(np.uint8)
        for contact in contacts_at(self.contacts, motion.person_id, float(motion.frame_time_s[frame])):
            rgb[np.isin(body.vertex_part, BODY_PARTS[contact.body_part])] = touched_rgb(contact.object_id)
        return rgb

    def present(self, frame: int) -> tuple[int, ...]:
        """Numbers of the people between their first and last measured frame: before and after, poses are repeated."""
        valid = [motion.valid for motion in self.people]
        return tuple(k for k, seen in enumerate(valid) if seen[: frame + 1].any() and seen[frame:].any())

    def draw(
        self,
        canvas: Canvas,
        viewpoint: Viewpoint,
        meshes: tuple[np.ndarray, ...],
        frame: int,
        people: Sequence[int] | None = None,
    ) -> None:
        """Draw some people (None: all) at one frame."""
        for person in range(len(self.people)) if people is None else people:
            draw_body(canvas, viewpoint, meshes[person], self.bodies[person].faces, self.colors(person, frame))
