"""Packs arrays into one glTF buffer: aligned views, typed accessors with bounds."""

from __future__ import annotations

import numpy as np
import pygltflib as gltf

from video2anim.artifacts.images import png_bytes

_ALIGNMENT_BYTES = 4
_COMPONENT_TYPES = {
    np.dtype(np.float32): gltf.FLOAT,
    np.dtype(np.uint32): gltf.UNSIGNED_INT,
    np.dtype(np.uint16): gltf.UNSIGNED_SHORT,
    np.dtype(np.uint8): gltf.UNSIGNED_BYTE,
}
_ELEMENT_TYPES = {(): gltf.SCALAR, (2,): gltf.VEC2, (3,): gltf.VEC3, (4,): gltf.VEC4, (4, 4): gltf.MAT4}


class GltfBuffer:
    """Grows the binary chunk of a GLB and the accessor tables that describe it."""

    def __init__(self, document: gltf.GLTF2) -> None:
        self._document = document
        self._chunks: list[bytes] = []
        self._length_bytes = 0

    def add(
        self, values: np.ndarray, *, target: int | None = None, normalized: bool = False, bounds: bool = False
    ) -> int:
        """Append `values` (N, ...) and return the index of their accessor.

        float64 becomes float32; 4x4 matrices are stored column by column as glTF wants them.
        `target` is the GPU use (ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER) or None for animation and skin data.

        Raises:
            ValueError: the type or element shape has no glTF form, or a vertex element is not 4-byte aligned.
        """
        packed = _packed(values)
        element_bytes = packed.dtype.itemsize * int(np.prod(packed.shape[1:], dtype=int))
        if target == gltf.ARRAY_BUFFER and element_bytes % _ALIGNMENT_BYTES:
            raise ValueError(f"vertex element of {element_bytes} bytes is not a multiple of {_ALIGNMENT_BYTES}")
        view_index = self._add_view(packed.tobytes(), target)
        accessor = gltf.Accessor(
            bufferView=view_index,
            byteOffset=0,
            componentType=_COMPONENT_TYPES[packed.dtype],
            normalized=normalized,
            count=len(packed),
            type=_ELEMENT_TYPES[packed.shape[1:]],
        )
        if bounds:
            accessor.min = np.atleast_1d(packed.min(0)).tolist()
            accessor.max = np.atleast_1d(packed.max(0)).tolist()
        self._document.accessors.append(accessor)
        return len(self._document.accessors) - 1

    def add_png(self, image_rgb: np.ndarray) -> int:
        """Append a picture and return the index of its image."""
        view = self._add_view(png_bytes(image_rgb), None)
        self._document.images.append(gltf.Image(bufferView=view, mimeType="image/png"))
        return len(self._document.images) - 1

    def _add_view(self, blob: bytes, target: int | None) -> int:
        view = gltf.BufferView(buffer=0, byteOffset=self._length_bytes, byteLength=len(blob), target=target)
        self._document.bufferViews.append(view)
        padded = blob + b"\0" * (-len(blob) % _ALIGNMENT_BYTES)
        self._chunks.append(padded)
        self._length_bytes += len(padded)
        return len(self._document.bufferViews) - 1

    def finish(self) -> None:
        """Hand the bytes to the document; nothing may be added afterwards."""
        self._document.buffers = [gltf.Buffer(byteLength=self._length_bytes)]
        self._document.set_binary_blob(b"".join(self._chunks))


def _packed(values: np.ndarray) -> np.ndarray:
    packed = np.asarray(values, np.float32) if values.dtype.kind == "f" else np.asarray(values)
    if packed.dtype not in _COMPONENT_TYPES or packed.shape[1:] not in _ELEMENT_TYPES:
        raise ValueError(f"no glTF form for elements {packed.shape[1:]} of {packed.dtype}")
    if packed.shape[1:] == (4, 4):
        packed = packed.transpose(0, 2, 1)
    return np.ascontiguousarray(packed)
