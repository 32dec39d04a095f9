"""Random outfits: cuts of clothes and colors of skin, hair and cloth."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import numpy as np

from video2anim.lab.synth.colors import COLORS, Rgb
from video2anim.lab.synth.world import Material

SKINS: tuple[Rgb, ...] = COLORS["skin"]
HAIRS: tuple[Rgb, ...] = COLORS["hair"]
TROUSERS: tuple[Rgb, ...] = COLORS["trousers"]
SHOES: tuple[Rgb, ...] = COLORS["shoe"]


BAREFOOT = float("inf")
"""Start of the shoe for a person without shoes: beyond every limb coordinate."""


@dataclass(frozen=True, slots=True)
class Outfit:
    """Cuts and materials of one person."""

    sleeve: float
    """End of the sleeve along the arm: 0 none, 1 elbow, 2 wrist."""
    cuff: float
    """End of the trouser leg: 1 knee, 2 ankle."""
    hem: float
    """Height of the shirt's hem over the pelvis joint, meters."""
    neckline: str
    """`crew`, `v` or `high`."""
    belt: bool
    sock: float
    """Start of the sock along the leg (2 = ankle); 0 = not visible."""
    shoe: float
    """Start of the shoe along the leg; `BAREFOOT` = no shoe."""
    hair: str
    """`short`, `long`, `bald` or `cap`."""
    beard: bool
    materials: dict[str, Material]


def draw_outfit(gender: float, rng: np.random.Generator) -> Outfit:
    """A random outfit. `gender` is the body model's (0 male to 1 female); it changes only the odds of beards and
    hair."""
    male = rng.random() > gender
    materials, hair = _body_materials(male, rng), _hair_style(male, rng)
    if hair == "cap":
        materials["hair"] = _cloth(_color(rng), rng, patterns=False)
    sleeve = float(rng.choice([0.0, 0.5, 0.6, 1.4, 1.93], p=[0.06, 0.3, 0.24, 0.1, 0.3]))
    cuff = float(rng.choice([0.55, 0.75, 0.95, 1.93], p=[0.05, 0.13, 0.12, 0.70]))
    tucked = rng.random() < 0.3
    materials["top"] = _cloth(_color(rng), rng, patterns=True)
    materials["bottom"] = _cloth(_jittered(TROUSERS[rng.integers(len(TROUSERS))], rng), rng, patterns=False)
    if rng.random() < (0.02 if male else 0.15):
        materials["bottom"], cuff, tucked = materials["top"], min(cuff, 0.8), False
    shoe = _jittered(SHOES[rng.integers(len(SHOES))], rng)
    materials["shoe"] = Material("leather", shoe, _scaled(shoe, 0.7), gloss=0.15, seed=_seed(rng))
    materials["sole"] = Material("plain", (0.85, 0.84, 0.80) if rng.random() < 0.5 else (0.12, 0.12, 0.12))
    materials["sock"] = Material("fabric", (0.85, 0.85, 0.85) if rng.random() < 0.5 else (0.12, 0.12, 0.14), shoe, 0.01)
    materials["belt"] = Material("leather", (0.14, 0.09, 0.06), (0.05, 0.04, 0.03), gloss=0.2)
    feet = str(rng.choice(["shoes", "socks", "bare"], p=[0.62, 0.22, 0.16]))
    sock = 1.72 if feet == "socks" or (feet == "shoes" and cuff < 1.5 and rng.random() < 0.7) else 0.0
    return Outfit(
        sleeve=sleeve,
        cuff=cuff,
        hem=0.075 if tucked else float(rng.uniform(-0.09, -0.02)),
        neckline=str(rng.choice(["crew", "v", "high"], p=[0.6, 0.25, 0.15])),
        belt=bool(tucked and rng.random() < 0.7),
        sock=sock,
        shoe=BAREFOOT if feet != "shoes" else float(rng.choice([1.9, 1.96])),
        hair=hair,
        beard=bool(male and rng.random() < 0.3),
        materials=materials,
    )


def _hair_style(male: bool, rng: np.random.Generator) -> str:
    odds = [0.68, 0.08, 0.12, 0.12] if male else [0.33, 0.57, 0.01, 0.09]
    return str(rng.choice(["short", "long", "bald", "cap"], p=odds))


def _body_materials(male: bool, rng: np.random.Generator) -> dict[str, Material]:
    tone = int(rng.integers(len(SKINS)))
    skin = _jittered(SKINS[tone], rng, 0.02)
    hair = HAIRS[rng.integers(len(HAIRS))] if tone < 3 else HAIRS[rng.integers(3)]
    flush = (skin[0] * 0.98, skin[1] * 0.80, skin[2] * 0.76)
    lips = (skin[0] * (0.86 if male else 0.85), skin[1] * 0.64, skin[2] * 0.66)
    strands = Material("hair", hair, _scaled(_mixed(hair, (0.4, 0.36, 0.32), 0.2), 1.4), gloss=0.12, seed=_seed(rng))
    return {
        "skin": Material("skin", skin, flush, gloss=0.07, seed=_seed(rng)),
        "hair": strands,
        "brow": Material("hair", _mixed(hair, skin, 0.3), _mixed(hair, skin, 0.5)),
        "beard": Material("hair", _mixed(hair, skin, 0.35), _mixed(hair, skin, 0.6), seed=strands.seed),
        "lips": Material("skin", lips, lips, gloss=0.2),
        "eye": Material("plain", (0.83, 0.81, 0.79), gloss=0.5),
        "iris": Material("plain", (0.09, 0.07, 0.06) if tone > 2 else (0.16, 0.17, 0.18), gloss=0.8),
    }


def _color(rng: np.random.Generator) -> Rgb:
    """A random cloth color; half of them are muted or gray."""
    muted = rng.random() < 0.5
    saturation = rng.uniform(0.0, 0.25) if muted else rng.uniform(0.35, 0.8)
    return colorsys.hsv_to_rgb(rng.random(), saturation, float(rng.uniform(0.18, 0.9)))


def _cloth(color: Rgb, rng: np.random.Generator, *, patterns: bool) -> Material:
    kind = str(rng.choice(["fabric", "stripes", "checks"], p=[0.62, 0.24, 0.14])) if patterns else "fabric"
    size = {"fabric": 0.01, "stripes": rng.uniform(0.02, 0.09), "checks": rng.uniform(0.03, 0.10)}[kind]
    second = _scaled(color, 0.82) if kind == "fabric" else _other(color, rng)
    return Material(kind, color, second, float(size), seed=_seed(rng))


def _other(color: Rgb, rng: np.random.Generator) -> Rgb:
    """A color that matches another: white, dark, or a shade of it."""
    choice = rng.integers(3)
    return ((0.90, 0.89, 0.86), (0.10, 0.10, 0.13), _scaled(color, 0.55))[choice]


def _jittered(color: Rgb, rng: np.random.Generator, amount: float = 0.03) -> Rgb:
    shift = rng.normal(0, amount) + rng.normal(0, 0.4 * amount, 3)
    r, g, b = (float(v) for v in np.clip(np.asarray(color) + shift, 0.03, 0.95))
    return r, g, b


def _scaled(color: Rgb, factor: float) -> Rgb:
    return min(1.0, factor * color[0]), min(1.0, factor * color[1]), min(1.0, factor * color[2])


def _mixed(one: Rgb, two: Rgb, share: float) -> Rgb:
    r, g, b = ((1 - share) * p + share * q for p, q in zip(one, two, strict=True))
    return r, g, b


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(1, 1000))
