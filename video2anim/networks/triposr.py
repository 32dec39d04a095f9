"""TripoSR (Tochilkin et al. 2024, ONNX): a closed, colored mesh of the object in one picture.

Tensor contract, of two ONNX files in one folder that the user exports from the public checkpoint (code and weights MIT;
there is no official export, so file and tensor names are this adapter's):

- `encoder.onnx`: input `image` (1, 3, 512, 512) float32, RGB in [0, 1] (the network normalizes inside), the object on
  gray 0.5, the longer side of its box 0.85 of the picture; output `scene_codes` (1, 3, 40, 64, 64), the planes xy, xz
  and yz. It is `TSR.forward` behind its image processor, without the axis of views.
- `field.onnx`: inputs `scene_codes` and `points` (1, N, 3), any N, in [-0.87, 0.87]; outputs `density` (1, N, 1) after
  the activation exp(x - 1), so never negative, and `color` (1, N, 3) after the sigmoid, in [0, 1]. They are the entries
  `density_act` and `color` of `TriplaneNeRFRenderer.query_triplane`.

The surface is where the density is 25, the default of `TSR.extract_mesh`. Interpolated is its logarithm, which is what
the network makes: on this coarser grid the density itself, which changes a hundredfold from one sample to the next,
would put the surface beside the outer samples. TripoSR's frame is right-handed with x towards the viewer, y to the
viewer's right and z up (`get_spherical_cameras` says so, of a view at azimuth 0, which is taken to be the picture's).
Here +Y is up and the side that the picture shows faces +Z: (x, y, z) becomes (y, z, x), a rotation.

Source: https://github.com/VAST-AI-Research/TripoSR (`tsr/system.py`, `tsr/models/nerf_renderer.py`, `tsr/utils.py`,
`run.py`) and its checkpoint's `config.yaml` (radius 0.87, density bias -1); arXiv 2403.02151.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from video2anim.errors import ModelMissingError, StageError
from video2anim.networks.amodal import GRAY
from video2anim.networks.network import Network, resized, to_unit_values
from video2anim.types.scene import Mesh

FIELD_FILE = "field.onnx"
"""Beside the encoder's file."""
PICTURE_PX = 512
FILL = 0.85
"""Share of the picture that the object's longer side takes."""
CODES = (1, 3, 40, 64, 64)
RADIUS = 0.87
"""Half of the side of the cube in which there is a field, in TripoSR's unit."""
DENSITY_FROM = 25.0
RESOLUTION = 96
"""Samples along the cube's side."""
_CHUNK = 1 << 15
"""Points asked for at once: 120 features each, 16 MB."""
_MAX_RATIO = 100.0
"""Density beyond this many times the threshold, or below it, says no more about where the surface is."""
_MIN_PART = 0.01
"""Parts with fewer samples than this share of the largest part's are specks."""
_OFF_SURFACE = 1e-3
"""No sample lies nearer to the surface, in logarithms: triangles of no area would tear it."""


