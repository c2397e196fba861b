"""Views of spheres with known information, and a rig that measures while it captures."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import trimesh

from drivers.errors import DeviceFaultError
from drivers.interfaces import CtSource, DeviceIdentity, DeviceReport, Mesh, ScanExport, ScannedMesh
from service.compute.planning.coverage import ViewInformation, view_information
from service.compute.scene import ScanSpheres
from service.core.geometry import Array, apply, transform
from tests.support.rig.bench_rig import BenchRig
from tests.support.scenes.sphere_images import (
    CONTROL_M,
    RADIUS_M,
    REGISTRATION_M,
    Scene,
    exact_outlines,
)

SPHERES_M = np.vstack([REGISTRATION_M, CONTROL_M])
CENTRE_M = SPHERES_M.mean(axis=0)


def informations(made: Scene, *, pose_noise_m: float = 0.0, seed: int = 0) -> list[ViewInformation]:
    """Views with outlines of 0.1 px and camera positions with errors of `pose_noise_m` in 3D."""
    rng = np.random.default_rng(seed)
    centre = apply(made.T_world_scan, CENTRE_M)
    out: list[ViewInformation] = []
    for i, T in enumerate(made.T_world_camera):
        outlines, which = exact_outlines(made, i, SPHERES_M, 0.1, seed=seed)
        shift = transform(np.eye(3), rng.normal(0, pose_noise_m / np.sqrt(3), 3))
        markers = dict(enumerate(which))
        out.append(
            view_information(
                shift @ T,
                made.T_world_scan,
                outlines,
                markers,
                ScanSpheres(SPHERES_M, RADIUS_M),
                centre,
                10 * pose_noise_m + 1e-4,
            )
        )
    return out


# --- coverage --------------------------------------------------------------------------------------------


def hill() -> tuple[Array, Any]:
    """A hemisphere on a board, among the spheres."""
    board = trimesh.creation.box(
        (0.7, 0.5, 0.02), transform=trimesh.transformations.translation_matrix((0, 0, -0.01))
    )
    board = board.subdivide_to_size(0.04)
    ball = trimesh.creation.icosphere(3, 0.06)
    whole = trimesh.util.concatenate([board, ball])
    assert isinstance(whole, trimesh.Trimesh)
    return np.asarray(whole.vertices, dtype=np.float64), np.asarray(whole.faces, dtype=np.int32)


# --- runs ------------------------------------------------------------------------------------------------


MEASURED = """\
  - id: camera
    kind: calibration
    title: Calibrate
    confirm: false
    params:
      solve: [intrinsics, hand_eye]
      viewpoints:
        - station: station_1
          prefix: b
          arcs: [{tilt_deg: 20, azimuth_from_deg: 0, azimuth_to_deg: 0, count: 1, distance_m: 0.6}]
  - id: ct
    kind: ct_import
    title: CT
    confirm: false
    skippable: true
    params: {source: mesh, spheres: 13, wait_s: 5}
"""


class BenchCt:
    """A CT suite that has segmented one mesh, or is out of order."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "segmented.stl"
        self.file.write_bytes(b"as it was exported")
        self.works = True

    def report(self) -> DeviceReport:
        return DeviceReport(DeviceIdentity("ct", "Bench CT", "CT-1", "1.0", "bench", "1", "memory"))

    def segmented_meshes(self) -> tuple[ScanExport, ...]:
        if not self.works:
            raise DeviceFaultError("the CT is out of order", where="ct")
        return (ScanExport("segmented", (self.file,), "2026-11-21T10:00:00Z"),)

    def read_mesh(self, export: ScanExport) -> ScannedMesh:
        vertices_m, faces = hill()
        return ScannedMesh(Mesh(vertices_m, faces, np.zeros_like(vertices_m)), "m", "known", {}, export)


class MeasuringRig(BenchRig):
    """The bench with a CT suite."""

    suite: BenchCt

    def ct(self) -> CtSource:
        return cast(CtSource, self.suite)  # it has the methods that the step uses
