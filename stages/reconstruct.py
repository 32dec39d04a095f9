"""Stage reconstruct: a closed, colored mesh of every object, at its place.

Forms of furniture and simple solids are fitted to what is seen and to people; the one with the most evidence is kept.
Meshes of the user, of a network, or of a program of theirs, take the place of these, in this order.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from video2anim.errors import InputError, StageError
from video2anim.pipeline.config import counts_as, user_path
from video2anim.pipeline.options import limits, model_of, only_without
from video2anim.pipeline.stage import NO_MODEL, StageContext, StageSpec
from video2anim.types import (
    BackgroundImage,
    CompletedObject,
    CompletedObjects,
    InstanceMasks,
    MetricDepth,
    ObjectMesh,
    ObjectMeshes,
)

if TYPE_CHECKING:
    from video2anim.objects.evidence import SeenObject

SLOT = "object-mesh"
FINEST = 256
"""Most samples of a network's field along a side: what TripoSR's own program takes."""
_COMMAND = r"(?s)^$|\{image\}.*\{mesh\}|\{mesh\}.*\{image\}"


def _with_digest(command: str) -> str:
    from video2anim.networks.external_mesh import program_digest

    return f"{command} (sha256 {program_digest(command)})"


@dataclass(frozen=True)
class ReconstructConfig:
    """Detail of the meshes, and what is believed of depth."""

    max_faces: Annotated[int, limits("faces", ge=300, le=1_000_000)] = 4000
    """Upper limit of faces of a network's mesh; forms have fewer than 300."""
    depth_error_ratio: Annotated[float, limits(gt=0, le=1)] = 0.03
    """Standard deviation of depth within an object, as a share of its distance."""
    depth_relief: Annotated[float, limits(gt=0, le=2)] = 0.65
    """Mean of true over estimated variation of log depth within an object: 0.60 on renders, 0.74 on photographs."""
    depth_relief_sigma: Annotated[float, limits(gt=0, le=2)] = 0.4
    """Its standard deviation: 0.35, 0.61 (`benchmarks/room_net.py`)."""
    open_bias: Annotated[float, limits(ge=-1, le=1)] = 0.1
    """Mean logarithm of estimated over true depth of chairs, tables and stools (0.05 to 0.25: docs/objects.md)."""
    min_points: Annotated[int, limits(ge=1, le=1_000_000)] = 30
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
    background: BackgroundImage,
    config: ReconstructConfig,
    ctx: StageContext,
) -> ObjectMeshes:
    """Meshes in their own frames (+Y up, resting on y = 0, centered) with a first pose.

    Raises:
        InputError: the user's meshes cannot be read.
        UsageError: `model` names one of another slot, or an option is out of range.
        ModelMissingError: the network's weights are absent, or no network of its contract.
    """
    from video2anim.artifacts.user_files import mesh_files
    from video2anim.geometry.heading import EdgeHeadings
    from video2anim.geometry.masks import never_seen
    from video2anim.objects.evidence import ObjectViews, PeopleEvidence
    from video2anim.objects.object_mesh import fitted
    from video2anim.objects.observed import DepthErrors
    from video2anim.objects.recognize import rested_on_one
    from video2anim.scene.supports import rested_and_inner_m

    unseen = never_seen(background.seen_ratio, depth.background_depth_m.shape)
    people = PeopleEvidence(*rested_and_inner_m(depth.bodies))
    view = depth.bodies.main_view.resized(*background.background_rgb.shape[1::-1])
    errors = DepthErrors(config.depth_error_ratio, config.depth_relief, config.depth_relief_sigma, config.open_bias)
    views = ObjectViews(masks, depth, unseen, people, errors, EdgeHeadings(background.background_rgb, view))
    foreign = mesh_files(Path(config.meshes)) if config.meshes else {}
    if unused := sorted(foreign.keys() - (numbers := {found.object_id for found in completed.objects})):
        names = ", ".join(foreign[number].name for number in unused)
        ctx.warn(f"{names} in {config.meshes}: there is no object of that number, only {sorted(numbers)}; not used")
    meshes: list[ObjectMesh] = []
    seen: dict[int, SeenObject] = {}
    for found in completed.objects:
        one = views.object(found, ctx.rng(f"reconstruct/{found.object_id}"))
        if one is None or len(one.points_m) < config.min_points:
            ctx.warn(f"object {found.object_id} has too little reliable depth and is dropped")
        else:
            seen[found.object_id] = one
    rested = rested_on_one(seen, {found.object_id: found.label for found in completed.objects})
    for found in (one for one in completed.objects if one.object_id in seen):
        mesh = _foreign(found, seen[found.object_id], foreign, config, ctx)
        meshes.append(mesh or fitted(found, rested[found.object_id], background.background_rgb, view))
        ctx.progress(len(meshes), len(seen))
    ctx.quality("meshes", len(meshes), "count")
    ctx.quality("dropped", len(completed.objects) - len(meshes), "count", "lower")
    ctx.quality("max_faces", max((len(m.mesh.faces) for m in meshes), default=0), "count")
    return ObjectMeshes(tuple(sorted(meshes, key=lambda mesh: mesh.object_id)))


def _foreign(
    found: CompletedObject, seen: SeenObject, files: dict[int, Path], config: ReconstructConfig, ctx: StageContext
) -> ObjectMesh | None:
    """The user's mesh of the object, that of the network or that of the user's program; None if there is none."""
    from video2anim.artifacts.user_files import read_mesh_file
    from video2anim.networks.external_mesh import mesh_by_program
    from video2anim.objects.object_mesh import adopted

    if found.object_id in files:
        return adopted(found, seen, read_mesh_file(files[found.object_id]), "user mesh")
    if config.model != NO_MODEL:
        network = ctx.model(config.model)
        try:
            mesh = network.mesh(found.image_rgb, max_faces=config.max_faces, resolution=config.model_resolution)
            return adopted(found, seen, mesh, network.name, in_meters=False)
        except StageError as error:
            instead = "by the program" if config.command else "of what is seen"
            ctx.warn(f"object {found.object_id} is made {instead} instead: {error}")
    if not config.command:
        return None
    try:
        with mesh_by_program(config.command, found.image_rgb, config.command_timeout_s) as file:
            return adopted(found, seen, read_mesh_file(file), "program")
    except (StageError, InputError) as error:
        again = "once that is mended, run with --from reconstruct (a changed program file is noticed)"
        ctx.warn(f"object {found.object_id} is made of what is seen instead: {error}; {again}")
        return None


STAGE = StageSpec("reconstruct", reconstruct_objects, version=44, models=(SLOT,))
