"""Measurements of a body for inverse kinematics: lengths, soles, hands, masses, and vertices that test surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from video2anim.body.shaped_body import ShapedBody
from video2anim.lab.synth.acting.curves import axis_rotation
from video2anim.types.skeleton import JOINT_INDEX

LEG = tuple(tuple(JOINT_INDEX[f"{side}_{n}"] for n in ("hip", "knee", "ankle", "foot")) for side in ("left", "right"))
"""Hip, knee, ankle, foot of the left and the right leg."""
ARM = tuple(
    tuple(JOINT_INDEX[f"{side}_{n}"] for n in ("collar", "shoulder", "elbow", "wrist")) for side in ("left", "right")
)
"""Collar, shoulder, elbow, wrist of the left and the right arm."""

_MASS = {
    "pelvis": 0.07, "spine1": 0.09, "spine2": 0.11, "spine3": 0.165, "head": 0.069,
    "left_hip": 0.08, "right_hip": 0.08, "left_knee": 0.082, "right_knee": 0.082,
    "left_ankle": 0.0275, "right_ankle": 0.0275, "left_foot": 0.009, "right_foot": 0.009,
    "left_shoulder": 0.016, "right_shoulder": 0.016, "left_elbow": 0.02, "right_elbow": 0.02,
    "left_wrist": 0.0134, "right_wrist": 0.0134,
}  # fmt: skip
"""Share of the body's mass at each joint: segment masses of de Leva (1996), split between the ends of each segment."""
_NOMINAL_LEG_M = 0.838
"""Thigh plus shin of the body model's average adult."""
_PROBE_STRIDE = 5
SINK_ANGLES_RAD = np.linspace(0.0, 0.85, 9)


@dataclass(frozen=True, slots=True, eq=False)
class BodyMeasure:
    """Lengths in meters. Index 0 is left, 1 is right."""

    body: ShapedBody
    rest_m: Float[np.ndarray, "22 3"]
    thigh_m: float
    shin_m: float
    ankle_height_m: float
    """Height of the ankle above the sole of a flat foot."""
    ball_m: Float[np.ndarray, "2 3"]
    """Foot joint (ball of the foot) relative to the ankle; foot flat, pointing to +Z."""
    heel_m: Float[np.ndarray, "3"]
    """Rear end of the sole relative to the ankle (same for both feet)."""
    toe_m: Float[np.ndarray, "3"]
    """Tip of the toe on the sole, relative to the foot joint."""
    hand_below_m: float
    """Distance of the hand's surface below the wrist when the palm lies flat."""
    sink_m: Float[np.ndarray, "2 angles"]
    """Depth of the skin below the sole when a foot rolls over its ball, at `SINK_ANGLES_RAD`."""
    mass: Float[np.ndarray, "22"]
    probe: Int[np.ndarray, "probes"]
    """Vertices that are tested against furniture."""
    probe_part: Int[np.ndarray, "probes"]

    @property
    def leg_m(self) -> float:
        return self.thigh_m + self.shin_m

    @property
    def scale(self) -> float:
        """Leg length relative to an average adult."""
        return self.leg_m / _NOMINAL_LEG_M

    @property
    def hip_drop_m(self) -> float:
        """Distance of the hips below the pelvis joint."""
        return float(-self.rest_m[1:3, 1].mean())

    @property
    def stand_m(self) -> float:
        """Height of the pelvis above the floor with straight legs."""
        return self.leg_m + self.ankle_height_m + self.hip_drop_m

    @property
    def knee_height_m(self) -> float:
        return self.shin_m + self.ankle_height_m

    @property
    def arm_m(self) -> float:
        """Length from shoulder to wrist."""
        return float(np.linalg.norm(self.rest_m[20] - self.rest_m[16]))


def measure(body: ShapedBody) -> BodyMeasure:
    """Measures a body in its T-pose."""
    rest = body.rest_joints_m
    vertices = body.vertices(np.eye(3)[None, None].repeat(22, 1), rest[None])[0].astype(float)
    part = body.vertex_part
    feet = np.isin(part, (7, 10))
    sole_y, ankle = vertices[feet, 1].min(), rest[7]
    heel_z = vertices[feet, 2].min() - ankle[2]
    toe_z = vertices[feet, 2].max() - rest[10, 2]
    hands = np.isin(part, (20, 21))
    mass = np.zeros(22)
    for name, share in _MASS.items():
        mass[JOINT_INDEX[name]] = share
    index = np.unique(np.concatenate([np.arange(0, len(part), _PROBE_STRIDE), _extremes(vertices, part)]))
    return BodyMeasure(
        body,
        rest,
        float(np.linalg.norm(rest[4] - rest[1])),
        float(np.linalg.norm(rest[7] - rest[4])),
        float(ankle[1] - sole_y),
        np.stack([rest[10] - rest[7], rest[11] - rest[8]]),
        np.array([0.0, sole_y - ankle[1], 0.8 * heel_z]),
        np.array([0.0, sole_y - rest[10, 1], 0.9 * toe_z]),
        float(rest[20, 1] - vertices[hands, 1].min()),
        _sinks(body, rest, sole_y),
        mass / mass.sum(),
        index,
        part[index],
    )


def _sinks(body: ShapedBody, rest: np.ndarray, sole_y: float) -> Float[np.ndarray, "2 angles"]:
    """Depth of each foot's skin below the sole when the heel rises about the foot joint and the toes stay flat."""
    count, out = len(SINK_ANGLES_RAD), []
    for ankle, foot in ((7, 10), (8, 11)):
        R = np.broadcast_to(np.eye(3), (count, 22, 3, 3)).copy()
        R[:, ankle] = axis_rotation(0, SINK_ANGLES_RAD)
        joints = np.broadcast_to(rest, (count, 22, 3)).copy()
        joints[:, ankle] = rest[foot] + R[:, ankle] @ (rest[ankle] - rest[foot])
        skin = np.flatnonzero(np.isin(body.vertex_part, (ankle, foot)))
        out.append(np.maximum(sole_y - body.vertices(R, joints, skin)[..., 1].min(1), 0.0))
    return np.array(out)


def _extremes(vertices: np.ndarray, part: np.ndarray) -> Int[np.ndarray, "chosen"]:
    """The outermost vertices of every part in 26 directions."""
    grid = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)])
    directions = grid / np.linalg.norm(grid, axis=1, keepdims=True)
    chosen = []
    for joint in range(22):
        own = np.flatnonzero(part == joint)
        if len(own):
            chosen.append(own[np.unique((vertices[own] @ directions.T).argmax(0))])
    return np.concatenate(chosen)
