"""Clips together with the scenes they were captured in: TRUMANS, GIMO and PROX behind one function."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from scenemi.data.gimo import read_gimo, read_gimo_sdf
from scenemi.data.hip_path import HIPS, leg_ratio
from scenemi.data.prox import read_prox, read_prox_sdf
from scenemi.data.source_clip import SourceClip
from scenemi.data.split import Part, Split
from scenemi.data.trumans import read_trumans, read_trumans_sdf
from video2anim.body.shaped_body import ShapedBody
from video2anim.errors import UsageError
from video2anim.geometry.sdf import SdfGrid
from video2anim.types.skeleton import forward_kinematics

SCENE_SOURCES = ("trumans", "gimo", "prox")
_TEST_ROOMS_OF_PROX = ("MPH16", "MPH1Library", "N0SittingBooth", "N3OpenArea")
"""The rooms that papers on PROX test on."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneClip:
    """A motion in its scene; world +Y up, floor y = 0, meters, 30 fps."""

    clip: SourceClip
    scene_name: str
    part: Part
    """By the data set's own rule; no room that is tested on is trained on."""
    solids: Callable[[], SdfGrid]
    """Signed distances to what stands on the floor, read when they are asked for."""


@dataclass(frozen=True, slots=True)
class SceneFit:
    """How a scene follows its motion when that is put on another body: it grows with the legs, as the path does, and
    rises with the hips, which retargeting raises or lowers until the feet stand. x_body_world = scale x + (0, lift, 0).
    """

    scale: float
    lift_m: float

    def scene_points(self, points_m: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
        """Places in the scene of points in the world of the retargeted motion."""
        return (points_m - np.array([0.0, self.lift_m, 0.0])) / self.scale


def read_scene_clips(source: str, folder: str | Path) -> Iterator[SceneClip]:
    """Clips of a data set with their scenes, which are read when they are asked for (the last few are kept).

    A clip whose body does not reach the floor in any size of a person (one that lies on a bed all the time) keeps its
    place in the scene and is marked `uneven`.

    Args:
        source: one of `SCENE_SOURCES`.
        folder: of the data set, see the modules `trumans`, `gimo`, `prox` of this package.

    Raises:
        UsageError: another source.
        InputError: files are missing or of another layout.
    """
    folder = Path(folder)
    if source == "trumans":
        for take in read_trumans(folder):
            load = functools.partial(_trumans_sdf, folder, take.scene_name)
            yield SceneClip(_in_place(take.clip), take.scene_name, Split().part_of(take.scene_name), load)
    elif source == "gimo":
        for sequence in read_gimo(folder):
            matrix = tuple(map(tuple, sequence.T_world_mesh.tolist()))
            size = np.cbrt(np.linalg.det(sequence.T_world_mesh[:3, :3]))  # sequences of a room may scale it differently
            room = f"{sequence.scene_mesh.parents[1].name}_{size:.4f}"
            part = _known_part(sequence.clip.name, test=not sequence.training)
            yield SceneClip(
                _in_place(sequence.clip), room, part, functools.partial(_gimo_sdf, sequence.scene_mesh, matrix)
            )
    elif source == "prox":
        for piece in read_prox(folder):
            part = _known_part(piece.clip.name, test=piece.scene_name in _TEST_ROOMS_OF_PROX)
            load = functools.partial(_prox_sdf, folder, piece.scene_name)
            yield SceneClip(_in_place(piece.clip), piece.scene_name, part, load)
    else:
        raise UsageError(f"scenes: want one of {', '.join(SCENE_SOURCES)}, got {source!r}")


def scene_folders(words: Sequence[str]) -> tuple[tuple[str, Path], ...]:
    """Sources and folders of `trumans=DIR` and its like.

    Raises:
        UsageError: other words.
    """
    pairs = [word.partition("=") for word in words]
    for word, (source, _, folder) in zip(words, pairs, strict=True):
        if source not in SCENE_SOURCES or not folder:
            raise UsageError(f"scenes: want SOURCE=FOLDER with one of {', '.join(SCENE_SOURCES)}, got {word!r}")
    return tuple((source, Path(folder)) for source, _, folder in pairs)


def fit_scene(
    clip: SourceClip,
    body: ShapedBody,
    rows: Int[np.ndarray, "frames"],
    R_world_root: Float[np.ndarray, "frames 3 3"],
    translation_m: Float[np.ndarray, "frames 3"],
) -> SceneFit:
    """How the scene of a clip follows the clip on a body.

    Args:
        clip: as captured.
        body: what it was put on.
        rows: some frames of the clip.
        R_world_root: root orientations of the retargeted motion at these frames.
        translation_m: its root translations.
    """
    some = replace(clip, root_position_m=clip.root_position_m[rows], rotation_wxyz=clip.rotation_wxyz[rows])
    named_m = some.smpl_joints_m()
    scale = leg_ratio(named_m, body.rest_joints_m)
    R = np.tile(np.eye(3), (len(rows), 22, 1, 1))
    R[:, 0] = R_world_root
    joints_m, _ = forward_kinematics(R, translation_m, body.rest_joints_m)
    rise_m = joints_m[:, HIPS, 1].mean(1) - scale * named_m[:, HIPS, 1].mean(1)
    return SceneFit(scale, float(np.median(rise_m)))


def _in_place(clip: SourceClip) -> SourceClip:
    """The clip where it was in its scene, if it was moved to the floor below its feet."""
    if clip.floor_shift_m == 0.0:
        return clip
    back_m = clip.root_position_m - np.array([0.0, clip.floor_shift_m, 0.0])
    return replace(clip, root_position_m=back_m, floor_shift_m=0.0, uneven=True)


def _known_part(name: str, *, test: bool) -> Part:
    return "test" if test else ("val" if Split().part_of(name) == "val" else "train")


_trumans_sdf = functools.lru_cache(maxsize=2)(read_trumans_sdf)
_prox_sdf = functools.lru_cache(maxsize=2)(read_prox_sdf)


@functools.lru_cache(maxsize=2)
def _gimo_sdf(mesh: Path, T_world_mesh: tuple[tuple[float, ...], ...]) -> SdfGrid:
    return read_gimo_sdf(mesh, np.array(T_world_mesh))
