"""Supports inferred from rests: places where a part of the body rested and the scene has no surface near."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from video2anim.body.anny_body import shaped_body
from video2anim.body.contact import LIKELY, NEAR_M, REACH_M, believed, posed_vertices, skin_of
from video2anim.body.shaped_body import ShapedBody
from video2anim.geometry.mesh_query import MeshQuery
from video2anim.geometry.runs import runs
from video2anim.geometry.scene_mesh import box_mesh, world_mesh
from video2anim.geometry.sdf import SdfGrid, build_sdf_grid
from video2anim.scene.free_space import passed_through
from video2anim.types.contact import RestedSkin
from video2anim.types.motion import BodyMotion, BodyTracks
from video2anim.types.scene import Mesh
from video2anim.types.skeleton import JOINT_INDEX, PARENTS, TOUCHING_PARTS, forward_kinematics

SUPPORT = "support"
"""Label of solids inferred from what rested on them."""
KINDS: dict[str, tuple[str, ...]] = {
    "seat": ("seat",), "back": ("back",), "left hand": ("left hand",), "right hand": ("right hand",),
    "feet": ("left foot", "right foot"),
}  # fmt: skip
"""Parts that may share a support."""
_FACING = {
    "seat": (0, -1, 0),
    "back": (0, 0, -1),
    "left hand": (0, -1, 0),
    "right hand": (0, -1, 0),
    "feet": (0, -1, 0),
}
"""Direction of the touching skin in the frame of the part's first joint; palms face down in the T-pose."""
LEVEL_COSINE = np.cos(np.deg2rad(45.0))
"""Surfaces whose normal is within this of the vertical are level."""
_LEVEL = ("seat", "feet")
"""Parts that rest on level surfaces whatever direction their skin faces."""
MIN_FRAMES = 8
"""Minimum duration of a rest (0.27 s)."""
_SAME_M = 0.1
"""Uncertainty of heights by one camera: rests this low are on the floor, and a part whose distance from a surface
differs from that of its rest by less may rest there without a contact."""
_LINK_M = 0.8
"""Rests within a stride of each other share a support..."""
_LINK_LEVEL_M = 2 * _SAME_M
"""...if their heights (along the normal of the surface) differ by less than the uncertainty of one camera."""
_MARGIN_M = 0.1
"""Margin of a support around the skin on it: a hand's width."""
_SLABS = ((0.1, _MARGIN_M), (0.1, 0.05), (0.05, 0.05))
"""Thickness and margin (m) of slabs, tested in order where a solid down to the floor is crossed by legs."""
_CROSSED_RATIO = 1.0
"""Maximum frames in which bodies pass through a support, over the frames of the rest."""
_CROSSED_M, _CROSSED_SHARE = 0.01, 0.002
"""A body passes through where this share of its skin (a hand's width of a calf) is this deep inside."""

_TOUCHING = ("left_wrist", "right_wrist", "left_foot", "right_foot")
_INNER = tuple(k for name, k in JOINT_INDEX.items() if name not in _TOUCHING)
"""Joints that are inside the body wherever it rests; wrists and balls of the feet are as near to objects as skin."""
_LIMB_M = 0.25
"""Joints in one cell of a grid of this width (a trunk's) count as one place of a body: they err together. Not
measured."""


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """A part that rested for a while."""

    frames: int
    normal: Float[np.ndarray, "3"]
    """Out of the surface, into the body."""
    level: bool
    patch_m: Float[np.ndarray, "points 3"]
    """Touching skin of all its frames."""
    nearest_m: Float[np.ndarray, "frames 3"]
    """Foremost skin point of each frame."""
    joint_m: Float[np.ndarray, "frames 3"]
    """The part's joint."""
    ahead: Float[np.ndarray, "frames 3"]
    """Unit direction in which the body looks from there."""

    @property
    def place_m(self) -> Float[np.ndarray, "3"]:
        return np.median(self.nearest_m, axis=0)


