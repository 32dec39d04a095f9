"""Stage reconstruct: a closed, colored mesh of every object.

Everything in the object's box that the camera does not see to be free is solid; what is free on one side is free on the
other where the object is symmetric. Sides that nothing shows are assumed, and the method says so. Meshes of the
user, of a network, or of a program of theirs, take the place of these, in this order.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from jaxtyping import UInt8
from pydantic import Field

from video2anim.errors import InputError, StageError
from video2anim.pipeline.config import counts_as, user_path
from video2anim.pipeline.options import limits, model_of, only_without
from video2anim.pipeline.stage import NO_MODEL, StageContext, StageSpec
from video2anim.types import (
    BackgroundPlate,
    CompletedObject,
    CompletedObjects,
    InstanceMasks,
    Mesh,
    MetricDepth,
    ObjectMesh,
    ObjectMeshes,
)

if TYPE_CHECKING:
    from video2anim.geometry.lifted_thing import ThingLifter
    from video2anim.geometry.object_solid import ObjectSolid

SLOT = "object-mesh"
FINEST = 256
"""Most samples of a network's field along a side: what TripoSR's own program takes."""


_COMMAND = r"(?s)^$|\{image\}.*\{mesh\}|\{mesh\}.*\{image\}"


def _with_digest(command: str) -> str:
    from video2anim.models.external_mesh import program_digest

    return f"{command} (sha256 {program_digest(command)})"


@dataclass(frozen=True)
class ReconstructConfig:
    """Detail of the meshes, and what is assumed of hidden sides."""

    most_faces: Annotated[int, limits("faces", ge=12, le=1_000_000)] = 4000
    """Upper limit of faces per object."""
    cubes_along: Annotated[int, limits(ge=4, le=256)] = 40
    """Cubes along the longest side of an object."""
    thickness_ratio: Annotated[float, limits(gt=0, le=10)] = 0.35
    """Assumed thickness of what is seen from the front alone, as a share of the root of width times height."""
    thickest_m: Annotated[float, limits("m", gt=0, le=100)] = 0.8
    """Largest assumed thickness."""
    depth_error_ratio: Annotated[float, limits(ge=0, le=1)] = 0.01
    """Error of depth within an object, as a share of its distance; nothing nearer than that is called free."""
    least_points: Annotated[int, limits(ge=1, le=1_000_000)] = 30
    """Objects with fewer reliable depth pixels are dropped."""
    meshes: str = user_path()
    """Folder of the user's meshes, named by object (`3.glb`; +Y up, front towards +Z)."""
    model: Annotated[str, model_of("object-mesh", also=(NO_MODEL,))] = NO_MODEL
    """Network that makes a mesh of a picture, for the other objects: `triposr@FOLDER`; `none` for no network."""
    model_resolution: Annotated[int, limits(ge=16, le=FINEST), only_without("model", NO_MODEL)] = 96
    """Samples of the network's field along a side; time grows with the third power."""
    command: Annotated[str, Field(pattern=_COMMAND, description="that has {image} and {mesh} in it, or nothing")] = (
        counts_as(_with_digest)
    )
    """Program that makes a mesh of a picture, for objects still without one: its words with {image} and {mesh}."""
    command_timeout_s: Annotated[float, limits("s", gt=0, le=604_800), only_without("command", "")] = 600.0
    """A program that takes longer for one object is ended, and the object made of what is seen."""


def reconstruct_objects(
    completed: CompletedObjects,
    masks: InstanceMasks,
    depth: MetricDepth,
    plate: BackgroundPlate,
    config: ReconstructConfig,
    ctx: StageContext,
) -> ObjectMeshes:
    """Meshes in their own frames (+Y up, resting on y = 0, centered) with a first pose.

    Raises:
        InputError: the user's meshes cannot be read.
        UsageError: `model` names one of another slot, or an option is out of range.
        ModelMissingError: the network's weights are absent, or no network of its contract.
    """
    from video2anim.geometry.lifted_thing import ThingLifter

    lifter = ThingLifter(masks, depth)
    foreign = _user_meshes(config)
    numbers = {found.object_id for found in completed.objects}
    if unused := sorted(foreign.keys() - numbers):
        names = ", ".join(foreign[number].name for number in unused)
        ctx.warn(f"{names} in {config.meshes}: there is no object of that number, only {sorted(numbers)}; not used")
    meshes, boxes = [], 0
    for done, found in enumerate(completed.objects):
        solid = _solid(found, lifter, config)
        if solid is None:
            ctx.warn(f"object {found.object_id} has too little reliable depth and is dropped")
        else:
            meshes.append(_foreign(found, solid, foreign, config, ctx) or _mesh(found, solid, plate, config))
            boxes += meshes[-1].method.startswith("box")
        ctx.progress(done + 1, len(completed.objects))
    ctx.quality("meshes", len(meshes), "objects")
    ctx.quality("boxes", boxes, "objects")
    ctx.quality("dropped", len(completed.objects) - len(meshes), "objects", "lower")
    ctx.quality("most_faces", max((len(m.mesh.faces) for m in meshes), default=0), "faces")
    return ObjectMeshes(tuple(meshes))


def _user_meshes(config: ReconstructConfig) -> dict[int, Path]:
    from video2anim.artifacts.user_files import mesh_files

    return mesh_files(Path(config.meshes)) if config.meshes else {}


