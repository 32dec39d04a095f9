"""Forms of furniture: a few sizes each, and the solids that they give.

Usual sizes are real ones, those in which the synthetic rooms draw their furniture
(`video2anim.lab.synth.rooms`): the middle of the range, and about half of it as a share of that. Tables on one foot are
also bar tables, 1.05 to 1.1 m high, which those rooms do not have.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from video2anim.objects.shapes import CUBE, CYLINDER, WEDGE, Shape
from video2anim.objects.solids import Solids

Sizes = Float[np.ndarray, "batch sizes"]
_Rows = list[tuple[str, list, list]]
"""Name, center (x, y, z) and full size (x, y, z) of every solid; numbers or arrays over the batch."""
_Built = tuple[tuple[str, ...], Solids]
"""Names of the parts, and the solids."""

LEG_M = 0.045
"""Thickness of a leg."""
_TILT_RAD = 0.13
"""Lean of the back of a chair: 5 to 11 degrees are usual."""
_SOFT_BACK_M = 0.16
"""Thickness of an upholstered back."""
_BOARD_M = 0.025
"""Thickness of boards and table tops: 18 to 40 mm are usual."""


@dataclass(frozen=True, slots=True)
class Size:
    """One size of a form."""

    name: str
    usual_m: float
    spread: float
    """Standard deviation of its logarithm."""


@dataclass(frozen=True, slots=True)
class Form:
    """A kind of object."""

    name: str
    """Class of object, such as `chair`; several forms may share one."""
    sizes: tuple[Size, ...]
    """`width` is along x, `depth` along z; `height` is that of the whole, but of a bed without its headboard and of a
    kitchen's lower row."""
    build: Callable[[Sizes], _Built]
    """Solids of a batch of sizes (m), and the names of the parts."""
    variant: str = ""
    turns: int = 4
    """Quarter turns in which it looks different."""
    stands: bool = True
    """On the floor, always."""
    share: float = 1.0
    """How common it is among objects in rooms and gardens, against a chair: a judgment, not a count."""

    @property
    def usual_m(self) -> Float[np.ndarray, "sizes"]:
        return np.array([size.usual_m for size in self.sizes])

    @property
    def spread(self) -> Float[np.ndarray, "sizes"]:
        return np.array([size.spread for size in self.sizes])


def _solids(
    rows: _Rows,
    batch: int,
    *,
    tilted: tuple[str, ...] = (),
    tilt_rad: float | np.ndarray = 0.0,
    shapes: dict[str, Shape] | None = None,
) -> _Built:
    """Parts that `shapes` does not name are boxes."""
    names = tuple(name for name, _, _ in rows)
    shape = (batch, len(rows), 3)
    center, half = np.empty(shape), np.empty(shape)
    for k, (_, middle, size) in enumerate(rows):
        for axis in range(3):
            center[:, k, axis], half[:, k, axis] = middle[axis], 0.5 * np.asarray(size[axis])
    tilt = np.isin(names, tilted) * np.broadcast_to(tilt_rad, batch)[:, None]
    return names, Solids(center, np.maximum(half, 1e-3), tilt, tuple((shapes or {}).get(name, CUBE) for name in names))


def _round(*names: str) -> dict[str, Shape]:
    return dict.fromkeys(names, CYLINDER)


def _legs(w: np.ndarray, d: np.ndarray, top: np.ndarray) -> _Rows:
    x, z = 0.5 * w - 0.6 * LEG_M, 0.5 * d - 0.6 * LEG_M
    return [("leg", [sx * x, 0.5 * top, sz * z], [LEG_M, top, LEG_M]) for sx in (-1, 1) for sz in (-1, 1)]


def _chair(s: Sizes) -> _Built:
    w, d, h, back = s.T
    thick = 0.045
    rows = [("seat", [0, h - 0.5 * thick, 0], [w, thick, d])]
    lean = 0.5 * back * np.sin(_TILT_RAD)
    rows.append(("back", [0, h + 0.5 * back, -0.5 * d - lean], [w, back, 0.035]))
    return _solids(rows + _legs(w, d, h - thick), len(s), tilted=("back",), tilt_rad=_TILT_RAD)


def _soft_seat(s: Sizes) -> _Built:
    w, d, h, back, arm, rise = s.T
    rear = _SOFT_BACK_M
    rows = [
        ("seat", [0, 0.5 * h + 0.03, 0], [w, h - 0.06, d]),
        ("back", [0, 0.5 * (h + back) + 0.03, -0.5 * d - 0.5 * rear], [w + 2 * arm, h + back - 0.06, rear]),
    ]
    for side in (-1, 1):
        x = side * 0.5 * (w + arm)
        rows.append(("arm", [x, 0.5 * (h + rise), 0], [arm, h + rise, d]))
    return _solids(rows, len(s))