@dataclass(frozen=True, slots=True, eq=False)
class Support:
    """A surface on which a part of somebody rested."""

    kind: str
    T_world_top: Float[np.ndarray, "4 4"]
    """Frame at the middle of the touching skin; y points out of the surface."""
    size_m: Float[np.ndarray, "2"]
    """Extent of the touching skin along x and z of that frame."""
    level: bool
    nearest_m: Float[np.ndarray, "frames 3"]
    """Foremost skin point in each frame of its rests."""
    ahead: Float[np.ndarray, "frames 3"]
    """As of its rests."""
    over_m: float
    """Distance of the part's joint from the surface during the rests."""

    @property
    def top_m(self) -> float:
        return float(self.T_world_top[1, 3])

    @property
    def carries(self) -> bool:
        """Whether the body would fall without it. Hands are also still in the air, and backs that lean on nothing are
        upright."""
        return self.kind in _LEVEL or (self.kind == "back" and self.level)

    @property
    def footprint_m(self) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
        """Corners of a level support in world x and z, with a margin."""
        center, half = self.T_world_top[[0, 2], 3], 0.5 * self.size_m + _MARGIN_M
        return center - half, center + half

    def gaps_m(self, solids: Sequence[Mesh], *, reach_m: float) -> Float[np.ndarray, "frames"]:
        """Distance from the resting skin to the floor or the nearest solid within reach that may carry it."""
        bounds_m = np.stack([self.nearest_m.min(0) - reach_m, self.nearest_m.max(0) + reach_m])
        near = [
            one
            for one in solids
            if (one.vertices_m.min(0) < bounds_m[1]).all() and (one.vertices_m.max(0) > bounds_m[0]).all()
        ]
        near = [one for one in near if not self.level or self._is_over(one)]
        spacing_m = max(0.04, float(np.ptp(bounds_m, axis=0).max()) / 60)
        return build_sdf_grid(near, bounds_m, spacing_m, reach_m=reach_m).sample(self.nearest_m)

    def _is_over(self, solid: Mesh) -> bool:
        """Whether tops of a solid are near most of the time: what is level does not rest beside a solid."""
        triangles_m = solid.vertices_m[solid.faces]
        normal = np.cross(triangles_m[:, 1] - triangles_m[:, 0], triangles_m[:, 2] - triangles_m[:, 0])
        tops_m = triangles_m[normal[:, 1] > LEVEL_COSINE * np.linalg.norm(normal, axis=-1)]
        return float((MeshQuery.of(tops_m).nearest(self.nearest_m, REACH_M).face >= 0).mean()) > 0.5

    def solid(self, thickness_m: float, margin_m: float) -> tuple[Mesh, Float[np.ndarray, "4 4"]]:
        """A box with that top, resting on y = 0 of its own frame, and the pose of that frame in the world."""
        T_world_box = self.T_world_top.copy()
        T_world_box[:3, 3] -= thickness_m * T_world_box[:3, 1]
        width_m, depth_m = self.size_m + 2 * margin_m
        return box_mesh(float(width_m), thickness_m, float(depth_m)), T_world_box


def rested_places(motion: BodyMotion, body: ShapedBody) -> list[Support]:
    """Surfaces that parts of a person rested on, whether or not the scene has them; rests at one place are merged."""
    found = []
    contact = believed(motion, body)
    for kind, parts in KINDS.items():
        rests: list[Rest] = []
        for joints in (TOUCHING_PARTS[part] for part in parts):
            rests += _rests(motion, body, contact[:, list(joints)].max(1), kind, joints)
        found += [_support(kind, group) for group in _at_one_place(rests)]
    return found


def rested_and_inner_m(bodies: BodyTracks) -> tuple[RestedSkin, Float[np.ndarray, "inner 3"]]:
    """Skin of all people where it rested above the floor, and places inside their bodies, where no object can be."""
    rested = [RestedSkin.nothing()]
    for motion in bodies.people:
        for place in rested_places(motion, shaped_body(motion.shape)):
            high = place.nearest_m[:, 1] > _SAME_M
            count = int(high.sum())
            ahead = place.ahead[high] if place.kind == "seat" else np.zeros((count, 3))
            bears = np.full(count, place.kind in _LEVEL)
            rested.append(RestedSkin(place.nearest_m[high], np.full(count, len(rested)), bears, ahead))
    inner = [motion.joints_world_m[motion.valid][:, list(_INNER)].reshape(-1, 3) for motion in bodies.people]
    joints_m = np.concatenate([np.zeros((0, 3)), *inner])
    _, first = np.unique(np.floor(joints_m / _LIMB_M), axis=0, return_index=True)
    return RestedSkin.joined(rested), joints_m[first]


def standing_solid(
    support: Support, people: Sequence[tuple[BodyMotion, ShapedBody]]
) -> tuple[Mesh, Float[np.ndarray, "4 4"]] | None:
    """Solid and pose of a level support: down to the floor, else a slab; None where bodies pass through all of them.

    Args:
        people: everybody who may pass there.
    """
    for thickness_m, margin_m in ((support.top_m, _MARGIN_M), *_SLABS):
        mesh, T_world_box = support.solid(min(thickness_m, support.top_m), margin_m)
        solid = world_mesh(mesh, T_world_box, 1.0)
        bounds_m = np.stack([solid.vertices_m.min(0) - 0.1, solid.vertices_m.max(0) + 0.1])
        field = build_sdf_grid([solid], bounds_m, max(0.02, float(np.ptp(bounds_m, axis=0).max()) / 60), floor_y_m=None)
        crossed = sum(_crossed_frames(field, support, *one) for one in people)
        if crossed < _CROSSED_RATIO * len(support.nearest_m):
            return mesh, T_world_box
    return None


