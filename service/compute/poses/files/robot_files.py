"""Reads files beside a robot's poses: T_flange_camera from hand_eye.json, and the station of each image."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from service.compute.poses.files.image_names import matched_names
from service.core.errors import DataError
from service.core.geometry import Transform
from service.core.text.counts import counted
from service.core.text.file_text import csv_rows, file_text
from service.core.text.json_text import parse_json

_REMEDY = "Give the file that `orthocapture calibrate hand-eye` wrote"


def read_hand_eye(path: Path) -> Transform:
    """T_flange_camera (4, 4), metres, from a hand_eye.json.

    Raises:
        DataError: the file holds no valid T_flange_camera.
    """
    document = parse_json(file_text(path), name=str(path), remedy=_REMEDY)
    try:
        T_flange_camera = np.array(document["T_flange_camera"], dtype=np.float64)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise DataError("no T_flange_camera can be read", where=str(path), remedy=_REMEDY) from error
    if T_flange_camera.shape != (4, 4) or not np.isfinite(T_flange_camera).all():
        raise DataError("T_flange_camera is not 4 × 4 finite numbers", where=str(path), remedy=_REMEDY)
    return T_flange_camera


def read_stations(path: Path, images: Iterable[str]) -> dict[str, str]:
    """Station by image name, from a CSV with the columns image and station.

    Raises:
        DataError: the columns are missing, or an image has no station.
    """
    rows = csv_rows(path)
    header = [cell.strip() for cell in next(rows, (1, []))[1]]
    if not {"image", "station"} <= set(header):
        raise DataError("no columns image and station", where=f"{path}:1", remedy="Begin the file with image,station")
    image, station = header.index("image"), header.index("station")
    found: dict[str, str] = {}
    for line, row in rows:
        if not any(cell.strip() for cell in row):
            continue
        if len(row) <= max(image, station):
            raise DataError("the line has no image or no station", where=f"{path}:{line}", remedy="Correct the line")
        found[row[image].strip()] = row[station].strip()
    wanted = list(images)
    names = matched_names(wanted, found, str(path), what="station")
    missing = sorted(set(wanted) - set(names))
    if missing:
        raise DataError(
            f"no station for {counted(len(missing), 'image')}: {', '.join(missing[:5])}",
            where=str(path),
            remedy="Add their lines",
        )
    return {image: found[name] for image, name in names.items()}
