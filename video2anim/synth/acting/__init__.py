"""Human motion that captured data lacks, made by a seeded generator."""

from video2anim.synth.acting.acts import ACTS, act
from video2anim.synth.acting.archive import to_source_clip
from video2anim.synth.acting.join import joined

__all__ = ["ACTS", "act", "joined", "to_source_clip"]
