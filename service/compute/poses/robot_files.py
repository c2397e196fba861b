"""Reads what goes with a robot's poses: T_flange_camera of a hand_eye.json, and the station of each image."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from service.core.errors import DataError
from service.core.geometry import Transform


def read_hand_eye(path: Path) -> Transform:
    """T_flange_camera (4, 4), metres.

    Raises:
        DataError: the file does not hold it.
    """
    try:
        T_flange_camera = np.array(json.loads(path.read_text(encoding="utf-8"))["T_flange_camera"], dtype=np.float64)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError("no T_flange_camera can be read", where=str(path)) from error
    if T_flange_camera.shape != (4, 4):
        raise DataError("T_flange_camera is not 4 × 4", where=str(path))
    return T_flange_camera


def read_stations(path: Path, images: Iterable[str]) -> dict[str, str]:
    """Station by image name, from a CSV with the columns image and station.

    Raises:
        DataError: the file has no such columns, or an image has no station.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            found = {row["image"]: row["station"] for row in csv.DictReader(file)}
    except (OSError, KeyError) as error:
        raise DataError("no columns image, station can be read", where=str(path)) from error
    missing = sorted(set(images) - set(found))
    if missing:
        raise DataError(f"{len(missing)} images have no station: {', '.join(missing[:5])}", where=str(path))
    return found
