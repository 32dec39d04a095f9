"""Clothes painted on a body: smooth borders between materials, and normals smoothed as if cloth spanned the body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

from video2anim.lab.synth.world import Material

CLOTH_KINDS = frozenset({"fabric", "stripes", "checks", "leather"})
_BORDER_PASSES = 7
"""Averaging steps over the mesh that straighten the border of a garment."""
_SPAN_PASSES = 9
"""Averaging steps of normals under cloth, which hide details of the body."""
_CANDIDATES = 3


@dataclass(frozen=True, slots=True, eq=False)
class Borders:
    """Faces that several materials share: a point shows the material with the largest interpolated weight."""

    row: Int[np.ndarray, "faces"]
    """Row of the face in the other fields; -1 for faces of one material."""
    material: Int[np.ndarray, "borders 3"]
    weight: Float[np.ndarray, "borders 3 3"]
    """Weight by row, corner of the face, and candidate material."""

    def renumbered(self, material: Int[np.ndarray, "materials"], row_start: int) -> Borders:
        """The same borders with new material numbers, and rows counted from `row_start`."""
        return Borders(np.where(self.row < 0, -1, self.row + row_start), material[self.material], self.weight)


def no_borders(face_count: int) -> Borders:
    """Borders of a mesh on which every face has one material."""
    return Borders(
        np.full(face_count, -1),
        np.zeros((0, _CANDIDATES), np.int64),
        np.zeros((0, _CANDIDATES, _CANDIDATES), np.float32),
    )


def material_at(
    borders: Borders, face: Int[np.ndarray, "points"], material: np.ndarray, barycentric: Float[np.ndarray, "points 2"]
) -> Int[np.ndarray, "points"]:
    """Material at points on faces; `material` is that of each face."""
    row = borders.row[face]
    at = np.flatnonzero(row >= 0)
    if not len(at):
        return material
    second, third = barycentric[at, 0], barycentric[at, 1]
    corner = np.stack([1 - second - third, second, third], 1)
    weight = np.einsum("pc,pck->pk", corner, borders.weight[row[at]])
    out = material.copy()
    out[at] = borders.material[row[at], weight.argmax(1)]
    return out


def borders_of(
    faces: np.ndarray, face_material: np.ndarray, materials: tuple[Material, ...], vertex_count: int
) -> Borders:
    """Borders where faces of several materials meet; those of garments are smoothed over the mesh."""
    incidence = _incidence(faces, vertex_count)
    one_hot = np.eye(len(materials), dtype=np.float32)[face_material]
    share = (incidence @ one_hot) / np.maximum(incidence.sum(1), 1)[:, None]
    cloth = np.array([m.kind in CLOTH_KINDS for m in materials])
    by_cloth = share[:, cloth].sum(1) > 0
    average = _averaging(faces, vertex_count)
    near = by_cloth
    for _ in range(_BORDER_PASSES):
        near = near | (average @ near.astype(np.float32) > 0)
        share = np.where(near[:, None], average @ share, share)
    corner = share[faces]
    total = corner.sum(1)
    mixed = np.flatnonzero((total > 0.02).sum(1) > 1)
    best = np.argsort(-total[mixed], axis=1, kind="stable")[:, :_CANDIDATES]
    if best.shape[1] < _CANDIDATES:
        return no_borders(len(faces))
    row = np.full(len(faces), -1)
    row[mixed] = np.arange(len(mixed))
    return Borders(row, best, np.take_along_axis(corner[mixed], best[:, None, :], axis=2).astype(np.float32))


def spanning(
    faces: np.ndarray, face_material: np.ndarray, materials: tuple[Material, ...], vertex_count: int
) -> sparse.csr_array:
    """(V, V) matrix that smooths vertex normals inside garments and keeps the others."""
    cloth = np.array([m.kind in CLOTH_KINDS for m in materials])[face_material]
    inside = np.ones(vertex_count, bool)
    inside[faces[~cloth]] = False
    average = _averaging(faces, vertex_count)
    keep = sparse.diags_array((~inside).astype(np.float32))
    step = sparse.csr_array(sparse.diags_array(inside.astype(np.float32)) @ average + keep)
    total = step
    for _ in range(_SPAN_PASSES - 1):
        total = sparse.csr_array(step @ total)
    return sparse.csr_array(total, dtype=np.float32)


def _incidence(faces: np.ndarray, vertex_count: int) -> sparse.csr_array:
    """(V, F) matrix, 1 where a vertex is a corner of a face."""
    count = len(faces)
    entries = np.ones(3 * count, np.float32), (faces.ravel(), np.repeat(np.arange(count), 3))
    return sparse.csr_array(entries, (vertex_count, count))


def _averaging(faces: np.ndarray, vertex_count: int) -> sparse.csr_array:
    """(V, V) matrix that averages a vertex with its neighbors."""
    a = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    both = np.concatenate([a, a[:, ::-1], np.repeat(np.arange(vertex_count)[:, None], 2, 1)])
    link = sparse.csr_array((np.ones(len(both), np.float32), (both[:, 0], both[:, 1])), (vertex_count, vertex_count))
    link.data[:] = 1
    return sparse.csr_array(sparse.diags_array(1 / link.sum(1)) @ link)
