"""Kernels of mesh queries, compiled by Warp when first used; the compiled code stays in the user's cache."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterator
from typing import no_type_check


@contextlib.contextmanager
def quiet_warp() -> Iterator[None]:
    """Without Warp's start-up messages: also its native code warns, through file descriptor 2, about a missing GPU."""
    kept = os.dup(2)
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


with quiet_warp():
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    wp.init()

WINDING = 0.5
"""Winding number from which a point is inside: 1 in the middle of a closed mesh, 0 around it."""
ACCURACY = 2.0
"""Clusters of triangles count as one from this many of their radii on (Barill et al. 2018, section 4: 2)."""


@wp.kernel
@no_type_check
def nearest_triangle(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    reach: float,
    face: wp.array(dtype=int),
    inside: wp.array(dtype=bool),
) -> None:
    """Number of the nearest triangle within reach or -1, and whether that is seen from inside."""
    i = wp.tid()
    found = wp.mesh_query_point_sign_winding_number(mesh, points[i], reach, ACCURACY, WINDING)
    face[i] = -1
    inside[i] = False
    if found.result:
        face[i] = found.face
        inside[i] = found.sign < 0.0
