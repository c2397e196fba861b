"""A posed data set of simulated views: images and poses of a rendered scene, with its simulated scan as the truth."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.images.render import RayMesh, WorldSphere
from service.compute.images.views import splits
from service.compute.poses.pose_files import read_poses_csv
from service.core.geometry import Array, apply, inverse
from service.core.units import metres
from service.dataset.pixels import Photographs
from service.dataset.records import DataSet, Mesh, PosedView

_POINTS = 2000  # of the scan, by which the sparse views are chosen


def simulated_data_set(folder: Path) -> DataSet:
    """The data set of a folder that `render_scene` wrote; its world is the frame of the scan."""
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    T_scan_world = inverse(np.array(truth["T_world_scan"]))
    camera = CameraModel.from_record(json.loads((folder / "camera.json").read_text(encoding="utf-8")))
    scan = trimesh.load_mesh(folder / "scan.ply", process=False)
    mesh = Mesh(metres(np.asarray(scan.vertices, dtype=np.float64)), np.asarray(scan.faces, dtype=np.int64))
    spheres = json.loads((folder / "spheres.json").read_text(encoding="utf-8"))
    centres_mm = np.array([*spheres["registration_mm"], *spheres["control_mm"]])
    balls = tuple(WorldSphere(metres(centre), metres(float(spheres["radius_mm"]))) for centre in centres_mm)
    poses = {name: T_scan_world @ T for name, T in read_poses_csv(folder / "poses.csv").items()}
    views = tuple(
        PosedView(Path(n).stem, Path(n).suffix, camera, T, np.zeros((6, 6))) for n, T in sorted(poses.items())
    )
    files = {view.name: folder / "images" / view.file for view in views}
    points = mesh.vertices_m[:: max(1, len(mesh.vertices_m) // _POINTS)]
    sees = {view.name: _within(camera.project(apply(inverse(view.T_world_camera), points)), camera) for view in views}
    pixels = Photographs(files, RayMesh(mesh.vertices_m, mesh.faces), balls)
    content = b"".join((folder / name).read_bytes() for name in ("poses.csv", "scan.ply"))
    identity = hashlib.sha256(content).hexdigest()
    return DataSet(identity, True, {"scene": folder.name}, views, pixels, mesh, splits(sees))


def _within(pixels: Array, camera: CameraModel) -> NDArray[np.bool_]:
    return np.asarray(((pixels > -0.5) & (pixels < np.array([camera.width, camera.height]) - 0.5)).all(axis=1))
