"""An import folder: photographs of a simulated scene by a hand-held camera, board images, scans and a CT."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from simulators.ct_suite.suite import write_series
from simulators.ct_suite.volume import grid_around
from simulators.faults import FaultPlan
from simulators.geometry import Array, from_euler, look_at
from simulators.rendering.render import REFERENCE, Renderer
from simulators.rendering.sensor import camera_picture, read_out
from simulators.scan_station.formats import encode
from simulators.scan_station.station import scan_scene
from simulators.scene.world import NOMINAL_LUX, SCENE_CENTRE_M, Scene
from simulators.sony_camera.exif import PLATE
from simulators.still_camera.exif import ExposureSettings, Shot, encode_jpeg
from simulators.still_camera.raw_file import encode_raw

SEED = 7
SETTINGS = ExposureSettings(
    aperture_f=22.0,
    exposure_s=1 / 15,
    exposure_fraction=(1, 15),
    iso=100,
    jpeg_level=1,
)
_BEGAN = datetime(2024, 3, 1, 10, 0, 0, tzinfo=UTC)


@dataclass
class Photographer:
    """Takes photographs of one scene and writes them as a camera does."""

    folder: Path
    width: int
    control_spheres: bool = True
    seed: int = SEED
    counter: int = 0
    raw: bool = False  # a raw file beside each photograph, of the same exposure

    def __post_init__(self) -> None:
        self.scene = Scene.generate(self.seed)
        self.renderer = Renderer(self.width)
        self.T_world_camera: dict[str, Array] = {}

    def photographs(self, part: str, poses: Sequence[Array], *, board: bool = False) -> None:
        """Take photographs into a subfolder, a minute apart, and remember the camera poses."""
        (self.folder / part).mkdir(parents=True, exist_ok=True)
        placed = self.scene.board_placement(1).tolist() if board else None
        for pose in poses:
            self.counter += 1
            view = {
                "T_world_camera": pose.tolist(),
                "intrinsics": self.scene.camera_intrinsics(self.width).to_json(),
                "scene": {
                    "seed": self.seed,
                    "spray": False,
                    "control_spheres": self.control_spheres,
                    "board": placed,
                },
                "light_lux": NOMINAL_LUX,
            }
            mosaic = read_out(self.renderer.light(view, REFERENCE), SETTINGS.iso, self.counter) if self.raw else None
            whole = self.renderer.render(view, REFERENCE, self.counter) if mosaic is None else camera_picture(mosaic)
            taken = _BEGAN + timedelta(minutes=self.counter)
            name = f"DSC{self.counter:05d}"
            shot = Shot(SETTINGS, self.counter, taken, PLATE)
            (self.folder / part / f"{name}.JPG").write_bytes(encode_jpeg(whole, shot))
            if mosaic is not None:
                (self.folder / part / f"{name}.ARW").write_bytes(encode_raw(mosaic, shot))
            self.T_world_camera[name] = pose

    def scan(self, part: str, *, control_spheres: bool, nth: int) -> None:
        """Write a mesh into a subfolder, in a frame of its own."""
        (self.folder / part).mkdir()
        scan = scan_scene(self.scene, spray=True, control_spheres=control_spheres, spacing_m=1.2e-3, nth=nth)
        (name, data), *_ = encode("ply", f"{part}.ply", 1e3 * scan.vertices_m, scan.faces, scan.normals)
        (self.folder / part / name).write_bytes(data)
        self.T_world_scan = scan.T_world_scan

    def ct(self) -> None:
        """Write a DICOM series of a few empty slices."""
        (self.folder / "ct").mkdir()
        grid = grid_around(self.scene, np.eye(4), 0.05, control_spheres=True)
        volume = np.full(grid.shape, -1000, dtype=np.int16)
        write_series(self.folder / "ct", volume, grid, grid.T_world_grid, "1.2.3.4", faults=FaultPlan.parse("[]"))


def around(count: int, *, distance_m: float = 0.62, turn: float = 0.3) -> list[Array]:
    """Camera poses around the scene, as of somebody walking around the table."""
    poses: list[Array] = []
    for i in range(count):
        azimuth, tilt = 2 * np.pi * (i + turn) / count, np.deg2rad(16 + 9 * (i % 3))
        out = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
        poses.append(look_at(SCENE_CENTRE_M + distance_m * out, SCENE_CENTRE_M, np.array([0.1, 1.0, 0.0])))
    return poses


def over_the_board(count: int) -> list[Array]:
    """Camera poses above the calibration board, tilted and turned."""
    poses: list[Array] = []
    centre = SCENE_CENTRE_M + np.array([0.0, 0.0, 0.09])
    for i in range(count):
        azimuth, tilt = 2.4 * i, np.deg2rad((8, 24, 34)[i % 3])
        out = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
        aim = centre + np.array([0.05 * np.cos(5.0 * i) - 0.01, 0.015 * np.sin(5.0 * i), 0.0])
        T = look_at(centre + 0.72 * out, aim, np.array([0.1, 1.0, 0.0]))  # the board's long side is horizontal
        poses.append(T @ from_euler(np.array([0.0, 0.0, 0.08 * (i % 4 - 1.5)]), np.zeros(3)))
    return poses
