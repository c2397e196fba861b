"""Writes a data set in an export format, and compares what was read back with places that are known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from service.core.geometry import Array, apply, inverse
from service.dataset.exporter import exporter, write_data_set
from service.dataset.records import DataSet, PosedView
from tests.support.scenes.posed import scene


def written(dataset: DataSet, name: str, folder: Path) -> Path:
    write_data_set(dataset, exporter(name), folder / name)
    return folder / name


def document(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def picture(path: Path) -> NDArray[Any]:
    """The pixels of a file, with all its channels and bits."""
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    return pixels


def corners() -> Array:
    """Points of the solid: corners of the mesh."""
    return np.asarray(scene().mesh.vertices)


def truth_px(view: PosedView) -> Array:
    """Our own projection of the corners; its first pixel has its centre at 0."""
    return view.camera.project(apply(inverse(view.T_world_camera), corners()))


def check_depth(view: PosedView, depth_m: Array, tolerance_m: float) -> None:
    """Points at the depth of their pixels lie on the solid."""
    v, u = (k.ravel() for k in np.mgrid[8:112:9, 8:152:9])
    z = depth_m[v, u]
    seen = (z > 0) & np.isfinite(z)
    rays = np.stack(
        [(u - view.camera.cx) / view.camera.fx, (v - view.camera.cy) / view.camera.fy, np.ones(len(u))], 1
    )
    points = apply(view.T_world_camera, (rays * z[:, None])[seen])
    assert len(points) > 20
    assert scene().distance_m(points).max() < tolerance_m
