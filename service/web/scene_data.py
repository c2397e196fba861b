"""The scene of a run as far as it is known, registered or planned, for the 3D view and in text and numbers."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.computations import fuse
from service.computations.further_cameras import FURTHER_VIEW
from service.computations.records import Point
from service.computations.registration import Registration
from service.compute.registration.accuracy import Alignment
from service.core.geometry import Array, Transform, inverse
from service.core.records.base import ArtefactRef
from service.core.records.run_events import RecordedView, ViewpointCaptured
from service.core.units import deg, metres, mm
from service.core.words import counted
from service.dataset.further_cameras import KnownFurtherCamera, further_poses
from service.dataset.registrations import registrations
from service.dataset.scene_view import FACES_SHOWN, Scene, SceneMesh, SceneSphere, decimated, viewing_frame
from service.dataset.summary import registered_scan
from service.followed_run import RunRecord
from service.web.images import cached, captures_of, further_cameras_of, further_of
from service.web.outlines import (
    DisplayedRegistration,
    LivePose,
    Sphere,
    ct_spheres,
    displayed_registration,
    last_step,
    read_live_pose,
    scan_spheres,
)
from service.web.planned_poses import nominal_T_flange_camera, planned_poses, station_of

_WITH_STATIONS = ("hybrid", "robot_corrected", "robot")  # sources that tell where each station's base stood


@dataclass(frozen=True, slots=True)
class KnownScene:
    """A scene and what pages say about it.

    Attributes:
        frame: a text on the frame of the positions.
        how: a text on the origin of the poses.
        missing: texts on what is not shown, and why.
        mesh: file of the surface; None: there is none yet.
        sphere_images: number of images in which each sphere was seen, by its label.
    """

    scene: Scene
    spheres: tuple[Sphere, ...]
    frame: str
    how: str
    missing: tuple[str, ...] = ()
    mesh: ArtefactRef | None = None
    registered: DisplayedRegistration | None = None
    sphere_images: Mapping[str, int] = field(default_factory=dict[str, int])


@dataclass(frozen=True, slots=True)
class MeshFacts:
    """Facts about a surface, for a table."""

    vertices: int
    faces: int
    shown_faces: int
    size_mm: tuple[float, float, float]


def scene_of(log: RunRecord) -> KnownScene:
    """Return the best known scene: registered, else provisional, else planned."""
    registered = displayed_registration(log)
    if registered is not None:
        return _registered(log, registered)
    live = _live(log)
    return live if live is not None else _planned(log)


# --- after the registration -------------------------------------------------------------------------------------


def _registered(log: RunRecord, registered: DisplayedRegistration) -> KnownScene:
    record = registered.record
    cameras = {name: np.array(T, dtype=np.float64) for name, T in record.T_scan_camera.items()}
    spheres = scan_spheres(log)
    bases, missing = _bases(log, record)
    scan = registered_scan(log.protocol, log.state)
    meshes = [ref for ref in log.state.steps[scan].artefacts if ref.kind == "scan_mesh"] if scan else []
    left_out = record.leave_one_out
    seen = {} if left_out is None else {label: int(row[2]) for label, row in left_out.spheres.items()}
    scene = Scene(
        cameras=cameras,
        stations=dict.fromkeys(cameras, "")
        | {c.viewpoint: c.station for c in _all_captures(log) if c.viewpoint in cameras},
        spheres=[SceneSphere(s.label, s.kind, s.centre_m) for s in spheres],
        radius_m=metres(log.protocol.spheres.radius_mm),
        bases=bases,
        outlines={"wound of the last fusion": np.array(wound)} if (wound := _wound(log)) else {},
        further=further_poses(log.protocol, log.state, _all_captures(log), record.T_scan_camera),
    )
    words = registered.name.replace("_", " ")
    return KnownScene(
        scene,
        spheres,
        "of the scan",
        f"registered, camera poses by {words}",
        tuple(missing),
        meshes[-1] if meshes else None,
        registered,
        seen,
    )


def _wound(log: RunRecord) -> tuple[Point, ...]:
    """Return the outline of the wound that the last fusion used, in the frame of the scan; empty without one."""
    steps = [log.state.steps[step.id] for step in log.protocol.steps if step.gives == "ground_truth"]
    jobs = [job for step in steps for job in step.jobs.values()]
    done = [job for job in jobs if job.kind == fuse.KIND.name and job.status == "finished"]
    last = max(done, key=lambda job: job.enqueued_seq, default=None)
    return () if last is None else fuse.KIND.read_answer(last.result).wound_m


def _bases(log: RunRecord, record: Registration) -> tuple[dict[str, Transform], list[str]]:
    """Return T_scan_base by station, of this registration or of one of the run that keeps the stations apart."""
    known_registrations = registrations(log.protocol, log.state)
    known = [record, *(known_registrations[n] for n in _WITH_STATIONS if n in known_registrations)]
    for candidate in known:
        if candidate.poses in _WITH_STATIONS:
            T_scan_world = inverse(np.array(candidate.T_world_scan))
            return {name: T_scan_world @ np.array(T) for name, T in candidate.T_world_station.items()}, []
    return {}, ["Robot bases: the poses come from the images alone, which do not show where the robots stood."]


# --- while images are being taken ---------------------------------------------------------------------------------


def _live(log: RunRecord) -> KnownScene | None:
    """Return the scene in the CT frame, by each station's newest provisional registration; None without one."""
    records: dict[str, LivePose] = {}
    for step in log.protocol.steps:
        for capture in captures_of(log, step.id):
            job = capture.live
            if capture.replaced is None and job is not None and job.status == "finished" and job.artefacts:
                records[capture.payload.viewpoint] = read_live_pose(log.store.artefact_path(job.artefacts[0].sha256))
    placed = {r.station: np.array(r.T_base_scan) for r in records.values() if r.T_base_scan is not None}
    if not placed:
        return None
    T_ct_base = {station: inverse(T) for station, T in placed.items()}
    mine = {name: r for name, r in records.items() if r.station in placed}
    spheres = ct_spheres(log)
    planned: dict[str, Transform] = {}
    stations = {name: r.station for name, r in mine.items()}
    for name, station, T in _to_come(log):
        if station in T_ct_base:
            planned[name], stations[name] = T_ct_base[station] @ T, station
    away = len(records) - len(mine)
    scene = Scene(
        cameras={n: T_ct_base[r.station] @ np.array(r.T_base_camera) for n, r in mine.items()},
        stations=stations,
        spheres=[SceneSphere(s.label, s.kind, s.centre_m) for s in spheres],
        radius_m=metres(log.protocol.spheres.radius_mm),
        planned=planned,
        bases=T_ct_base,
        further=_live_further(log),
    )
    step = last_step(log, "ct_surface")
    meshes = [ref for ref in log.state.steps[step].artefacts if ref.kind == "ct_mesh"] if step else []
    return KnownScene(
        scene,
        spheres,
        "of the CT",
        "provisional: placed by the spheres seen so far",
        (f"{counted(away, 'image')} of a station whose position is not known yet.",) if away else (),
        meshes[-1] if meshes else None,
    )


