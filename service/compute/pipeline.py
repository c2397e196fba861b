"""The whole pipeline from outlines and poses to a registration and its evaluation, without a run or a store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.evaluation.accuracy import Evaluation, evaluate
from service.compute.markers.records import SphereOutline
from service.compute.markers.search.image_files import detect_all, locate_outlines
from service.compute.registration.cost import Cost
from service.compute.registration.identification.identity import Assignment, identify
from service.compute.registration.identification.pairing import CONTROL_GATE, paired
from service.compute.registration.settings import RegistrationSettings
from service.compute.registration.solve import OutlineResidual, RegistrationResult, register
from service.core.errors import DataError
from service.core.geometry import Array, Transform, inverse
from service.core.units import mm

__all__ = ["Detection", "ImageDetections", "PipelineResult", "detect_all", "locate_outlines", "register_images"]


@dataclass(frozen=True, slots=True)
class Detection:
    """One outline of an image and what it was used for."""

    outline: SphereOutline
    marker: int | None  # registration sphere, index into the list given
    control: int | None  # control sphere, index into the list given
    rms_px: float | None  # distance from the outline that the registration predicts
    excluded: str = ""  # the reason, if the registration excluded it


@dataclass(frozen=True, slots=True)
class ImageDetections:
    """All outlines of one image."""

    image: str
    detections: tuple[Detection, ...]
    T_scan_camera: Transform = field(repr=False)


@dataclass(frozen=True, slots=True)
class PipelineResult:
    """The results for result.json and the report. `evaluation` is None if there are no control spheres."""

    registration: RegistrationResult
    evaluation: Evaluation | None
    images: tuple[ImageDetections, ...]
    markers: tuple[int, ...]  # registration spheres used
    assignments: tuple[Assignment, ...] = field(repr=False)
    control_assignments: tuple[Assignment, ...] = field(repr=False)
    centre_scan_m: Array = field(repr=False)  # (3,) mean of the registration spheres: the scene's centre

    def as_json(self, camera: CameraModel) -> dict[str, object]:
        """The content of result.json: metres, row-major 4×4 matrices, pixels of the images as captured."""
        r = self.registration
        return {
            "T_world_scan": r.T_world_scan.tolist(),
            "scale": r.scale,
            "covariance": r.covariance.tolist(),
            "covariance_order": ["x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad", "ln_scale"][: len(r.covariance)],
            "T_world_group": {str(g): T.tolist() for g, T in r.T_world_group.items()},
            "rms_px": r.rms_px,
            "mean_radial_error_mm": None if self.evaluation is None else self.evaluation.mean_radial_error_mm,
            "mean_reprojection_error_px": None
            if self.evaluation is None
            else self.evaluation.mean_reprojection_error_px,
            "predicted_error_mm": mm(r.sigma_at_m(self.centre_scan_m)),
            "n_images": r.n_images,
            "markers": [
                {
                    "index": m,
                    "n_images": len(mine),
                    "rms_px": float(np.sqrt(np.mean([x.rms_px**2 for x in mine]))) if mine else None,
                }
                for m in self.markers
                for mine in [[x for x in r.residuals if x.marker == m and not x.excluded]]
            ],
            "control_spheres": []
            if self.evaluation is None
            else [
                {"index": s, "radial_error_mm": radial, "reprojection_error_px": px, "n_images": n}
                for s, (radial, px, n) in self.evaluation.per_sphere().items()
            ],
            "images": [
                {
                    "image": entry.image,
                    "T_scan_camera": entry.T_scan_camera.tolist()
                    if np.all(np.isfinite(entry.T_scan_camera))
                    else None,
                    "detections": [_detection_json(d) for d in entry.detections],
                }
                for entry in self.images
            ],
        }


def _detection_json(d: Detection) -> dict[str, object]:
    o = d.outline
    return {
        "marker": d.marker,
        "control": d.control,
        "centre_px": list(o.centre_px),
        "semi_axes_px": list(o.semi_axes_px),
        "angle_rad": o.angle_rad,
        "coverage": o.coverage,
        "outline_rms_px": o.rms_px,
        "registration_rms_px": d.rms_px,
        "excluded": d.excluded,
    }


def register_images(
    outlines: Sequence[Sequence[SphereOutline]],
    poses: Array,
    camera: CameraModel,
    registration_centres_m: Array,
    radius_m: float,
    *,
    control_centres_m: Array | None = None,
    groups: Sequence[int] | NDArray[np.int64] | None = None,
    estimate_scale: bool = False,
    cost: Cost = "cone",
    names: Sequence[str] = (),
    assignments: Sequence[Assignment] | None = None,
    pose_covariance: Array | Literal["estimate", "exact"] = "estimate",
    sphere_covariance_m2: Array | None = None,
    intrinsics_covariance: Array | None = None,
) -> PipelineResult:
    """Identify, register and evaluate detected outlines.

    Args:
        outlines: per image, from `locate_outlines` or `detect_all`.
        poses: (N, 4, 4) T_world_camera, or T_base_camera in the base frame of each image's group.
        camera: intrinsics.
        registration_centres_m: (M, 3) in the scan frame.
        radius_m: radius of all spheres.
        control_centres_m: (C, 3) spheres used only for the evaluation, or None.
        groups: (N,) station of each image; None: all the same.
        estimate_scale: whether to estimate a scale, for poses that are not metric.
        cost: residual of the registration.
        names: image names, for messages and results.
        assignments: per image, which outlines are which registration spheres, if `locate_outlines` knows it; None:
            identified here.
        pose_covariance: of the poses, as for `register`.
        sphere_covariance_m2: (M, 3, 3) of the registration spheres; None takes them as exact.
        intrinsics_covariance: of fx, fy, cx, cy, k1, k2, p1, p2, as for `register`.

    Raises:
        DataError: the lengths do not agree, or a pose is not finite.
        ComputeError: too few spheres, or an ambiguous or contradictory assignment.
    """
    n = len(outlines)
    stations = np.zeros(n, dtype=np.int64) if groups is None else np.asarray(groups, dtype=np.int64)
    if poses.shape != (n, 4, 4) or len(stations) != n:
        raise DataError(f"{n} images, but {len(poses)} poses and {len(stations)} stations")
    if not np.all(np.isfinite(poses)):
        raise DataError("a camera pose holds a number that is not finite")
    labels = list(names) or [f"image {i}" for i in range(n)]
    if assignments is None:
        assignments = identify(
            outlines, registration_centres_m, camera, poses,
            radius_m=radius_m, groups=stations, metric=not estimate_scale, names=labels,
        )  # fmt: skip
    registration = register(
        outlines,
        assignments,
        poses,
        stations,
        registration_centres_m,
        radius_m,
        camera,
        RegistrationSettings(
            estimate_scale=estimate_scale,
            cost=cost,
            pose_covariance=pose_covariance,
            sphere_covariance_m2=sphere_covariance_m2,
            intrinsics_covariance=intrinsics_covariance,
        ),
    )
    controls = np.zeros((0, 3)) if control_centres_m is None else np.asarray(control_centres_m, dtype=np.float64)
    control = _find_controls(outlines, assignments, registration, controls, radius_m, camera)
    evaluation = None
    if any(a.markers for a in control):
        evaluation = evaluate(outlines, control, registration.T_scan_camera, controls, radius_m, camera)
    records = {(r.image, r.outline): r for r in registration.residuals}
    images = tuple(
        ImageDetections(
            labels[i],
            tuple(_detection(o, j, records.get((i, j)), control[i]) for j, o in enumerate(found)),
            registration.T_scan_camera[i],
        )
        for i, found in enumerate(outlines)
    )
    used = tuple(sorted({r.marker for r in registration.residuals if not r.excluded}))
    centre = np.asarray(registration_centres_m, dtype=np.float64).mean(axis=0)
    return PipelineResult(registration, evaluation, images, used, tuple(assignments), control, centre)


def _detection(outline: SphereOutline, index: int, record: OutlineResidual | None, control: Assignment) -> Detection:
    return Detection(
        outline,
        None if record is None else record.marker,
        control.markers.get(index),
        None if record is None else record.rms_px,
        "" if record is None else record.reason,
    )


def _find_controls(
    outlines: Sequence[Sequence[SphereOutline]],
    assignments: Sequence[Assignment],
    registration: RegistrationResult,
    controls: Array,
    radius_m: float,
    camera: CameraModel,
) -> tuple[Assignment, ...]:
    """Match outlines not used by the registration to the control spheres' predicted positions."""
    out: list[Assignment] = []
    for i, found in enumerate(outlines):
        T = registration.T_scan_camera[i]
        free = [j for j in range(len(found)) if j not in assignments[i].markers]
        if len(controls) == 0 or not free or not np.all(np.isfinite(T)):
            out.append(Assignment())
            continue
        pairs = paired([found[j] for j in free], inverse(T), controls, radius_m, camera, CONTROL_GATE)
        out.append(Assignment({free[d]: m for d, m in pairs.items()}, inverse(T), registration.scale))
    return tuple(out)
