"""Reads and writes camera.json and reads spheres.json."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.scene import ScanSpheres
from service.core.errors import DataError
from service.core.geometry import Array
from service.core.text_files import file_text, parse_json
from service.core.units import metres

_CAMERA_KEYS = ("width", "height", "fx", "fy", "cx", "cy")
_DISTORTION = (
    "k1",
    "k2",
    "p1",
    "p2",
    "k3",
    "k4",
    "k5",
    "k6",
)  # missing ones are zero
#: Keys that `calibrate intrinsics` writes into the same file beside the camera.
_CALIBRATION_KEYS = (
    "model", "board", "n_views", "images", "rms_px", "per_view_rms_px", "excluded", "sigma", "sigma_independent",
    "sigma_by_image", "sigma_corner_px", "inflation", "covariance", "coverage", "tilt", "cross_validation",
    "residuals", "uncertainty", "warnings", "optics",
)  # fmt: skip
_SIMULATED = "simulated"  # of a camera that a simulated rig had


def read_camera_json(path: Path) -> CameraModel:
    """Read a camera from {"width","height","fx","fy","cx","cy"} and, if not zero, "k1" … "k6", "p1", "p2" (OpenCV).

    A file written by `calibrate intrinsics` also holds the calibration's results, and one of a simulated data set
    says so. Any other key is refused, since it could change the meaning of the numbers.

    Raises:
        DataError: a key is missing, unknown or not a number.
    """
    document = json_object(path)
    _check_keys(document, set(_CAMERA_KEYS), {*_DISTORTION, *_CALIBRATION_KEYS, _SIMULATED}, path)
    values: dict[str, float] = {}
    for key in (*_CAMERA_KEYS, *_DISTORTION):
        value = document.get(key, 0.0)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise DataError(f"{key} is {value!r}, not a number", where=str(path), remedy=f"Correct {key}")
        values[key] = value
    if min(values["fx"], values["fy"]) <= 0 or any(values[k] < 1 or values[k] % 1 for k in ("width", "height")):
        raise DataError(
            "width, height, fx and fy must be positive, width and height whole numbers",
            where=str(path),
            remedy="Correct them",
        )
    size = (int(values["width"]), int(values["height"]))
    return CameraModel(*size, *(float(values[k]) for k in (*_CAMERA_KEYS, *_DISTORTION)[2:]))


def write_camera_json(path: Path, camera: CameraModel, *, simulated: bool = False) -> None:
    """Write a camera in the format that `read_camera_json` reads."""
    mark = {_SIMULATED: True} if simulated else {}
    path.write_text(json.dumps(mark | camera.record(), indent=2) + "\n", encoding="utf-8")


def read_spheres_json(path: Path) -> ScanSpheres:
    """Read scan-frame spheres from {"radius_mm": 15, "registration_mm": [[x,y,z],…], "control_mm": [[x,y,z],…]}.

    `details`, which the `spheres` command adds for each sphere, is ignored.

    Raises:
        DataError: a key is missing or unknown, there is no registration sphere, or numbers are malformed.
    """
    document = json_object(path)
    _check_keys(document, {"radius_mm", "registration_mm"}, {"control_mm", "details"}, path)
    radius = document["radius_mm"]
    if isinstance(radius, bool) or not isinstance(radius, int | float) or not 0 < radius < math.inf:
        raise DataError(
            f"radius_mm is {radius!r}, not a positive number", where=str(path), remedy="Correct radius_mm"
        )
    centres: list[Array] = []
    for key in ("registration_mm", "control_mm"):
        rows = finite_numbers(document.get(key, []), f"{path}: {key}")
        if rows.size == 0:
            rows = np.empty((0, 3))
        if rows.ndim != 2 or rows.shape[1] != 3:
            raise DataError(f"{key} is not a list of [x, y, z]", where=str(path), remedy=f"Correct {key}")
        centres.append(metres(rows))
    if len(centres[0]) == 0:
        raise DataError("registration_mm is empty", where=str(path), remedy="Give at least three spheres")
    return ScanSpheres(centres[0], metres(float(radius)), control_m=centres[1])


def _check_keys(document: Mapping[str, Any], needed: set[str], optional: set[str], path: Path) -> None:
    missing = sorted(needed - set(document))
    unknown = sorted(set(document) - needed - optional)
    if missing or unknown:
        parts = [f"missing {', '.join(missing)}"] * bool(missing) + [f"unknown {', '.join(unknown)}"] * bool(unknown)
        allowed = ", ".join(sorted(needed | optional))
        raise DataError(f"wrong keys: {'; '.join(parts)}", where=str(path), remedy=f"The keys are {allowed}")


def json_object(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file.

    Raises:
        DataError: the file is not JSON, or holds no object.
    """
    document = parse_json(file_text(path), name=str(path))
    if not isinstance(document, dict):
        raise DataError("the file does not hold a JSON object", where=str(path), remedy="Begin it with {")
    return cast("dict[str, Any]", document)


def finite_numbers(value: object, where: str) -> Array:
    """Return an array of finite numbers from parsed JSON.

    Raises:
        DataError: it is none; `where` names the place.
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise DataError("not an array of numbers", where=where, remedy="Correct the numbers") from None
    if not np.isfinite(array).all():
        raise DataError("a number is not finite", where=where, remedy="Correct the numbers")
    return array
