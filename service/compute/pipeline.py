"""Computes a registration and its evaluation from outlines and poses, and draws them, without a run or a store."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import cone_of_sphere
from service.compute.markers.records import SphereOutline
from service.compute.registration.accuracy import Evaluation
from service.compute.registration.contradictions import (
    UNEXPLAINED,
    BeyondModel,
    Contradiction,
    beyond_model,
    describe_left_out,
    held_lens_covariance,
    odd_images,
    odd_spheres,
    require_handedness,
    too_many,
)
from service.compute.registration.control_spheres import ControlEvaluation, SearchNearby, evaluate_controls
from service.compute.registration.identity import Assignment, identify
from service.compute.registration.problem import RegistrationSettings
from service.compute.registration.result import OutlineResidual, RegistrationResult
from service.compute.registration.solve import register
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, apply, inverse
from service.core.units import mm

INTRINSICS = "intrinsics"  # name of the component of the covariance
_CHECKED_TIMES = 3  # an image far off can hide another
_DEFAULT = RegistrationSettings()


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
    """The results for result.json and the report. `controls` is None if there are no control spheres."""

    registration: RegistrationResult
    controls: ControlEvaluation | None
    images: tuple[ImageDetections, ...]
    markers: tuple[int, ...]  # registration spheres used
    assignments: tuple[Assignment, ...] = field(repr=False)
    centre_scan_m: Array = field(repr=False)  # (3,) mean of the registration spheres: the scene's centre
    findings: tuple[Contradiction, ...] = ()
    left_out: Mapping[int, str] = field(default_factory=dict[int, str])  # images that contradict the others, and why
    beyond: BeyondModel | None = None  # None: not checked

    @property
    def evaluation(self) -> Evaluation | None:
        """The paper's errors; None if no control sphere was measured."""
        return None if self.controls is None else self.controls.means

    @property
    def control_assignments(self) -> tuple[Assignment, ...]:
        """Per image, outline → control sphere; the outlines are those of `controls`."""
        return tuple(Assignment() for _ in self.images) if self.controls is None else self.controls.assignments

    def measures(self) -> dict[str, float]:
        """Return the figures that gates judge, by their names in a run."""
        out = {
            "predicted_error_mm": mm(self.registration.sigma_at_m(self.centre_scan_m)),
            "contradictions": float(sum(one.refuses for one in self.findings)),
        }
        if self.controls is not None:
            out |= self.controls.measures()
        if self.evaluation is not None:
            out["best_mean_radial_error_mm"] = self.evaluation.mean_radial_error_mm
        return out

    def as_json(self, camera: CameraModel) -> dict[str, object]:
        """Return the content of result.json: metres, row-major 4×4 matrices, pixels of the images as captured."""
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
            "components_mm": {
                name: mm(float(np.sqrt(np.trace(r.part_at_m2(name, self.centre_scan_m))))) for name in r.components
            },
            "common_errors": []
            if self.beyond is None
            else [{**asdict(error), "named": error.significant} for error in self.beyond.errors],
            "blur_px": None if self.beyond is None else self.beyond.blur_px,
            "findings": [asdict(one) for one in self.findings],
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
            if self.controls is None
            else [
                {
                    "index": s.index,
                    "radial_error_mm": s.radial_error_mm,
                    "reprojection_error_px": s.reprojection_error_px,
                    "n_images": s.measured,
                    "n_expected": s.expected,
                    "displacement_mm": s.displacement_mm,
                    "displacement_sigma_mm": s.displacement_sigma_mm,
                    "finding": s.finding,
                }
                for s in self.controls.spheres
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
    images: PosedImages,
    spheres: ScanSpheres,
    settings: RegistrationSettings = _DEFAULT,
    *,
    assignments: Sequence[Assignment] | None = None,
    search: SearchNearby | None = None,
    lens_covariance: Array | None = None,
    calibrated: Array | None = None,
    check: bool = True,
) -> PipelineResult:
    """Identify, register and evaluate detected outlines.

    Args:
        outlines: the outlines of each image from `locate_outlines` or `detect_all`.
        images: camera, poses and names of the images. If the poses are not metric, their scale is estimated.
        spheres: registration spheres, and control spheres if there are any.
        settings: the settings of `register`.
        assignments: registration sphere of outlines in each image, if `locate_outlines` knows it; None:
            identified here.
        search: searches images for control spheres that are missing among the outlines; None: they count as not
            measured.
        lens_covariance: (8, 8) covariance of the calibration, which adds the component INTRINSICS to the covariance.
        calibrated: (8, 8) covariance of the calibration with which the check compares; None: `lens_covariance`.
        check: true to look for contradictions: images that contradict the others are left out, and what the model
            does not explain adds the component UNEXPLAINED.

    Raises:
        DataError: the lengths do not agree, or a pose is not finite.
        ComputeError: too few spheres, or an ambiguous or contradictory assignment.
    """
    images.require(len(outlines))
    try:
        if assignments is None:
            assignments = identify(outlines, images, spheres)
        registration = register(outlines, assignments, images, spheres, settings)
    except ComputeError:
        require_handedness(outlines, images, spheres)  # says so if the list is mirrored
        raise
    findings: list[Contradiction] = []
    left_out: dict[int, str] = {}
    beyond = None
    if check:
        odd: frozenset[int] = frozenset()
        of_all = assignments, registration
        for _ in range(_CHECKED_TIMES):
            new = odd_images(outlines, images, spheres, registration) - odd
            excess = too_many(odd | new, images)
            if excess is not None:
                findings.append(excess)
                odd, (assignments, registration) = frozenset(), of_all
            if not new or excess is not None:
                break
            odd |= new
            assignments = [Assignment() if i in odd else a for i, a in enumerate(assignments)]
            registration = register(outlines, assignments, images, spheres, settings)
        described = describe_left_out(odd, outlines, images, spheres, registration)
        findings += described.values()
        left_out = {i: one.what for i, one in described.items()}
        registration = replace(
            registration,
            T_scan_camera=_without(registration.T_scan_camera, left_out),
            T_scan_camera_refined=_without(registration.T_scan_camera_refined, left_out),
        )
        findings += odd_spheres(outlines, images, spheres, registration, search)
        known = lens_covariance if calibrated is None else calibrated
        beyond = beyond_model(outlines, assignments, images, spheres, registration, settings, lens_covariance=known)
        findings += beyond.findings
        registration = _with_component(registration, UNEXPLAINED, beyond.component)
    if lens_covariance is not None:
        uncertain = replace(settings, intrinsics_covariance=lens_covariance)
        more = register(outlines, assignments, images, spheres, uncertain)
        caused = held_lens_covariance(more, lens_covariance)
        registration = _with_component(registration, INTRINSICS, caused)
    controls = None
    if len(spheres.control_m):
        registered = PosedImages(registration.T_scan_camera, images.camera)
        controls = evaluate_controls(outlines, assignments, registered, spheres, search=search)
    shown = outlines if controls is None else controls.outlines
    named = [Assignment()] * len(shown) if controls is None else controls.assignments
    labels = images.labels
    records = {(r.image, r.outline): r for r in registration.residuals}
    detections = tuple(
        ImageDetections(
            labels[i],
            tuple(_detection(o, j, records.get((i, j)), named[i]) for j, o in enumerate(found)),
            registration.T_scan_camera[i],
        )
        for i, found in enumerate(shown)
    )
    used = tuple(sorted({r.marker for r in registration.residuals if not r.excluded}))
    centre = np.asarray(spheres.centres_m, dtype=np.float64).mean(axis=0)
    return PipelineResult(
        registration, controls, detections, used, tuple(assignments), centre, tuple(findings), left_out, beyond
    )


