"""People and carried objects as surfaces, at any time of a shot."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from video2anim.body.anny_body import shaped_body
from video2anim.lab.synth.render.garments import borders_of, spanning
from video2anim.lab.synth.render.surfaces import (
    Surfaces,
    join_surfaces,
    object_vertices,
    surfaces_of_mesh,
    surfaces_of_object,
)
from video2anim.lab.synth.world import PERSON_ID, Actor, MovingObject, Shot
from video2anim.types.skeleton import forward_kinematics


class MovingSurfaces:
    """The moving surfaces of a shot: actors first, then carried objects."""

    def __init__(self, shot: Shot) -> None:
        self._shot = shot
        self._rest = [_rest_surfaces(actor) for actor in shot.actors]
        self._spanning = [
            spanning(rest.faces, rest.material, rest.materials, len(rest.vertices_m)) for rest in self._rest
        ]
        self._posed: dict[tuple[int, int], np.ndarray] = {}

    def surfaces(self, frame: int, shift: float = 0.0) -> Surfaces:
        """All surfaces at the time `frame + shift` (-1 <= shift <= 1), interpolated linearly between frames."""
        pieces = [self.actor_surfaces(n, frame, shift) for n in range(len(self._shot.actors)) if self._here(n, frame)]
        for moving in self._shot.moving:
            blended = surfaces_of_object(moving.scene_object, moving.T_world_object[self._clamped(frame)])
            pieces.append(blended.moved(self._object_vertices(moving, frame, shift)) if shift else blended)
        return join_surfaces(pieces)

    def vertices_m(self, frame: int, shift: float = 0.0) -> Float[np.ndarray, "vertices 3"]:
        """Vertices of `surfaces`; their normals, which are not made here, take much longer."""
        actors = [n for n in range(len(self._shot.actors)) if self._here(n, frame)]
        pieces = [self._actor_vertices(n, frame, shift) for n in actors]
        pieces += [self._object_vertices(moving, frame, shift) for moving in self._shot.moving]
        return np.concatenate([np.zeros((0, 3), np.float32), *pieces]).astype(np.float32)

    def actor_surfaces(self, number: int, frame: int, shift: float = 0.0) -> Surfaces:
        """The surfaces of one actor at the time `frame + shift`."""
        return self._rest[number].moved(self._actor_vertices(number, frame, shift), self._spanning[number])

    def _actor_vertices(self, number: int, frame: int, shift: float) -> np.ndarray:
        vertices = self._vertices(number, frame)
        if shift:
            other = self._vertices(number, self._clamped(frame + int(np.sign(shift))))
            vertices = vertices + abs(shift) * (other - vertices)
        return vertices

    def _object_vertices(self, moving: MovingObject, frame: int, shift: float) -> np.ndarray:
        vertices = object_vertices(moving.scene_object, moving.T_world_object[self._clamped(frame)])
        if shift:
            other = moving.T_world_object[self._clamped(frame + int(np.sign(shift)))]
            vertices = vertices + abs(shift) * (object_vertices(moving.scene_object, other) - vertices)
        return vertices

    def _here(self, number: int, frame: int) -> bool:
        return bool(self._shot.actors[number].motion.valid[frame])

    def _clamped(self, frame: int) -> int:
        return min(max(frame, 0), self._shot.frame_count - 1)

    def _vertices(self, number: int, frame: int) -> np.ndarray:
        """(V, 3) skinned vertices in the world; the last few frames are cached."""
        key = (number, frame)
        if key not in self._posed:
            motion = self._shot.actors[number].motion
            joints, R_world_joint = forward_kinematics(
                motion.R_parent_joint[frame : frame + 1],
                motion.T_world_root[frame : frame + 1, :3, 3],
                motion.rest_joints_m,
            )
            while len(self._posed) >= 3 * len(self._shot.actors):
                del self._posed[next(iter(self._posed))]
            self._posed[key] = shaped_body(motion.shape).vertices(R_world_joint, joints)[0]
        return self._posed[key]


def _rest_surfaces(actor: Actor) -> Surfaces:
    """An actor's body at rest; textures are evaluated here."""
    body = shaped_body(actor.motion.shape)
    return surfaces_of_mesh(
        body.rest_vertices_m,
        body.faces,
        body.rest_vertices_m,
        smooth=True,
        object_id=PERSON_ID + actor.motion.person_id,
        face_material=actor.face_material,
        materials=actor.materials,
        borders=borders_of(body.faces, actor.face_material, actor.materials, len(body.rest_vertices_m)),
    )