def _crossed_frames(solid: SdfGrid, support: Support, motion: BodyMotion, body: ShapedBody) -> int:
    """Frames in which somebody is inside, without the resting part and its neighbors while the part is as far from the
    surface as during its rest."""
    joints = [joint for part in KINDS[support.kind] for joint in TOUCHING_PARTS[part]]
    beside = [*joints, *PARENTS[joints].tolist(), *np.flatnonzero(np.isin(PARENTS, joints)).tolist()]
    normal, top_m = support.T_world_top[:3, 1], support.T_world_top[:3, 3]
    over_m = (motion.joints_world_m[:, joints[0]] - top_m) @ normal
    at_rest = np.abs(over_m - support.over_m) < _SAME_M
    inside = sum(
        passed_through(
            solid, replace(motion, valid=motion.valid & chosen), body,
            deep_m=_CROSSED_M, share=_CROSSED_SHARE, resting=resting,
        ).sum()
        for chosen, resting in ((at_rest, beside), (~at_rest, ()))
    )  # fmt: skip
    # Every second frame is tested.
    return 2 * int(inside)


def _rests(
    motion: BodyMotion, body: ShapedBody, contact: Float[np.ndarray, "frames"], kind: str, joints: tuple[int, ...]
) -> Iterator[Rest]:
    """Periods in which a part is in contact."""
    for start, stop in runs(contact > LIKELY):
        frames = np.arange(start, stop)
        if len(frames) < MIN_FRAMES:
            continue
        joints_m, R_world_joint = forward_kinematics(
            motion.R_parent_joint[frames], motion.T_world_root[frames, :3, 3], motion.rest_joints_m
        )
        facing = (R_world_joint[:, joints[0]] @ np.array(_FACING[kind], np.float64)).mean(0)
        facing /= max(float(np.linalg.norm(facing)), 1e-9)
        level = kind in _LEVEL or bool(-facing[1] > LEVEL_COSINE)
        if not level and facing[1] > LEVEL_COSINE:
            continue  # Nothing rests against what is above it.
        facing = np.array([0.0, -1.0, 0.0]) if level else facing
        skin_m = posed_vertices(motion, body, skin_of(body, joints), frames)
        ahead_m = skin_m @ facing
        foremost = ahead_m.argmax(1)
        patch = ahead_m > ahead_m.max(1, keepdims=True) - NEAR_M
        nearest_m = skin_m[np.arange(len(frames)), foremost]
        ahead = R_world_joint[:, joints[0], :, 2]
        yield Rest(len(frames), -facing, level, skin_m[patch], nearest_m, joints_m[:, joints[0]], ahead)


def _at_one_place(rests: list[Rest]) -> list[list[Rest]]:
    """Groups of rests that are near each other along the surface and in its height."""
    groups: list[list[Rest]] = []
    for rest in rests:
        near = [group for group in groups if any(_linked(rest, other) for other in group)]
        groups = [group for group in groups if group not in near] + [[rest, *(one for group in near for one in group)]]
    return groups


def _linked(one: Rest, other: Rest) -> bool:
    way_m = other.place_m - one.place_m
    off_m = abs(float(way_m @ one.normal))
    along_m = float(np.linalg.norm(way_m - (way_m @ one.normal) * one.normal))
    alike = float(one.normal @ other.normal) > LEVEL_COSINE
    return one.level == other.level and alike and off_m < _LINK_LEVEL_M and along_m < _LINK_M


def _support(kind: str, rests: list[Rest]) -> Support:
    normal = np.sum([rest.frames * rest.normal for rest in rests], axis=0)
    normal = normal / np.linalg.norm(normal)
    # A level patch has the world's axes; a leaning one has x level.
    x = np.array([1.0, 0.0, 0.0]) if rests[0].level else np.cross([0.0, 1.0, 0.0], normal)
    x = x / np.linalg.norm(x)
    R_world_top = np.stack([x, normal, np.cross(x, normal)], axis=1)
    nearest_m = np.concatenate([rest.nearest_m for rest in rests])
    patch = np.concatenate([rest.patch_m for rest in rests]) @ R_world_top
    low, high = patch[:, [0, 2]].min(0), patch[:, [0, 2]].max(0)
    center = 0.5 * (low + high)
    top_m = float(np.median(nearest_m @ normal))
    T_world_top = np.eye(4)
    T_world_top[:3, :3] = R_world_top
    T_world_top[:3, 3] = R_world_top @ [center[0], top_m, center[1]]
    over_m = float(np.median(np.concatenate([rest.joint_m for rest in rests]) @ normal)) - top_m
    ahead = np.concatenate([rest.ahead for rest in rests])
    return Support(kind, T_world_top, high - low, rests[0].level, nearest_m, ahead, over_m)
