"""Renders captures of simulated scenes: a folder with images, camera, poses, scan and ground truth of each."""

from __future__ import annotations

import csv
import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from simulators.geometry import apply, inverse, look_at
from simulators.rendering.render import Renderer
from simulators.scan_station.formats import encode
from simulators.scan_station.station import scan_scene
from simulators.scene.arm import ARM_MODEL
from simulators.scene.world import STATIONS, Scene, nominal_hand_eye
from simulators.ur_controller.kinematics import inverse as joints_for
from tests.support.rig.rig import REPOSITORY

Array = NDArray[np.float64]
CACHE = REPOSITORY / "build" / "bench" / "scenes"
SETTINGS = {"exposure_s": 1 / 15, "iso": 100, "aperture_f": 22}
POSE_COLUMNS = ["image", "x", "y", "z", "qx", "qy", "qz", "qw"]
_NEAR = np.array([1.57, -1.5, 1.9, -2.0, -1.57, 0.0])
JPEG_QUALITY = 94


@dataclass(frozen=True, slots=True)
class Shot:
    """One image to be taken: its file, station and the arm's joints."""

    name: str
    station: str
    q: Array


def plan_shots(scene: Scene, views: int) -> list[Shot]:
    """Views from both stations on two arcs, 14° and 32° from the vertical, slightly irregular as in reality."""
    rng = np.random.default_rng([scene.seed, 0xBE4C])
    shots: list[Shot] = []
    for station, side in zip(STATIONS, (-1.0, 1.0), strict=True):
        count = (views + (side < 0)) // 2
        upper = max(1, round(0.4 * count))
        azimuths = np.concatenate([np.linspace(-50, 50, upper), np.linspace(-60, 60, count - upper)])
        tilts = np.repeat([14.0, 32.0], [upper, count - upper])
        for i, (azimuth_deg, tilt_deg) in enumerate(zip(azimuths, tilts, strict=True)):
            q = None
            while q is None:
                azimuth, tilt = np.radians([azimuth_deg + rng.uniform(-5, 5), tilt_deg + rng.uniform(-4, 4)])
                out = np.array([np.sin(tilt) * np.sin(azimuth), side * np.sin(tilt) * np.cos(azimuth), np.cos(tilt)])
                target = np.array([*rng.uniform(-0.02, 0.02, 2), 0.05])
                eye = target + rng.uniform(0.62, 0.72) * out
                T_world_camera = look_at(eye, target, np.array([0.0, -side, 0.0]))
                T_base_flange = inverse(scene.T_world_base[station]) @ T_world_camera @ inverse(nominal_hand_eye())
                q = joints_for(ARM_MODEL, T_base_flange, _NEAR)
            shots.append(Shot(f"{station[-1]}_{i:03d}.jpg", station, q))
    return shots


