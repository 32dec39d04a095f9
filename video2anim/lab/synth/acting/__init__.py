"""Procedural human motion: kinds that captured data lacks (sit, lie, carry...), made by a seeded generator."""

from video2anim.lab.synth.acting.acts import ACTS, act
from video2anim.lab.synth.acting.archive import to_source_clip
from video2anim.lab.synth.acting.carry import CARRIES, act_carry
from video2anim.lab.synth.acting.join import joined

__all__ = ["ACTS", "CARRIES", "act", "act_carry", "joined", "to_source_clip"]
