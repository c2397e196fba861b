"""Reads a mesh or a point cloud of any size, as arrays in metres, for comparison with another."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.errors import UnreadableFileError
from drivers.interfaces import Array
from drivers.meshes.mesh_file import MESH_SUFFIXES, METRES_PER_UNIT, MeshUnit, check_mesh, read_raw_mesh
from drivers.meshes.mesh_format import check_complete
from drivers.meshes.point_cloud import TEXT_SUFFIXES, is_point_cloud, parse_point_cloud

OTHER_SUFFIXES = (".off", ".glb", ".gltf")
LARGEST_IN_METRES = 3.0  # diagonal; nothing that is compared is larger, and nothing measured in mm is smaller


@dataclass(frozen=True, slots=True)
class SurfaceFile:
    """The content of a file.

    Attributes:
        vertices_m: (V, 3), metres.
        faces: (F, 3); (0, 3) for a point cloud.
        normals: (V, 3) unit normals of a cloud's points; None if it has none, and for a mesh.
        unit: the file's unit, mm or m.
        unit_evidence: how it was determined.
        polygons_in_doubt: polygons of a mesh that have no inside to speak of.
    """

    vertices_m: Array = field(repr=False)
    faces: NDArray[np.int64] = field(repr=False)
    normals: Array | None = field(repr=False)
    unit: str
    unit_evidence: str
    polygons_in_doubt: int = 0


def read_surface_file(path: Path, unit: MeshUnit = "auto") -> SurfaceFile:
    """Read a mesh (OBJ, PLY, STL, OFF, GLB, glTF) or a point cloud (PLY, text).

    Args:
        path: the file.
        unit: the file's unit; `auto` takes a bounding box of at most LARGEST_IN_METRES units as metres, a larger one
            as millimetres. Unlike a scan, what is compared may have any size.

    Raises:
        IncompleteExportError: the file is truncated.
        UnreadableFileError: no such file, another format, damaged, or coordinates that are not finite.
    """
    if not path.is_file():
        raise UnreadableFileError("there is no such file", where=str(path), remedy="Check the path")
    try:
        faces, doubtful = np.empty((0, 3), dtype=np.int64), 0
        if is_point_cloud(path):
            vertices, normals = parse_point_cloud(path)
        else:
            _check_format(path)
            check_complete(path)
            if path.suffix.lower() == ".glb":
                _check_chunks(path)
            raw = read_raw_mesh(path)
            vertices, faces, normals, doubtful = raw.vertices, raw.faces, None, raw.polygons_in_doubt
            check_mesh(path, vertices, faces)
    except OSError as error:
        raise UnreadableFileError(
            f"the file cannot be opened ({error.strerror})", where=str(path), remedy="Check its permissions"
        ) from error
    extent = vertices if len(faces) == 0 else vertices[np.unique(faces)]
    diagonal = float(np.linalg.norm(np.ptp(extent, axis=0)))
    found = unit if unit != "auto" else "m" if diagonal <= LARGEST_IN_METRES else "mm"
    how = "inferred" if unit == "auto" else "given"
    evidence = f"{how}: the bounding box is {diagonal:.4g} {found} across"
    return SurfaceFile(vertices * METRES_PER_UNIT[found], faces, normals, found, evidence, doubtful)


def _check_format(path: Path) -> None:
    if path.suffix.lower() not in (*MESH_SUFFIXES, *OTHER_SUFFIXES):
        raise UnreadableFileError(
            f"this kind of file ({path.suffix or 'no extension'}) is not supported",
            where=str(path),
            remedy="Export it as OBJ, PLY, STL, OFF, GLB or glTF, or points as PLY or text "
            f"({', '.join(TEXT_SUFFIXES)})",
        )


def _check_chunks(path: Path) -> None:
    """Check that the chunks of a GLB file are as long as they say; what reads them sets that memory aside at once.

    Raises UnreadableFileError.
    """
    size, at = path.stat().st_size, 12
    with path.open("rb") as stream:
        while at + 8 <= size:
            stream.seek(at)
            at += 8 + int.from_bytes(stream.read(4), "little")
    if at != size:
        raise UnreadableFileError(
            "a part of the file is longer or shorter than it says",
            where=str(path),
            remedy="Export it again; it was cut short or damaged",
        )
