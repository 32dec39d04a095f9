"""The mesh of one object: of the form that fits best, or one from elsewhere in the place of what was seen."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8

from video2anim.objects.evidence import SeenObject
from video2anim.objects.meshing import ObjectPicture, form_mesh, outline_iou
from video2anim.objects.recognize import Recognition
from video2anim.types import CompletedObject, Mesh, ObjectMesh, View


def fitted(
    found: CompletedObject,
    recognition: Recognition,
    background_rgb: UInt8[np.ndarray, "height width 3"],
    view: View,
) -> ObjectMesh:
    """The form with the most evidence, painted with the picture."""
    (best, *_), label = recognition.fits()
    picture = ObjectPicture(_completed_picture(found, background_rgb), found.amodal_mask, view)
    mesh, parts, texture = form_mesh(best, picture)
    sigma = best.sigma
    return ObjectMesh(
        found.object_id, label, f"form: {best.form.name}{' ' * bool(best.form.variant)}{best.form.variant}", mesh,
        best.T_world_object, parts, (texture,), best.chamfer_m, float(np.hypot(*sigma[:2])), float(sigma[2]),
        float(np.sqrt(np.mean(sigma[6:] ** 2))), outline_iou(best, recognition.seen.evidence, recognition.seen.own),
    )  # fmt: skip


def adopted(found: CompletedObject, seen: SeenObject, mesh: Mesh, method: str, *, in_meters: bool = True) -> ObjectMesh:
    """A mesh of any unit in the place of what was seen: as high as that.

    It keeps its own size where that is near and may be in meters.
    """
    low, high = mesh.vertices_m.min(0), mesh.vertices_m.max(0)
    base = np.array([0.5 * (low[0] + high[0]), low[1], 0.5 * (low[2] + high[2])])
    box = seen.box()
    # By height; what lies flat has none to go by.
    tall = high[1] - low[1] > 0.1 * (high - low).max()
    ratio = float(box.size_m[1] / (high[1] - low[1]) if tall else box.size_m.max() / max((high - low).max(), 1e-6))
    scale = 1.0 if in_meters and 0.75 < ratio < 1.33 else ratio
    T_world_object = np.eye(4)
    T_world_object[:3, :3] = box.R_world_box
    T_world_object[:3, 3] = box.R_world_box @ np.array([box.center_m[0], box.low_m[1], box.center_m[2]])
    own = Mesh((scale * (mesh.vertices_m - base)).astype(np.float32), mesh.faces, mesh.vertex_rgb)
    return ObjectMesh(found.object_id, found.label, method, own, T_world_object)


def _completed_picture(
    found: CompletedObject, background_rgb: UInt8[np.ndarray, "height width 3"]
) -> UInt8[np.ndarray, "height width 3"]:
    """The background image with the object's hidden parts inpainted; its outline's colors, which mix, are those further
    in."""
    picture = background_rgb.copy()
    (x, y), (h, w) = found.crop_xy_px, found.image_rgb.shape[:2]
    mask = found.amodal_mask[y : y + h, x : x + w]
    around = np.pad(mask.astype(np.uint8), 2)
    inner = cv2.erode(around, np.ones((5, 5), np.uint8))[2:-2, 2:-2].astype(bool)
    if not inner.any():
        inner = mask
    labels = np.asarray(
        cv2.distanceTransformWithLabels(
            (~inner).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )[1], np.int64,
    )  # fmt: skip
    color_of = np.zeros((int(labels.max()) + 1, 3), np.uint8)
    color_of[labels[inner]] = found.image_rgb[inner]
    picture[y : y + h, x : x + w][mask] = color_of[labels][mask]
    return picture
