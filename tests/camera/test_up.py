"""The up direction by several sources."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from video2anim.camera.up import up_by_images
from video2anim.geometry.perspective_field import FieldCamera, up_of


def seen_from(R_first_camera: np.ndarray, up: np.ndarray, sigma_rad: float = 0.005) -> FieldCamera:
    """A camera that is turned, and what its image says of up."""
    return FieldCamera(1.0, up @ R_first_camera, np.diag([1e-6, sigma_rad**2, 0.0]))


def test_the_image_that_agrees_with_the_others_tells_up() -> None:
    """Lines of tables that stand at an angle take one of three images 6 degrees off, however sure it is."""
    R = Rotation.from_rotvec([[0, 0, 0], [0, 0.6, 0], [0.1, 1.2, 0.05]]).as_matrix()
    up = up_of(-0.35, 0.02)
    wrong, near = up_of(-0.25, 0.02), up_of(-0.352, 0.02)
    images = [seen_from(R[0], wrong, 0.001), seen_from(R[1], up), seen_from(R[2], near)]
    found = up_by_images(images, R)
    assert np.arccos(found.up_camera @ up) < 0.003
    # One of the others is 0.1 rad away, one 0.002.
    assert found.sigma_rad == pytest.approx(0.051, abs=0.002)


def test_one_image_is_as_sure_as_it_says() -> None:
    found = up_by_images([seen_from(np.eye(3), up_of(-0.2, 0.0))], np.eye(3)[None])
    np.testing.assert_allclose(found.up_camera, up_of(-0.2, 0.0), atol=1e-12)
    assert found.sigma_rad == pytest.approx(0.005)