def _live_further(log: RunRecord) -> dict[str, dict[str, Transform]]:
    """Return T_ct_camera of further cameras, each by its image alone; of one that stands still, the newest."""
    found: dict[str, dict[str, Transform]] = {}
    for step in log.protocol.steps:
        for capture in captures_of(log, step.id):
            for one in further_of(log, capture) if capture.replaced is None else ():
                answer = None
                if one.live is not None and one.live.status == "finished":
                    answer = FURTHER_VIEW.read_answer(one.live.result)
                if answer is not None and answer.T_ct_camera is not None:
                    name, fixed = one.exposure.device, one.exposure.mounted == "fixed"
                    view = name if fixed else f"{capture.payload.viewpoint}, {name}"
                    found.setdefault(name, {})[view] = np.array(answer.T_ct_camera)
    return found


def _to_come(log: RunRecord) -> list[tuple[str, str, Transform]]:
    """Return viewpoints of the current step that are still to be taken: name, station, T_base_camera."""
    state = log.state.step
    if log.state.terminal:
        return []
    gone = {*state.captured, *state.skipped_viewpoints}
    plan = planned_poses(log, log.protocol.step(log.state.current))
    return [(v.name, v.station, v.T_base_camera) for v in plan if v.name not in gone]


# --- before anything has been placed ----------------------------------------------------------------------------


