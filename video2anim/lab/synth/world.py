"""Types of a synthetic clip before it is rendered. World frame: meters, +Y up, floor at y = 0."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from video2anim.types import BodyMotion, Intrinsics

PICTURE_SIZE_PX = (640, 480)
"""Width and height of clips unless the user gives another size."""
LABEL_STRIDE_FRAMES = 5
"""Depth, normals and instances are kept for every such frame."""
PERSON_ID = 1000
"""The number of a person in instance maps is this plus `person_id`; smaller numbers are objects."""
NEAR_M = 0.05
"""Points nearer than this to the camera's plane, or behind it, are not projected."""
FURNITURE_LABELS = (
    "chair", "armchair", "sofa", "bed", "table", "desk", "shelf", "cabinet", "stool", "plant", "lamp", "box", "step",
)  # fmt: skip
STRUCTURE_LABELS = ("floor", "wall", "ceiling", "door", "window", "picture", "rug", "skirting")
CLUTTER_LABELS = ("book", "cup", "vase", "toy", "cushion", "monitor", "bag", "clutter")
LABELS = ("none", "person", *STRUCTURE_LABELS, *FURNITURE_LABELS, *CLUTTER_LABELS, "mesh")
"""Semantic classes; a pixel's class number is the index in this tuple. `mesh` = external mesh without a known class."""