def render_scene(seed: int, width: int, views: int, *, cache: Path = CACHE, workers: int = 1) -> Path:
    """Render a capture, unless it is cached, and return its folder.

    `images/`, `camera.json` (the true intrinsics), `poses.csv` (true T_world_camera), `robot_poses.csv`
    (T_base_flange as the controller reports it), `joints.csv`, `stations.csv`, `spheres.json` (true centres, scan
    frame), `scan.ply` (millimetres) and `truth.json` (T_world_scan, T_flange_camera, T_world_base).
    """
    folder = cache / f"scene{seed:02d}_{width}_{views}"
    if (folder / "truth.json").is_file():
        return folder
    (folder / "images").mkdir(parents=True, exist_ok=True)
    scene = Scene.generate(seed)
    shots = plan_shots(scene, views)
    tasks = _tasks(folder, seed, width, shots)
    if workers > 1:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            list(pool.map(_render, tasks))
    else:
        for task in tasks:
            _render(task)
    _write_json(folder / "camera.json", scene.camera_intrinsics(width).to_json())
    _write_poses(folder / "poses.csv", [(s.name, scene.true_camera(s.q, s.station)) for s in shots])
    _write_poses(folder / "robot_poses.csv", [(s.name, scene.nominal_flange(s.q)) for s in shots])
    _write_rows(folder / "joints.csv", [["image", *(f"q{i + 1}" for i in range(6))]])
    _write_rows(folder / "joints.csv", [[s.name, *map(float, s.q)] for s in shots], append=True)
    _write_rows(folder / "stations.csv", [["image", "station"], *([s.name, s.station] for s in shots)])
    scan = scan_scene(scene, spray=True, control_spheres=True, spacing_m=0.5e-3)
    for name, data in encode("ply", "scan.ply", scan.vertices_m * 1e3, scan.faces, scan.normals):
        (folder / name).write_bytes(data)
    T_scan_world = inverse(scan.T_world_scan)
    spheres = {
        "radius_mm": 1e3 * scene.radius_m,
        "registration_mm": (1e3 * apply(T_scan_world, scene.registration_m)).tolist(),
        "control_mm": (1e3 * apply(T_scan_world, scene.control_m)).tolist(),
    }
    _write_json(folder / "spheres.json", spheres)
    truth = {
        "seed": seed,
        "T_world_scan": scan.T_world_scan.tolist(),
        "T_flange_camera": scene.T_flange_camera.tolist(),
        "T_world_base": {station: T.tolist() for station, T in scene.T_world_base.items()},
        "specimen_centre_world_m": [0.0, 0.0, 0.05],
    }
    _write_json(folder / "truth.json", truth)
    return folder


def render_image(seed: int, width: int, views: int, name: str, *, cache: Path = CACHE) -> Path:
    """Render one image of a capture, unless it is cached, and return its file."""
    folder = cache / f"scene{seed:02d}_{width}_{views}"
    (folder / "images").mkdir(parents=True, exist_ok=True)
    task = next(t for t in _tasks(folder, seed, width, plan_shots(Scene.generate(seed), views)) if t[2].name == name)
    _render(task)
    return task[2]


def rendered(name: str, cache: Path = CACHE) -> Path:
    """Render a capture named like scene01_1920_20 (seed, width, number of views), unless cached.

    Returns its folder.
    """
    seed, width, views = name.removeprefix("scene").split("_")
    return render_scene(int(seed), int(width), int(views), cache=cache)


_Task = tuple[int, int, Path, Shot, int]


def _tasks(folder: Path, seed: int, width: int, shots: list[Shot]) -> list[_Task]:
    return [(seed, width, folder / "images" / shot.name, shot, i) for i, shot in enumerate(shots)]


def _render(task: _Task) -> None:
    seed, width, path, shot, number = task
    if path.is_file():
        return
    scene = Scene.generate(seed)
    view = {
        "T_world_camera": scene.true_camera(shot.q, shot.station).tolist(),
        "intrinsics": scene.lens.to_json(),
        "scene": {"seed": seed, "spray": False, "control_spheres": True, "board": None},
        "light_lux": scene.light_lux,
    }
    renderer = _renderers.setdefault(width, Renderer(width))
    picture = Image.fromarray(renderer.render(view, SETTINGS, number))
    part = path.with_suffix(".part")
    picture.save(part, format="JPEG", quality=JPEG_QUALITY)
    part.rename(path)


_renderers: dict[int, Renderer] = {}


def _write_json(path: Path, value: object) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def _write_poses(path: Path, poses: list[tuple[str, Array]]) -> None:
    rows: list[list[object]] = [list(POSE_COLUMNS)]
    for name, T in poses:
        rows.append([name, *map(float, T[:3, 3]), *map(float, Rotation.from_matrix(T[:3, :3]).as_quat())])
    _write_rows(path, rows)


def _write_rows(path: Path, rows: list[list[object]], *, append: bool = False) -> None:
    with path.open("a" if append else "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows(rows)
