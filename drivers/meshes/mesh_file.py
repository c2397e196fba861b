"""Reads OBJ, PLY and STL meshes into metres and reports completeness, unit, normals and defects; repairs nothing."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drivers.errors import IncompleteExportError, UnreadableFileError
from drivers.foreign_code import reading
from drivers.interfaces import Array, Mesh, ScanExport, ScannedMesh
from drivers.meshes.companions import TEXTURE_SUFFIXES, companions
from drivers.meshes.foreign_text import name_of
from drivers.meshes.mesh_format import check_complete
from drivers.meshes.obj import read_obj
from drivers.meshes.off import read_off
from drivers.meshes.ply import read_ply
from drivers.meshes.raw_mesh import IntArray, RawMesh
from drivers.meshes.stl import read_stl

MeshUnit = Literal["auto", "mm", "m"]
METRES_PER_UNIT = {"mm": 1e-3, "m": 1.0}
# Plausible diagonals of the bounding box. A unit is inferred only for the size of a scene with its spheres, so that
# centimetres or inches are not mistaken for millimetres. A configured unit must be plausible for anything between a
# bone and a room; this range spans a factor of 1000, so that millimetres and metres are never both plausible.
SCENE_DIAGONAL_M = (0.1, 3.0)
OBJECT_DIAGONAL_M = (0.02, 20.0)
MESH_SUFFIXES = (".obj", ".ply", ".stl")


def export_of(path: Path) -> ScanExport:
    """Return the export formed by this mesh file and its companions. Raises as `mesh_format.companions` does."""
    stat = path.stat()
    modified = datetime.fromtimestamp(stat.st_mtime, UTC).isoformat().replace("+00:00", "Z")
    return ScanExport(name=name_of(path), files=(path, *companions(path)), modified_utc=modified)


def read_mesh_file(
    path: Path, unit: MeshUnit = "auto", *, export: ScanExport | None = None, any_size: bool = False
) -> ScannedMesh:
    """Read a triangle mesh, in metres.

    Args:
        path: an OBJ, PLY or STL (ASCII or binary) file.
        unit: the file's unit; `auto` infers it from the size of the bounding box, and `unit_evidence` says how. A
            unit that contradicts the size is an error, never silently corrected.
        export: the export that the file belongs to; found beside the file if not given.
        any_size: the argument of `credible_unit`.

    Returns:
        The mesh with bitwise equal vertices merged (STL facets, UV seams), vertex normals (V, 3) from the file or
        area-weighted from its faces, and `findings`, the numbers of: vertices, faces, holes, boundary_edges,
        non_manifold_edges, components, degenerate_faces, unreferenced_vertices, polygons_in_doubt, textures;
        normals_computed is 0 or 1.

    Raises:
        IncompleteExportError: truncated, still growing, locked, or a companion is missing.
        UnreadableFileError: not a mesh, no faces, coordinates not finite, indices out of range, implausible unit.
    """
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise UnreadableFileError(
            f"this kind of file ({path.suffix or 'no extension'}) is not supported",
            where=str(path),
            remedy="Export the scan as OBJ, PLY or STL",
        )
    with unchanged(path):
        check_complete(path)
        export = export or export_of(path)
        raw = read_raw_mesh(path)
    return scanned_mesh(raw, unit, export, any_size=any_size)


@contextmanager
def unchanged(path: Path) -> Generator[None]:
    """While a file is read: it may not change.

    Raises:
        IncompleteExportError: it changed, or cannot be opened.
        UnreadableFileError: there is no such file.
    """
    try:
        before = path.stat()
        yield
        after = path.stat()
    except FileNotFoundError as error:
        raise UnreadableFileError(
            "there is no such file", where=str(path), remedy="Check the path, or export the scan again"
        ) from error
    except OSError as error:
        raise IncompleteExportError(
            f"the file cannot be opened ({error.strerror})",
            where=str(path),
            remedy="Wait until the exporting program has let go of it, and check the permissions of the folder",
        ) from error
    if (before.st_size, before.st_mtime_ns) != (after.st_size, after.st_mtime_ns):
        raise IncompleteExportError(
            "the file changed while it was read", where=str(path), remedy="Wait until the export has finished"
        )


def scanned_mesh(raw: RawMesh, unit: MeshUnit, export: ScanExport, *, any_size: bool = False) -> ScannedMesh:
    """Check a mesh that was read from an export, in the file's unit, and report on it as `read_mesh_file` does.

    Raises UnreadableFileError as `check_mesh` and `credible_unit` do.
    """
    path = export.files[0]
    vertices, faces, normals = raw.vertices, raw.faces, raw.normals
    check_mesh(path, vertices, faces)
    found, evidence = credible_unit(path, vertices[_used(faces, len(vertices))], unit, any_size=any_size)
    vertices = vertices * METRES_PER_UNIT[found]
    first, index = merge_equal(vertices)
    merged, faces = vertices[first], index[faces]
    computed = normals is None
    kept = vertex_normals(merged, faces) if normals is None else _unit_length(_summed(index, normals, len(merged)))
    findings = {
        **mesh_findings(merged, faces),
        "polygons_in_doubt": float(raw.polygons_in_doubt),
        "normals_computed": float(computed),
        "textures": float(sum(file.suffix.lower() in TEXTURE_SUFFIXES for file in export.files[1:])),
    }
    return ScannedMesh(Mesh(merged, faces.astype(np.int32), kept), found, evidence, findings, export)


def merge_equal(vertices: Array) -> tuple[IntArray, IntArray]:
    """Group bitwise equal vertices (V, 3).

    Returns the index of each group's first vertex (G,), in the order of the file, and the group of each vertex (V,).
    """
    # Sorting one 64-bit hash per row is several times faster than sorting rows; the comparison detects collisions.
    words = np.ascontiguousarray(vertices + 0.0).view(np.uint64).reshape(-1, 3)  # + 0.0: no negative zero
    mix = words[:, 0] * np.uint64(0x9E3779B97F4A7C15)
    mix = (mix ^ (mix >> np.uint64(29)) ^ words[:, 1]) * np.uint64(0xBF58476D1CE4E5B9)
    mix = (mix ^ (mix >> np.uint64(31)) ^ words[:, 2]) * np.uint64(0x94D049BB133111EB)
    mix ^= mix >> np.uint64(30)
    _, first, index = np.unique(mix, return_index=True, return_inverse=True)
    if not np.array_equal(vertices[first[index]], vertices):
        _, first, index = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    # Keep the order of the file.
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return first[order].astype(np.int64), rank[index.reshape(-1)].astype(np.int64)


def vertex_normals(vertices: Array, faces: IntArray) -> Array:
    """Area-weighted unit normals (V, 3) of vertices (V, 3); zero for a vertex without a face of non-zero area."""
    p = vertices[faces]
    n = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    corner = faces.ravel()
    return _unit_length(_summed(corner, np.repeat(n, 3, axis=0), len(vertices)))


def mesh_findings(vertices: Array, faces: IntArray) -> dict[str, float]:
    """Count the defects of an indexed mesh without duplicate vertices; the keys are those of `read_mesh_file`."""
    p, q, r = (vertices.take(faces[:, k], axis=0) for k in range(3))
    cross = np.cross(q - p, r - p)
    longest = np.max([np.einsum("ij,ij->i", edge, edge) for edge in (p - r, q - p, r - q)], axis=0)
    degenerate = np.linalg.norm(cross, axis=1) <= 1e-9 * longest
    sound = faces[~degenerate]
    n = len(vertices)
    first, second = sound.T.ravel(), sound.T[[1, 2, 0]].ravel()
    keys, counts = np.unique(np.minimum(first, second) * n + np.maximum(first, second), return_counts=True)
    a, b = keys // n, keys % n
    return {
        "vertices": float(n),
        "faces": float(len(faces)),
        "holes": float(_components(a[counts == 1], b[counts == 1], n)),
        "boundary_edges": float(np.count_nonzero(counts == 1)),
        "non_manifold_edges": float(np.count_nonzero(counts > 2)),
        "components": float(_components(a, b, n)),
        "degenerate_faces": float(np.count_nonzero(degenerate)),
        "unreferenced_vertices": float(n - np.count_nonzero(_used(sound, n))),
    }


def _used(index: NDArray[np.integer], n: int) -> NDArray[np.bool_]:
    """Return which of 0…n-1 occur among these indices, (n,): in a tenth of the time of np.unique."""
    used = np.zeros(n, dtype=np.bool_)
    used[index] = True
    return used


def _components(a: IntArray, b: IntArray, n: int) -> int:
    """Number of connected components of these edges, given by their end vertices `a` and `b` out of `n`."""
    if len(a) == 0:
        return 0
    from scipy.sparse import coo_matrix  # noqa: PLC0415 - half a second, for those who read a mesh
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    graph = coo_matrix((np.ones(len(a), dtype=np.int8), (a, b)), shape=(n, n))
    count, labels = connected_components(graph, directed=False)
    return int(np.count_nonzero(_used(labels[a], count)))


def _summed(index: IntArray, rows: Array, n: int) -> Array:
    """Sum the rows (N, 3) that share an index (N,) in 0…n-1; returns (n, 3)."""
    return np.stack([np.bincount(index, rows[:, k], n).astype(np.float64) for k in range(3)], axis=1)


def _unit_length(normals: Array) -> Array:
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


def parse_mesh(path: Path) -> tuple[Array, IntArray, Array | None]:
    """Vertices (V, 3) in the file's unit, faces (F, 3) and the file's vertex normals, None if missing or invalid.

    Raises as `read_raw_mesh` does.
    """
    raw = read_raw_mesh(path)
    return raw.vertices, raw.faces, raw.normals


def read_raw_mesh(path: Path) -> RawMesh:
    """The triangles of an OBJ, PLY, STL, OFF, GLB or glTF file, in its unit, with normals only if they are valid.

    Vertices that are no numbers and belong to no face, as of pixels without a measurement, are left out.

    Raises:
        IncompleteExportError: the file is cut short.
        UnreadableFileError: not a mesh of the format that the name says, or no faces.
        OSError: the file cannot be opened.
    """
    suffix = path.suffix.lower()
    remedy = "Open it in the scanner's software and export it again"
    with reading(path, f"a {suffix[1:].upper()} mesh", remedy):
        raw = _READERS.get(suffix, _by_trimesh)(path)
    if len(raw.faces) == 0:
        raise UnreadableFileError(
            "the file has no faces, only points",
            where=str(path),
            remedy="Export a triangle mesh; triangle strips and point clouds are not supported",
        )
    _check_shape(path, raw.vertices, raw.faces)
    raw = _without_holes(raw)
    return raw if _valid(raw) else replace(raw, normals=None)


_READERS: Mapping[str, Callable[[Path], RawMesh]] = {
    ".obj": read_obj, ".off": read_off, ".ply": read_ply, ".stl": read_stl
}  # fmt: skip


def _by_trimesh(path: Path) -> RawMesh:
    """The mesh of a GLB or glTF, whose faces are triangles. Raises whatever trimesh does."""
    import trimesh  # noqa: PLC0415 - half a second, for those who read such a mesh

    with path.open("rb") as stream:
        loaded = trimesh.load(stream, file_type=path.suffix.lower()[1:], process=False, skip_materials=True)
    mesh = loaded.to_geometry() if isinstance(loaded, trimesh.Scene) else loaded
    if not isinstance(mesh, trimesh.Trimesh):
        return RawMesh(np.empty((0, 3)), np.empty((0, 3), dtype=np.int64))
    return RawMesh(np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64))


def _without_holes(raw: RawMesh) -> RawMesh:
    """The mesh without vertices of no face whose coordinates are no numbers."""
    kept = np.isfinite(raw.vertices).all(axis=1) | _used(raw.faces, len(raw.vertices))
    if kept.all():
        return raw
    place = np.cumsum(kept) - 1
    normals, colours = (None if rows is None else rows[kept] for rows in (raw.normals, raw.colours))
    return replace(raw, vertices=raw.vertices[kept], faces=place[raw.faces], normals=normals, colours=colours)


def _valid(raw: RawMesh) -> bool:
    """Return whether nearly all normals of vertices that have a face are of unit length."""
    if raw.normals is None:
        return True
    length = np.linalg.norm(raw.normals[_used(raw.faces, len(raw.vertices))], axis=1)
    return bool(np.all(np.isfinite(length)) and np.mean(np.abs(length - 1.0) > 0.05) <= 0.01)


def check_mesh(path: Path, vertices: Array, faces: IntArray) -> None:
    """Raise UnreadableFileError unless these are finite vertices (V, 3) and faces (F, 3) that refer to them."""
    _check_shape(path, vertices, faces)
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(bad):
        raise UnreadableFileError(
            f"{len(bad)} of {len(vertices)} vertices have coordinates that are not numbers, first vertex {bad[0]}",
            where=str(path),
            remedy="Export the scan again; if the problem remains, clean the mesh in the scanner's software",
        )


def _check_shape(path: Path, vertices: Array, faces: IntArray) -> None:
    """Raise UnreadableFileError unless faces are (F, 3) and refer to vertices (V, 3)."""
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        raise UnreadableFileError(
            f"vertices have {vertices.shape[-1]} coordinates and faces {faces.shape[-1]} corners, each must have 3",
            where=str(path),
            remedy="Open it in the scanner's software and export it again as triangles",
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise UnreadableFileError(
            f"a face refers to vertex {int(faces.max())} of {len(vertices)}",
            where=str(path),
            remedy="The file is damaged or was cut short: export it again",
        )


def credible_unit(path: Path, vertices: Array, unit: MeshUnit, *, any_size: bool = False) -> tuple[str, str]:
    """Determine the unit of vertices (V, 3) from the size of their bounding box; returns the unit and the evidence.

    With `any_size`, `auto` also takes what is smaller or larger than a scene: for those whom something else, such as
    the radius of the spheres in it, tells if the unit is wrong.

    Raises:
        UnreadableFileError: no unit is plausible, or the configured one contradicts the size.
    """
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    scene = unit == "auto" and not any_size
    low, high = SCENE_DIAGONAL_M if scene else OBJECT_DIAGONAL_M
    span = f"{'a scene' if scene else 'what is scanned'} is {low:g} to {high:g} m across"
    fitting = [name for name, scale in METRES_PER_UNIT.items() if low <= diagonal * scale <= high]
    if unit == "auto":
        if len(fitting) != 1:
            raise UnreadableFileError(
                f"the unit cannot be determined: the bounding box is {diagonal:.6g} file units across, which is "
                f"credible neither in millimetres nor in metres ({span})",
                where=str(path),
                remedy="Set the unit of the export in the scanner's software to millimetres and export again; "
                "if this is a single object, configure its unit",
            )
        other = "m" if fitting[0] == "mm" else "mm"
        return fitting[0], (
            f"inferred: the bounding box is {diagonal:.4g} {fitting[0]} across; in {other} it would be "
            f"{diagonal * METRES_PER_UNIT[other]:.4g} m, and {span}"
        )
    if unit not in fitting:
        advice = f"Set the unit to {fitting[0]}" if fitting else "Check the unit in the scanner's software"
        raise UnreadableFileError(
            f"the configured unit {unit} contradicts the size: the bounding box would be "
            f"{diagonal * METRES_PER_UNIT[unit]:.4g} m across, and {span}",
            where=str(path),
            remedy=f"{advice}, unless the scan shows something else",
        )
    return unit, (
        f"configured; the bounding box is {diagonal * METRES_PER_UNIT[unit]:.4g} m across, which is credible ({span})"
    )
