"""Appearance of people: skin, hair, face, clothes and shoes as materials of the faces of a body.

Regions are defined on the rest mesh by the body part that moves a face and by the face's position along its limb, so
they fit every body shape. Textures are evaluated on the rest mesh too, so patterns move with the body. The renderer
draws borders between regions as smooth lines through the faces that they cross.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from video2anim.body.anny_body import KEYPOINT_NAMES, anny_model
from video2anim.body.shaped_body import ShapedBody
from video2anim.lab.synth.render.surfaces import face_normals
from video2anim.lab.synth.wardrobe import Outfit, draw_outfit
from video2anim.lab.synth.world import Material
from video2anim.types.skeleton import JOINT_INDEX, JOINT_NAMES

_HAND = 2.05
"""Limb coordinate at which the hand begins (shoulder 0, elbow 1, wrist 2)."""
_OFF = -np.inf
"""Limb coordinate of faces that are not on the limb."""


def make_appearance(
    body: ShapedBody, rng: np.random.Generator
) -> tuple[Int[np.ndarray, "faces"], tuple[Material, ...]]:
    """Random clothes, skin and hair for a body: an index into the materials for each face, and the materials."""
    outfit = draw_outfit(body.shape.parameters.get("gender", 0.5), rng)
    places = _places(body)
    face = np.zeros(len(body.faces), np.int64)
    names = list(outfit.materials)

    def paint(where: Bool[np.ndarray, "faces"], name: str) -> None:
        face[where] = names.index(name)

    paint(np.ones(len(face), bool), "skin")
    _paint_head(places, outfit, paint)
    paint(_bottom(places, outfit), "bottom")
    paint(_top(places, outfit), "top")
    if outfit.belt:
        paint(_band(places.center[:, 1], outfit.hem, 0.05) & (places.trunk | (places.leg != _OFF)), "belt")
    if outfit.sock > 0:
        paint(places.leg > outfit.sock, "sock")
    paint(places.leg > outfit.shoe, "shoe")
    paint((places.leg > outfit.shoe) & (places.down > 0.6) & (places.center[:, 1] < places.sole + 0.03), "sole")
    return face, tuple(outfit.materials.values())


@dataclass(frozen=True, slots=True, eq=False)
class _Places:
    """Position of each face on the body in coordinates that hold for all shapes; rest pose, meters."""

    center: Float[np.ndarray, "faces 3"]
    """Rest position, meters; the two triangles of a quad share it."""
    trunk: Bool[np.ndarray, "faces"]
    """Faces that move with pelvis, spine or collars."""
    arm: Float[np.ndarray, "faces"]
    """Shoulder 0, elbow 1, wrist 2, hand beyond; `_OFF` elsewhere."""
    leg: Float[np.ndarray, "faces"]
    """Hip 0, knee 1, ankle 2, foot 3; `_OFF` elsewhere."""
    down: Float[np.ndarray, "faces"]
    """Minus the y of the face's unit normal: 1 = faces down, -1 = faces up."""
    head: Bool[np.ndarray, "faces"]
    neck: Float[np.ndarray, "3"]
    """Neck joint."""
    landmarks: dict[str, Float[np.ndarray, "3"]]
    """Nose, eyes, ears."""
    crown: float
    """Height of the top of the head."""
    sole: float
    """Height of the lowest point."""
    piece: Int[np.ndarray, "faces"]
    """Index of the connected component, largest first: 0 skin, 1 mouth, 2 and 3 eyeballs."""