def _foreign(
    found: CompletedObject, solid: ObjectSolid, files: dict[int, Path], config: ReconstructConfig, ctx: StageContext
) -> ObjectMesh | None:
    """The user's mesh of the object, that of the network or that of the user's program; None if there is none."""
    from video2anim.artifacts.user_files import read_mesh_file
    from video2anim.models.external_mesh import mesh_by_program

    if found.object_id in files:
        return _adopted(found, solid, read_mesh_file(files[found.object_id]), "user mesh")
    if config.model != NO_MODEL:
        network = ctx.model(config.model)
        try:
            mesh = network.mesh(found.image_rgb, most_faces=config.most_faces, resolution=config.model_resolution)
            return _adopted(found, solid, mesh, network.name, in_metres=False)
        except StageError as error:
            instead = "by the program" if config.command else "of what is seen"
            ctx.warn(f"object {found.object_id} is made {instead} instead: {error}")
    if not config.command:
        return None
    try:
        with mesh_by_program(config.command, found.image_rgb, config.command_timeout_s) as file:
            return _adopted(found, solid, read_mesh_file(file), "program")
    except (StageError, InputError) as error:
        ctx.warn(
            f"object {found.object_id} is made of what is seen instead: {error}; once that is mended, "
            "run with --from reconstruct (a changed program file is noticed)"
        )
        return None


def _adopted(
    found: CompletedObject, solid: ObjectSolid, mesh: Mesh, method: str, *, in_metres: bool = True
) -> ObjectMesh:
    """A mesh of any unit in the place of what was seen: as high as that.

    It keeps its own size where that is near and may be in metres.
    """
    low, high = mesh.vertices_m.min(0), mesh.vertices_m.max(0)
    base = np.array([0.5 * (low[0] + high[0]), low[1], 0.5 * (low[2] + high[2])])
    box = solid.box
    # By height; what lies flat has none to go by.
    tall = high[1] - low[1] > 0.1 * (high - low).max()
    ratio = float(box.size_m[1] / (high[1] - low[1]) if tall else box.size_m.max() / max((high - low).max(), 1e-6))
    scale = 1.0 if in_metres and 0.75 < ratio < 1.33 else ratio
    T_world_object = np.eye(4)
    T_world_object[:3, :3] = box.R_world_box
    T_world_object[:3, 3] = box.R_world_box @ np.array([box.middle_m[0], box.low_m[1], box.middle_m[2]])
    own = Mesh((scale * (mesh.vertices_m - base)).astype(np.float32), mesh.faces, mesh.vertex_rgb)
    return ObjectMesh(found.object_id, found.label, method, own, T_world_object)


def _solid(found: CompletedObject, lifter: ThingLifter, config: ReconstructConfig) -> ObjectSolid | None:
    from video2anim.geometry.carving import ObjectView
    from video2anim.geometry.masks import shrunk
    from video2anim.geometry.object_solid import SolidLimits, object_solid

    own, known = lifter.own(found.object_id), lifter.known
    if (own & known).sum() < config.least_points:
        return None
    thing = lifter.lift(found.object_id)
    added = shrunk(found.amodal_mask, own.shape) & ~own
    view = ObjectView(
        thing.depth_m, known & ~added, own, lifter.floor & ~own, lifter.T_world_camera, lifter.lens, thing.shows
    )
    limits = SolidLimits(
        most_along=config.cubes_along, thickness_ratio=config.thickness_ratio, thickest_m=config.thickest_m
    )
    distance_m = float(np.median(thing.depth_m[thing.shows]))
    return object_solid(own, added, view, limits, blur_m=config.depth_error_ratio * distance_m)


def _mesh(found: CompletedObject, solid: ObjectSolid, plate: BackgroundPlate, config: ReconstructConfig) -> ObjectMesh:
    from video2anim.geometry.solid_mesh import box_surface, mesh_of_voxels, surface_colors

    box = solid.box
    if solid.method.startswith("box"):
        vertices_m, faces = box_surface(box.low_m, box.high_m, config.most_faces)
    else:
        vertices_m, faces = mesh_of_voxels(solid.voxels, config.most_faces)
    world_m = vertices_m @ box.R_world_box.T
    rgb = surface_colors(
        world_m, _completed_picture(found, plate), solid.view, box, solid.voxels.mirrored, 3 * solid.voxels.spacing_m
    )
    low, high = vertices_m.min(0), vertices_m.max(0)
    base = np.array([0.5 * (low[0] + high[0]), low[1], 0.5 * (low[2] + high[2])])
    T_world_object = np.eye(4)
    T_world_object[:3, :3], T_world_object[:3, 3] = box.R_world_box, box.R_world_box @ base
    mesh = Mesh((vertices_m - base).astype(np.float32), faces, rgb)
    return ObjectMesh(found.object_id, found.label, solid.method, mesh, T_world_object)


def _completed_picture(found: CompletedObject, plate: BackgroundPlate) -> UInt8[np.ndarray, "height width 3"]:
    """The plate with the object's hidden parts inpainted; its outline's colors, which mix, are those further in."""
    import cv2

    picture = plate.plate_rgb.copy()
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


STAGE = StageSpec("reconstruct", reconstruct_objects, version=8, models=(SLOT,))
