"""The pictures of a report: outlines, scene, photographs with their originals, and the notes taken on its steps.

A report should be small enough to send: under 3 MB with 36 photographs and the scene. The originals are named by
their hashes, which are their names in the evidence.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import cycle
from textwrap import wrap

import cv2
import numpy as np
from numpy.typing import NDArray

from service.audit.recorded_run import RecordedRun
from service.audit.report_blocks import (
    Block,
    Column,
    Drawing,
    Heading,
    Label,
    Line,
    Paragraph,
    Picture,
    Pictures,
    Raster,
    Rectangle,
    SceneBlock,
    Section,
    Shape,
    Table,
    TableCell,
    utc,
)
from service.compute.images.photographs import decode_reduced
from service.compute.registration.accuracy import Alignment
from service.core.errors import DataError, IntegrityError
from service.core.geometry import Array, Transform, apply
from service.core.protocol import Step
from service.core.records.entered import NoteTaken, about_rows
from service.core.records.run_events import FurtherExposure, RecordedView, ViewpointCaptured
from service.core.units import metres, mm
from service.core.words import counted
from service.dataset import scene_view
from service.dataset.further_cameras import further_poses
from service.dataset.scene_view import frustum_lines, unit_ball
from service.dataset.summary import RunSummary

# --- the scene: cameras, spheres and the scan's mesh, as a drawing and for turning in a browser -------------------
#
# The pages show the scene with plotly, whose script of 4.8 MB is too large for a report that is sent by e-mail.

_FACES = 16_000
_WIDTH, _HEIGHT = 960.0, 600.0
_SUPERSAMPLED = 2
_BACK = (255, 255, 255)
_LEGEND = 44.0  # height below the picture
_LIGHT = np.array([0.35, -0.75, 0.9])


def report_scene(summary: RunSummary, *, turning: bool) -> SceneBlock | None:
    """Return cameras, spheres and mesh in one frame; None without a registration. `turning`: also for a browser."""
    best, registrations = summary.best(), summary.registrations()
    spheres, scan = summary.scan_spheres_m(), summary.scan_mesh_file()
    if best is None or best not in registrations or not spheres or scan is None:
        return None
    try:
        summary.store.artefact_path(scan.sha256, verify=True)
    except IntegrityError:
        return None  # the first page names the file
    registered = registrations[best]
    points_m, triangles = scene_view.decimated(*summary.scan_mesh(), most=_FACES)
    placed = Alignment(np.array(registered.T_world_scan), np.array(registered.covariance)[:6, :6])
    error_mm = mm(np.sqrt(np.trace(placed.covariance_at_m2(points_m), axis1=1, axis2=2)))
    cameras = {name: np.array(T) for name, T in registered.T_scan_camera.items()}
    stations = {c.viewpoint: c.station for c in summary.captures() if c.viewpoint in cameras}
    scene = scene_view.Scene(
        cameras=cameras,
        stations={name: stations.get(name, "") for name in cameras},
        spheres=[scene_view.SceneSphere(str(i), "registration", centre) for i, centre in enumerate(spheres)],
        radius_m=metres(summary.protocol.spheres.radius_mm),
        mesh=scene_view.SceneMesh(points_m, triangles, error_mm),
        further=further_poses(summary.protocol, summary.state, summary.captures(), registered.T_scan_camera),
    )
    geometry = _geometry(scene)
    text = (
        f"{counted(len(cameras), 'camera')} and {counted(len(spheres), 'sphere')}, registered with the poses of "
        f"{best}, about the scan's mesh, which is coloured by its predicted error: {error_mm.min():.3g} to "
        f"{error_mm.max():.3g} mm. The bar has {scene_view.BAR_MM:.0f} mm."
    )
    drawing = _drawing(geometry, text, _rows(scene))
    return SceneBlock(drawing, _turned(geometry) if turning else "")


@dataclass(slots=True)
class _Geometry:
    """The drawn scene, in millimetres of the viewing frame.

    Attributes:
        points: (V, 3) corners of the triangles.
        triangles: (F, 3) indices of points.
        colours: (V, 3) a colour for each point, red first.
        segments: (N, 2, 3) ends of the lines.
        strokes: (N, 3) a colour for each line.
        labels: text and where it stands.
        legend: colour and what it stands for.
        error_mm: the errors that the first and the last colour of the mesh stand for; None: it has one colour.
    """

    points: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    triangles: NDArray[np.uint32] = field(default_factory=lambda: np.zeros((0, 3), np.uint32))
    colours: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    segments: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 2, 3), np.float32))
    strokes: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    labels: list[tuple[str, NDArray[np.float32]]] = field(default_factory=list[tuple[str, NDArray[np.float32]]])
    legend: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    error_mm: tuple[float, float] | None = None

    def add_surface(self, points: NDArray[np.float32], faces: NDArray[np.int64], colour: NDArray[np.uint8]) -> None:
        """Add triangles in one colour, or in one for each point."""
        self.triangles = np.concatenate([self.triangles, (faces + len(self.points)).astype(np.uint32)])
        self.points = np.concatenate([self.points, points])
        self.colours = np.concatenate([self.colours, np.broadcast_to(colour, (len(points), 3))])

    def add_lines(self, segments: NDArray[np.float32], colour: str) -> None:
        """Add line segments (N, 2, 3) in one colour."""
        self.segments = np.concatenate([self.segments, segments])
        self.strokes = np.concatenate([self.strokes, np.broadcast_to(_rgb(colour), (len(segments), 3))])


def _geometry(scene: scene_view.Scene) -> _Geometry:
    to_view, parts = scene_view.viewing_frame(scene), _Geometry()
    _add_mesh(parts, scene.mesh, to_view)
    _add_spheres(parts, scene, to_view)
    _add_cameras(parts, scene, to_view)
    _add_scale_bar(parts)
    return parts


def _in_view_mm(points_m: Array, to_view: Transform) -> NDArray[np.float32]:
    return mm(apply(to_view, np.asarray(points_m, dtype=np.float64).reshape(-1, 3))).astype(np.float32)


def _add_mesh(parts: _Geometry, mesh: scene_view.SceneMesh | None, to_view: Transform) -> None:
    """Add the mesh, coloured by its predicted error."""
    if mesh is None or mesh.error_mm is None:
        return
    least, most = float(mesh.error_mm.min()), float(mesh.error_mm.max())
    share = (mesh.error_mm - least) / max(most - least, 1e-12)
    parts.add_surface(_in_view_mm(mesh.points_m, to_view), mesh.triangles, _viridis(share))
    parts.error_mm = least, most


def _add_spheres(parts: _Geometry, scene: scene_view.Scene, to_view: Transform) -> None:
    ball, faces = unit_ball()
    radius_mm = mm(scene.radius_m)
    for sphere in scene.spheres:
        centre = _in_view_mm(np.array(sphere.centre_m), to_view)[0]
        vertices = (centre + scene_view.PROUD * radius_mm * ball).astype(np.float32)
        parts.add_surface(vertices, faces, _rgb(scene_view.KINDS[sphere.kind]))
        parts.labels.append((sphere.label, centre + np.array([0, 0, 1.6 * radius_mm], np.float32)))
    kinds = dict.fromkeys(sphere.kind for sphere in scene.spheres)
    parts.legend += [(scene_view.KINDS[kind], scene_view.KIND_NAMES[kind]) for kind in kinds]


def _add_cameras(parts: _Geometry, scene: scene_view.Scene, to_view: Transform) -> None:
    """Add the frustums of each station's cameras in a colour of their own."""
    for number, station in enumerate(sorted(set(scene.stations.values()))):
        colour = scene_view.STYLES[number % len(scene_view.STYLES)][0]
        mine = [to_view @ T for name, T in scene.cameras.items() if scene.stations[name] == station]
        _add_frustums(parts, mine, colour)
        parts.legend.append((colour, f"cameras of {station}".replace("_", " ") if station else "cameras"))
    for (name, poses), (colour, _) in zip(scene.further.items(), cycle(scene_view.FURTHER_STYLES), strict=False):
        _add_frustums(parts, [to_view @ T for T in poses.values()], colour)
        parts.legend.append((colour, name))


