"""The format of the BOP challenge: one scene with the specimen as its object, in millimetres."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.distance import cdist

from service.compute.images.views import DEPTH_UNIT_MM, coded_depth
from service.core.geometry import Array, inverse
from service.core.units import mm
from service.dataset.export_folder import ExportFolder, Part, json_bytes
from service.dataset.exporter import Exporter, mask_png, ply, png
from service.dataset.records import DataSet, PosedView

_SCENE = "test/000001"
_OBJECT = 1


def write(dataset: DataSet, folder: ExportFolder) -> None:
    """`models/`, `camera.json` and the scene: `scene_camera.json`, `scene_gt.json`, `scene_gt_info.json`, rgb, depth,
    mask, mask_visib. `dataset_info.json` has the views' names by their numbers.

    Millimetres; depth is 16 bit in units of depth_scale; pixel centres lie at integers. The model's frame is the
    world's. The object is all of the mesh: nothing hides it but itself and what is not in it.
    """
    numbers = {str(k): view for k, view in enumerate(dataset.views, start=1)}
    vertices_mm = mm(dataset.mesh.vertices_m)
    folder.file(f"models/obj_{_OBJECT:06d}.ply", lambda: ply(vertices_mm, dataset.mesh.faces, dataset.mark))
    folder.file("models/models_info.json", lambda: json_bytes({str(_OBJECT): _extent(vertices_mm)}))
    if dataset.views:
        camera = dataset.views[0].camera
        shape = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
        size = {"width": camera.width, "height": camera.height, "depth_scale": DEPTH_UNIT_MM}
        folder.json("camera.json", {**shape, **size, "simulated": dataset.simulated})
    folder.json(f"{_SCENE}/scene_camera.json", {key: _camera(view) for key, view in numbers.items()})
    folder.json(f"{_SCENE}/scene_gt.json", {key: [_pose(view)] for key, view in numbers.items()})
    folder.json(
        "dataset_info.json",
        {"simulated": dataset.simulated, "names": {key: view.name for key, view in numbers.items()}},
    )
    for key, view in numbers.items():
        name = f"{int(key):06d}"
        folder.file(
            f"{_SCENE}/rgb/{name}{view.suffix}",
            lambda view=view: dataset.pixels.picture(view),
            Part("image", view.name),
        )
        folder.file(
            f"{_SCENE}/depth/{name}.png",
            lambda view=view: png(coded_depth(dataset.pixels.depth_m(view)), dataset.mark),
            Part("depth", view.name),
        )
        for mask in ("mask", "mask_visib"):
            folder.file(
                f"{_SCENE}/{mask}/{name}_000000.png",
                lambda view=view: mask_png(dataset.pixels.depth_m(view) > 0, dataset.mark),
                Part("mask", view.name),
            )


def _camera(view: PosedView) -> dict[str, Any]:
    T_camera_world = inverse(view.T_world_camera)
    return {
        "cam_K": view.camera.matrix.ravel().tolist(),
        "cam_R_w2c": T_camera_world[:3, :3].ravel().tolist(),
        "cam_t_w2c": mm(T_camera_world[:3, 3]).tolist(),
        "depth_scale": DEPTH_UNIT_MM,
    }


def _pose(view: PosedView) -> dict[str, Any]:
    T_camera_model = inverse(view.T_world_camera)
    return {
        "cam_R_m2c": T_camera_model[:3, :3].ravel().tolist(),
        "cam_t_m2c": mm(T_camera_model[:3, 3]).tolist(),
        "obj_id": _OBJECT,
    }


def _extent(vertices_mm: Array) -> dict[str, float]:
    """Return the box and diameter, which is the largest distance between two vertices."""
    low, size = vertices_mm.min(axis=0), np.ptp(vertices_mm, axis=0)
    corners = vertices_mm[ConvexHull(vertices_mm, qhull_options="QJ").vertices]
    diameter = max(float(cdist(corners[k : k + 500], corners).max()) for k in range(0, len(corners), 500))
    box = {f"min_{axis}": float(v) for axis, v in zip("xyz", low, strict=True)}
    box |= {f"size_{axis}": float(v) for axis, v in zip("xyz", size, strict=True)}
    return {"diameter": diameter, **box}


KIND = Exporter("bop", "BOP challenge: the specimen as an object, in millimetres", write, pinhole=True)