def _places(body: ShapedBody) -> _Places:
    center = body.rest_vertices_m[body.faces].mean(1)
    center = np.repeat(0.5 * (center[0::2] + center[1::2]), 2, axis=0)
    weight = body.skin_weights[body.faces].sum(1)
    part = np.repeat((weight[0::2] + weight[1::2]).argmax(1), 2)
    rest = np.linalg.inv(body.inverse_bind)[:, :3, 3]
    names = np.array(JOINT_NAMES)[part]
    head = names == "head"
    arm, leg = np.full(len(part), _OFF), np.full(len(part), _OFF)
    for side in ("left", "right"):
        limb = [rest[JOINT_INDEX[f"{side}_{joint}"]] for joint in ("shoulder", "elbow", "wrist")]
        own = (names == f"{side}_shoulder") | (names == f"{side}_elbow")
        arm[own] = _along(center[own], *limb)
        arm[names == f"{side}_wrist"] = _HAND
        limb = [rest[JOINT_INDEX[f"{side}_{joint}"]] for joint in ("hip", "knee", "ankle")]
        own = (names == f"{side}_hip") | (names == f"{side}_knee")
        leg[own] = np.minimum(_along(center[own], *limb), 2.2)
        leg[(names == f"{side}_ankle") | (names == f"{side}_foot")] = 3.0
    trunk = np.char.startswith(names, "spine") | np.char.endswith(names, "collar") | (names == "pelvis")
    heights = body.rest_vertices_m[:, 1]
    down = -face_normals(body.rest_vertices_m, body.faces)[:, 1]
    down = np.repeat(0.5 * (down[0::2] + down[1::2]), 2)
    neck = rest[JOINT_INDEX["neck"]]
    return _Places(
        center, trunk, arm, leg, down, head, neck, _landmarks(body, rest), heights.max(), heights.min(), _pieces(body)
    )


def _along(points: np.ndarray, start: np.ndarray, middle: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Limb coordinate of points: 0 to 1 along the first bone, 1 to 2 along the second."""
    first, second = middle - start, end - middle
    one = (points - start) @ first / (first @ first)
    two = (points - middle) @ second / (second @ second)
    return np.where(one + two < 1, np.minimum(one, 1), 1 + np.maximum(two, 0))


def _landmarks(body: ShapedBody, rest: np.ndarray) -> dict[str, np.ndarray]:
    """Rest positions of the face's keypoints (the head's joint frame is parallel to the rest mesh)."""
    phenotype = {name: torch.tensor(float(value)) for name, value in body.shape.parameters.items()}
    with torch.no_grad():
        offsets = anny_model().rest_skeleton(phenotype).keypoint_offsets_m.numpy()
    head = JOINT_INDEX["head"]
    wanted = ("nose", "left_eye", "right_eye", "left_ear", "right_ear")
    return {name: rest[head] + offsets[KEYPOINT_NAMES.index(name), head] for name in wanted}


def _pieces(body: ShapedBody) -> np.ndarray:
    """Index of the connected component of each face; 0 is the largest."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    faces, count = body.faces, len(body.rest_vertices_m)
    a, b = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    _, vertex = connected_components(coo_matrix((np.ones(len(a)), (a, b)), (count, count)), directed=False)
    piece = vertex[faces[:, 0]]
    values, inverse, sizes = np.unique(piece, return_inverse=True, return_counts=True)
    rank = np.empty(len(values), np.int64)
    rank[np.argsort(-sizes, kind="stable")] = np.arange(len(values))
    return rank[inverse]


def _band(values: np.ndarray, middle: float | np.ndarray, width: float | np.ndarray) -> np.ndarray:
    return np.abs(values - middle) < 0.5 * width


def _top(places: _Places, outfit: Outfit) -> np.ndarray:
    """Faces of the shirt: trunk above the hem and below the neckline, and sleeves."""
    x, y, z = places.center.T
    drop = 0.55 * np.maximum(z - places.neck[2], -0.03)
    if outfit.neckline == "v":
        drop = drop + np.where(z > places.neck[2], np.maximum(0.085 - 1.1 * np.abs(x), 0), 0)
    if outfit.neckline == "high":
        drop = drop - 0.05
    below_neck = (y < places.neck[1] + 0.012 - drop) & ~places.head
    hips = (places.leg != _OFF) & (places.leg < 0.45)
    covered = (places.trunk | hips | (~places.head & (places.arm == _OFF) & (places.leg == _OFF))) & (y > outfit.hem)
    if outfit.sleeve <= 0:
        armhole = 0.10 + 0.5 * np.maximum(places.neck[1] - 0.10 - y, 0)
        return below_neck & covered & (np.abs(x) < armhole)
    return below_neck & (covered | ((places.arm != _OFF) & (places.arm < outfit.sleeve)))


