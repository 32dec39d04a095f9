"""Closed, outward-oriented solids of which furniture is composed. Meters, radians, +Y up.

A solid is a pair (vertices (V, 3), faces (F, 3)), counter-clockwise seen from outside. `y` is always the height of the
lower end, `x` and `z` are the center.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

Mesh = tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]


def loft(rings: Float[np.ndarray, "rings points 3"], closed_loop: bool = False) -> Mesh:
    """Surface through rings of equally many points, counter-clockwise seen from the last ring; flat caps unless a
    loop."""
    count, points = rings.shape[:2]
    vertices = rings.reshape(-1, 3)
    i = np.arange(points)
    j = (i + 1) % points
    faces = []
    for r in range(count if closed_loop else count - 1):
        a, b = r * points, ((r + 1) % count) * points
        faces.append(np.stack([a + i, a + j, b + j], 1))
        faces.append(np.stack([a + i, b + j, b + i], 1))
    if closed_loop:
        return vertices, np.concatenate(faces)
    middles = np.stack([rings[0].mean(0), rings[-1].mean(0)])
    low, top = len(vertices), len(vertices) + 1
    last = (count - 1) * points
    faces.append(np.stack([j, i, np.full(points, low)], 1))
    faces.append(np.stack([last + i, last + j, np.full(points, top)], 1))
    return np.concatenate([vertices, middles]), np.concatenate(faces)


def _rounded_rectangle(width: float, depth: float, radius: float, steps: int) -> Float[np.ndarray, "points 2"]:
    """Outline in (x, z), counter-clockwise seen from above (+Y)."""
    turn = np.linspace(0, np.pi / 2, steps + 1)
    corners = []
    for quarter, (sx, sz) in enumerate(((1, -1), (-1, -1), (-1, 1), (1, 1))):
        angle = turn + quarter * np.pi / 2
        x = sx * (width / 2 - radius) + radius * np.cos(angle)
        z = sz * (depth / 2 - radius) - radius * np.sin(angle)
        corners.append(np.stack([x, z], 1))
    return np.concatenate(corners)


def soft_box(
    width: float,
    height: float,
    depth: float,
    radius: float,
    *,
    x: float = 0.0,
    y: float = 0.0,
    z: float = 0.0,
    steps: int = 2,
    flat_base: bool = False,
) -> Mesh:
    """Box with rounded edges; its top and bottom are flat and lie exactly at y and y + height. Convex."""
    radius = min(radius, 0.49 * min(width, height, depth))
    turn = np.linspace(0, np.pi / 2, steps + 1)
    upper = [(radius * (1 - np.cos(a)), height - radius + radius * np.sin(a)) for a in turn]
    lower = [(0.0, 0.0)] if flat_base else [(inset, height - level) for inset, level in reversed(upper)]
    rings = []
    for inset, level in (*lower, *upper):
        own = max(radius - inset, 0.15 * radius)
        outline = _rounded_rectangle(width - 2 * inset, depth - 2 * inset, own, steps)
        rings.append(np.stack([outline[:, 0] + x, np.full(len(outline), level + y), outline[:, 1] + z], 1))
    return loft(np.stack(rings))


def block(
    width: float, height: float, depth: float, *, x: float = 0.0, y: float = 0.0, z: float = 0.0, edge: float = 0.004
) -> Mesh:
    """Board or leg: a box with slightly beveled edges."""
    return soft_box(width, height, depth, min(edge, 0.2 * min(width, height, depth)), x=x, y=y, z=z, steps=1)


def plain_box(width: float, height: float, depth: float, *, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Mesh:
    """Box of 12 triangles."""
    ring = np.array([[1, -1], [-1, -1], [-1, 1], [1, 1]]) / 2 * [width, depth]
    rings = [np.stack([ring[:, 0] + x, np.full(4, level), ring[:, 1] + z], 1) for level in (y, y + height)]
    vertices = np.concatenate(rings)
    sides = [(i, (i + 1) % 4, 4 + (i + 1) % 4) for i in range(4)] + [(i, 4 + (i + 1) % 4, 4 + i) for i in range(4)]
    lids = [(2, 1, 0), (3, 2, 0), (4, 5, 6), (4, 6, 7)]
    return vertices, np.array([*sides, *lids])


def taper(
    bottom: tuple[float, float],
    top: tuple[float, float],
    height: float,
    *,
    x: float = 0.0,
    y: float = 0.0,
    z: float = 0.0,
    lean: tuple[float, float] = (0.0, 0.0),
) -> Mesh:
    """Tapered square leg with sizes (x, z) at bottom and top; its foot is offset by `lean` (x, z) from below the
    top."""
    ring = np.array([[1, -1], [-1, -1], [-1, 1], [1, 1]]) / 2
    rings = []
    for share in np.linspace(0, 1, 4):
        outline = ring * ((1 - share) * np.asarray(bottom) + share * np.asarray(top)) + (1 - share) * np.asarray(lean)
        rings.append(np.stack([outline[:, 0] + x, np.full(4, y + share * height), outline[:, 1] + z], 1))
    return loft(np.stack(rings))


def lathe(
    profile: Sequence[tuple[float, float]],
    sides: int = 20,
    *,
    x: float = 0.0,
    y: float = 0.0,
    z: float = 0.0,
    closed: bool = False,
) -> Mesh:
    """Solid of revolution about the vertical through (x, z); profile of (radius, height), from below.

    `closed`: the profile is a loop counter-clockwise in the (radius, height) plane: a ring, like a lamp shade.
    """
    angle = np.arange(sides) / sides * 2 * np.pi
    rings = [
        np.stack([x + r * np.cos(angle), np.full(sides, y + h), z - r * np.sin(angle)], 1)
        for r, h in ((max(r, 1e-4), h) for r, h in profile)
    ]
    return loft(np.stack(rings), closed_loop=closed)


def cylinder(
    radius: float,
    height: float,
    *,
    x: float = 0.0,
    y: float = 0.0,
    z: float = 0.0,
    sides: int = 20,
    top: float | None = None,
) -> Mesh:
    """Round leg, pot or column with slightly beveled edges; `top` is the radius at the upper end."""
    top = radius if top is None else top
    edge = min(0.003, 0.2 * height, 0.3 * radius, 0.3 * top)
    profile = [(radius - edge, 0), (radius, edge), (top, height - edge), (top - edge, height)]
    return lathe(profile, sides, x=x, y=y, z=z)


def tube(points: Float[np.ndarray, "points 3"], radius: float | Sequence[float] | np.ndarray, sides: int = 10) -> Mesh:
    """Round bar along a curve, with flat ends."""
    points = np.asarray(points, float)
    radii = np.broadcast_to(np.asarray(radius, float), (len(points),))
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(along[0], [0.0, 0.0, 1.0] if abs(along[0, 2]) < 0.9 else [1.0, 0.0, 0.0])
    angle = np.arange(sides) / sides * 2 * np.pi
    rings = []
    for point, direction, r in zip(points, along, radii, strict=True):
        side = side - direction * (side @ direction)
        side /= np.linalg.norm(side)
        other = np.cross(direction, side)
        rings.append(point + r * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other))
    return loft(np.stack(rings))


def bar(start: Sequence[float] | np.ndarray, end: Sequence[float] | np.ndarray, radius: float, sides: int = 10) -> Mesh:
    """Straight round bar."""
    return tube(np.stack([np.asarray(start, float), np.asarray(end, float)]), radius, sides)


def ribbon(line_xz: Float[np.ndarray, "points 2"], thickness: float, height: float, y: float = 0.0) -> Mesh:
    """Vertical sheet along a curve in the xz plane, for curved backrests and curtains."""
    line = np.asarray(line_xz, float)
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    normal = np.stack([-along[:, 1], along[:, 0]], 1) * thickness / 2
    rings = []
    for point, offset in zip(line, normal, strict=True):
        a, b = point + offset, point - offset
        rings.append([[a[0], y, a[1]], [b[0], y, b[1]], [b[0], y + height, b[1]], [a[0], y + height, a[1]]])
    return oriented(loft(np.array(rings)))


def pillow(
    width: float, height: float, depth: float, *, x: float = 0.0, y: float = 0.0, z: float = 0.0, power: float = 0.45
) -> Mesh:
    """Stuffed cushion lying flat: a superellipsoid with four corners."""
    across = np.arange(24) / 24 * 2 * np.pi
    up = np.linspace(-np.pi / 2, np.pi / 2, 9)[1:-1]
    root = lambda v, p: np.sign(v) * np.abs(v) ** p  # noqa: E731
    rings = []
    for phi in up:
        flat = root(np.cos(phi), 0.8)
        px = width / 2 * flat * root(np.cos(across), power)
        pz = -depth / 2 * flat * root(np.sin(across), power)
        rings.append(np.stack([px + x, np.full(24, y + height / 2 * (1 + np.sin(phi))), pz + z], 1))
    return loft(np.stack(rings))


def leaf(length: float, width: float, droop: float, thickness: float = 0.002) -> Mesh:
    """Pointed leaf from the origin along +Z, bending down by `droop` at its tip."""
    share = np.linspace(0, 1, 5)
    half = width / 2 * np.array([0.12, 0.8, 1.0, 0.65, 0.06])
    rings = []
    for s, w in zip(share, half, strict=True):
        center = np.array([0.0, -droop * s**2, length * s])
        fold = 0.25 * w
        up = np.array([0.0, thickness, 0.0])
        left, right = center + np.array([-w, fold, 0.0]), center + np.array([w, fold, 0.0])
        rings.append([left, center, right, right + up, center + up, left + up])
    return oriented(loft(np.array(rings)))


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """Several solids as one mesh."""
    starts = np.cumsum([0, *[len(v) for v, _ in meshes]])
    faces = [f + start for (_, f), start in zip(meshes, starts, strict=False)]
    return np.concatenate([v for v, _ in meshes]), np.concatenate(faces)


def moved(
    mesh: Mesh,
    *,
    x: float = 0.0,
    y: float = 0.0,
    z: float = 0.0,
    yaw: float = 0.0,
    pitch: float = 0.0,
    roll: float = 0.0,
) -> Mesh:
    """The solid rotated about Z (roll), X (pitch), Y (yaw), in this order, then shifted."""
    vertices, faces = mesh
    return vertices @ rotation(yaw, pitch, roll).T + np.array([x, y, z]), faces


def rotation(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Float[np.ndarray, "3 3"]:
    """R = R_y(yaw) R_x(pitch) R_z(roll)."""
    (cy, sy), (cp, sp), (cr, sr) = ((np.cos(a), np.sin(a)) for a in (yaw, pitch, roll))
    R_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    R_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    R_z = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    return R_y @ R_x @ R_z


def volume_m3(mesh: Mesh) -> float:
    """Signed volume; positive when faces point outwards."""
    triangles = mesh[0][mesh[1]]
    return float(np.einsum("ij,ij->i", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])).sum() / 6)


def oriented(mesh: Mesh) -> Mesh:
    """The solid with its faces oriented outward."""
    return mesh if volume_m3(mesh) >= 0 else (mesh[0], mesh[1][:, ::-1].copy())
