"""Contacts of the lifter by body part, in the order of `CONTACT_JOINTS`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from video2anim.humans.lifter_input import CONTACT_JOINTS


def _joints(*names: str) -> Bool[np.ndarray, "contacts"]:
    return np.array([joint.rpartition("_")[2] in names for joint in CONTACT_JOINTS])


PARTS = {
    "feet": _joints("ankle", "foot"),
    "hands": _joints("wrist"),
    "seat": _joints("pelvis"),
    "back": _joints("spine3"),
}
"""Contacts of each body part."""


def _mirrored(joint: str) -> str:
    side, _, part = joint.partition("_")
    return f"{dict(left='right', right='left')[side]}_{part}" if part else joint


MIRRORED = [CONTACT_JOINTS.index(_mirrored(joint)) for joint in CONTACT_JOINTS]
"""Index of the contact on the other side."""