def _bottom(places: _Places, outfit: Outfit) -> np.ndarray:
    """Faces of trousers or shorts: from the waist down to the cuff."""
    waist = places.trunk & (places.center[:, 1] < 0.12)
    return waist | ((places.leg != _OFF) & (places.leg < outfit.cuff))


def _paint_head(places: _Places, outfit: Outfit, paint: Callable[[np.ndarray, str], None]) -> None:
    """Materials of hair, brows, lips, beard and eyes."""
    x, y, z = places.center.T
    eye = 0.5 * (places.landmarks["left_eye"] + places.landmarks["right_eye"])
    ear = 0.5 * (places.landmarks["left_ear"] + places.landmarks["right_ear"])
    nose, unit = places.landmarks["nose"], places.crown - eye[1]
    skin = places.piece == 0
    on_head = places.head & skin
    mouth = places.center[places.piece == 1]
    mouth_y, mouth_z = mouth[:, 1].mean() + 0.05 * unit, mouth[:, 2].max()
    face_front = z > ear[2] + 0.35 * unit

    height = 0.17 * unit - 0.5 * np.abs(x)
    lips = on_head & _band(y, mouth_y, height) & (z > mouth_z - 0.12 * unit) & (np.abs(x) < 0.25 * unit)
    paint(lips, "lips")
    if outfit.beard:
        jaw = on_head & (y < nose[1] - 0.12 * unit) & (z > ear[2] + 0.05 * unit) & (y > mouth_y - 0.75 * unit)
        paint(jaw & ~lips, "beard")
    arch = eye[1] + 0.24 * unit - 0.18 * np.abs(np.abs(x) - 0.3 * unit)
    paint(on_head & face_front & _band(y, arch, 0.085 * unit) & _band(np.abs(x), 0.3 * unit, 0.38 * unit), "brow")

    front, back = eye[2] + 0.1 * unit, ear[2]
    stations = [back - 0.2 * unit, back + 0.15 * unit, back + 0.45 * unit, front - 0.1 * unit]
    line = np.interp(z, stations, _hairline(outfit, eye, ear, unit))
    is_ear = (np.abs(x) > np.abs(places.landmarks["left_ear"][0]) - 0.06 * unit) & (np.abs(y - ear[1]) < 0.35 * unit)
    is_ear &= np.abs(z - ear[2]) < 0.3 * unit
    hair = on_head & (y > line) & ~is_ear
    if outfit.hair == "long":
        hair |= skin & (z < places.neck[2] + 0.01) & (y > places.neck[1] - 0.03) & (np.abs(x) < 0.09)
        hair |= on_head & (z < ear[2] + 0.1 * unit) & (y > ear[1] - 0.9 * unit) & ~is_ear
    if outfit.hair != "bald":
        paint(hair, "hair")
    for number in (2, 3):
        _paint_eye(places, number, paint)


def _hairline(outfit: Outfit, eye: np.ndarray, ear: np.ndarray, unit: float) -> list[float]:
    """Heights above which hair grows: nape, before the ear, temple, forehead."""
    if outfit.hair == "cap":
        return [ear[1] + 0.35 * unit, eye[1] + 0.45 * unit, eye[1] + 0.45 * unit, eye[1] + 0.4 * unit]
    return [ear[1] - 0.5 * unit, ear[1] + 0.05 * unit, eye[1] + 0.30 * unit, eye[1] + 0.66 * unit]


def _paint_eye(places: _Places, number: int, paint: Callable[[np.ndarray, str], None]) -> None:
    """White of the eye with an iris that faces +Z."""
    ball = places.piece == number
    if not ball.any():
        return
    middle = 0.5 * (places.center[ball].min(0) + places.center[ball].max(0))
    off = places.center - middle
    ahead = off[:, 2] / np.maximum(np.linalg.norm(off, axis=1), 1e-9)
    paint(ball, "eye")
    paint(ball & (ahead > 0.86), "iris")
