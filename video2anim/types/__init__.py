"""The typed values that stages pass to each other. Conventions: docs/conventions.md.

Every value is a frozen dataclass of numpy arrays and plain values. `stored()` gives the file format of a field.
"""

from video2anim.types.camera import BackgroundPoints, CameraEstimate, Intrinsics, View
from video2anim.types.clip import SourceInfo, SourceVideo, VideoClip
from video2anim.types.contact import Contact
from video2anim.types.metric import MetricDepth
from video2anim.types.motion import BodyMotion, BodyShape, BodyTracks, KeyframedMotion, PersonQuality, RefinedMotion
from video2anim.types.people import PersonTrack, PersonTracks, Thumbnail
from video2anim.types.results import ExportedFiles
from video2anim.types.scene import (
    BackgroundImage,
    CompletedObject,
    CompletedObjects,
    DepthClip,
    Hold,
    InstanceMasks,
    Mesh,
    ObjectInstance,
    ObjectMesh,
    ObjectMeshes,
    ObjectPart,
    ObjectPath,
    PlacedObject,
    PlacedObjects,
    RoomPiece,
    SceneModel,
    Texture,
)
from video2anim.types.storage import PayloadFile, Storage, stored

__all__ = [
    "BackgroundImage",
    "BackgroundPoints",
    "BodyMotion",
    "BodyShape",
    "BodyTracks",
    "CameraEstimate",
    "CompletedObject",
    "CompletedObjects",
    "Contact",
    "DepthClip",
    "ExportedFiles",
    "Hold",
    "InstanceMasks",
    "Intrinsics",
    "KeyframedMotion",
    "Mesh",
    "MetricDepth",
    "ObjectInstance",
    "ObjectMesh",
    "ObjectMeshes",
    "ObjectPart",
    "ObjectPath",
    "PayloadFile",
    "PersonQuality",
    "PersonTrack",
    "PersonTracks",
    "PlacedObject",
    "PlacedObjects",
    "RefinedMotion",
    "RoomPiece",
    "SceneModel",
    "SourceInfo",
    "SourceVideo",
    "Storage",
    "Texture",
    "Thumbnail",
    "VideoClip",
    "View",
    "stored",
]
