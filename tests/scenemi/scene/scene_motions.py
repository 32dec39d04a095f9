"""Motions in their canonical frame with the skin of the body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scenemi.scene.basis_points import anchor_vertices
from video2anim.body.shaped_body import ShapedBody
from video2anim.lab.synth.acting import act
from video2anim.types.skeleton import forward_kinematics

FRAMES = 121


@dataclass(frozen=True)
class Window:
    """A motion in its canonical frame."""

    body: ShapedBody
    joints_m: np.ndarray
    R_world_joint: np.ndarray
    anchors_m: np.ndarray
    contact: np.ndarray

    def skin_m(self, every: int = 6) -> np.ndarray:
        return self.body.vertices(self.R_world_joint[::every], self.joints_m[::every])


def canonical(body: ShapedBody, R_parent_joint: np.ndarray, translation_m: np.ndarray, contact: np.ndarray) -> Window:
    joints_m, R_world = forward_kinematics(R_parent_joint, translation_m, body.rest_joints_m)
    facing = R_world[0, 0, :, 2]
    cos, sin = facing[[2, 0]] / np.hypot(facing[0], facing[2])
    turn = np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])
    joints_m, R_world = (joints_m - joints_m[0, 0] * [1, 0, 1]) @ turn.T, turn @ R_world
    return Window(body, joints_m, R_world, body.vertices(R_world, joints_m, anchor_vertices(body)), contact)


def procedural_window(kind: str, body: ShapedBody, seed: int) -> Window:
    """The part of a procedural motion around its first rest."""
    motion = act(kind, body, np.random.default_rng(seed))
    rests = np.flatnonzero(motion.contact[:, [0, 20, 21]].any(axis=1))
    start = int(np.clip(rests[0] - 50 if len(rests) else 60, 0, len(motion.contact) - FRAMES))
    cut = slice(start, start + FRAMES)
    return canonical(body, motion.R_parent_joint[cut], motion.translation_m[cut], motion.contact[cut])