def _add_frustums(parts: _Geometry, cameras: Sequence[Transform], colour: str) -> None:
    path = frustum_lines(cameras).astype(np.float32)
    pairs = np.stack([path[:-1], path[1:]], axis=1)
    parts.add_lines(pairs[np.isfinite(pairs).all(axis=(1, 2))], colour)


def _add_scale_bar(parts: _Geometry) -> None:
    bar = scene_view.BAR_MM
    ends = np.array([[[-bar / 2, -300, -60], [bar / 2, -300, -60]]], np.float32)
    parts.add_lines(ends, "#52606d")
    parts.labels.append((f"{bar:.0f} mm", ends[0, 1] + np.array([0.4 * bar, 0, 0], np.float32)))


def _viridis(share: Array) -> NDArray[np.uint8]:
    """Return colours (N, 3), red first, of the map viridis for shares between 0 and 1."""
    grey = np.clip(np.rint(255 * share), 0, 255).astype(np.uint8)[:, None]
    coloured = np.asarray(cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS), dtype=np.uint8)
    return np.ascontiguousarray(coloured[:, 0, ::-1])


def _rgb(colour: str) -> NDArray[np.uint8]:
    return np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)], np.uint8)


def _hex(colour: NDArray[np.uint8]) -> str:
    return "#" + "".join(f"{int(value):02x}" for value in colour)


