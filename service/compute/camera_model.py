"""Models the pinhole camera with OpenCV's distortion (k1, k2, p1, p2, k3 … k6), and a calibration's covariance."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from service.core.errors import DataError
from service.core.geometry import Array
from service.core.text_files import file_text, parse_json

_OPTIONAL = ("k3", "k4", "k5", "k6")


@dataclass(frozen=True, slots=True)
class CameraModel:
    """Intrinsics in pixels for images of width × height; pixel centres lie at integer coordinates.

    The distortion is OpenCV's: radial (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶), tangential p1, p2.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    @classmethod
    def from_record(cls, record: Mapping[str, float]) -> CameraModel:
        """Return the camera of a recorded result: its fields by name; the image size may be floats."""
        rest = {name: value for name, value in record.items() if name not in ("width", "height")}
        return cls(int(record["width"]), int(record["height"]), **rest)

    def record(self) -> dict[str, float]:
        """Return the camera as `from_record` reads it; k3 … k6 only if one of them is not zero."""
        fields = dataclasses.asdict(self)
        return {name: value for name, value in fields.items() if name not in _OPTIONAL or value != 0}

    @property
    def matrix(self) -> Array:
        """K (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def distortion(self) -> Array:
        """(4,) k1, k2, p1, p2; (5,) with k3 or (8,) with k3 … k6 if these are not zero."""
        terms = np.array([self.k1, self.k2, self.p1, self.p2, self.k3, self.k4, self.k5, self.k6])
        return terms if terms[5:].any() else terms[:5] if self.k3 else terms[:4]

    def project(self, points_camera: Array) -> Array:
        """Return the distorted pixels (N, 2) of points (N, 3) in the camera frame."""
        xy = points_camera[:, :2] / points_camera[:, 2:]
        r2 = np.sum(xy**2, axis=1)
        radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        radial /= 1.0 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))
        x, y = xy[:, 0], xy[:, 1]
        xd = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        yd = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        return np.stack([self.fx * xd + self.cx, self.fy * yd + self.cy], axis=1)

    def normalise(self, pixels: Array) -> Array:
        """Return the undistorted normalised coordinates (N, 2), at z = 1, of distorted pixels (N, 2)."""
        import cv2  # noqa: PLC0415 - reading a record of a camera does not need it

        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-12)
        points = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        out = cv2.undistortPointsIter(points, self.matrix, self.distortion, np.eye(3), np.eye(3), criteria)
        return np.asarray(out, dtype=np.float64).reshape(-1, 2)

    def scaled(self, width: int, height: int) -> CameraModel:
        """Return the camera at another image size; pixel centres stay at integers, so c' = (c + ½) s − ½."""
        sx, sy = width / self.width, height / self.height
        return dataclasses.replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )


#: Parameters of the lens, in the order of the registration's solver.
LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


@dataclass(frozen=True, slots=True)
class CameraCovariance:
    """Covariance (P, P) of named parameters of a CameraModel, in their units (px and 1)."""

    parameters: tuple[str, ...]
    matrix: Array

    def of_lens(self) -> Array | None:
        """Return (8, 8) covariance of the parameters LENS; None if the covariance is of another lens model."""
        if not set(self.parameters) <= set(LENS):
            return None
        # Parameters that the model holds fixed are exact, but the solver needs a positive variance.
        out = 1e-18 * np.eye(len(LENS))
        places = [LENS.index(name) for name in self.parameters]
        out[np.ix_(places, places)] = self.matrix
        return out

    def deviations(self, camera: CameraModel) -> Iterator[CameraModel]:
        """Yield the cameras displaced by one standard deviation along each principal axis of the covariance.

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
    """Read the covariance that `calibrate intrinsics` wrote into camera.json; None if the file has none.

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
