"""What the crash sweep captures: spheres on a table, by an in-memory arm that logs its motions; and the imports."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from drivers.interfaces import RobotSample, Scanner
from drivers.photos.photo_folder import listed
from drivers.scan_folder import ScanFolder, ScanFolderConfig
from service.core.geometry import Array, apply, from_rotation_vector, inverse, transform
from service.core.records.import_list import ImportedFile, ImportedView, ImportList
from service.steps.context import StationLayout
from service.steps.viewpoints import Arc, Viewpoint, ViewpointSet, plan_viewpoints
from service.store.durable_effects import utc_text
from tests.support.rig.bench_rig import BenchArm, BenchCamera, BenchRig, numbered
from tests.support.scenes.sphere_images import REGISTRATION_M, camera, render
from tests.support.scenes.sphere_meshes import MeshBuilder, cap

WIDTH = 600
CAMERA = camera(WIDTH)
VIEWPOINTS = ViewpointSet(
    station="station_1",
    prefix="v",
    arcs=(Arc(tilt_deg=24, azimuth_from_deg=-70, azimuth_to_deg=70, count=4, distance_m=0.78),),
)
LAYOUT = StationLayout("station_1", "robot", (0.0, 0.8, 0.0), (0.0, -1.0, 0.0))
T_BASE_SCAN = transform(np.eye(3), np.array([0.0, 0.8, 0.0]))
_SAMPLES = 20


def planned() -> tuple[Viewpoint, ...]:
    """The viewpoints that the run must have, each exactly once."""
    return plan_viewpoints(VIEWPOINTS, LAYOUT)


def prepare_files(folder: Path) -> None:
    """Create all input files: pictures (one per viewpoint), a scanner export, photographs."""
    for viewpoint in planned():
        centres = apply(inverse(viewpoint.T_base_camera) @ T_BASE_SCAN, REGISTRATION_M)
        np.save(folder / f"{viewpoint.name}.npy", render(CAMERA, centres, seed=7))
    rng = np.random.default_rng(3)
    built = MeshBuilder()
    for centre in REGISTRATION_M:
        built.add(*cap(centre, 1.3, rng, level=4, white_m=2e-5))
    vertices, faces = built.build()
    (folder / "scans").mkdir()
    trimesh.Trimesh(1e3 * vertices, faces, process=False).export(folder / "scans" / "scene.ply")
    (folder / "photographs").mkdir()
    for number in (1, 2):
        cv2.imwrite(str(folder / "photographs" / f"IMG{number}.JPG"), numbered(number))
        (folder / "photographs" / f"IMG{number}.ARW").write_bytes(b"raw of %d" % number)


def import_list(folder: Path) -> ImportList:
    """The photographs and the scan, as files captured earlier."""

    def entry(path: Path, media_type: str) -> ImportedFile:
        found = listed(path)
        return ImportedFile(
            path=str(path),
            sha256=found.sha256,
            size_bytes=found.size_bytes,
            modified_utc=utc_text(datetime.fromtimestamp(found.modified_ns / 1e9, UTC)),
            media_type=media_type,
        )

    photographs = folder / "photographs"
    views = tuple(
        ImportedView(
            name=path.stem,
            role="control_image",
            photograph=entry(path, "image/jpeg"),
            raws=(entry(path.with_suffix(".ARW"), "image/x-sony-arw"),),
            camera={},
        )
        for path in sorted(photographs.glob("*.JPG"))
    )
    scan = entry(folder / "scans" / "scene.ply", "application/octet-stream")
    return ImportList(folder=str(folder), views=views, files={"scan": (scan,)})


class SteadyArm(BenchArm):
    """An arm with a fixed number of samples per exposure, so that the mean pose is bitwise reproducible."""

    def samples(self, start_monotonic_s: float, end_monotonic_s: float) -> tuple[RobotSample, ...]:
        """Return a fixed number of samples between two host times, oldest first."""
        return super().samples(start_monotonic_s, start_monotonic_s + 1.0)[:1] * _SAMPLES


@dataclass
class CrashRig(BenchRig):
    """Arm and camera in memory, a scanner's folder, and files to import.

    Attributes:
        folder: created by `prepare_files`.
        motions: log file with one line per motion, written before it begins: monotonic seconds.
    """

    folder: Path = field(default=Path())
    motions: Path = field(default=Path())

    def __post_init__(self) -> None:
        self.arm = SteadyArm(on_move=self._moved)
        self.shutter = BenchCamera(picture=self._picture)
        self.box = None

    @cached_property
    def _pictures(self) -> list[tuple[Array, NDArray[np.uint8]]]:
        return [(v.T_base_camera, np.load(self.folder / f"{v.name}.npy")) for v in planned()]

    def _moved(self, _number: int) -> None:
        descriptor = os.open(self.motions, os.O_CREAT | os.O_APPEND | os.O_WRONLY)
        os.write(descriptor, f"{time.monotonic()}\n".encode())
        os.close(descriptor)

    def _picture(self, _exposure: int) -> NDArray[np.uint8]:
        """The camera's picture from the arm's current pose."""
        here = from_rotation_vector(self.arm.state().sample.joints_rad) @ self.nominal_T_flange_camera()
        return min(self._pictures, key=lambda one: float(np.abs(one[0] - here).max()))[1]

    def layout(self, station: str) -> StationLayout:
        """The layout of the station."""
        return LAYOUT

    def scanner(self, name: str | None = None) -> Scanner:
        """The real driver on a folder."""
        scanner = ScanFolder(ScanFolderConfig(folder=self.folder / "scans", stable_s=0))
        scanner.open()
        return scanner

    def imported(self) -> ImportList | None:
        """The photographs and the scan to import."""
        return import_list(self.folder)