# --- the drawing ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Camera:
    """The view of the drawing, and its place on the sheet: u, v = offset + scale · x / z."""

    rotation: Array
    eye_mm: Array
    scale: float
    offset: Array

    def project(self, points_mm: Array | NDArray[np.float32]) -> tuple[Array, Array]:
        """Return positions (N, 2) on the sheet, y downwards, and distances (N,)."""
        seen = (np.asarray(points_mm, dtype=np.float64) - self.eye_mm) @ self.rotation.T
        return self.offset + self.scale * seen[:, :2] / seen[:, 2:], seen[:, 2]


def _camera(geometry: _Geometry) -> _Camera:
    every = np.concatenate([geometry.points, geometry.segments.reshape(-1, 3)]).astype(np.float64)
    towards = np.array(scene_view.TOWARDS_MM)
    away = np.array(scene_view.EYE_MM) - towards
    away /= np.linalg.norm(away)
    extent_mm = float(np.linalg.norm(every - towards, axis=1).max())
    eye = towards + 2.6 * extent_mm * away
    forward = -away
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.array([right, np.cross(forward, right), forward])
    plain = _Camera(rotation, eye, 1.0, np.zeros(2)).project(every)[0]
    low, high = plain.min(axis=0), plain.max(axis=0)
    margin = 16.0
    room = np.array([_WIDTH - 2 * margin, _HEIGHT - 2 * margin])
    scale = float(np.min(room / (high - low)))
    return _Camera(rotation, eye, scale, np.array([_WIDTH, _HEIGHT]) / 2 - scale * (low + high) / 2)


def _drawing(geometry: _Geometry, text: str, rows: tuple[tuple[str, ...], ...]) -> Drawing:
    camera = _camera(geometry)
    shapes: list[Shape] = [Raster(0, 0, _WIDTH, _HEIGHT, _painted(geometry, camera))]
    for (start, end), stroke in zip(geometry.segments, geometry.strokes, strict=True):
        (a, b), _ = camera.project(np.array([start, end]))
        shapes.append(Line(float(a[0]), float(a[1]), float(b[0]), float(b[1]), _hex(stroke), 1.2))
    for words, where in geometry.labels:
        (at,), _ = camera.project(where[None])
        shapes.append(Label(float(at[0]), float(at[1]), words, 13))
    x, y = 16.0, _HEIGHT + 24
    for colour, words in geometry.legend:
        shapes += [Rectangle(x, y - 10, 12, 12, colour), Label(x + 18, y, words, 13, anchor="start")]
        x += 44 + 7.4 * len(words)
    if geometry.error_mm is not None:
        shapes += _scale(geometry.error_mm, y)
    title = "Cameras, spheres and the scan's mesh in one frame"
    return Drawing(title, text, _WIDTH, _HEIGHT + _LEGEND, tuple(shapes), "scene", rows)


