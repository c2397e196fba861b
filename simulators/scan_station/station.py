"""A simulated scanner: exports the scene as a hand scanner swept above it sees it, or as views of a sensor."""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.spatial.transform import Rotation

from simulators.faults import Fault, FaultPlan
from simulators.geometry import Array, Ints, apply, inverse, transform
from simulators.rendering.array_cache import cached
from simulators.scan_station.formats import encode
from simulators.scan_station.scanners import SCANNERS, USUAL_SPACING_MM, VIEWS, add_scanner_arguments, chosen_format
from simulators.scan_station.view_formats import e57, view_ply
from simulators.scan_station.views import sensor_pose, sensor_view
from simulators.scene.parts import Part, sphere_mesh, vertex_normals
from simulators.scene.world import RADIUS_M, Scene, parse_moved
from simulators.serve import Request, SimulatorError, Termination, announce, wait_for_line
from simulators.units import UNITS, in_unit, metres

log = logging.getLogger(__name__)

NOISE_M = 0.05e-3
GLOSSY_NOISE_M = 0.12e-3  # wet tissue and steel without scanning spray
SCANNER_POSES = 42
BASELINE_M = 0.06  # between projector and camera; a point must be visible from both
_COARSE_LEVEL = 4  # sphere subdivisions at which visibility is tested


@dataclass(frozen=True, slots=True)
class Scan:
    """A scan as the scanner's software holds it before export: in the scan frame, in metres."""

    vertices_m: Array
    faces: Ints
    normals: Array
    T_world_scan: Array


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--scene", type=int, required=True, metavar="SEED", help="seed of the scene")
    parser.add_argument(
        "--moved",
        type=parse_moved,
        default=(),
        metavar="JSON",
        help="registration spheres moved, as a JSON list of lists: index, x, y, z",
    )
    parser.add_argument("--folder", type=Path, required=True, help="folder to export to")
    parser.add_argument("--once", action="store_true", help="end after one export")
    parser.add_argument(
        "--when-told", action="store_true", help="compute the first export, and write it when a line comes on stdin"
    )
    parser.add_argument("--spray", action="store_true", help="the specimen is coated with scanning spray")
    parser.add_argument(
        "--control-spheres",
        action=argparse.BooleanOptionalAction,
        default=False,
        help="the control spheres are in place",
    )
    add_scanner_arguments(parser)
    parser.add_argument("--unit", choices=UNITS, default="mm", help="of the file; E57 is in metres")
    parser.add_argument("--normals", action=argparse.BooleanOptionalAction, default=True, help="write vertex normals")
    parser.add_argument(
        "--spacing-mm",
        type=float,
        default=USUAL_SPACING_MM,
        help="vertex spacing of the mesh on spheres; where it is wider than usual, views have as many fewer pixels",
    )
    parser.add_argument("--nth", type=int, help="number of the scan (default: exports in the folder, plus one)")


def serve(args: argparse.Namespace) -> None:
    """Export once and print the ready line.

    Without --once serve until SIGTERM, with another export at each SIGUSR1. With --once SIGTERM ends it at once.
    """
    folder: Path = args.folder
    chosen_format(args.scanner, args.format)
    folder.mkdir(parents=True, exist_ok=True)
    scene = Scene.generate(args.scene, args.moved)
    if args.once:
        _export(scene, args, announce_it=True)
        return
    termination, another = Termination(), Request()
    _export(scene, args, announce_it=True)
    another.serve(termination, lambda: _export(scene, args, announce_it=False))


