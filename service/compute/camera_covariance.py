"""The covariance of a calibrated camera, whose error is common to all images."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from service.compute.camera_model import CameraModel
from service.core.errors import DataError
from service.core.geometry import Array
from service.core.text.file_text import file_text
from service.core.text.json_text import parse_json

#: Parameters of the lens, in the order of the registration's solver.
LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


@dataclass(frozen=True, slots=True)
class CameraCovariance:
    """Covariance (P, P) of named parameters of a CameraModel, in their units (px and 1)."""

    parameters: tuple[str, ...]
    matrix: Array

    def of_lens(self) -> Array | None:
        """(8, 8) covariance of the parameters LENS; None if the covariance is of another lens model."""
        if not set(self.parameters) <= set(LENS):
            return None
        # Parameters that the model holds fixed are exact, but the solver needs a positive variance.
        out = 1e-18 * np.eye(len(LENS))
        places = [LENS.index(name) for name in self.parameters]
        out[np.ix_(places, places)] = self.matrix
        return out

    def deviations(self, camera: CameraModel) -> Iterator[CameraModel]:
        """Cameras displaced by one standard deviation along each principal axis of the covariance.

        The outer products of the changes that they cause in a result add up to the camera's share of its covariance.
        """
        scale = np.sqrt(np.maximum(np.diag(self.matrix), 1e-300))
        values, axes = np.linalg.eigh(self.matrix / np.outer(scale, scale))
        for step in (axes * np.sqrt(np.maximum(values, 0.0))).T:
            change = dict(zip(self.parameters, step * scale, strict=True))
            yield dataclasses.replace(
                camera, **{name: getattr(camera, name) + float(d) for name, d in change.items()}
            )


def read_camera_covariance(path: Path) -> CameraCovariance | None:
    """The covariance that `calibrate intrinsics` wrote into camera.json; None if the file has none.

    Raises:
        DataError: the file is not JSON, or its `covariance` is malformed.
    """
    document = parse_json(file_text(path), name=str(path))
    stated: Any = cast("dict[str, Any]", document).get("covariance") if isinstance(document, dict) else None
    if stated is None:
        return None
    wrong = DataError(
        "the covariance of the camera is not a square matrix of its parameters",
        where=f"{path}: covariance",
        remedy="Calibrate again, or remove the key: the camera then counts as exactly known",
    )
    try:
        parameters = tuple(str(name) for name in stated["parameters"])
        matrix = np.array(stated["matrix"], dtype=np.float64)
    except (TypeError, KeyError, ValueError, OverflowError) as error:
        raise wrong from error
    known = {field.name for field in dataclasses.fields(CameraModel)} - {"width", "height"}
    if not set(parameters) <= known or matrix.shape != (len(parameters),) * 2 or not np.isfinite(matrix).all():
        raise wrong
    return CameraCovariance(parameters, matrix)
