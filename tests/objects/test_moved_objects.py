"""Pictures of a fixed camera in which somebody takes a box from the floor, carries it, and puts it down."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator
from seen_boxes import FLOOR, LENS, Block, looking, shoot

from video2anim.body.anny_body import ADULT, shaped_body
from video2anim.geometry.projection import invert_rigid, project, transform_points
from video2anim.geometry.rotations import matrix_from_axis_angle
from video2anim.geometry.scene_mesh import box_mesh
from video2anim.objects.carried import Pictures, with_moved_objects
from video2anim.objects.changes import Change
from video2anim.objects.hands import hands_of
from video2anim.types import (
    BodyMotion,
    BodyShape,
    BodyTracks,
    InstanceMasks,
    ObjectInstance,
    PlacedObject,
)
from video2anim.types.skeleton import JOINT_INDEX, forward_kinematics

FRAMES, STEP = 300, 5
T_WORLD_CAMERA = looking((0.0, 1.6, 0.0), (0.0, 0.7, -3.4))
BOX_M = (0.26, 0.3, 0.26)
START_M, GOAL_M = (-0.7, 0.0, -3.3), (0.8, 0.0, -3.5)
"""Where the box's bottom rests."""
WALL = Block((0.0, 1.5, -6.0), (16.0, 3.0, 0.1))
TOP_M = BOX_M[1] + 0.03
"""The middle of the hand above the box's bottom."""
FLOOR_RGB, WALL_RGB, BOX_RGB, BODY_RGB = (128, 112, 92), (176, 180, 176), (190, 50, 44), (52, 66, 96)


@dataclass(frozen=True, eq=False)
class Scene:
    """Pictures of known truth."""

    pictures: Pictures
    motion: BodyMotion
    bottom_m: np.ndarray
    """Of the box, by frame."""

    def mask(self, frame: int) -> np.ndarray:
        """Of the box there, without people."""
        nobody = np.zeros((LENS.height_px, LENS.width_px), bool)
        return painted([box_at(self.bottom_m[frame])], nobody)[1]

    def found(
        self, *objects: PlacedObject, masks: tuple[np.ndarray, ...] = (), people: tuple[BodyMotion, ...] = ()
    ) -> list[PlacedObject]:
        """What is made of it.

        Args:
            objects: Of the background image.
            masks: Theirs.
            people: Instead of the one.
        """
        instances = tuple(
            ObjectInstance(one.object_id, one.label, 1.0, np.zeros(4), mask)
            for one, mask in zip(objects, masks, strict=True)
        )
        known = InstanceMasks("truth", instances, np.zeros((LENS.height_px, LENS.width_px), bool))
        return with_moved_objects(self.pictures, known, BodyTracks(tuple(people or (self.motion,))), objects)


def hand_course(taken: int, put: int, rise: int, lift_m: float) -> np.ndarray:
    """The hand by frame: in from the left, down to the box, up and on to the goal, down, and out to the right.

    Args:
        taken: Frame of the grip.
        put: Frame of letting go.
        rise: Frames in which it is lifted.
        lift_m: How high.
    """
    start_m, goal_m = (np.add(place_m, (0.0, TOP_M, 0.0)) for place_m in (START_M, GOAL_M))
    before_m, after_m = np.array([-0.3, lift_m, 0.0]), np.array([0.3, lift_m, 0.0])
    places_m = {
        0: np.array([-1.9, 0.8, -3.2]),
        taken - 15: start_m + before_m,
        taken: start_m,
        taken + rise: start_m + after_m,
        put - 15: goal_m + before_m,
        put: goal_m,
        put + 15: goal_m + after_m,
        put + 50: np.array([2.2, 0.8, -3.5]),
    }
    frames = sorted(places_m)
    course = PchipInterpolator(frames, [places_m[frame] for frame in frames])
    return course(np.clip(np.arange(FRAMES), 0, frames[-1]))


def body_at(hand_m: np.ndarray) -> BodyMotion:
    """A stiff body that faces the camera and glides so that its right hand is there."""
    body = shaped_body(BodyShape("anny", dict(ADULT)))
    R = np.tile(np.eye(3), (len(hand_m), 22, 1, 1))
    for name, angle_rad in (("left_shoulder", -1.3), ("right_shoulder", 1.3)):
        R[:, JOINT_INDEX[name]] = matrix_from_axis_angle(np.array([0.0, 0.0, angle_rad]))
    T_world_root = np.tile(np.eye(4), (len(hand_m), 1, 1))
    motion = BodyMotion(
        1, np.arange(len(hand_m)) / 30, np.ones(len(hand_m), bool), T_world_root, R,
        np.tile(T_WORLD_CAMERA, (len(hand_m), 1, 1)), LENS, np.zeros((len(hand_m), 22)),
        BodyShape("anny", dict(ADULT)), body.rest_joints_m, np.zeros((len(hand_m), 22, 3)),
    )  # fmt: skip
    T_world_root[:, :3, 3] = hand_m - hands_of(motion, LENS)[1].T_world_hand[0, :3, 3]
    joints_m, _ = forward_kinematics(R, T_world_root[:, :3, 3], body.rest_joints_m)
    return replace(motion, T_world_root=T_world_root, joints_world_m=joints_m)