def _scale(error_mm: tuple[float, float], y: float) -> list[Shape]:
    """Return the colour scale of the mesh, at the right end of the legend."""
    width, steps = 140.0, 35
    x = _WIDTH - width - 92
    shapes: list[Shape] = [Label(x - 62, y, "predicted error", 13, anchor="end")]
    for step, colour in enumerate(_viridis(np.linspace(0, 1, steps))):
        shapes.append(Rectangle(x + step * width / steps, y - 10, width / steps + 0.3, 12, _hex(colour)))
    shapes.append(Label(x - 8, y, f"{error_mm[0]:.3g}", 13, anchor="end"))
    shapes.append(Label(x + width + 8, y, f"{error_mm[1]:.3g} mm", 13, anchor="start"))
    return shapes


def _painted(geometry: _Geometry, camera: _Camera) -> bytes:
    """Return the surfaces as PNG, painted from the farthest to the nearest triangle."""
    grown = _SUPERSAMPLED
    canvas = np.full((int(_HEIGHT * grown), int(_WIDTH * grown), 3), _BACK, np.uint8)
    places, distances = camera.project(geometry.points)
    corners = geometry.points[geometry.triangles].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    lit = np.abs(normals @ (_LIGHT / np.linalg.norm(_LIGHT))) / np.maximum(lengths, 1e-12)
    shades = geometry.colours[geometry.triangles].astype(np.float64).mean(axis=1) * (0.5 + 0.5 * lit[:, None])
    fixed = np.rint(places[geometry.triangles] * grown * 16).astype(np.int32)  # four fractional bits
    for face in np.argsort(-distances[geometry.triangles].mean(axis=1), kind="stable"):
        red, green, blue = (float(value) for value in shades[face])
        cv2.fillConvexPoly(canvas, fixed[face], (blue, green, red), cv2.LINE_8, 4)
    small = cv2.resize(canvas, None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".png", small, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()


def _rows(scene: scene_view.Scene) -> tuple[tuple[str, ...], ...]:
    """Return the positions of cameras and spheres in the scan's frame, as rows of a table."""
    head = ("what", "name", "station", "x_mm", "y_mm", "z_mm", "axis_x", "axis_y", "axis_z")
    rows: list[tuple[str, ...]] = [head]
    for name, T in sorted(scene.cameras.items()):
        rows.append(("camera", name, scene.stations[name], *_place(T)))
    for device, poses in sorted(scene.further.items()):
        rows += [(device, name, "", *_place(pose)) for name, pose in sorted(poses.items())]
    for sphere in scene.spheres:
        rows.append(("sphere", sphere.label, "", *_numbers(mm(np.array(sphere.centre_m)), 4), "", "", ""))
    return tuple(rows)


def _place(T: Transform) -> tuple[str, ...]:
    """Return a camera's position and optical axis."""
    return (*_numbers(mm(T[:3, 3]), 4), *_numbers(T[:3, 2], 6))


def _numbers(values: Array, digits: int) -> tuple[str, ...]:
    return tuple(f"{float(value):.{digits}f}" for value in values)


# --- for a browser ----------------------------------------------------------------------------------------------


def _turned(geometry: _Geometry) -> str:
    """Return a canvas over the drawing, except its legend, and the data that templates/scene.js draws on it."""
    wide = len(geometry.points) > 0xFFFF
    data: Mapping[str, object] = {
        "points": _packed(geometry.points),
        "triangles": _packed(geometry.triangles if wide else geometry.triangles.astype(np.uint16)),
        "wide": wide,
        "colours": _packed(geometry.colours),
        "segments": _packed(geometry.segments),
        "strokes": _packed(np.repeat(geometry.strokes, 2, axis=0)),
        "labels": [[text, [round(float(value), 1) for value in at]] for text, at in geometry.labels],
        "towards": scene_view.TOWARDS_MM,
        "eye": scene_view.EYE_MM,
    }
    text = json.dumps(data, separators=(",", ":"))
    # base64, numbers and escaped labels: nothing in it can close the element.
    kept = text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
    height = 100 * _HEIGHT / (_HEIGHT + _LEGEND)
    return (
        f'<div class="turned" style="height: {height:.3f}%" tabindex="0" role="application" '
        'aria-label="The scene: arrow keys turn it, + and − come nearer and go back" hidden><canvas></canvas></div>'
        f'<script type="application/json" id="scene-data">{kept}</script>\n'
    )


def _packed(values: NDArray[np.float32] | NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.uint32]) -> str:
    little = np.ascontiguousarray(values.astype(values.dtype.newbyteorder("<")))
    return base64.b64encode(little.tobytes()).decode()


