"""Converts outlines to plain data and back: the cone and its evidence are stored, the points follow from them."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone
from service.compute.markers.records import DetectionOptions, OutlineEvidence, SphereOutline, outline_from_cone

_EVIDENCE = tuple(field.name for field in dataclasses.fields(OutlineEvidence))


def outline_record(outline: SphereOutline) -> dict[str, Any]:
    """An outline as JSON-compatible data."""
    record: dict[str, Any] = {name: getattr(outline, name) for name in _EVIDENCE}
    record["cone_covariance"] = outline.cone_covariance.tolist()
    record["axis"] = outline.cone.axis.tolist()
    record["half_angle_rad"] = float(outline.cone.half_angle_rad)
    record["centre_px"] = list(outline.centre_px)
    record["semi_axes_px"] = list(outline.semi_axes_px)
    record["angle_rad"] = outline.angle_rad
    return record


def outline_from_record(record: dict[str, Any], camera: CameraModel) -> SphereOutline:
    """Rebuild an outline from `outline_record`'s data, with new sample points on the same conic."""
    values = {name: _value(record[name]) for name in _EVIDENCE}
    values["cone_covariance"] = np.array(record["cone_covariance"], dtype=np.float64)
    evidence = OutlineEvidence(**values)
    cone = Cone(np.array(record["axis"]), float(record["half_angle_rad"]))
    return outline_from_cone(cone, camera, DetectionOptions().n_points, evidence)


def _value(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