def _stool(s: Sizes) -> _Built:
    w, d, h = s.T
    thick = 0.05
    return _solids([("seat", [0, h - 0.5 * thick, 0], [w, thick, d]), *_legs(0.9 * w, 0.9 * d, h - thick)], len(s))


def _table_rows(w: np.ndarray, d: np.ndarray, h: np.ndarray) -> _Rows:
    top = ("top", [0, h - 0.5 * _BOARD_M, 0], [w, _BOARD_M, d])
    return [top, *_legs(w - 0.06, d - 0.06, h - _BOARD_M)]


def _table(s: Sizes) -> _Built:
    w, d, h = s.T
    return _solids(_table_rows(w, d, h), len(s))


def _panel_table(s: Sizes) -> _Built:
    w, d, h = s.T
    top = h - _BOARD_M
    rows = [("top", [0, h - 0.5 * _BOARD_M, 0], [w, _BOARD_M, d])]
    rows += [("side", [side * (0.5 * w - 0.06), 0.5 * top, 0], [_BOARD_M, top, d - 0.08]) for side in (-1, 1)]
    return _solids(rows, len(s))


def _desk(side: int) -> Callable[[Sizes], _Built]:
    def build(s: Sizes) -> _Built:
        w, d, h = s.T
        top = h - _BOARD_M
        drawers = ("drawers", [side * (0.5 * w - 0.26), 0.5 * top + 0.02, 0], [0.4, top - 0.06, d - 0.12])
        return _solids([*_table_rows(w, d, h), drawers], len(s))

    return build


def _round_table(s: Sizes) -> _Built:
    across, h, foot = s.T
    top = h - 0.03
    rows = [
        ("top", [0, h - 0.015, 0], [across, 0.03, across]),
        ("leg", [0, 0.5 * top, 0], [0.08, top, 0.08]),
        ("base", [0, 0.015, 0], [foot, 0.03, foot]),
    ]
    return _solids(rows, len(s), shapes=_round("top", "leg", "base"))


def _round_table_on_legs(s: Sizes) -> _Built:
    across, h = s.T
    rows = [("top", [0, h - 0.015, 0], [across, 0.03, across]), *_legs(0.62 * across, 0.62 * across, h - 0.03)]
    return _solids(rows, len(s), shapes=_round("top"))


def _swivel_chair(s: Sizes) -> _Built:
    w, d, h, back = s.T
    rows = [
        ("seat", [0, h - 0.035, 0], [w, 0.07, d]),
        ("back", [0, h + 0.55 * back, -0.5 * d - 0.5 * back * np.sin(_TILT_RAD)], [w, 0.9 * back, 0.045]),
        ("leg", [0, 0.5 * (h - 0.07), 0], [0.07, h - 0.07, 0.07]),
        ("base", [0, 0.05, 0], [0.55, 0.06, 0.55]),
    ]
    return _solids(rows, len(s), tilted=("back",), tilt_rad=_TILT_RAD, shapes=_round("leg", "base"))


def _kitchen(s: Sizes) -> _Built:
    w, d, h, gap, upper, shallow = s.T
    rows = [
        ("body", [0, 0.5 * h, 0], [w, h, d]),
        ("top cabinet", [0, h + gap + 0.5 * upper, 0.5 * (shallow - d)], [w, upper, shallow]),
    ]
    return _solids(rows, len(s))


def _bed(s: Sizes) -> _Built:
    w, length, h, head = s.T
    rows = [
        ("bed", [0, 0.5 * h + 0.04, 0], [w, h - 0.08, length]),
        ("headboard", [0, 0.5 * (h + head), -0.5 * length - 0.03], [w, h + head, 0.06]),
    ]
    return _solids(rows, len(s))


def _shelf(boards: int) -> Callable[[Sizes], _Built]:
    def build(s: Sizes) -> _Built:
        w, d, h = s.T
        rows: _Rows = [("side", [side * (0.5 * w - 0.011), 0.5 * h, 0], [0.022, h, d]) for side in (-1, 1)]
        rows.append(("back", [0, 0.5 * h, -0.5 * d + 0.005], [w, h, 0.01]))
        for k in range(boards):
            top = 0.08 + (h - 0.08) * k / (boards - 1)
            rows.append(("board", [0, top - 0.011, 0], [w - 0.04, 0.022, d]))
        # What stands on the boards: its front is what the camera sees.
        rows.append(("contents", [0, 0.5 * h, -0.2 * d], [w - 0.05, h - 0.04, 0.55 * d]))
        return _solids(rows, len(s))

    return build