def scan_scene(scene: Scene, *, spray: bool, control_spheres: bool, spacing_m: float, nth: int = 1) -> Scan:
    """Simulate the `nth` scan of a scene: the visible surface with noise, in that scan's own frame."""
    rng = np.random.default_rng([scene.seed, 0x5CA4, nth])
    T_world_scan = transform(Rotation.random(rng=rng).as_matrix(), rng.uniform(-0.3, 0.3, 3))
    centres = [*scene.registration_m, *(scene.control_m if control_spheres else ())]
    parts = [*scene.fixed_parts, *(sphere_mesh(centre, RADIUS_M, _COARSE_LEVEL) for centre in centres)]
    spheres: list[Array | None] = [*(None for _ in scene.fixed_parts), *centres]
    scores = _seen_counts(parts)
    pieces: list[tuple[Array, Ints, Array]] = []
    for part, centre, (score, best_cosine) in zip(parts, spheres, scores, strict=True):
        glossy = part.material in ("specimen", "steel") and not spray
        pieces.append(_observed(rng, part, score, best_cosine, centre, spacing_m, glossy=glossy))
    offsets = np.cumsum([0, *(len(piece[0]) for piece in pieces[:-1])])
    vertices = np.concatenate([piece[0] for piece in pieces])
    faces = np.concatenate([piece[1] + offset for piece, offset in zip(pieces, offsets, strict=True)])
    normals = np.concatenate([piece[2] for piece in pieces])
    T_scan_world = inverse(T_world_scan)
    return Scan(apply(T_scan_world, vertices), faces, normals @ T_scan_world[:3, :3].T, T_world_scan)


def _seen_counts(parts: list[Part]) -> list[tuple[Array, Array]]:
    """For each part and vertex: the number of scanner poses that see it, and the best cosine of incidence."""
    offsets = np.cumsum([0, *(len(part.vertices_m) for part in parts)])
    vertices = np.concatenate([part.vertices_m for part in parts])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets[:-1], strict=True)])
    normals = np.concatenate([vertex_normals(part.vertices_m, part.faces) for part in parts])
    count, best = cached("seen", [vertices, faces, normals], lambda: _count_views(vertices, faces, normals))
    return [(count[a:b], best[a:b]) for a, b in pairwise(offsets)]


def _count_views(vertices: Array, faces: Ints, normals: Array) -> list[Array]:
    """For each vertex (V, 3): the number (V,) of scanner poses that see it, and the best cosine (V,) of incidence."""
    scene = EmbreeScene()
    mesh = TriangleMesh(scene, vertices[faces].astype(np.float32))
    origins, outward = (np.ascontiguousarray(rows.T) for rows in (vertices + 0.3e-3 * normals, normals))
    count, best = np.zeros(len(vertices)), np.zeros(len(vertices))
    for centre, across in _sweep():
        free, cosine = np.arange(len(vertices)), np.ones(len(vertices))
        for eye in (centre - 0.5 * BASELINE_M * across, centre + 0.5 * BASELINE_M * across):
            ray = eye[:, None] - origins[:, free]
            ray /= np.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2])
            towards = ray * outward[:, free]
            cosine = np.minimum(cosine, towards[0] + towards[1] + towards[2])
            facing = np.flatnonzero(cosine > 0.3)
            free, cosine = free[facing], cosine[facing]
            from_m = origins[:, free].T.astype(np.float32, order="C")
            hit = scene.run(from_m, ray[:, facing].T.astype(np.float32, order="C"), query="OCCLUDED")
            unhidden = np.asarray(hit) != 0
            free, cosine = free[unhidden], cosine[unhidden]
        count[free] += 1
        best[free] = np.maximum(best[free], cosine)
    del mesh
    return [count, best]


def _sweep() -> Iterator[tuple[Array, Array]]:
    """The scanner's positions in the world during the sweep, and the direction from its projector to its camera."""
    for i in range(SCANNER_POSES):
        # A Fibonacci spiral over a dome, down to 15° above the table.
        sine = 1.0 - (i + 0.5) / SCANNER_POSES * 0.75
        azimuth = i * 2.399963
        out = np.array([np.cos(azimuth) * np.sqrt(1 - sine**2), np.sin(azimuth) * np.sqrt(1 - sine**2), sine])
        centre = np.array([0.0, 0.0, 0.04]) + out * [0.45, 0.40, 0.40]
        across = np.cross(out, [np.cos(3.1 * i), np.sin(3.1 * i), 0.2])
        yield centre, across / np.linalg.norm(across)


