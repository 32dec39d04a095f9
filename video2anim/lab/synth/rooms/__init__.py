"""Random furnished rooms around a given motion: solids, materials, furniture, structure, layout and clearance."""

from video2anim.lab.synth.rooms.build import ITEM_NOTE, STYLES, build_room, split_items
from video2anim.lab.synth.rooms.clearance import clearance_ok, penetration_m
from video2anim.lab.synth.rooms.external import load_meshes
from video2anim.lab.synth.rooms.furniture import make_furniture

__all__ = [
    "ITEM_NOTE",
    "STYLES",
    "build_room",
    "clearance_ok",
    "load_meshes",
    "make_furniture",
    "penetration_m",
    "split_items",
]
