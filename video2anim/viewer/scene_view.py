"""What the viewer shows: motions of the stages and the scene."""

from __future__ import annotations

from dataclasses import dataclass

from video2anim.errors import UsageError
from video2anim.types import BodyMotion, Contact, SceneModel
from video2anim.types.motion import main_person

STAGES = ("raw", "keyframes", "refined")


@dataclass(frozen=True, slots=True, eq=False)
class SceneView:
    """What can be looked at: motions by stage, and the scene where there is one."""

    motions: dict[str, tuple[BodyMotion, ...]]
    """Any of `raw`, `keyframes`, `refined`, main person first; at least one, all of the same length."""
    scene: SceneModel | None
    contacts: tuple[Contact, ...] = ()
    """What the people of `refined` touch."""

    def people(self, stage: str | None = None) -> tuple[BodyMotion, ...]:
        """Motions of a stage; of the last one made where `stage` is None.

        Raises:
            UsageError: there is no such stage here.
        """
        present = [name for name in STAGES if name in self.motions]
        if stage is None and present:
            return self.motions[present[-1]]
        if stage not in self.motions:
            raise UsageError(f"view stage: want one of {', '.join(present) or 'none (no motion yet)'}, got {stage!r}")
        return self.motions[stage]

    def contacts_of(self, stage: str | None = None) -> tuple[Contact, ...]:
        """What is known of the contacts of a stage, as `people` takes it."""
        return self.contacts if self.people(stage) is self.motions.get("refined") else ()

    @property
    def frame_count(self) -> int:
        return main_person(self.people()).frame_count
