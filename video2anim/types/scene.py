"""The scene: background image, depth, object masks and meshes, floor and walls."""

# `stored()` gives the file format of a field. It is not a default value, although it has the place of one.
# pyright: reportGeneralTypeIssues=false

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from pydantic import Field, FiniteFloat, NonNegativeFloat, NonNegativeInt, PositiveFloat

from video2anim.errors import ArtifactError
from video2anim.types.checks import Checked, expect_sound
from video2anim.types.storage import Holds, Storage, stored

DEPTH_LOG_SIGMA = 0.12
"""Error of a network's depth of one object or person, logarithm (`benchmarks/object_errors.py`)."""


@dataclass(frozen=True, slots=True, eq=False)
class Mesh(Checked):
    """Triangle mesh with vertex colors (sRGB). Stored as PLY."""

    vertices_m: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    vertex_rgb: UInt8[np.ndarray, "vertices 3"]

    def __post_init__(self) -> None:
        expect_sound(self)
        if len(self.faces) and not 0 <= self.faces.min() <= self.faces.max() < len(self.vertices_m):
            raise ValueError(
                f"Mesh.faces: want triangles of {len(self.vertices_m)} vertices, "
                f"got numbers {self.faces.min()} to {self.faces.max()}"
            )


@dataclass(frozen=True, slots=True, eq=False)
class BackgroundImage(Checked):
    """The image without people (temporal median), and masks of people in sampled frames."""

    background_rgb: UInt8[np.ndarray, "height width 3"] = stored(Storage.IMAGE)
    seen_ratio: Float[np.ndarray, "small_height small_width"]
    """Share of sampled frames in which no person covers the pixel; where it is 0, the background image is
    inpainted."""
    frame_index: Annotated[Int[np.ndarray, "samples"], Holds.FRAMES]
    """Sampled frames of the clip."""
    person_mask: Bool[np.ndarray, "samples small_height small_width"]
    """Any person, at the working resolution."""
    selected_mask: Bool[np.ndarray, "samples small_height small_width"]
    """The main person, at the working resolution."""

    def of_frames(self, frame_index: Int[np.ndarray, "some"]) -> BackgroundImage:
        """The same with some of the sampled frames only.

        Raises:
            ArtifactError: one of them was not sampled.
        """
        if not np.isin(frame_index, self.frame_index).all():
            raise ArtifactError("BackgroundImage: want sampled frames, got others: run again from stage background")
        rows = np.searchsorted(self.frame_index, frame_index)
        return replace(
            self, frame_index=frame_index, person_mask=self.person_mask[rows], selected_mask=self.selected_mask[rows]
        )