# --- photographs with their originals, and the notes taken on the steps -------------------------------------------

THUMBNAIL_PX = 240
LARGE_PX = 720
_QUALITY = 76  # so that a report of 36 photographs stays under 3 MB


def picture(run: RecordedRun, sha256: str, caption: str, width_px: int, *, upright: bool = False) -> Picture:
    """Return a JPEG copy of limited width without the camera's metadata; empty if the file is missing or altered.

    `upright`: rotate by the orientation tag. Images that are measured are never rotated.
    """
    try:
        path = run.files.artefact_path(sha256, verify=True)
    except IntegrityError:
        return Picture(f"{caption}: the file is missing or was altered", None)
    try:
        pixels, _ = decode_reduced(path.read_bytes(), width_px, path.name, upright=upright)
    except DataError:
        return Picture(f"{caption}: the file cannot be read as a picture", None)
    jpeg = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
    return Picture(caption, jpeg, pixels.shape[1], pixels.shape[0], sha256)


_WIDTH_PX = 500
_PIECE_CHARACTERS = 900


def about_facts(run: RecordedRun) -> list[tuple[str, TableCell | str]]:
    """Return what was entered when the run began; it is empty for old runs, which did not ask."""
    rows: list[tuple[str, TableCell | str]] = []
    for name, value in about_rows(run.root.about):
        rows += [(name if part == 0 else "", text) for part, text in enumerate(_pieces(value))]
    return rows


def _pieces(text: str) -> list[str]:
    """Return a long text in parts, because a row of a table has to fit on a page."""
    return wrap(text, _PIECE_CHARACTERS, replace_whitespace=False, break_on_hyphens=False) or [""]


def notes_section(run: RecordedRun, *, with_pictures: bool) -> Section | None:
    """Return every note with its step, time and author, and the photographs; None without any."""
    titles = {step.id: step.title for step in run.protocol.steps}
    notes = [(event, event.payload) for event in run.events if isinstance(event.payload, NoteTaken)]
    if not notes:
        return None
    rows: list[tuple[str, ...]] = []
    for event, note in notes:
        head = (str(event.seq), utc(event.at_utc), titles.get(note.step, note.step), run.named(event.actor))
        text = " ".join([note.text, "[photograph]"] if note.photograph is not None else [note.text]).strip()
        rows += [(*(head if part == 0 else ("",) * 4), piece) for part, piece in enumerate(_pieces(text))]
    columns = (
        Column("event", 0.5, "number"),
        Column("time", 1.35),
        Column("step", 1.3),
        Column("who", 1.0),
        Column("note", 3.6),
    )
    blocks: list[Block] = [Table(columns, tuple(rows))]
    pictures = tuple(
        picture(
            run, note.photograph.sha256, f"event {event.seq}: {note.text[:120]}".rstrip(": "), _WIDTH_PX, upright=True
        )
        for event, note in notes
        if note.photograph is not None
    )
    if pictures and with_pictures:
        blocks += [Heading("Photographs of the notes"), Pictures(pictures, 3)]
    return Section("Notes", tuple(blocks))


