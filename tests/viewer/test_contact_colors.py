"""Contacts are seen on the bodies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from synthetic import planted_walk

from video2anim.types import Contact
from video2anim.types.skeleton import JOINT_INDEX
from video2anim.viewer import SceneView
from video2anim.viewer.bodies import PosedBodies
from video2anim.viewer.contacts import contact_line, contacts_at, touched_rgb
from video2anim.viewer.software import render_software

SKIN_RGB, CONTACT_RGB, UNMEASURED_RGB = (214, 164, 134), (205, 48, 38), (160, 160, 160)


def test_parts_in_contact_are_red_and_others_the_persons_own() -> None:
    walk = planted_walk(4)
    contact = np.zeros_like(walk.contact)
    contact[2, JOINT_INDEX["left_wrist"]], contact[2, JOINT_INDEX["pelvis"]] = 1.0, 0.5
    valid = np.array([True, True, True, False])
    posed = PosedBodies((replace(walk, contact=contact, valid=valid),))
    part = posed.bodies[0].vertex_part
    colors = posed.colors(0, 2)
    assert (colors[part == JOINT_INDEX["left_wrist"]] == CONTACT_RGB).all()
    half = 0.5 * np.array(SKIN_RGB) + 0.5 * np.array(CONTACT_RGB)
    assert np.abs(colors[part == JOINT_INDEX["pelvis"]] - half).max() <= 1
    assert (colors[part == JOINT_INDEX["head"]] == SKIN_RGB).all()
    assert (posed.colors(0, 1) == SKIN_RGB).all()
    assert (posed.colors(0, 3) == UNMEASURED_RGB).all()


def test_known_contacts_have_the_color_of_what_is_touched() -> None:
    walk = planted_walk(4)
    times_s = [float(time_s) for time_s in walk.frame_time_s]
    hand = Contact(walk.person_id, "left hand", 2, "table", "top", times_s[1], times_s[2], 0.0, 0.0)
    foot = Contact(walk.person_id, "left foot", None, "floor", "floor", times_s[0], times_s[3], 0.0, 0.0)
    somebody = Contact(walk.person_id + 1, "head", 2, "table", "top", times_s[0], times_s[3], 0.0, 0.0)
    contact = np.zeros_like(walk.contact)
    contact[:, JOINT_INDEX["right_wrist"]] = 1.0
    posed = PosedBodies((replace(walk, contact=contact),), (hand, foot, somebody))
    part = posed.bodies[0].vertex_part
    colors = posed.colors(0, 2)
    assert (colors[part == JOINT_INDEX["left_wrist"]] == touched_rgb(2)).all()
    assert (colors[part == JOINT_INDEX["left_ankle"]] == touched_rgb(None)).all()
    assert (colors[part == JOINT_INDEX["right_wrist"]] == CONTACT_RGB).all(), "what it touches is not known"
    assert (colors[part == JOINT_INDEX["head"]] == SKIN_RGB).all(), "the contact is another person's"
    assert (posed.colors(0, 3)[part == JOINT_INDEX["left_wrist"]] == SKIN_RGB).all(), "over by then"
    assert [contact_line(one) for one in contacts_at(posed.contacts, walk.person_id, times_s[1])] == [
        "left hand: table 2, top", "left foot: floor",
    ]  # fmt: skip
    assert len({touched_rgb(None), *(touched_rgb(number) for number in range(8))}) == 9


def test_a_picture_tells_contacts_of_the_refined_motion_in_its_corner() -> None:
    walk = planted_walk(4)
    foot = Contact(walk.person_id, "left foot", None, "floor", "floor", 0.0, 1.0, 0.0, 0.0)
    plain, told = (render_software((walk,), None, 1, 320, 240, contacts) for contacts in ((), (foot,)))
    changed = (plain != told).any(-1)
    assert changed[-25:, :150].any()
    shown = SceneView({"raw": (walk,), "refined": (walk,)}, None, (foot,))
    assert shown.contacts_of() == shown.contacts_of("refined") == (foot,)
    other = replace(shown, motions={"raw": (replace(walk),), "refined": shown.people()})
    assert other.contacts_of("raw") == ()