@dataclass(frozen=True, slots=True, eq=False)
class DepthClip(Checked):
    """Depth up to one scale and offset for the whole clip, at the working resolution."""

    kind: Annotated[str, Field(pattern="^(depth|disparity)$")]
    """`depth` (metric = s * value + o) or `disparity` (1 / metric = s * value + o)."""
    provider: str
    """Name of the network."""
    frame_index: Annotated[Int[np.ndarray, "samples"], Holds.FRAMES]
    value: Annotated[Float[np.ndarray, "samples small_height small_width"], Holds.GAPS]
    sigma: Annotated[Float[np.ndarray, "samples small_height small_width"], Holds.GAPS]
    """Standard deviation of `value`."""
    valid: Bool[np.ndarray, "samples small_height small_width"]
    """Reliable pixels (paper 8.1)."""
    background_value: Annotated[Float[np.ndarray, "small_height small_width"], Holds.GAPS]
    background_valid: Bool[np.ndarray, "small_height small_width"]
    """Depth of the background image, without people."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectInstance(Checked):
    """One object in the background image."""

    object_id: NonNegativeInt
    label: str
    """Semantic class, or `object` if unknown."""
    score: FiniteFloat
    box_px: Float[np.ndarray, "4"]
    mask: Annotated[Bool[np.ndarray, "height width"], Holds.SOMETHING] = stored(Storage.IMAGE)
    """Visible pixels, at the size of the clip."""


@dataclass(frozen=True, slots=True, eq=False)
class InstanceMasks(Checked):
    provider: str
    instances: tuple[ObjectInstance, ...]
    floor_mask: Bool[np.ndarray, "height width"] = stored(Storage.IMAGE)


@dataclass(frozen=True, slots=True, eq=False)
class CompletedObject(Checked):
    """An object with its occluded parts restored (amodal)."""

    object_id: NonNegativeInt
    label: str
    amodal_mask: Annotated[Bool[np.ndarray, "height width"], Holds.SOMETHING] = stored(Storage.IMAGE)
    image_rgb: UInt8[np.ndarray, "crop_height crop_width 3"] = stored(Storage.IMAGE)
    """Crop of the amodal box, gray (127) outside the object."""
    crop_xy_px: tuple[int, int] = (0, 0)
    """Top-left pixel of the crop in the clip."""
    completed_ratio: FiniteFloat = 0.0
    """Share of the amodal mask that was not visible."""


@dataclass(frozen=True, slots=True, eq=False)
class CompletedObjects:
    objects: tuple[CompletedObject, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Texture(Checked):
    """Texture image of a mesh."""

    image_rgb: UInt8[np.ndarray, "rows columns 3"] = stored(Storage.IMAGE)
    corner_uv: Float[np.ndarray, "faces 3 2"]
    """Texture coordinates of every corner of every face: 0..1, (0, 0) at the upper left, as in glTF."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectPart(Checked):
    """A named part of an object's mesh: consecutive faces that form a closed surface."""

    name: str
    """`seat`, `back`, `arm`, `leg`, `top`, `base`, `board`, `body`..."""
    first_face: NonNegativeInt
    face_count: NonNegativeInt