def _planned(log: RunRecord) -> KnownScene:
    """Return one station in its base frame: past camera poses by the mount's design, and planned ones."""
    captured = _all_captures(log)
    to_come = _to_come(log)
    station = to_come[0][1] if to_come else captured[-1].station if captured else ""
    mount = nominal_T_flange_camera(log)
    cameras: dict[str, Transform] = {}
    if mount is not None:
        T_flange_camera = np.array(mount)
        mine = [c for c in captured if c.station == station and isinstance(c, ViewpointCaptured)]
        cameras = {c.viewpoint: np.array(c.T_base_flange) @ T_flange_camera for c in mine}
    planned = {name: T for name, there, T in to_come if there == station}
    missing = ["Spheres and specimen: nothing has been registered with the images yet."]
    if not station:
        missing = ["Nothing has been planned or taken yet."]
    known = station_of(log, station)
    centre = None if known is None else known.layout.scene_centre_m
    base = {} if not station else {station: np.eye(4)}
    scene = Scene(cameras, dict.fromkeys((*cameras, *planned), station), planned=planned, bases=base, up=(0, 0, 1))
    if centre is not None:
        scene = replace(scene, mesh=_table(centre))
    return KnownScene(
        scene,
        (),
        f"of the robot base at {station}" if station else "",
        "by the robot's poses and the design of the camera's mount",
        tuple(missing),
    )


def _table(centre_m: tuple[float, float, float]) -> SceneMesh:
    """Return a square of 0.4 m where the scene is expected."""
    offsets = 0.2 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return SceneMesh(np.array(centre_m) + offsets, np.array([[0, 1, 2], [0, 2, 3]]))


def _all_captures(log: RunRecord) -> list[RecordedView]:
    found = [c for step in log.protocol.steps for c in captures_of(log, step.id) if c.replaced is None]
    return [c.payload for c in sorted(found, key=lambda c: c.seq)]


# --- the surface --------------------------------------------------------------------------------------------------


def with_mesh(now: KnownScene, log: RunRecord, data: Path) -> Scene:
    """Return the scene with its surface, which is decimated once and cached; coloured by the predicted error."""
    if now.mesh is None:
        return now.scene
    points, triangles, _ = _surface(log, now.mesh, data)
    error_mm = None if now.registered is None else predicted_error_mm(now.registered, points)
    return replace(now.scene, mesh=SceneMesh(points, triangles, error_mm))


def predicted_error_mm(registered: DisplayedRegistration, points_m: Array) -> Array:
    """Return the 3D standard deviation (N,) of points (N, 3) of the scan by the registration with images, mm."""
    placed = Alignment(np.array(registered.record.T_world_scan), np.array(registered.record.covariance)[:6, :6])
    return np.asarray(mm(np.sqrt(np.trace(placed.covariance_at_m2(points_m), axis1=1, axis2=2))), dtype=np.float64)


def mesh_facts(now: KnownScene, log: RunRecord, data: Path) -> MeshFacts | None:
    """Return facts about the surface; None without a surface."""
    return None if now.mesh is None else _surface(log, now.mesh, data)[2]


def _surface(log: RunRecord, ref: ArtefactRef, data: Path) -> tuple[Array, NDArray[np.int64], MeshFacts]:
    def make() -> bytes:
        with np.load(log.store.artefact_path(ref.sha256, verify=True), allow_pickle=False) as mesh:
            vertices, faces = mesh["vertices_m"], mesh["faces"]
        points, triangles = decimated(vertices, faces)
        size = mm(vertices.max(axis=0) - vertices.min(axis=0))
        buffer = io.BytesIO()
        facts = np.array([len(vertices), len(faces), len(triangles), *size], dtype=np.float64)
        np.savez(buffer, points=points.astype(np.float32), triangles=triangles.astype(np.int32), facts=facts)
        return buffer.getvalue()

    return _load(cached(data, f"surface {ref.sha256} {FACES_SHOWN}", ".npz", make))