def _box(s: Sizes) -> _Built:
    w, d, h = s.T
    return _solids([("body", [0, 0.5 * h, 0], [w, h, d])], len(s))


def _board(s: Sizes) -> _Built:
    w, d, h, lower = s.T
    tall = h - lower
    rows = [("board", [0, lower + 0.5 * tall, 0], [w, tall, d])]
    rows += [("leg", [side * 0.45 * w, 0.5 * lower, 0], [0.05, lower, 0.05]) for side in (-1, 1)]
    return _solids(rows, len(s))


def _lamp(s: Sizes) -> _Built:
    shade, tall, h, foot = s.T
    rows = [
        ("base", [0, 0.015, 0], [foot, 0.03, foot]),
        ("pole", [0, 0.5 * (h - tall), 0], [0.025, h - tall, 0.025]),
        ("shade", [0, h - 0.5 * tall, 0], [shade, tall, shade]),
    ]
    return _solids(rows, len(s), shapes=_round("base", "pole", "shade"))


def _plant(s: Sizes) -> _Built:
    leaves, pot_h, h, pot = s.T
    rows = [
        ("pot", [0, 0.5 * pot_h, 0], [pot, pot_h, pot]),
        ("leaves", [0, 0.5 * (h + pot_h), 0], [leaves, h - pot_h, leaves]),
    ]
    return _solids(rows, len(s), shapes=_round("pot", "leaves"))


def _steps(s: Sizes) -> _Built:
    w, d, h = s.T
    rows = [
        ("tread", [0, 0.25 * h, 0.25 * d], [w, 0.5 * h, 0.5 * d]),
        ("tread", [0, 0.5 * h, -0.25 * d], [w, h, 0.5 * d]),
    ]
    return _solids(rows, len(s))


def _stack(s: Sizes) -> _Built:
    w, d, h, lower, w_upper, d_upper, aside, back = s.T
    upper = [0.5 * np.log(aside) * (w - w_upper), 0.5 * (lower + h), 0.5 * np.log(back) * (d - d_upper)]
    rows = [("lower", [0, 0.5 * lower, 0], [w, lower, d]), ("upper", upper, [w_upper, h - lower, d_upper])]
    return _solids(rows, len(s))


def _slope(s: Sizes) -> _Built:
    w, d, h = s.T
    return _solids([("slope", [0, 0.5 * h, 0], [w, h, d])], len(s), shapes={"slope": WEDGE})


def _leaning_board(s: Sizes) -> _Built:
    w, d, h, thick = s.T
    lean_rad, length = np.arctan2(d, h), np.hypot(d, h)
    center_y = 0.5 * (h + thick * np.sin(lean_rad))
    return _solids([("board", [0, center_y, 0], [w, length, thick])], len(s), tilted=("board",), tilt_rad=lean_rad)


def _size(name: str, usual_m: float, spread: float) -> Size:
    return Size(name, usual_m, spread)


def place(name: str) -> Size:
    """What may be anywhere from -1 to 1: the logarithm of this size."""
    return Size(name, 1.0, float(np.sqrt(1 / 3)))


_ANY = (_size("width", 0.6, 0.8), _size("depth", 0.6, 0.8), _size("height", 0.6, 0.8))
"""Things of no known kind."""


