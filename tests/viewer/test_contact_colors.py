"""Contacts are seen on the bodies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from synthetic import planted_walk

from video2anim.body.skeleton import JOINT_INDEX
from video2anim.viewer.bodies import CONTACT_RGB, PERSON_RGB, UNMEASURED_RGB, PosedBodies


def test_parts_in_contact_are_red_and_others_the_persons_own() -> None:
    walk = planted_walk(4)
    contact = np.zeros_like(walk.contact)
    contact[2, JOINT_INDEX["left_wrist"]], contact[2, JOINT_INDEX["pelvis"]] = 1.0, 0.5
    valid = np.array([True, True, True, False])
    posed = PosedBodies((replace(walk, contact=contact, valid=valid),))
    part = posed.bodies[0].vertex_part
    colors = posed.colors(0, 2)
    assert (colors[part == JOINT_INDEX["left_wrist"]] == CONTACT_RGB).all()
    half = 0.5 * np.array(PERSON_RGB[0]) + 0.5 * np.array(CONTACT_RGB)
    assert np.abs(colors[part == JOINT_INDEX["pelvis"]] - half).max() <= 1
    assert (colors[part == JOINT_INDEX["head"]] == PERSON_RGB[0]).all()
    assert (posed.colors(0, 1) == PERSON_RGB[0]).all()
    assert (posed.colors(0, 3) == UNMEASURED_RGB).all()
