"""Meshes and coded images as the bytes of a file."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from service.core.errors import DataError
from service.core.geometry import Array


def ply(vertices: Array, faces: NDArray[np.int64], comment: str) -> bytes:
    """A binary PLY with vertices (V, 3) in double precision and faces (F, 3), in the unit that they have."""
    said = f"comment {comment}\n" if comment else ""
    head = (
        f"ply\nformat binary_little_endian 1.0\n{said}element vertex {len(vertices)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), dtype=[("n", "u1"), ("corners", "<i4", 3)])
    rows["n"], rows["corners"] = 3, faces
    return head.encode("ascii") + vertices.astype("<f8").tobytes() + rows.tobytes()


def png(image: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    """A PNG of (H, W) grey, (H, W, 3) BGR or (H, W, 4) BGRA values.

    Raises:
        DataError: it cannot be encoded.
    """
    encoded, data = cv2.imencode(".png", image)
    if not encoded:
        raise DataError("an image cannot be encoded as PNG", remedy="Export at a lower resolution")
    return data.tobytes()


def mask_png(mask: NDArray[np.bool_]) -> bytes:
    """A PNG with 255 where the mask (H, W) is true and 0 elsewhere."""
    return png(np.where(mask, np.uint8(255), np.uint8(0)))
