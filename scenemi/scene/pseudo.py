"""Random scenes in which a given motion could have happened, for training on motion captured without its scene.

Free space is what the clip's own body sweeps (the idea of Liu et al. 2023, "Revisit human-scene interaction via space
occupancy"). There is a floor, supports under resting body parts, and furniture and walls pushed up to a chosen
clearance beside the path. Everything is upright boxes, so distances are exact and fast.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float

from scenemi.scene.body_spheres import BodySpheres, adult_spheres
from scenemi.scene.boxes import Boxes
from scenemi.scene.furniture import FURNITURE, Piece, doorway, wall
from scenemi.scene.sliding import Slide, SweptBody, nearest_free, places_m
from scenemi.scene.supports import Motion, RestConfig, supports
from scenemi.scene.telling import telling_solids
from video2anim.types.clip import FPS

_QUARTER = np.pi / 2
_BEYOND_M = 3.0
"""Depth behind a wall in which nothing stands: more than the model sees (2.4 m)."""
_SNUG_M = 0.01
"""Supports are put against spheres smaller by this, which end where the skin does."""
_THIN_M = 0.012
"""Anchors may lie this far outside of the spheres before these are made larger."""
_THICKEST_M = 0.1
"""By which spheres are made larger at most: bodies of other shapes differ by up to 7 cm."""


@dataclass(frozen=True, slots=True)
class SyntheticSceneConfig:
    """How full scenes are."""

    empty_share: float = 0.1
    """Share of scenes with a floor and nothing else."""
    furniture: tuple[int, int] = (1, 7)
    """Fewest and most pieces tried."""
    telling: tuple[int, int] = (1, 3)
    """Fewest and most solids tried on the path of the scene-blind filling, where one is given."""
    wall_share: tuple[float, ...] = (0.3, 0.3, 0.25, 0.1, 0.05)
    """Chances of 0, 1, 2, 3, 4 walls."""
    doorway_share: float = 0.2
    """Share of scenes with a wall whose opening the path goes through, where it goes anywhere."""
    clearance_m: tuple[tuple[float, float, float], ...] = ((0.35, 0.0, 0.05), (0.4, 0.05, 0.25), (0.25, 0.25, 0.6))
    """(chance, least, largest) of the gap between sweep and furniture."""
    loose_share: float = 0.3
    """Share of scenes in which all gaps are larger, by up to `loosest_m`."""
    loosest_m: float = 0.5
    """See above (not measured)."""
    enclosed_share: float = 0.25
    """Share of pieces put at any free place of their line, such as inside a curve of the path, not at the nearest."""
    wall_room_m: float = 1.0
    """Half of the walls stand up to this much farther off, so that furniture fits before them."""
    tries: int = 3
    """How many places are tried for a piece."""
    rest: RestConfig = field(default_factory=RestConfig)


class SyntheticScenes:
    """Draws scenes; the same generator state and motion give the same scene."""

    def __init__(self, config: SyntheticSceneConfig | None = None) -> None:
        self.config = config or SyntheticSceneConfig()

    def solids(
        self,
        rng: np.random.Generator,
        joints_m: Float[np.ndarray, "frames 22 3"],
        R_world_joint: Float[np.ndarray, "frames 22 3 3"],
        anchors_m: Float[np.ndarray, "frames anchors 3"] | None,
        contact: Bool[np.ndarray, "frames 22"] | None = None,
        *,
        spheres: BodySpheres | None = None,
        blind_m: Float[np.ndarray, "frames 22 3"] | None = None,
    ) -> list[tuple[str, Boxes]]:
        """Named solids around a motion, none with the body in it.

        Args:
            rng: source of everything random.
            joints_m: canonical frame, floor at y = 0.
            R_world_joint: orientations in the canonical frame.
            anchors_m: anchors of the posed skin.
            contact: joints known to rest on something; still joints are found without it too.
            spheres: volume of this body (`fit_spheres`); else the mean adult's, thickened until it holds the anchors.
            blind_m: joints of a filling of the same keyframes that sees no scene: solids are put where it goes and the
                body does not (`scenemi.scene.telling`).
        """
        body, spheres = _sweep(joints_m, R_world_joint, anchors_m, spheres)
        known = np.zeros(joints_m.shape[:2], bool) if contact is None else np.asarray(contact, bool)
        named: list[tuple[str, Boxes]] = []
        if rng.random() >= self.config.empty_share:
            snug = replace(body, radius_m=body.radius_m - np.float32(_SNUG_M))
            motion = Motion(joints_m, R_world_joint, known, spheres, snug, FPS)
            named = supports(rng, motion, self.config.rest)
            if blind_m is not None:
                count = int(rng.integers(self.config.telling[0], self.config.telling[1] + 1))
                named += telling_solids(rng, body, blind_m, count)
            named = self._furnished(rng, body, joints_m[:, 0], named)
        return named

    def _furnished(
        self, rng: np.random.Generator, body: SweptBody, root_m: np.ndarray, named: list[tuple[str, Boxes]]
    ) -> list[tuple[str, Boxes]]:
        """The supports, then a doorway, walls and furniture, most of it along the room's axes."""
        config, named = self.config, list(named)
        loose_m = float(rng.uniform(0.0, config.loosest_m)) if rng.random() < config.loose_share else 0.0
        room = Room(body, rng.normal(0.0, 0.1) if rng.random() < 0.5 else rng.uniform(0.0, _QUARTER))
        if rng.random() < config.doorway_share:
            _add(named, room.doorway(rng, root_m))
        resting = Boxes.joined(b for _, b in named)
        for side in rng.permutation(4)[: rng.choice(len(config.wall_share), p=config.wall_share)]:
            clearance_m = loose_m + self._clearance(rng) + rng.choice([0.0, rng.uniform(0.0, config.wall_room_m)])
            _add(named, room.beside(rng, wall(rng), int(side), root_m, clearance_m, resting, 0.0))
        makers, chances = zip(*FURNITURE, strict=True)
        for _ in range(rng.integers(config.furniture[0], config.furniture[1] + 1)):
            piece = makers[rng.choice(len(makers), p=chances)](rng)
            others = _with_beyond(named)
            for _ in range(config.tries):
                side = int(rng.integers(4))
                clearance_m = loose_m + self._clearance(rng)
                found = room.beside(rng, piece, side, root_m, clearance_m, others, config.enclosed_share)
                if found is not None:
                    named.append(found)
                    break
        return named

    def _clearance(self, rng: np.random.Generator) -> float:
        chances = [chance for chance, _, _ in self.config.clearance_m]
        _, low, high = self.config.clearance_m[rng.choice(len(chances), p=chances)]
        return float(rng.uniform(low, high))