_ORIGINALS = (
    Column("event", 0.5, "number"),
    Column("view", 0.9),
    Column("original file name", 1.4),
    Column("SHA-256, its name in the evidence", 4.2, "code"),
)


def pictures_section(run: RecordedRun, *, turning: bool) -> Section:
    """Return overlays of the evaluation, the scene, a contact sheet of the valid captures, and the list of originals.

    `turning`: include the scene that can be turned, which only HTML can show.
    """
    blocks: list[Block] = []
    overlays = run.summary().artefacts("overlay")
    if overlays:
        blocks += [
            Heading("Detected and predicted outlines"),
            Paragraph(
                "Green: registration spheres. Blue: control spheres, which took no part in the registration. Yellow, "
                "dashed: predicted by the registration."
            ),
            Pictures(tuple(picture(run, ref.sha256, ref.original_name, LARGE_PX) for ref in overlays), 2),
        ]
    scene = report_scene(run.summary(), turning=turning)
    if scene is not None:
        blocks += [Heading(scene.drawing.title), scene]
    originals: list[tuple[TableCell | str, ...]] = []
    for step in run.protocol.steps:
        sheets, of_step = _contact_sheets(run, step)
        blocks += sheets
        originals += of_step
    if originals:
        text = (
            "The pictures above are small copies. The original photographs are in the folder "
            "artefacts of the evidence, and of a bundle made from it, each under its SHA-256."
        )
        blocks += [Heading("Originals"), Paragraph(text), Table(_ORIGINALS, tuple(originals), small=True)]
    return Section("Pictures", tuple(blocks) or (Paragraph("No photograph was taken."),))


def _contact_sheets(run: RecordedRun, step: Step) -> tuple[list[Block], list[tuple[str, str, str, str]]]:
    """Return a step's contact sheets, one for each camera, and a row of `_ORIGINALS` for each picture of them."""
    blocks: list[Block] = []
    seqs = sorted(run.state.steps[step.id].captured.values())
    captures = [(seq, run.events[seq - 1].payload) for seq in seqs]
    views = [(seq, capture) for seq, capture in captures if isinstance(capture, RecordedView)]
    if views:
        sheet = tuple(picture(run, view.artefacts[0].sha256, _caption(view), THUMBNAIL_PX) for _, view in views)
        blocks += [Heading(f"Contact sheet: {step.title}"), Pictures(sheet, 5)]
    further = _further(views)
    for device, mine in further.items():
        sheet = tuple(picture(run, one.artefacts[0].sha256, caption, THUMBNAIL_PX) for _, caption, one in mine)
        blocks += [Heading(f"Contact sheet: {step.title}, {device}"), Pictures(sheet, 5)]
    shown = [(seq, view.viewpoint, view.artefacts[0]) for seq, view in views]
    shown += [(seq, f"{name}, {one.device}", one.artefacts[0]) for m in further.values() for seq, name, one in m]
    return blocks, [(str(seq), name, ref.original_name, ref.sha256) for seq, name, ref in shown]


def _further(views: Sequence[tuple[int, RecordedView]]) -> dict[str, list[tuple[int, str, FurtherExposure]]]:
    """Return the images of each further camera: event, viewpoint, exposure."""
    found: dict[str, list[tuple[int, str, FurtherExposure]]] = {}
    for seq, view in views:
        for one in view.further if isinstance(view, ViewpointCaptured) else ():
            found.setdefault(one.device, []).append((seq, view.viewpoint, one))
    return found


def _caption(capture: RecordedView) -> str:
    failed = [name for name, passed in capture.verdicts.items() if not passed]
    return capture.viewpoint + (f" ✗ {', '.join(failed)}" if failed else "")
