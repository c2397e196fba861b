"""Fuzz targets for files that people write: protocols, rig files, import lists, poses, cameras, spheres, joints."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import yaml

from service.computations.conversion import corrected_mounting
from service.computations.kind import read_part
from service.computations.records import Mounting
from service.compute.camera_model import CameraModel
from service.compute.markers.paper import read_boxes
from service.compute.poses.pose_files import (
    read_camera_json,
    read_colmap_model,
    read_poses,
    read_spheres_json,
    write_camera_json,
    write_poses_csv,
    write_transforms_json,
)
from service.compute.poses.robot_files import read_hand_eye, read_joints_csv, read_stations
from service.core.geometry import Transform
from service.core.protocol import parse_protocol
from service.core.records.import_list import ImportedFile, ImportedView, ImportList
from service.core.text_files import parse_json
from service.import_folder import import_rig
from service.rig import load_rig
from service.station import Station
from service.steps import params_models
from tests.support.rig.rig import REPOSITORY
from tests.support.torture.fuzz.mutations import JSON, TEXT
from tests.support.torture.fuzz.targets.target import MisbehavedError, Target

CAMERA = CameraModel(480, 320, 700.0, 700.0, 239.5, 159.5, -0.05, 0.01)
MODEL_PARTS = ("cameras", "images", "frames", "points3D", "rigs")


def _poses() -> dict[str, Transform]:
    """Three distinct poses."""
    poses: dict[str, Transform] = {}
    for k in range(3):
        c, s = np.cos(0.2 * k), np.sin(0.2 * k)
        poses[f"v{k}.jpg"] = np.array([[c, -s, 0, 0.1 * k], [s, c, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]])
    return poses


def _put(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


# --- protocol, rig, import list -----------------------------------------------------------------------------------


def _protocols(_: Path) -> list[bytes]:
    return [path.read_bytes() for path in sorted((REPOSITORY / "protocols").glob("*.yaml"))]


def _protocol(data: bytes, folder: Path) -> None:
    parse_protocol(data, params_models(), name=str(folder / "protocol.yaml"))


def _rigs(_: Path) -> list[bytes]:
    # As simulators/rig/processes.py writes them.
    rig = {
        "name": "simulated rig, scene 7",
        "simulated": True,
        "hands": "127.0.0.1:40000",
        "devices": {
            "robot_1": {"driver": "ur", "host": "127.0.0.2"},
            "camera": {"driver": "gphoto", "port": "ptpip:127.0.0.1:15740:15740", "capture_timeout_s": 44.0},
            "scanner": {"driver": "scan_folder", "folder": "scans", "unit": "mm", "stable_s": 1.0},
            "lightbox": {"driver": "lightbox", "port": "lightbox"},
        },
        "stations": {
            "station_1": {"robot": "robot_1", "scene_centre_m": [0.6, 0.0, 0.1], "approach_azimuth_deg": 180.0}
        },
        "T_flange_camera_nominal": np.eye(4).tolist(),
        "payload": {"mass_kg": 1.6, "centre_of_gravity_m": [0.0, 0.0, 0.08]},
        "lens": {"focal_length_mm": 50.0, "sensor_width_mm": 35.7, "image_px": [480, 320]},
    }
    return [yaml.safe_dump(rig, sort_keys=False).encode()]


def _import_lists(folder: Path) -> list[bytes]:
    file = ImportedFile(path="images/a.jpg", sha256="0" * 64, size_bytes=10, modified_utc="2026-11-22T10:00:00Z")
    view = ImportedView(name="a", role="image", photograph=file, camera={"make": "SONY", "iso": 100})
    listing = ImportList(folder=str(folder), views=(view,), files={"scan": (file,)})
    return [import_rig(listing, simulated=True).source]


def _rig(data: bytes, folder: Path) -> None:
    rig = load_rig(_put(folder, "rig.yaml", data))
    station = Station(rig)
    for name in station.names():
        station.kind_of(name)
    rig.nominal_T_flange_camera()


# --- poses and what belongs to them -------------------------------------------------------------------------------


def _finite(poses: object) -> None:
    for T in poses.values() if isinstance(poses, dict) else (poses,):
        if not np.isfinite(np.asarray(T, dtype=np.float64)).all():
            raise MisbehavedError("a pose that is not finite is accepted")


def _pose_tables(folder: Path) -> list[bytes]:
    write_poses_csv(folder / "poses.csv", _poses())
    return [(folder / "poses.csv").read_bytes()]


def _transforms(folder: Path) -> list[bytes]:
    write_transforms_json(folder / "transforms.json", CAMERA, _poses())
    return [(folder / "transforms.json").read_bytes()]


def _cameras(folder: Path) -> list[bytes]:
    write_camera_json(folder / "camera.json", CAMERA)
    return [(folder / "camera.json").read_bytes()]


def _spheres(_: Path) -> list[bytes]:
    rows = [[10.0 * k, 5.0, -2.5] for k in range(6)]
    return [json.dumps({"radius_mm": 15, "registration_mm": rows, "control_mm": rows[:2], "details": []}).encode()]


def _joint_tables(_: Path) -> list[bytes]:
    return [_table(["image", *(f"q{k}" for k in range(1, 7))], [[f"v{k}.jpg", *[0.1 * k] * 6] for k in range(3)])]


def _station_tables(_: Path) -> list[bytes]:
    return [_table(["image", "station"], [[f"v{k}.jpg", f"station_{k % 2}"] for k in range(3)])]


def _table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue().encode()


def _hand_eyes(_: Path) -> list[bytes]:
    correction = {
        "model": "dh_deltas", "arm": "UR10e", "dh_deltas": np.zeros((6, 4)).tolist(),
        "gear_cos_rad": np.zeros((6, 1)).tolist(), "gear_sin_rad": np.zeros((6, 1)).tolist(), "observed": [0.5] * 6,
        "T_flange_camera": np.eye(4).tolist(),
    }  # fmt: skip
    return [json.dumps({"T_flange_camera": np.eye(4).tolist(), "arm_correction": correction}).encode()]


def _hand_eye(data: bytes, folder: Path) -> None:
    path = _put(folder, "hand_eye.json", data)
    _finite(read_hand_eye(path))
    document = parse_json(data, name="hand_eye.json", remedy="")  # as it was parsed
    if isinstance(document.get("arm_correction"), dict):
        correction = read_part(Mounting, document).arm_correction
        if correction is not None:
            corrected_mounting(correction)


def _box_files(_: Path) -> list[bytes]:
    return [json.dumps({f"v{k}.jpg": [[10, 20, 50.5, 60], [100, 90, 140, 130]] for k in range(3)}).encode()]


# --- COLMAP -------------------------------------------------------------------------------------------------------


def _packed(parts: dict[str, bytes]) -> bytes:
    """Pack several files into one input: a line of names and sizes, then their bytes."""
    head = " ".join(f"{name}:{len(data)}" for name, data in parts.items())
    return head.encode() + b"\n" + b"".join(parts.values())


def _unpack(data: bytes, folder: Path, suffix: str) -> None:
    """Unpack the files of an input; if its first line is spoilt, everything goes into the images."""
    head, _, rest = data.partition(b"\n")
    for entry in head.split(b" "):
        name, _, size = entry.partition(b":")
        if name.decode(errors="replace") in MODEL_PARTS and size.isdigit() and len(size) < 8:
            (folder / f"{name.decode()}{suffix}").write_bytes(rest[: int(size)])
            rest = rest[int(size) :]
    if not (folder / f"images{suffix}").exists():
        (folder / f"images{suffix}").write_bytes(rest)


def _text_models(folder: Path) -> list[bytes]:
    from tests.support.scenes.colmap_model import write_colmap_text  # noqa: PLC0415 - loads pycolmap, which takes a second

    write_colmap_text(folder, CAMERA, _poses())
    return [_packed({part: (folder / f"{part}.txt").read_bytes() for part in MODEL_PARTS})]


def _binary_models(folder: Path) -> list[bytes]:
    import pycolmap  # noqa: PLC0415 - takes a second, and only this needs it

    from tests.support.scenes.colmap_model import write_colmap_text  # noqa: PLC0415 - loads pycolmap

    write_colmap_text(folder, CAMERA, _poses())
    (folder / "binary").mkdir()
    pycolmap.Reconstruction(str(folder)).write_binary(str(folder / "binary"))
    return [_packed({part: (folder / "binary" / f"{part}.bin").read_bytes() for part in MODEL_PARTS})]


def _text_model(data: bytes, folder: Path) -> None:
    _unpack(data, folder, ".txt")
    _finite(read_colmap_model(folder))


def _binary_model(data: bytes, folder: Path) -> None:
    _unpack(data, folder, ".bin")
    _finite(read_colmap_model(folder))


TARGETS: tuple[Target, ...] = (
    Target(
        "protocol", "service.core.protocol:load_protocol", _protocol, _protocols, TEXT, seconds=4.0, pace=0.2
    ),
    Target("rig", "service.rig:load_rig", _rig, _rigs, TEXT),
    Target("import_list", "service.rig:load_rig", _rig, _import_lists, JSON),
    Target(
        "poses_csv",
        "service.compute.poses.pose_files:read_poses",
        lambda data, folder: _finite(read_poses(_put(folder, "poses.csv", data))),
        _pose_tables,
        TEXT,
    ),
    Target(
        "transforms_json",
        "service.compute.poses.pose_files:read_poses",
        lambda data, folder: _finite(read_poses(_put(folder, "transforms.json", data))),
        _transforms,
        JSON,
    ),
    Target(
        "camera_json",
        "service.compute.poses.pose_files:read_camera_json",
        lambda data, folder: read_camera_json(_put(folder, "camera.json", data)),
        _cameras,
        JSON,
    ),
    Target(
        "spheres_json",
        "service.compute.poses.pose_files:read_spheres_json",
        lambda data, folder: read_spheres_json(_put(folder, "spheres.json", data)),
        _spheres,
        JSON,
    ),
    Target(
        "joints_csv",
        "service.compute.poses.robot_files:read_joints_csv",
        lambda data, folder: read_joints_csv(_put(folder, "joints.csv", data), ["v0.jpg"]),
        _joint_tables,
        TEXT,
    ),
    Target(
        "stations_csv",
        "service.compute.poses.robot_files:read_stations",
        lambda data, folder: read_stations(_put(folder, "stations.csv", data), ["v0.jpg"]),
        _station_tables,
        TEXT,
    ),
    Target("hand_eye_json", "service.compute.poses.robot_files:read_hand_eye", _hand_eye, _hand_eyes, JSON),
    Target(
        "boxes_json",
        "service.compute.markers.paper:read_boxes",
        lambda data, folder: read_boxes(_put(folder, "boxes.json", data), [f"v{k}.jpg" for k in range(3)]),
        _box_files,
        JSON,
    ),
    Target(
        "colmap_text", "service.compute.poses.pose_files:read_colmap_model", _text_model, _text_models, TEXT,
        memory_mib=1024, seconds=20.0, pace=0.02,
    ),
    Target(
        "colmap_binary", "service.compute.poses.pose_files:read_colmap_model", _binary_model, _binary_models,
        memory_mib=1024, seconds=20.0, pace=0.02,
    ),
)  # fmt: skip
