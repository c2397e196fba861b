"""views.csv: one line for each view, with its files, its camera and its pose."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from service.dataset.posed.records import DataSet, PosedView

NAME = "views.csv"
CAMERA = ("width", "height", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
COVARIANCE = tuple(f"c{row}{column}" for row in range(6) for column in range(row, 6))
_UPPER = np.triu_indices(6)
Parts = Mapping[str, Mapping[str, str]]  # role → view → file


def columns(parts: Parts) -> dict[str, str]:
    """The columns in order, each with what it holds."""
    return {
        "name": "name of the view",
        **{role: f"{role} of the view, a file of this folder" for role in parts},
        "split": "train or test",
        "sparse": "whether the view is one of the sparse split",
        "simulated": "whether the view was made by a simulated rig",
        "camera": "name of the further camera that took it; empty: the first camera",
        "width": "of the picture, px",
        "height": "of the picture, px",
        "fx": "focal length along x, px",
        "fy": "focal length along y, px",
        "cx": "principal point, px; the centre of the first pixel is 0",
        "cy": "principal point, px; the centre of the first pixel is 0",
        **dict.fromkeys(CAMERA[6:], "distortion, as OpenCV defines it"),
        **dict.fromkeys(POSE[:3], "position of the camera in the world, m"),
        **dict.fromkeys(POSE[3:], "rotation from the camera (x right, y down, z forward) to the world"),
        **dict.fromkeys(COVARIANCE, "covariance of the pose: position (m), rotation (rad), axes of the world"),
    }


def views_csv(dataset: DataSet, parts: Parts) -> bytes:
    """The table; `parts` names the files of each view, relative to the folder."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns(parts))
    test, sparse = set(dataset.splits.test), set(dataset.splits.sparse)
    for view in dataset.views:
        files = [files.get(view.name, "") for files in parts.values()]
        split = "test" if view.name in test else "train"
        about = [split, _flag(view.name in sparse), _flag(dataset.simulated), view.device]
        writer.writerow([view.name, *files, *about, *_numbers(view)])
    return text.getvalue().encode()


def _flag(value: bool) -> str:
    return "true" if value else "false"


def _numbers(view: PosedView) -> Sequence[str]:
    camera, T = view.camera, view.T_world_camera
    lens = [getattr(camera, name) for name in CAMERA]
    pose = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
    shown = [str(int(value)) for value in lens[:2]]
    return [*shown, *(repr(float(value)) for value in (*lens[2:], *pose, *view.covariance[_UPPER]))]
