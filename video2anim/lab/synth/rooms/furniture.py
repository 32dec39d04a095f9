"""`make_furniture`: one piece of furniture, random within real sizes or of a given size."""

from __future__ import annotations

import numpy as np

from video2anim.errors import InputError
from video2anim.lab.synth.rooms.decor import make_clutter, make_lamp, make_plant
from video2anim.lab.synth.rooms.materials import Palette, draw_palette
from video2anim.lab.synth.rooms.seats import Seat, draw_seat, make_seat
from video2anim.lab.synth.rooms.storage import make_cabinet, make_shelf
from video2anim.lab.synth.rooms.tables import make_bed, make_box, make_desk, make_step, make_table
from video2anim.lab.synth.world import CLUTTER_LABELS, FURNITURE_LABELS, SceneObject


def make_furniture(
    label: str,
    rng: np.random.Generator,
    *,
    size_m: tuple[float, float] | None = None,
    surface_height_m: float | None = None,
    palette: Palette | None = None,
) -> SceneObject:
    """One piece in its own frame (front +Z, resting on y = 0, origin below the center of its bounding box).

    Args:
        label: One of `FURNITURE_LABELS`, or of `CLUTTER_LABELS` except `clutter`.
        rng: Random numbers.
        size_m: Width (x) and depth (z) of its surface; drawn from real ranges (see each maker) if None.
        surface_height_m: Height of its seat, top or tread; total height of a shelf, lamp or plant.
        palette: Materials of the room; drawn at random if None.

    Raises:
        InputError: unknown label.
    """
    palette = draw_palette(rng) if palette is None else palette
    if label in ("chair", "armchair", "sofa", "stool"):
        seat = draw_seat(label, rng, size_m)
        height = seat.height_m if surface_height_m is None else surface_height_m
        return make_seat(label, Seat(seat.width_m, seat.depth_m, height, seat.back, seat.arms), rng, palette)
    if label == "plant":
        return make_plant(rng, surface_height_m)
    if label == "lamp":
        return make_lamp(rng, palette, surface_height_m)
    makers = {
        "table": make_table,
        "desk": make_desk,
        "bed": make_bed,
        "shelf": make_shelf,
        "cabinet": make_cabinet,
        "box": make_box,
        "step": make_step,
    }
    if label in makers:
        return makers[label](rng, palette, size_m, surface_height_m)
    if label in CLUTTER_LABELS and label != "clutter":
        return make_clutter(label, rng, palette, size_m=size_m)
    raise InputError(f"furniture: want one of {', '.join(FURNITURE_LABELS)}, got {label!r}")