FORMS: tuple[Form, ...] = (
    Form("chair", (_size("width", 0.45, 0.12), _size("depth", 0.43, 0.1), _size("seat height", 0.455, 0.05),
                   _size("back height", 0.45, 0.2)), _chair),
    Form("chair", (_size("width", 0.48, 0.12), _size("depth", 0.45, 0.1), _size("seat height", 0.47, 0.08),
                   _size("back height", 0.5, 0.2)), _swivel_chair, "swivel"),
    Form("armchair", (_size("width", 0.57, 0.1), _size("depth", 0.55, 0.1), _size("seat height", 0.42, 0.08),
                      _size("back height", 0.46, 0.2), _size("arm width", 0.14, 0.3), _size("arm rise", 0.19, 0.2)),
         _soft_seat),
    Form("sofa", (_size("width", 1.6, 0.2), _size("depth", 0.57, 0.1), _size("seat height", 0.42, 0.08),
                  _size("back height", 0.42, 0.2), _size("arm width", 0.14, 0.3), _size("arm rise", 0.19, 0.2)),
         _soft_seat),
    Form("stool", (_size("width", 0.36, 0.12), _size("depth", 0.36, 0.12), _size("seat height", 0.48, 0.2)), _stool,
         turns=2),
    Form("table", (_size("width", 1.4, 0.3), _size("depth", 0.85, 0.2), _size("height", 0.74, 0.04)), _table, turns=2),
    Form("table", (_size("width", 1.0, 0.25), _size("depth", 0.6, 0.2), _size("height", 0.42, 0.15)), _table, "low", 2),
    Form("table", (_size("width", 1.4, 0.3), _size("depth", 0.85, 0.2), _size("height", 0.74, 0.04)), _panel_table,
         "panels", 2),
    Form("table", (_size("width", 0.8, 0.25), _size("height", 0.85, 0.22), _size("foot", 0.5, 0.2)), _round_table,
         "round", 1),
    Form("table", (_size("width", 0.85, 0.25), _size("height", 0.6, 0.25)), _round_table_on_legs, "round, legs", 2),
    Form("desk", (_size("width", 1.3, 0.2), _size("depth", 0.68, 0.15), _size("height", 0.73, 0.04)), _desk(1),
         "drawers at +x"),
    Form("desk", (_size("width", 1.3, 0.2), _size("depth", 0.68, 0.15), _size("height", 0.73, 0.04)), _desk(-1),
         "drawers at -x"),
    Form("bed", (_size("width", 1.3, 0.3), _size("depth", 2.02, 0.04), _size("height", 0.5, 0.15),
                 _size("head rise", 0.4, 0.4)), _bed, share=0.3),
    Form("shelf", (_size("width", 0.9, 0.25), _size("depth", 0.32, 0.2), _size("height", 1.5, 0.3)), _shelf(4), "4"),
    Form("shelf", (_size("width", 0.9, 0.25), _size("depth", 0.32, 0.2), _size("height", 1.9, 0.15)), _shelf(6), "6"),
    Form("cabinet", (_size("width", 0.9, 0.4), _size("depth", 0.45, 0.25), _size("height", 1.0, 0.5)), _box,
         turns=2, stands=False),
    Form("cabinet", (_size("width", 2.2, 0.3), _size("depth", 0.6, 0.06), _size("height", 0.9, 0.04),
                     _size("gap", 0.55, 0.1), _size("upper height", 0.65, 0.15),
                     _size("upper depth", 0.35, 0.1)), _kitchen, "kitchen", share=0.2),
    Form("board", (_size("width", 1.2, 0.4), _size("depth", 0.04, 0.4), _size("height", 1.2, 0.4)), _box, turns=2,
         stands=False, share=0.3),
    Form("board", (_size("width", 1.4, 0.3), _size("depth", 0.04, 0.4), _size("height", 1.8, 0.15),
                   _size("lower edge", 0.8, 0.25)), _board, "on legs", 2, share=0.3),
    Form("lamp", (_size("width", 0.4, 0.25), _size("shade height", 0.28, 0.3), _size("height", 1.55, 0.15),
                  _size("foot", 0.28, 0.2)), _lamp, turns=1, stands=False, share=0.3),
    Form("plant", (_size("width", 0.5, 0.4), _size("pot height", 0.3, 0.3), _size("height", 1.1, 0.35),
                   _size("pot", 0.3, 0.3)), _plant, turns=1, stands=False, share=0.05),
    Form("steps", (_size("width", 0.6, 0.4), _size("depth", 0.55, 0.3), _size("height", 0.36, 0.3)), _steps, share=0.1),
    Form("slope", (_size("width", 1.5, 0.6), _size("depth", 1.2, 0.6), _size("height", 0.5, 0.6)), _slope, share=0.01),
    Form("board", (_size("width", 0.8, 0.6), _size("depth", 0.5, 0.8), _size("height", 1.2, 0.6),
                   _size("thickness", 0.04, 0.4)), _leaning_board, "leaning", share=0.01),
    Form("stack", (*_ANY, _size("lower height", 0.3, 0.8), _size("upper width", 0.4, 0.8),
                   _size("upper depth", 0.4, 0.8), place("upper x"), place("upper z")), _stack, turns=2, stands=False,
         share=0.1),
    Form("box", _ANY, _box, turns=2, stands=False),
)  # fmt: skip
"""All that is tried, with the object's own outline (`extrusion`). Those from `slope` on are for objects of no known
kind."""

BOX = next(form for form in FORMS if form.name == "box")