@lru_cache(maxsize=4)
def _load(path: Path) -> tuple[Array, NDArray[np.int64], MeshFacts]:
    with np.load(path, allow_pickle=False) as kept:
        points, triangles, facts = (
            kept["points"].astype(np.float64),
            kept["triangles"].astype(np.int64),
            kept["facts"],
        )
    counts, size = (int(n) for n in facts[:3]), (float(v) for v in facts[3:6])
    vertices, faces, shown = counts
    x, y, z = size
    return points, triangles, MeshFacts(vertices, faces, shown, (x, y, z))


Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class CameraRow:
    """A row of the table of camera poses; a planned one has not been taken yet."""

    name: str
    station: str
    position_mm: Vector
    tilt_deg: float  # tilt of the optical axis from straight down
    distance_mm: float  # distance from the middle of the spheres
    planned: bool


@dataclass(frozen=True, slots=True)
class SphereRow:
    """A row of the table of spheres."""

    label: str
    kind: str
    position_mm: Vector
    radius_residual_mm: float | None
    rms_mm: float | None
    images: int | None


@dataclass(frozen=True, slots=True)
class StationRow:
    """A row of the table of robot bases."""

    name: str
    position_mm: Vector
    distance_mm: float  # distance from the middle of the spheres
    cameras: int


@dataclass(frozen=True, slots=True)
class SceneTables:
    """Everything on the page except the picture."""

    frame: str
    how: str
    missing: tuple[str, ...]
    cameras: tuple[CameraRow, ...]
    spheres: tuple[SphereRow, ...]
    stations: tuple[StationRow, ...]
    further: tuple[KnownFurtherCamera, ...]
    mesh: MeshFacts | None
    error_at_spheres_mm: tuple[float, float] | None  # predicted, least and most


def scene_tables(log: RunRecord, data: Path) -> SceneTables:
    """Return the tables; positions are in the frame that the record uses, not in that of the picture."""
    now = scene_of(log)
    T_view = viewing_frame(now.scene)
    down, centre = -T_view[2, :3], -T_view[:3, :3].T @ T_view[:3, 3]
    rows: list[CameraRow] = []
    beside = [(poses, False) for poses in now.scene.further.values()]
    for poses, planned in ((now.scene.cameras, False), (now.scene.planned, True), *beside):
        for name, T in poses.items():
            tilt = deg(float(np.arccos(np.clip(T[:3, 2] @ down, -1, 1))))
            away = mm(float(np.linalg.norm(T[:3, 3] - centre)))
            rows.append(CameraRow(name, now.scene.stations.get(name, ""), _mm(T[:3, 3]), tilt, away, planned))
    stations = [
        StationRow(
            name,
            _mm(T[:3, 3]),
            mm(float(np.linalg.norm(T[:3, 3] - centre))),
            sum(now.scene.stations.get(camera) == name for camera in now.scene.cameras),
        )
        for name, T in sorted(now.scene.bases.items())
    ]
    spheres = [
        SphereRow(
            s.label, s.kind, _mm(np.array(s.centre_m)), s.radius_residual_mm, s.rms_mm, now.sphere_images.get(s.label)
        )
        for s in now.spheres
    ]
    error = None
    if now.registered is not None and now.spheres:
        errors = predicted_error_mm(now.registered, np.array([s.centre_m for s in now.spheres]))
        error = (float(errors.min()), float(errors.max()))
    facts = mesh_facts(now, log, data)
    cameras, about = tuple(rows), further_cameras_of(log)
    return SceneTables(now.frame, now.how, now.missing, cameras, tuple(spheres), tuple(stations), about, facts, error)


def _mm(point_m: Array) -> Vector:
    x, y, z = (mm(float(v)) for v in point_m)
    return x, y, z