def _observed(
    rng: np.random.Generator,
    part: Part,
    count: Array,
    best_cosine: Array,
    centre_m: Array | None,
    spacing_m: float,
    *,
    glossy: bool,
) -> tuple[Array, Ints, Array]:
    """Return vertices, faces and normals of a part as scanned: refined, without its unseen surface, and noisy."""
    # A glossy surface is lost where it is seen at grazing angles or rarely.
    score = np.minimum(count / (7.0 if glossy else 2.5), np.maximum(best_cosine, 0.0) / (0.62 if glossy else 0.35))
    vertices, faces = part.vertices_m, part.faces
    # Merge the solid's repeated vertices at its seams, which would otherwise open the scan.
    _, first, index = np.unique(np.round(vertices, 9), axis=0, return_index=True, return_inverse=True)
    score = _maximum_over(index.reshape(-1), score, len(first))
    vertices, faces = vertices[first], index.reshape(-1)[faces]
    target = spacing_m if centre_m is not None else 1.3 * spacing_m
    if part.material != "board":
        edge = float(np.median(np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1)))
        for _ in range(max(0, round(float(np.log2(edge / target))))):
            vertices, faces, score = _subdivided(vertices, faces, score)
    if centre_m is not None:
        ray = vertices - centre_m
        vertices = centre_m + RADIUS_M * ray / np.linalg.norm(ray, axis=1, keepdims=True)
    # The threshold varies from place to place, which gives ragged rims.
    wobble = _correlated(rng, faces, len(vertices), 12) * (0.25 if glossy else 0.06)
    kept = (score + wobble > 1.0)[faces].all(axis=1)
    used, compact = np.unique(faces[kept], return_inverse=True)
    normals = vertex_normals(vertices, faces)[used]
    vertices, faces = vertices[used], compact.reshape(-1, 3)
    sigma = GLOSSY_NOISE_M if glossy else NOISE_M
    noise = sigma * _correlated(rng, faces, len(vertices), 1)
    vertices = vertices + noise[:, None] * normals
    return vertices, faces, vertex_normals(vertices, faces)


def _maximum_over(index: Ints, values: Array, n: int) -> Array:
    out = np.zeros(n)
    np.maximum.at(out, index, values)
    return out


def _subdivided(vertices: Array, faces: Ints, score: Array) -> tuple[Array, Ints, Array]:
    """Split each face in four at its edge midpoints; the score is interpolated."""
    n = len(vertices)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    keys, index = np.unique(edges[:, 0] * n + edges[:, 1], return_inverse=True)
    p, q = keys // n, keys % n
    ab, bc, ca = index.reshape(3, -1) + n
    a, b, c = faces.T
    split = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    vertices = np.concatenate([vertices, 0.5 * (vertices[p] + vertices[q])])
    return vertices, split, np.concatenate([score, 0.5 * (score[p] + score[q])])


def _correlated(rng: np.random.Generator, faces: Ints, n: int, rounds: int) -> Array:
    """Noise (n,) of unit variance, averaged `rounds` times over the neighbours on the mesh."""
    values = rng.standard_normal(n)
    if len(faces) == 0:
        return values
    corner, after, before = faces.ravel(), np.roll(faces, -1, axis=1).ravel(), np.roll(faces, 1, axis=1).ravel()
    valence = np.maximum(np.bincount(corner, minlength=n), 1)
    for _ in range(rounds):
        mean = np.bincount(corner, 0.5 * (values[after] + values[before]), n) / valence
        values = 0.6 * values + 0.4 * mean
        values /= values.std()
    return values


@dataclass(frozen=True, slots=True)
class _Export:
    """The files of one export, the one with the surface first, and the frame in which they are."""

    files: list[tuple[str, bytes]]
    T_world_scan: Array
    faces: int = 0