@dataclass(frozen=True, slots=True)
class Material:
    """A procedural solid texture: a color for each point of an object's own frame, so that no UVs are needed."""

    kind: str
    """One of `KINDS` of `render/texture.py`."""
    rgb: tuple[float, float, float]
    """Main color, sRGB 0 to 1."""
    rgb2: tuple[float, float, float] = (0.5, 0.5, 0.5)
    """Second color (grain, joints, stripes), sRGB 0 to 1."""
    scale_m: float = 0.1
    """Size of the pattern: plank width, tile edge, stripe period."""
    gloss: float = 0.0
    """Strength of the highlight, 0 (matt) to 1."""
    emission: float = 0.0
    """Radiance sent out in units of `rgb` (lamp shades, screens, window panes)."""
    stain: float = 0.0
    """Amount of large-scale dirt and fading, 0 to 1."""
    seed: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A closed surface of one material (open only for labels floor, wall, ceiling, leaf), in the object's frame."""

    vertices_m: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    """Counter-clockwise from outside."""
    material: Material
    smooth: bool = False
    """Shade with interpolated vertex normals (round objects) instead of face normals."""
    vertex_rgb: UInt8[np.ndarray, "vertices 3"] | None = None
    """Baked colors of external meshes; used instead of the material's."""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A horizontal rectangle that objects or people can rest on, in the object's frame."""

    kind: str
    """`seat`, `top`, `bed` or `tread`."""
    height_m: float
    center_m: tuple[float, float]
    """x, z of the center."""
    size_m: tuple[float, float]
    """Extent along x and z."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneObject:
    """One object. Its frame: +Y up, resting on y = 0, origin below the center, front towards +Z."""

    object_id: int
    """Unique in the world, from 1; structure and furniture alike."""
    label: str
    """One of `LABELS`."""
    parts: tuple[Part, ...]
    T_world_object: Float[np.ndarray, "4 4"]
    surfaces: tuple[Surface, ...] = ()
    note: str = ""
    """Origin: variant of the generator, or file name."""

    def moved(self, T_world_object: np.ndarray, object_id: int | None = None) -> SceneObject:
        """The same object at another pose."""
        number = self.object_id if object_id is None else object_id
        return replace(self, T_world_object=np.asarray(T_world_object, float), object_id=number)

    def merged(self) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
        """Vertices (world, meters) and faces of all parts as one triangle list."""
        vertices, faces, count = [], [], 0
        R, t = self.T_world_object[:3, :3], self.T_world_object[:3, 3]
        for part in self.parts:
            vertices.append(part.vertices_m @ R.T + t)
            faces.append(np.asarray(part.faces, np.int64) + count)
            count += len(part.vertices_m)
        return np.concatenate(vertices), np.concatenate(faces)


@dataclass(frozen=True, slots=True)
class Light:
    """A lamp: a glowing sphere (`radius_m`) or, with a `direction`, a parallel sun through the windows."""

    position_m: tuple[float, float, float]
    rgb: tuple[float, float, float]
    """Linear radiant intensity per channel; irradiance at distance d is rgb * cos / d^2 (for a sun: rgb * cos)."""
    radius_m: float
    direction: tuple[float, float, float] | None = None
    """Unit vector of travel, for a sun."""


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """Everything static but the camera. The room is the box `bounds_m` (x0, x1, z0, z1) with height `height_m`."""

    bounds_m: tuple[float, float, float, float]
    height_m: float
    structure: tuple[SceneObject, ...]
    """Floor, walls (with holes or insets for doors and windows), ceiling, pictures, rugs."""
    furniture: tuple[SceneObject, ...]
    """Furniture and clutter."""
    lights: tuple[Light, ...]
    ambient_rgb: tuple[float, float, float]
    """Linear irradiance from everywhere, before ambient occlusion."""

    @property
    def objects(self) -> tuple[SceneObject, ...]:
        return (*self.structure, *self.furniture)


@dataclass(frozen=True, slots=True)
class Prop:
    """An object that a procedural motion needs, in the world frame; the room builder makes furniture that fits it."""

    kind: str
    """`seat`, `bed`, `table` (something to reach to or lean on at `height_m`), `step`, `wall` (to lean against),
    `item` (small object picked up; it lies at `height_m`)."""
    position_m: tuple[float, float, float]
    """Center of the surface that the body uses (seat: under the pelvis; table: at the hand; step: under the foot;
    wall: the point touched; item: center of its underside); y is the height of that surface."""
    yaw_rad: float
    """Heading of the object: +Z of its frame is (sin yaw, 0, cos yaw). A seat faces as the sitter does; table, step and
    wall face the side from which the person comes."""
    size_m: tuple[float, float]
    """Minimum width (x) and depth (z) of the surface."""
    frames: tuple[int, int]
    """First and last frame of use."""
    back: bool = False
    """Seat: the sitter leans back against a rest."""


@dataclass(frozen=True, slots=True, eq=False)
class MovingObject:
    """A rigid object that somebody carries."""

    scene_object: SceneObject
    T_world_object: Float[np.ndarray, "frames 4 4"]
    held: Bool[np.ndarray, "frames 2"]
    """Whether the left and the right hand hold it."""


@dataclass(frozen=True, slots=True, eq=False)
class ProceduralMotion:
    """A motion of the 22 joints of one body shape with true contacts, in the world frame at 30 fps."""

    name: str
    kind: str
    """`walk`, `walk_turn`, `sit`, `lie`, `step_up`, `pick_up`, `lean`, `reach`, or the kind of the source clip."""
    source: str
    """`synthetic`, or the source of the captured clip."""
    translation_m: Float[np.ndarray, "frames 3"]
    R_parent_joint: Float[np.ndarray, "frames 22 3 3"]
    contact: Bool[np.ndarray, "frames 22"]
    """Whether a part touches something and does not move: ankle = heel, foot = ball of the foot, wrist = hand,
    pelvis = seat, spine3 = back."""
    props: tuple[Prop, ...] = ()
    item_pose: Float[np.ndarray, "frames 4 4"] | None = None
    """World pose of the moved object in every frame, also while it rests."""
    item_held: Bool[np.ndarray, "frames 2"] | None = None
    """Whether the left and the right hand hold it."""
    item: SceneObject | None = None
    """The moved object, if the motion is made for it; else the room builder makes it for the `item` prop."""


@dataclass(frozen=True, slots=True, eq=False)
class Actor:
    """A body with its motion and its materials."""

    motion: BodyMotion
    """True motion in the world frame of the clip; `contact` holds 0 or 1; camera fields are those of the clip."""
    face_material: Int[np.ndarray, "faces"]
    """Index into `materials` for each face of the body mesh. Textures are evaluated on the rest mesh."""
    materials: tuple[Material, ...]
    kind: str = ""
    """Kind of the motion."""
    source: str = ""
    """`synthetic`, or the source of the captured clip."""
    clip: str = ""
    """Name of the motion."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorModel:
    """Exposure, noise, blur, distortion and compression of the camera."""

    exposure: float = 1.0
    noise_steps: float = 0.0
    """Standard deviation of read and shot noise in 8-bit steps at mid gray; 0 = none."""
    blur_s: float = 0.0
    """Shutter time of motion blur; 0 = none."""
    k1: float = 0.0
    """Radial distortion (Brown-Conrady) on normalized coordinates; labels have the same distortion."""
    k2: float = 0.0
    vignette: float = 0.0
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    jpeg_quality: int | None = None
    crf: int = 18
    """x264 quality of the clip's video."""


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """A complete clip, ready to be rendered."""

    name: str
    room: Room
    actors: tuple[Actor, ...]
    intrinsics: Intrinsics
    T_world_camera: Float[np.ndarray, "frames 4 4"]
    is_static: bool
    sensor: SensorModel
    moving: tuple[MovingObject, ...] = ()
    facts: dict[str, str | float | int] = field(default_factory=dict)
    """Further entries of `meta.json`."""

    @property
    def frame_count(self) -> int:
        return len(self.T_world_camera)