def _without(T_scan_camera: Array, left_out: Mapping[int, str]) -> Array:
    """Return the poses, with NaN for images that were left out."""
    out = T_scan_camera.copy()
    out[list(left_out)] = np.nan
    return out


def _with_component(registration: RegistrationResult, name: str, part: Array) -> RegistrationResult:
    """Return the registration with a further (6, 6) part of its covariance; unchanged if the part is zero."""
    if not part.any():
        return registration
    whole = np.zeros_like(registration.covariance)
    whole[:6, :6] = part[:6, :6]
    components = registration.components | {name: whole}
    return replace(registration, covariance=registration.covariance + whole, components=components)


def _detection(outline: SphereOutline, index: int, record: OutlineResidual | None, control: Assignment) -> Detection:
    return Detection(
        outline,
        None if record is None else record.marker,
        control.markers.get(index),
        None if record is None else record.rms_px,
        "" if record is None else record.reason,
    )


_REGISTRATION, _CONTROL, _UNUSED, _EXCLUDED, _PREDICTED = (
    (60, 220, 60), (255, 160, 0), (160, 160, 160), (40, 40, 255), (0, 220, 255),
)  # fmt: skip


def draw_overlay(
    image_bgr: NDArray[np.uint8],
    camera: CameraModel,
    detections: Sequence[Detection],
    *,
    T_scan_camera: Transform | None = None,
    registration_centres_m: Array | None = None,
    control_centres_m: Array | None = None,
    radius_m: float = 0.015,
) -> NDArray[np.uint8]:
    """Draw a copy (H, W, 3) with detected outlines (green: registration, blue: control, grey: unused, red: excluded),
    their sphere numbers, and the outlines that the registration predicts, dashed in yellow.
    """
    picture = image_bgr.copy()
    width = max(1, round(camera.width / 900))
    if T_scan_camera is not None and np.all(np.isfinite(T_scan_camera)):
        for centres in (registration_centres_m, control_centres_m):
            if centres is not None:
                for c in apply(inverse(T_scan_camera), centres):
                    _dashed(picture, c, radius_m, camera, width)
    for d in detections:
        colour, label = _UNUSED, ""
        if d.marker is not None:
            colour, label = (_EXCLUDED if d.excluded else _REGISTRATION), str(d.marker)
        elif d.control is not None:
            colour, label = _CONTROL, f"C{d.control}"
        curve = np.rint(d.outline.captured_px(camera) * 16).astype(np.int32)
        cv2.polylines(picture, [curve], True, colour, width, cv2.LINE_AA, shift=4)
        if label:
            x, y = (round(v) for v in d.outline.centre_px)
            size = camera.width / 1900
            for tone, thickness in (((0, 0, 0), 4 * width), (colour, 2 * width)):
                place = (x - round(10 * size * len(label)), y + round(10 * size))
                cv2.putText(picture, label, place, cv2.FONT_HERSHEY_SIMPLEX, size, tone, thickness, cv2.LINE_AA)
    return picture


def _dashed(picture: NDArray[np.uint8], centre: Array, radius_m: float, camera: CameraModel, width: int) -> None:
    if centre[2] < 3 * radius_m:
        return
    cone = cone_of_sphere(centre, radius_m)
    middle = camera.project(centre[None])[0]
    if not (-0.2 < middle[0] / camera.width < 1.2 and -0.2 < middle[1] / camera.height < 1.2):
        return
    curve = camera.project(cone.rays(np.linspace(0, 2 * np.pi, 97), np.full(97, cone.half_angle_rad * 1.04)))
    points = np.rint(curve * 16).astype(np.int32)
    for k in range(0, 96, 4):
        cv2.polylines(picture, [points[k : k + 3]], False, _PREDICTED, width, cv2.LINE_AA, shift=4)