def silhouettes(motion: BodyMotion) -> list[np.ndarray]:
    """Blobs around the body's joints and hands, in the frames that are looked at."""
    hands_m = np.stack([hand.T_world_hand[:, :3, 3] for hand in hands_of(motion, LENS)], 1)
    points_m = np.concatenate([motion.joints_world_m, hands_m], 1)[::STEP]
    pixels = np.round(project(transform_points(invert_rigid(T_WORLD_CAMERA), points_m), LENS)).astype(np.int32)
    made = []
    for own in pixels:
        mask = np.zeros((LENS.height_px, LENS.width_px), np.uint8)
        cv2.fillConvexPoly(mask, cv2.convexHull(own), 1)
        made.append(cv2.dilate(mask, np.ones((9, 9), np.uint8)) > 0)
    return made


def box_at(bottom_m: np.ndarray) -> Block:
    x, y, z = bottom_m.tolist()
    return Block((x, y + 0.5 * BOX_M[1], z), BOX_M)


def painted(blocks: list[Block], person: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A picture without noise, and the pixels of the box, which is the first block but the wall."""
    shot = shoot([WALL, *blocks], T_WORLD_CAMERA)
    wave = 1 + 0.08 * np.sin(9 * shot.world_m[..., 0]) * np.cos(7 * shot.world_m[..., 1] + 5 * shot.world_m[..., 2])
    color = np.where(shot.mask(FLOOR)[..., None], FLOOR_RGB, WALL_RGB) * wave[..., None]
    color = np.where(person[..., None], BODY_RGB, color)
    box = shot.mask(1)
    lit = 0.6 + 0.4 * np.abs(shot.normal @ [0.2, 0.5, 0.84])
    return np.where(box[..., None], np.array(BOX_RGB) * lit[..., None], color), box


@functools.cache
def scene(kind: str = "put down", taken: int = 100, put: int = 190, rise: int = 15, lift_m: float = 0.45) -> Scene:
    """A person comes from the left, takes the box and goes to the right.

    Args:
        kind: `put down` there; `kept` in the hand; `vanishes`: it is gone when it is taken; `left alone`: it stays.
        taken: See `hand_course`, like the next three.
    """
    hand_m = hand_course(taken, put, rise, lift_m)
    if kind == "kept":
        hand_m[put - 20 :] = hand_m[put - 20]
    motion = body_at(hand_m)
    frame = np.arange(FRAMES)
    last = FRAMES - 1 if kind == "kept" else put
    bottom_m = hand_m[np.clip(frame, taken, last)] - [0.0, TOP_M, 0.0]
    if kind == "left alone":
        bottom_m = np.tile(START_M, (FRAMES, 1))
    shown = np.ones(FRAMES, bool) if kind != "vanishes" else frame < taken
    noise = np.random.default_rng(2)
    pictures, masks = [], []
    for number, person in zip(range(0, FRAMES, STEP), silhouettes(motion), strict=True):
        color, box = painted([box_at(bottom_m[number])] if shown[number] else [], person)
        pictures.append(np.clip(color + noise.normal(0, 2, color.shape), 0, 255).astype(np.uint8))
        masks.append(person & ~box)
    seen, rgb = np.stack(masks), np.stack(pictures)
    ranked = np.sort(np.where(seen[..., None], np.uint8(255), rgb), axis=0)
    median = ((~seen).sum(0) // 2)[None, ..., None]
    background_rgb = np.take_along_axis(ranked, median.clip(max=len(rgb) - 1), axis=0)[0]
    return Scene(Pictures(rgb, seen, background_rgb, STEP), motion, bottom_m)


def obj(number: int, bottom_m: np.ndarray) -> PlacedObject:
    """A box of the background image."""
    T = np.eye(4)
    T[:3, 3] = bottom_m
    return PlacedObject(number, "box", box_mesh(*BOX_M), 1.0, T, None, None, True, "")


def check_path(item: PlacedObject, true: Scene, taken: int, put: int) -> None:
    """It is where it was, within 10 cm, and is held when it was, within 15 frames; at rest it does not move at all."""
    (path,) = item.path
    (hold,) = item.holds
    T = path.T_world_object
    assert T.shape == (FRAMES, 4, 4)
    assert (hold.person_id, hold.hand) == (1, "right hand")
    assert abs(hold.first_frame - taken) <= 15
    assert abs(hold.last_frame - put) <= 15
    off_m = np.linalg.norm(T[:, :3, 3] - true.bottom_m, axis=-1)
    assert off_m[[0, -1]].max() < 0.1
    assert np.delete(off_m, np.s_[taken - 15 : taken + 15]).max() < 0.15
    for rest in (T[: hold.first_frame + 1], T[hold.last_frame :]):
        np.testing.assert_array_equal(rest, np.broadcast_to(rest[0], rest.shape))
    np.testing.assert_array_equal(item.T_world_object, T[0])
    np.testing.assert_allclose(
        T[:, :3, :3] @ T[:, :3, :3].swapaxes(1, 2), np.tile(np.eye(3), (FRAMES, 1, 1)), atol=1e-6
    )
    assert np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=-1).max() < 0.1, "it does not jump"


def test_a_box_that_is_carried_to_another_place_has_a_path() -> None:
    true = scene()
    (item,) = true.found()
    check_path(item, true, 100, 190)
    assert item.path[0].T_world_object[[0, -1], 1, 3] == pytest.approx(0.0, abs=1e-6), "it stands on the floor"
    size_m = np.ptp(item.mesh.vertices_m, axis=0)
    np.testing.assert_allclose(size_m, BOX_M, atol=0.1)
    assert (item.label, item.scale, item.trusted) == ("object", 1.0, True)
    (texture,) = item.textures
    red, green, blue = np.median(texture.image_rgb.reshape(-1, 3).astype(int), axis=0)
    assert red - max(green, blue) > 60


def test_a_box_that_stays_in_the_hand_is_held_to_the_end() -> None:
    true = scene("kept")
    (item,) = true.found()
    check_path(item, true, 100, FRAMES - 1)
    assert item.holds[0].last_frame == FRAMES - 1


@pytest.mark.parametrize("kind", ["vanishes", "left alone"])
def test_nothing_moves_that_is_not_seen_in_the_hand(kind: str) -> None:
    """It vanishes when the hand is there, or stays while somebody bends over it."""
    assert scene(kind).found() == []
    stays = obj(4, np.array([0.0, 0.0, -5.0]))
    assert scene(kind).found(stays, masks=(np.eye(LENS.height_px, LENS.width_px) > 0,)) == [stays]


def test_who_is_elsewhere_moves_nothing() -> None:
    true = scene()
    T_world_root = true.motion.T_world_root.copy()
    T_world_root[:, 1, 3] += 1.2
    afar = replace(true.motion, person_id=2, T_world_root=T_world_root)
    assert true.found(people=(afar,)) == []
    (item,) = true.found(people=(afar, true.motion))
    check_path(item, true, 100, 190)


def test_a_known_object_is_moved_from_where_it_stands() -> None:
    """The background image shows it at its start."""
    true = scene(taken=180, put=250)
    item, other = obj(7, true.bottom_m[0] + [0.02, 0.0, 0.02]), obj(3, np.array([0.0, 0.0, -5.0]))
    elsewhere = np.roll(true.mask(0), 150, 1)
    kept, moved = true.found(other, item, masks=(elsewhere, true.mask(0)))
    assert kept is other
    assert (moved.object_id, moved.label, moved.mesh) == (7, "box", item.mesh)
    np.testing.assert_allclose(moved.T_world_object, item.T_world_object, atol=1e-9)
    check_path(moved, true, 180, 250)


def test_a_known_object_may_be_where_it_was_put() -> None:
    """The background image shows it at its goal."""
    true = scene(taken=60, put=140)
    item = obj(7, true.bottom_m[-1])
    (moved,) = true.found(item, masks=(true.mask(FRAMES - 1),))
    assert (moved.object_id, moved.mesh) == (7, item.mesh)
    np.testing.assert_allclose(moved.path[0].T_world_object[-1], item.T_world_object, atol=1e-9)
    check_path(moved, true, 60, 140)


def test_a_new_object_has_a_number_of_its_own() -> None:
    other = obj(7, np.array([0.0, 0.0, -5.0]))
    kept, moved = scene().found(other, masks=(np.roll(scene().mask(0), 150, 1),))
    assert kept is other
    assert moved.object_id == 8


def test_a_box_may_be_lifted_slowly() -> None:
    true = scene(rise=30, lift_m=0.2)
    (item,) = true.found()
    check_path(item, true, 100, 190)


@pytest.mark.parametrize(
    ("came", "seen_before", "seen_after", "shows"),
    [(False, 6, 14, False), (False, 14, 6, True), (True, 6, 14, True), (True, 14, 6, False)],
)
def test_the_background_image_shows_what_most_looks_saw(
    came: bool, seen_before: int, seen_after: int, shows: bool
) -> None:
    """Of 40 pictures half are before and half after; people hide it in the others."""
    mask = np.zeros((12, 16), bool)
    mask[4:8, 5:9] = True
    hidden = np.zeros((40, 12, 16), bool)
    hidden[seen_before:20] = hidden[20 + seen_after :] = mask
    rgb = np.zeros((40, 12, 16, 3), np.uint8)
    change = Change(mask, 19, 20, came, rgb[0])
    assert Pictures(rgb, hidden, rgb[0], STEP).background_shows(change) == shows
