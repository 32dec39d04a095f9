"""Rooms of known truth as the evidence that stages before calibration would have of them: no picture, no body model.

The truth is drawn in the camera's frame; what wrong sizes make of it follows from pinhole geometry: bodies keep their
place and size in the picture.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from video2anim.calibration.evidence import (
    Evidence,
    ObjectEvidence,
    PersonEvidence,
    PixelEvidence,
    SkinEvidence,
)

FOCAL_PX = 900.0
HALF_PX = np.array([640.0, 360.0])
"""Half of the picture."""


def up_of(pitch_deg: float, roll_deg: float = 0.0) -> np.ndarray:
    """Up in the axes of a camera that looks down by `pitch_deg` and is rolled."""
    pitch, roll = np.deg2rad([pitch_deg, roll_deg])
    return np.array([np.sin(roll) * np.cos(pitch), -np.cos(roll) * np.cos(pitch), -np.sin(pitch)])


@dataclass(frozen=True)
class Thing:
    """An object on the floor, and by how much the network sees it nearer than it is (logarithm)."""

    label: str
    at_m: tuple[float, float]
    """To the right and away, on the floor."""
    height_m: float
    nearer_log: float = 0.0
    is_cut: bool = False


@dataclass(frozen=True)
class Noise:
    """Standard deviations, as the fit takes them to be."""

    sole_m: float = 0.0
    distance_ratio: float = 0.0
    floor_log: float = 0.0
    """Common to a block of the floor's pixels; there are twelve."""
    skin_log: float = 0.0
    """Common to a frame's."""


HONEST = Noise(0.03, 0.03, 0.08, 0.05)


@dataclass(frozen=True)
class World:
    """The truth, and the wrong ideas that the evidence has of it."""

    kind: str = "depth"
    up: np.ndarray = field(default_factory=lambda: up_of(15.0, 3.0))
    height_m: float = 1.6
    scale: float = 0.7
    offset: float = 0.3
    nearer_log: float = 0.0
    """Of the main person, as for objects."""
    size: tuple[float, ...] = (1.0,)
    """Every person's true size over the supposed one."""
    body_height_sigma: tuple[float, ...] = (0.05,)
    step_m: tuple[float, ...] = (0.0,)
    """By how much higher than the floor each person's own floor is."""
    objects: tuple[Thing, ...] = ()
    usual_offset_sigma: float = 0.5
    noise: Noise = Noise()
    seed: int = 0

    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Right and away on the floor."""
        away = np.array([0.0, 0.0, 1.0]) - self.up[2] * self.up
        away /= np.linalg.norm(away)
        return np.cross(away, self.up) * np.sign(np.cross(away, self.up)[0]), away

    def on_floor(self, right_m: np.ndarray, away_m: np.ndarray, above_m: np.ndarray | float = 0.0) -> np.ndarray:
        """Points in the true camera's frame."""
        right, away = self.axes()
        at = np.multiply.outer(np.asarray(right_m, float), right) + np.multiply.outer(np.asarray(away_m, float), away)
        return at + (np.asarray(above_m, float) - self.height_m)[..., None] * self.up

    def ray(self, points_m: np.ndarray) -> np.ndarray:
        return points_m / points_m[..., 2:]

    def coded(self, depth_m: np.ndarray, nearer_log: float = 0.0) -> np.ndarray:
        """What the network says of a depth that it sees nearer than it is."""
        seen_m = np.asarray(depth_m, float) * np.exp(-nearer_log)
        return ((seen_m if self.kind == "depth" else 1 / seen_m) - self.offset) / self.scale

    def person(self, number: int, rng: np.random.Generator, windows: int = 20) -> PersonEvidence:
        """Somebody who walks about, 2.5 to 5.5 m away."""
        size, noise = self.size[number], self.noise
        right_m, away_m = rng.uniform(-1.2, 1.2, windows), rng.uniform(2.5, 5.5, windows)
        sole_m = self.on_floor(right_m, away_m, self.step_m[number] + noise.sole_m * rng.normal(size=windows))
        farther = np.exp(noise.distance_ratio * rng.normal(size=windows))[:, None]
        return PersonEvidence(number + 1, self.body_height_sigma[number], sole_m * farther / size, 0 * sole_m)

    def skin(self, rng: np.random.Generator, frames: int = 8, points: int = 60) -> tuple[SkinEvidence, ...]:
        """The near half of an upright cylinder: points of the body, and pixels of other points of it."""
        found = []
        for away_m in np.linspace(2.6, 5.2, frames):
            right_m = rng.uniform(-1.0, 1.0)
            angle, high_m = rng.uniform(-1.3, 1.3, (2, points)), rng.uniform(0.1, 1.7, (2, points))
            skin_m, seen_m = self.on_floor(right_m + 0.2 * np.sin(angle), away_m - 0.2 * np.cos(angle), high_m)
            wrong_log = self.nearer_log + self.noise.skin_log * rng.normal()
            value = self.coded(seen_m[:, 2], wrong_log)
            found.append(SkinEvidence(skin_m / self.size[0], self.ray(seen_m), value))
        return tuple(found)

    def floor(self, rng: np.random.Generator, pixels: int = 120) -> PixelEvidence:
        """Floor 2 to 7 m away, in order of its distance."""
        away_m = np.sort(np.exp(rng.uniform(np.log(2.2), np.log(7.0), pixels)))
        floor_m = self.on_floor(rng.uniform(-0.35, 0.35, pixels) * away_m, away_m)
        blocks = np.arange(pixels) * 12 // max(pixels, 1)
        wrong_log = self.noise.floor_log * rng.normal(size=12)[blocks]
        return PixelEvidence(self.ray(floor_m), self.coded(floor_m[:, 2] * np.exp(wrong_log)))

    def object_evidence(self, number: int, obj: Thing) -> ObjectEvidence:
        """An object of which foot and top are seen."""
        foot_m, top_m = self.on_floor(*np.array([obj.at_m] * 2).T, np.array([0.0, obj.height_m]))
        foot, top = (
            PixelEvidence(self.ray(at_m)[None], self.coded(at_m[2:], obj.nearer_log)) for at_m in (foot_m, top_m)
        )
        return ObjectEvidence(number, obj.label, foot, obj.is_cut, top)

    def evidence(self, frames: int = 8) -> Evidence:
        """All of it."""
        rng = np.random.default_rng(self.seed)
        center = float(np.median(np.abs(self.coded(np.linspace(2.2, 7.0, 50)))))
        return Evidence(
            focal_px=FOCAL_PX,
            up=self.up,
            people=tuple(self.person(number, rng) for number in range(len(self.size))),
            kind=self.kind,
            skin=self.skin(rng, frames),
            floor=self.floor(rng),
            objects=tuple(self.object_evidence(number, obj) for number, obj in enumerate(self.objects, 1)),
            usual_offset=self.offset / (self.scale * center),
            usual_offset_sigma=self.usual_offset_sigma,
            median_value=center,
        )


def times(evidence: Evidence, factor: float) -> Evidence:
    """The same evidence with all relative depth multiplied."""

    def of(seen: PixelEvidence | None) -> PixelEvidence | None:
        return None if seen is None else PixelEvidence(seen.ray, factor * seen.value)

    return replace(
        evidence,
        floor=of(evidence.floor),
        skin=tuple(replace(one, value=factor * one.value) for one in evidence.skin),
        objects=tuple(replace(o, foot=of(o.foot), top=of(o.top)) for o in evidence.objects),
        median_value=factor * evidence.median_value,
    )
