"""Meshes and coded images as the bytes of a file."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.ground_truth.surface import ply_bytes
from service.compute.pixels.metadata import described
from service.core.errors import DataError
from service.core.geometry import Array
from service.dataset.records import Mesh


def ply(vertices: Array, faces: NDArray[np.int64], comment: str) -> bytes:
    """Return a binary PLY with vertices (V, 3) in double precision and faces (F, 3), in the vertices' own unit."""
    columns = {name: vertices[:, k].astype("<f8") for k, name in enumerate("xyz")}
    return ply_bytes(columns, faces, [comment] if comment else [])


def ground_truth_ply(mesh: Mesh, comment: str) -> bytes:
    """Return a binary PLY of the ground truth in metres, with `source` and `sigma_m` of each vertex if known."""
    columns: dict[str, NDArray[np.generic]] = {
        name: mesh.vertices_m[:, k].astype("<f8") for k, name in enumerate("xyz")
    }
    comments = [comment] if comment else []
    if mesh.source is not None and mesh.sigma_m is not None:
        columns |= {"source": mesh.source.astype(np.uint8), "sigma_m": mesh.sigma_m.astype("<f4")}
        comments.append("source 0: CT, 1: scan, 2: blend; sigma along the normal")
    return ply_bytes(columns, mesh.faces, comments)


def png(image: NDArray[np.uint8] | NDArray[np.uint16], mark: str = "") -> bytes:
    """Return a PNG of (H, W) grey, (H, W, 3) BGR or (H, W, 4) BGRA values; a mark is its description.

    Raises:
        DataError: it cannot be encoded.
    """
    encoded, data = cv2.imencode(".png", image)
    if not encoded:
        raise DataError("an image cannot be encoded as PNG", remedy="Export at a lower resolution")
    return described(data.tobytes(), mark) if mark else data.tobytes()


def mask_png(mask: NDArray[np.bool_], mark: str) -> bytes:
    """Return a PNG with 255 where the mask (H, W) is true and 0 elsewhere."""
    return png(np.where(mask, np.uint8(255), np.uint8(0)), mark)