def _export(scene: Scene, args: argparse.Namespace, *, announce_it: bool) -> None:
    faults: FaultPlan = args.faults
    folder: Path = args.folder
    nth = args.nth or 1 + len(list(folder.glob("scan_*.*")))
    kind = chosen_format(args.scanner, args.format)
    exports = _views(scene, args, kind, nth) if kind in VIEWS else [_mesh(scene, args, kind, nth)]
    if announce_it and args.when_told and not wait_for_line():
        return
    for export in exports:
        fault = faults.check("scanner", "export")
        for number, (name, data) in enumerate(export.files):
            _write_progressively(folder / name, data, None if number else fault)
        log.info("exported %s: %d faces", export.files[0][0], export.faces)
    if announce_it:
        first = exports[0]
        announce(
            folder=str(folder),
            export=first.files[0][0],
            faces=first.faces,
            truth={"T_world_scan": first.T_world_scan.tolist()},
        )


def _mesh(scene: Scene, args: argparse.Namespace, kind: str, nth: int) -> _Export:
    scan = scan_scene(
        scene,
        spray=args.spray,
        control_spheres=args.control_spheres,
        spacing_m=metres(args.spacing_mm),
        nth=nth,
    )
    vertices = in_unit(scan.vertices_m, args.unit)
    artec = args.scanner.startswith("artec")
    normals = scan.normals if args.normals else None
    files = encode(kind, f"scan_{nth:02d}.{kind}", vertices, scan.faces, normals, artec=artec)
    return _Export(files, scan.T_world_scan, len(scan.faces))


def _views(scene: Scene, args: argparse.Namespace, kind: str, nth: int) -> list[_Export]:
    """One E57 file with every view, or a PLY file for each view in the sensor's frame."""
    scanner = SCANNERS[args.scanner]
    columns, rows = (round(pixels * min(1.0, USUAL_SPACING_MM / args.spacing_mm)) for pixels in scanner.pixels)
    views = [
        sensor_view(
            scene, sensor_pose(index), columns, rows,
            spray=args.spray, control_spheres=args.control_spheres, nth=nth + index,
        )
        for index in range(args.views or scanner.views)
    ]  # fmt: skip
    if kind == "e57":
        rng = np.random.default_rng([scene.seed, 0xE57, nth])
        T_world_file = transform(Rotation.random(rng=rng).as_matrix(), rng.uniform(-0.3, 0.3, 3))
        placed = [(view.points_m, inverse(T_world_file) @ view.T_world_sensor) for view in views]
        return [_Export([(f"scan_{nth:02d}.e57", e57(placed))], T_world_file)]
    return [
        _Export(
            [(f"scan_{nth + index:02d}.ply", view_ply(scanner, in_unit(view.points_m, args.unit), view.normals))],
            view.T_world_sensor,
        )
        for index, view in enumerate(views)
    ]


def _write_progressively(path: Path, data: bytes, fault: Fault | None) -> None:
    """Write a file as the scanner's software does: for a moment it exists but is incomplete."""
    kind = fault.kind if fault else ""
    value = float(fault.value) if fault is not None and isinstance(fault.value, (int, float)) else None
    if kind == "truncate":
        data = data[: int(len(data) * (0.6 if value is None else value))]
    elif kind == "corrupt":
        middle = len(data) // 2
        data = data[:middle] + b"\xff" * 64 + data[middle + 64 :]
    size = max(1, len(data) // 6)
    try:
        with path.open("wb") as stream:
            for start in range(0, len(data), size):
                if start:
                    time.sleep(0.03)
                if kind == "disk_full" and start >= 3 * size:
                    raise SimulatorError(f"no space left in {path.parent}: {path.name} is incomplete")
                if kind == "stall" and start == 3 * size:
                    time.sleep(5.0 if value is None else value)
                stream.write(data[start : start + size])
                stream.flush()
    except OSError as error:
        raise SimulatorError(f"{path} cannot be written: {error.strerror}") from error
