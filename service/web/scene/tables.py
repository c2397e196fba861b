"""The 3D view in words and numbers: cameras, spheres, surface, robot stations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from service.core.geometry import Array
from service.core.units import deg, mm
from service.dataset.further_cameras import KnownFurtherCamera
from service.dataset.scene_view import viewing_frame
from service.run_record import RunRecord
from service.web.record.images import further_cameras_of
from service.web.scene.data import MeshFacts, mesh_facts, predicted_error_mm, scene_of

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class CameraRow:
    """A camera pose; a planned one has not been taken yet."""

    name: str
    station: str
    position_mm: Vector
    tilt_deg: float  # of the optical axis from straight down
    distance_mm: float  # from the middle of the spheres
    planned: bool


@dataclass(frozen=True, slots=True)
class SphereRow:
    """A sphere."""

    label: str
    kind: str
    position_mm: Vector
    radius_residual_mm: float | None
    rms_mm: float | None
    images: int | None


@dataclass(frozen=True, slots=True)
class StationRow:
    """A robot base."""

    name: str
    position_mm: Vector
    distance_mm: float  # from the middle of the spheres
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
    """The tables; positions are in the frame that the record uses, not in that of the picture."""
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
