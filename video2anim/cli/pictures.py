"""`video2anim models run`: runs one model on single images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from video2anim.errors import InputError, StageError, UsageError

if TYPE_CHECKING:
    import numpy as np


def models_run(
    slot: Annotated[Literal["depth", "camera", "segment"], typer.Argument(help="depth, camera or segment.")],
    images: Annotated[list[Path], typer.Argument(help="Images of equal size.", metavar="IMAGE...")],
    out: Annotated[Path, typer.Option(help="File to write, .npz.")],
    model: Annotated[str | None, typer.Option(help="Model of the slot, or NAME@PATH (default: the first).")] = None,
) -> None:
    """Run the model of a slot on images and write its outputs as arrays."""
    import numpy as np

    from video2anim.artifacts.images import read_picture
    from video2anim.networks import find_model, load_model

    if out.suffix != ".npz":
        raise UsageError(f"--out: want a file name that ends in .npz, got {out}")
    entry = find_model(model or slot)
    if slot not in (entry.slot, *entry.also):
        raise UsageError(f"--model: want a model of slot {slot}, got {entry.name} of slot {entry.slot}")
    names = [path.stem for path in images]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise UsageError(f"pictures: want file names that differ, got {sorted(twice)[0]!r} twice")
    pictures = [read_picture(path) for path in images]
    for path, picture in zip(images, pictures, strict=True):
        if picture.shape != pictures[0].shape:
            have, want = (f"{shape[1]}x{shape[0]}" for shape in (picture.shape, pictures[0].shape))
            raise InputError(
                f"pictures: want one size, {want} as {images[0]}, got {have} at {path}; run them separately"
            )
    aside = out.with_name(f".{out.name}.part")
    if out.is_dir() or not out.parent.is_dir():
        raise InputError(f"--out: cannot write {out}: want a file in an existing folder; choose another")
    try:
        answer = ANSWERS[slot](load_model(model or slot), pictures)
    except ValueError as error:
        raise StageError(f"{entry.name}: its output cannot be used: {error}") from error
    arrays: dict[str, Any] = {"frames": np.array(names), "model": np.array(entry.name), **answer}
    try:
        with aside.open("wb") as file:
            np.savez_compressed(file, **arrays)
        aside.replace(out)
    except OSError as error:
        aside.unlink(missing_ok=True)
        raise InputError(f"--out: cannot write {out}: {error.strerror}; choose another") from error
    typer.echo(str(out))


def depth_arrays(model: Any, pictures: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """`depth` (N, h, w) float32 and `kind`: metric (m), or depth or disparity up to scale and offset."""
    import numpy as np

    return {
        "depth": np.stack([np.asarray(model.infer(picture), np.float32) for picture in pictures]),
        "kind": np.array(model.kind),
    }


def camera_arrays(model: Any, pictures: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """Focal length; for models with perspective fields also gravity, uncertainties, and the fields.

    A camera is fitted to the fields and corrected by line segments of the image, as in stage camera.
    `focal_px` (N,), `fov_y_rad` (N,); `focal_log_sigma` (N,), `up_camera` (N, 3) unit vectors in OpenCV axes,
    `pitch_rad` (N,) positive = looks up, `roll_rad` (N,) positive = clockwise, `up_sigma_rad` (N,), `up_field`
    (N, rows, columns, 2), `latitude_rad` (N, rows, columns).
    """
    import numpy as np

    from video2anim.geometry.line_segments import camera_with_edges, detect_line_segments
    from video2anim.geometry.perspective_field import fit_camera

    height, width = pictures[0].shape[:2]
    if not hasattr(model, "field"):
        focal_px = np.array([model.focal_px(picture) for picture in pictures])
        return {"focal_px": focal_px, "fov_y_rad": 2 * np.arctan(0.5 * height / focal_px)}
    fields = [model.field(picture) for picture in pictures]
    cameras = [
        camera_with_edges(fit_camera([field], width / height), [detect_line_segments(picture)])
        for field, picture in zip(fields, pictures, strict=True)
    ]
    up = np.stack([camera.up_camera for camera in cameras])
    return {
        "focal_px": np.array([camera.focal_ratio * height for camera in cameras]),
        "fov_y_rad": np.array([camera.fov_y_rad for camera in cameras]),
        "focal_log_sigma": np.array([camera.focal_log_sigma for camera in cameras]),
        "up_camera": up,
        "pitch_rad": np.arcsin(np.clip(up[:, 2], -1, 1)),
        "roll_rad": np.arctan2(-up[:, 0], -up[:, 1]),
        "up_sigma_rad": np.array([camera.up_sigma_rad for camera in cameras]),
        "up_field": np.stack([field.up for field in fields]).astype(np.float32),
        "latitude_rad": np.stack([field.latitude_rad for field in fields]).astype(np.float32),
    }


def segment_arrays(model: Any, pictures: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """`semantic` (N, h, w), uint8 index into `classes`, and instances, best first within an image.

    Instances: `masks` (M, h, w) bool with `mask_frame` (M,) into `frames`, `mask_label`, `mask_kind`, `mask_score`.
    """
    import numpy as np

    from video2anim.networks.segmentation import CLASSES

    found = [model.segment(picture) for picture in pictures]
    every = [(number, instance) for number, one in enumerate(found) for instance in one.instances]
    shape = pictures[0].shape[:2]
    return {
        "semantic": np.stack([one.semantic for one in found]),
        "classes": np.array(CLASSES),
        "masks": np.stack([i.mask for _, i in every]) if every else np.zeros((0, *shape), bool),
        "mask_frame": np.array([number for number, _ in every], np.int64),
        "mask_label": np.array([i.label for _, i in every], dtype=np.str_),
        "mask_kind": np.array([i.kind for _, i in every], dtype=np.str_),
        "mask_score": np.array([i.score for _, i in every], np.float32),
    }


ANSWERS: dict[str, Callable[[Any, Sequence[np.ndarray]], dict[str, np.ndarray]]] = {
    "depth": depth_arrays,
    "camera": camera_arrays,
    "segment": segment_arrays,
}
