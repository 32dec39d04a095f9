"""The scene: background plate, depth, object masks and meshes, floor and walls."""

# `stored()` marks how a field lies on disk; it is no default, though it stands where one would.
# pyright: reportGeneralTypeIssues=false

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from video2anim.types.storage import Storage, stored


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles with a colour per vertex. Stored as PLY."""

    vertices_m: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    vertex_rgb: UInt8[np.ndarray, "vertices 3"]


@dataclass(frozen=True, slots=True, eq=False)
class BackgroundPlate:
    """The picture without its people (temporal median), and where people are in sampled frames."""

    plate_rgb: UInt8[np.ndarray, "height width 3"] = stored(Storage.IMAGE)
    seen_ratio: Float[np.ndarray, "small_height small_width"]
    """Share of sampled frames in which no person covers the pixel; 0 = never seen, the plate is inpainted there."""
    frame_index: Int[np.ndarray, "samples"]
    """Sampled frames of the clip."""
    person_mask: Bool[np.ndarray, "samples small_height small_width"]
    """Any person, at the working resolution."""
    selected_mask: Bool[np.ndarray, "samples small_height small_width"]
    """The main person, at the working resolution."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthClip:
    """Depth up to one scale and offset for the whole clip, at the working resolution."""

    kind: str
    """`depth` (metric = s * value + o) or `disparity` (1 / metric = s * value + o)."""
    provider: str
    """`geometric` or the name of a network."""
    frame_index: Int[np.ndarray, "samples"]
    value: Float[np.ndarray, "samples small_height small_width"]
    sigma: Float[np.ndarray, "samples small_height small_width"]
    """Standard deviation of `value`."""
    valid: Bool[np.ndarray, "samples small_height small_width"]
    """Reliable pixels (paper 8.1)."""
    background_value: Float[np.ndarray, "small_height small_width"]
    background_valid: Bool[np.ndarray, "small_height small_width"]
    """Depth of the plate, without people."""


@dataclass(frozen=True, slots=True, eq=False)
class MetricDepth:
    """Scale and offset that make a `DepthClip` metric (paper 8.1), and the depth they give."""

    scale: float
    offset_m: float
    """Metres for kind `depth`, 1/metres for `disparity`."""
    scale_sigma: float
    offset_sigma: float
    chamfer_before_m: float | None
    """None where no fit was possible."""
    chamfer_after_m: float | None
    trusted: bool
    """False where the person covers too little to fix the scale."""
    reason: str
    frame_index: Int[np.ndarray, "samples"]
    depth_m: Float[np.ndarray, "samples small_height small_width"]
    valid: Bool[np.ndarray, "samples small_height small_width"]
    background_depth_m: Float[np.ndarray, "small_height small_width"]
    background_valid: Bool[np.ndarray, "small_height small_width"]
    T_world_camera: Float[np.ndarray, "frames 4 4"]


@dataclass(frozen=True, slots=True, eq=False)
class ObjectInstance:
    """One thing in the plate."""

    object_id: int
    label: str
    """Semantic class, or `object` where the provider does not know."""
    score: float
    box_px: Float[np.ndarray, "4"]
    mask: Bool[np.ndarray, "height width"] = stored(Storage.IMAGE)
    """Visible pixels, at the size of the clip."""


@dataclass(frozen=True, slots=True, eq=False)
class InstanceMasks:
    provider: str
    instances: tuple[ObjectInstance, ...]
    floor_mask: Bool[np.ndarray, "height width"] = stored(Storage.IMAGE)


@dataclass(frozen=True, slots=True, eq=False)
class CompletedObject:
    """An object with its hidden parts restored (amodal)."""

    object_id: int
    label: str
    amodal_mask: Bool[np.ndarray, "height width"] = stored(Storage.IMAGE)
    image_rgb: UInt8[np.ndarray, "height width 3"] = stored(Storage.IMAGE)
    """Crop of the amodal box, gray (127) outside the object."""
    crop_xy_px: tuple[int, int] = (0, 0)
    """Top-left pixel of the crop in the clip."""
    completed_ratio: float = 0.0
    """Share of the amodal mask that was not visible."""


@dataclass(frozen=True, slots=True, eq=False)
class CompletedObjects:
    objects: tuple[CompletedObject, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ObjectMesh:
    """A reconstructed object in its own frame: +Y up, resting on y = 0, centred in x and z."""

    object_id: int
    label: str
    method: str
    """How it was made: `box` or `carved` with its assumptions, `user mesh`, `triposr`, `program`."""
    mesh: Mesh
    T_world_object: Float[np.ndarray, "4 4"]
    """First guess of the pose."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectMeshes:
    objects: tuple[ObjectMesh, ...]


@dataclass(frozen=True, slots=True, eq=False)
class PlacedObject:
    """Metric pose of an object (paper 8.1): x_world = T_world_object @ (scale * x_object)."""

    object_id: int
    label: str
    mesh: Mesh
    scale: float
    T_world_object: Float[np.ndarray, "4 4"]
    chamfer_before_m: float | None
    """None where no fit was possible or needed."""
    chamfer_after_m: float | None
    trusted: bool
    reason: str
    position_sigma_m: float | None = None
    """Standard deviation of the horizontal place; None where nothing was fitted."""
    yaw_sigma_rad: float | None = None
    scale_sigma: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PlacedObjects:
    objects: tuple[PlacedObject, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SceneModel:
    """Everything the body can touch, in the world frame."""

    objects: tuple[PlacedObject, ...]
    floor: Mesh
    """Patch of y = 0 under the scene."""
    background: Mesh
    """Room surface behind the objects."""
    sdf_m: Float[np.ndarray, "x y z"]
    """Signed distance to the nearest solid at grid nodes, positive in free space."""
    sdf_origin_m: Float[np.ndarray, "3"]
    """World position of node (0, 0, 0)."""
    sdf_spacing_m: float