class TripoSR:
    """Picture to mesh, for slot `object-mesh`."""

    name = "triposr"

    def __init__(self, path: Path) -> None:
        """Load both networks.

        Args:
            path: Of the encoder; `field.onnx` lies beside it.

        Raises:
            ModelMissingError: a file is missing or no network of that contract.
        """
        self._encoder = Network(path, inputs=("image",), outputs=("scene_codes",))
        self._field = Network(
            path.with_name(FIELD_FILE), inputs=("scene_codes", "points"), outputs=("density", "color")
        )  # fmt: skip

    def mesh(
        self, picture_rgb: UInt8[np.ndarray, "height width 3"], *, max_faces: int, resolution: int = RESOLUTION
    ) -> Mesh:
        """The object of a picture, watertight, in TripoSR's unit: +Y up, the side that the picture shows towards +Z.

        Args:
            picture_rgb: Crop of the object's box, gray (127) around the object.
            most_faces: Upper limit.
            resolution: Samples along the cube's side, 2 or more.

        Raises:
            StageError: the field is empty, or numbers are not finite.
            ModelMissingError: the networks' outputs are not those of the contract.
        """
        codes = self._encoder.run({"image": to_input(picture_rgb)}, ("scene_codes",))["scene_codes"]
        self._encoder.expect_shape("scene_codes", codes, CODES)
        self._expect_finite("scene_codes", codes)
        density = self._density(codes, resolution)
        if not (density >= DENSITY_FROM).any():
            raise StageError(
                f"{self.name}: want density of {DENSITY_FROM:g} somewhere, got {density.max():.3g} at most"
            )
        points, faces = surface(density, max_faces)
        color = self._ask(codes, points.astype(np.float32), "color", 3)
        low, high = color.min(), color.max()
        if low < -0.01 or high > 1.01:
            raise ModelMissingError(
                f"{self._field.path}: want color in 0..1 (after the sigmoid), got {low:.3g} to {high:.3g}"
            )
        rgb = np.round(255.0 * np.clip(color, 0.0, 1.0)).astype(np.uint8)
        return Mesh(points[:, [1, 2, 0]].astype(np.float32), faces, rgb)

    def _density(
        self, codes: Float[np.ndarray, "1 3 40 64 64"], resolution: int
    ) -> Float[np.ndarray, "resolution resolution resolution"]:
        axis = np.linspace(-RADIUS, RADIUS, resolution, dtype=np.float32)
        shape = (resolution, resolution, resolution)
        density = np.empty(resolution**3, np.float32)
        for start in range(0, density.size, _CHUNK):
            places = np.arange(start, min(start + _CHUNK, density.size))
            points = axis[np.stack(np.unravel_index(places, shape), axis=-1)]
            density[places] = self._ask(codes, points, "density", 1)[:, 0]
        if density.min() < 0.0:
            raise ModelMissingError(
                f"{self._field.path}: want density after exp(x - 1), never negative, got {density.min():.3g}"
            )
        return density.reshape(shape)

    def _ask(
        self, codes: Float[np.ndarray, "1 3 40 64 64"], points: Float[np.ndarray, "points 3"], name: str, width: int
    ) -> Float[np.ndarray, "points width"]:
        """One output of the field at points, in chunks."""
        answers = []
        for start in range(0, len(points), _CHUNK):
            part = points[start : start + _CHUNK]
            found = self._field.run({"scene_codes": codes, "points": part[None]}, (name,))[name]
            self._field.expect_shape(name, found, (1, len(part), width))
            self._expect_finite(name, found)
            answers.append(found[0])
        return np.concatenate(answers)

    def _expect_finite(self, name: str, values: np.ndarray) -> None:
        if not np.isfinite(values).all():
            raise StageError(f"{self.name}: want finite {name}, got {(~np.isfinite(values)).mean():.0%} that are not")


def to_input(picture_rgb: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "1 3 512 512"]:
    """The object in the middle of a gray square, RGB in [0, 1]."""
    height, width = picture_rgb.shape[:2]
    side = max(1, int(max(height, width) / FILL))
    square = np.full((side, side, 3), GRAY, np.uint8)
    top, left = (side - height) // 2, (side - width) // 2
    square[top : top + height, left : left + width] = picture_rgb
    return to_unit_values(resized(square, PICTURE_PX, PICTURE_PX))


def surface(
    density: Float[np.ndarray, "n n n"], max_faces: int
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Closed surface around what is dense, without specks and hollows, in the field's frame and unit.

    Where marching cubes leave an open edge, or no simplification keeps them closed, the samples become cubes.

    Args:
        density: At samples of the cube from -0.87 to 0.87, its border included; somewhere 25 or more.
        most_faces: Upper limit.
    """
    import trimesh
    from skimage.measure import marching_cubes

    from video2anim.networks.solid_mesh import Voxels, mesh_of_voxels, outward, simplified

    spacing = 2.0 * RADIUS / (len(density) - 1)
    ratio = np.clip(density.astype(np.float64) / DENSITY_FROM, 1.0 / _MAX_RATIO, _MAX_RATIO)
    solid = _solid(ratio >= 1.0)
    field = np.where(solid, np.maximum(np.log(ratio), _OFF_SURFACE), np.minimum(np.log(ratio), -_OFF_SURFACE))
    found = marching_cubes(np.pad(field, 1, constant_values=-np.log(_MAX_RATIO)), 0.0)
    mesh = trimesh.Trimesh((found[0] - 1.0) * spacing - RADIUS, found[1], process=True)
    vertices, faces = simplified(np.asarray(mesh.vertices), np.asarray(mesh.faces), max_faces)
    if len(faces) > max_faces or not trimesh.Trimesh(vertices, faces, process=False).is_watertight:
        origin = np.full(3, -RADIUS - 0.5 * spacing)
        vertices, faces = mesh_of_voxels(Voxels(solid, origin, spacing), max_faces)
    return np.clip(vertices, -RADIUS, RADIUS), outward(vertices, faces)


def _solid(dense: Bool[np.ndarray, "n n n"]) -> Bool[np.ndarray, "n n n"]:
    """What is dense, with its hollows filled and without specks: only the outside can have been learned of pictures."""
    from scipy.ndimage import binary_fill_holes, label

    parts = np.empty(dense.shape, np.int32)
    label(dense, output=parts)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    large = sizes >= max(1.0, _MIN_PART * sizes.max())
    return np.asarray(binary_fill_holes(large[parts]), bool)