class Room:
    """Four directions to push furniture in."""

    def __init__(self, body: SweptBody, yaw_rad: float) -> None:
        self._body, self._yaw_rad = body, yaw_rad
        self._slides: dict[int, Slide] = {}

    def slide(self, side: int) -> Slide:
        """Lines toward one of four sides, made once."""
        if side not in self._slides:
            self._slides[side] = Slide(self._body, self._yaw_rad + side * _QUARTER)
        return self._slides[side]

    def beside(
        self,
        rng: np.random.Generator,
        piece: Piece,
        side: int,
        root_m: Float[np.ndarray, "frames 3"],
        clearance_m: float,
        others: Boxes,
        anywhere_share: float,
    ) -> tuple[str, Boxes] | None:
        """The piece beside a random point of the path, its front toward the path."""
        slide = self.slide(side)
        sideways_m, along_m = slide.local(root_m[rng.integers(len(root_m))])
        sideways_m += float(rng.normal(0.0, 0.3))
        free = slide.free(piece, sideways_m, clearance_m, others)
        if rng.random() < anywhere_share:
            places = places_m()[free & (np.abs(places_m() - along_m) < 2.0)]
            place_m = float(rng.choice(places)) if len(places) else None
        else:
            behind = free & (places_m() < along_m)
            place_m = nearest_free(behind, along_m, 3.0)
        return None if place_m is None else (piece.kind, slide.placed(piece, sideways_m, place_m))

    def doorway(self, rng: np.random.Generator, root_m: Float[np.ndarray, "frames 3"]) -> tuple[str, Boxes] | None:
        """A wall across the path whose opening lets the body through."""
        travel = root_m[-1] - root_m[0]
        if np.hypot(travel[0], travel[2]) < 1.0:
            return None
        slide = self.slide(int(np.rint((np.arctan2(travel[0], travel[2]) - self._yaw_rad) / _QUARTER)) % 4)
        piece = doorway(rng)
        sideways_m, along_m = slide.local(root_m[rng.integers(len(root_m))])
        sideways_m += float(rng.normal(0.0, 0.08))
        place_m = nearest_free(slide.free(piece, sideways_m, 0.0, Boxes.none()), along_m, 0.5)
        return None if place_m is None else (piece.kind, slide.placed(piece, sideways_m, place_m))


def _with_beyond(named: list[tuple[str, Boxes]]) -> Boxes:
    """What is in the way of furniture: all that stands there, and the space behind walls."""
    blocked = []
    for kind, boxes in named:
        if kind == "wall":
            # A wall's front faces the path; its copies behind it fill what lies beyond.
            behind = np.stack([np.sin(boxes.yaw_rad), 0 * boxes.yaw_rad, np.cos(boxes.yaw_rad)], -1)
            depth_m = np.array([0.0, 0.0, 0.5 * _BEYOND_M])
            center_m = boxes.center_m - behind * (0.5 * _BEYOND_M)
            boxes = Boxes(center_m, boxes.half_m + depth_m, boxes.yaw_rad)
        blocked.append(boxes)
    return Boxes.joined(blocked)


def _add(named: list[tuple[str, Boxes]], found: tuple[str, Boxes] | None) -> None:
    if found is not None:
        named.append(found)


def _sweep(
    joints_m: np.ndarray, R_world_joint: np.ndarray, anchors_m: np.ndarray | None, spheres: BodySpheres | None
) -> tuple[SweptBody, BodySpheres]:
    """The swept spheres; without a body of its own, the adult's, thickened until the skin's anchors are inside."""
    known = spheres is not None
    spheres = spheres if spheres is not None else adult_spheres()
    center_m, radius_m = spheres.placed(joints_m, R_world_joint), spheres.radius_m
    if not known and anchors_m is not None:
        frames = np.linspace(0, len(joints_m) - 1, 4).astype(int)
        toward = np.moveaxis(center_m[:, frames], 0, -1)[:, None] - anchors_m[frames][:, :, None]
        outside_m = float((np.linalg.norm(toward, axis=-1) - radius_m).min(axis=-1).max())
        radius_m = radius_m + np.float32(np.clip(outside_m - _THIN_M, 0.0, _THICKEST_M))
    return SweptBody(center_m, radius_m), spheres