@dataclass(frozen=True, slots=True, eq=False)
class ObjectMesh(Checked):
    """A reconstructed object in its own frame: +Y up, front towards +Z, resting on y = 0, its seat, top or body above
    the origin."""

    object_id: NonNegativeInt
    label: str
    method: str
    """Origin: `form: NAME` for a fitted form, `user mesh`, `triposr`, `program`."""
    mesh: Annotated[Mesh, Holds.SOMETHING]
    T_world_object: Annotated[Float[np.ndarray, "4 4"], Holds.RIGID]
    """Initial pose; for a fitted form, its pose."""
    parts: tuple[ObjectPart, ...] = ()
    """None where the shape has no known parts."""
    textures: tuple[Texture, ...] = ()
    """One, or none where the colors of the vertices are all there is."""
    chamfer_m: NonNegativeFloat | None = None
    """Mean distance of the object's depth points to a fitted form; None for other meshes, which stage place fits."""
    position_sigma_m: NonNegativeFloat | None = None
    """Standard deviation of a fitted form's horizontal position. The next two are also of fitted forms only."""
    yaw_sigma_rad: NonNegativeFloat | None = None
    size_sigma: NonNegativeFloat | None = None
    """Standard deviation of the logarithm of its sizes."""
    outline_iou: NonNegativeFloat | None = None
    """Mask IoU of a fitted form with the object, where nothing occludes it."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectMeshes:
    objects: tuple[ObjectMesh, ...]


@dataclass(frozen=True, slots=True)
class Hold(Checked):
    """A range of frames in which somebody holds an object."""

    person_id: NonNegativeInt
    hand: str
    """`left hand`, `right hand` or `both hands`."""
    first_frame: NonNegativeInt
    last_frame: NonNegativeInt
    """Last frame in which it is held (inclusive)."""

    def __post_init__(self) -> None:
        expect_sound(self)
        if self.last_frame < self.first_frame:
            raise ValueError(f"Hold.last_frame: want {self.first_frame} or later, got {self.last_frame}")


@dataclass(frozen=True, slots=True, eq=False)
class ObjectPath(Checked):
    """Rigid motion of an object that somebody moves: one pose per frame of the clip, constant while nobody holds it."""

    T_world_object: Annotated[Float[np.ndarray, "frames 4 4"], Holds.RIGID]
    holds: tuple[Hold, ...]
    """Sorted by time."""

    def __post_init__(self) -> None:
        expect_sound(self)
        if any(hold.last_frame >= len(self.T_world_object) for hold in self.holds):
            last = max(hold.last_frame for hold in self.holds)
            raise ValueError(f"ObjectPath.holds: want frames of the {len(self.T_world_object)}, got {last}")


@dataclass(frozen=True, slots=True, eq=False)
class PlacedObject(Checked):
    """Metric pose of an object (paper 8.1): x_world = T_world_object @ (scale * x_object)."""

    object_id: NonNegativeInt
    label: str
    mesh: Annotated[Mesh, Holds.SOMETHING]
    scale: PositiveFloat
    T_world_object: Annotated[Float[np.ndarray, "4 4"], Holds.RIGID]
    chamfer_before_m: NonNegativeFloat | None
    """None if no fit was possible or needed."""
    chamfer_after_m: NonNegativeFloat | None
    trusted: bool
    reason: str
    position_sigma_m: NonNegativeFloat | None = None
    """Standard deviation of the horizontal position; None without a fit."""
    yaw_sigma_rad: NonNegativeFloat | None = None
    scale_sigma: NonNegativeFloat | None = None
    distance_sigma: NonNegativeFloat = DEPTH_LOG_SIGMA
    """Standard deviation of the logarithm of its distance from the camera, by the fit of stage metric."""
    parts: tuple[ObjectPart, ...] = ()
    """None where the shape has no known parts."""
    textures: tuple[Texture, ...] = ()
    """One, or none where the colors of the vertices are all there is."""
    path: tuple[ObjectPath, ...] = ()
    """One item if somebody moves it (`T_world_object` is then its pose in the first frame), else empty."""

    def pose(self, frame: int) -> Float[np.ndarray, "4 4"]:
        """`T_world_object` in a frame of the clip."""
        return self.path[0].T_world_object[frame] if self.path else self.T_world_object

    @property
    def holds(self) -> tuple[Hold, ...]:
        """When somebody holds it, sorted by time."""
        return self.path[0].holds if self.path else ()


@dataclass(frozen=True, slots=True, eq=False)
class PlacedObjects:
    objects: tuple[PlacedObject, ...]


@dataclass(frozen=True, slots=True, eq=False)
class RoomPiece(Checked):
    """A part of the surroundings of people and objects, in the world. Flat, except for a user's scan."""

    name: str
    """`floor`, `wall 1`, `ceiling`, `card 2` (upright, for non-planar regions), `backdrop` (far objects), `scan`."""
    mesh: Mesh
    """Triangles face the camera; those of the floor face up."""
    textures: tuple[Texture, ...] = ()
    """One, or none where the colors of the vertices are all there is."""
    openings: tuple[Float[np.ndarray, "4 3"], ...] = ()
    """Corners (world, m) of rectangular holes through which something farther is visible: windows and doors."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneModel(Checked):
    """Everything that a body can touch, in the world frame."""

    objects: tuple[PlacedObject, ...]
    floor: RoomPiece
    """Part of the plane y = 0 below the scene."""
    background: tuple[RoomPiece, ...]
    """Walls, ceiling, upright cards and a backdrop behind the objects; or a user's scan."""
    sdf_m: Float[np.ndarray, "x y z"]
    """Signed distance to the nearest solid at grid nodes, positive in free space."""
    sdf_origin_m: Float[np.ndarray, "3"]
    """World position of node (0, 0, 0)."""
    sdf_spacing_m: PositiveFloat

    def __post_init__(self) -> None:
        expect_sound(self)
        numbers = [item.object_id for item in self.objects]
        if len(set(numbers)) < len(numbers):
            raise ValueError(f"SceneModel.objects: want a number of its own for each object, got {numbers}")
