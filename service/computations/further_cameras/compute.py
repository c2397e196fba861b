"""Jobs of raw files and further cameras: developing, the pose by each image, and the camera's pose by all."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

import cv2
import numpy as np

from service.computations.conversion import camera_of, camera_record
from service.computations.further_cameras import (
    DevelopAnswer,
    DevelopArguments,
    FirstCamera,
    FurtherCameraAnswer,
    FurtherCameraArguments,
    FurtherViewAnswer,
    FurtherViewArguments,
)
from service.computations.job import JobAnswer, JobContext, finite
from service.computations.records import matrix
from service.compute.camera_model import CameraCovariance, CameraModel, read_camera_covariance
from service.compute.images.develop import Development, develop, encode_tiff
from service.compute.images.photographs import read_image, read_image_of
from service.compute.live import expected_spheres, image_measures
from service.compute.markers.detect import detect_spheres, options_for
from service.compute.markers.image_files import detect_all
from service.compute.markers.records import SphereOutline, outline_from_record, outline_record
from service.compute.markers.refine import remeasure_file
from service.compute.photography import DevelopParameters
from service.compute.poses.pose_files import read_camera_json
from service.compute.registration.further_camera import (
    FurtherPose,
    OuterFrame,
    SightedPose,
    fixed_pose,
    rigid_pose,
    sighted_pose,
)
from service.compute.registration.result import of_inverse, of_product
from service.compute.scene import ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import Array, inverse
from service.core.units import mm, mrad
from service.machine.resources import IMAGE_MB, processes_for


@dataclass(frozen=True, slots=True)
class DevelopedFile:
    """A linear TIFF of 16 bits, and how it was made."""

    tiff: bytes = field(repr=False)
    how: Development


def develop_file(raw: Path, jpeg: Path | None, parameters: DevelopParameters) -> DevelopedFile:
    """Develop a raw file.

    Args:
        raw: the raw file.
        jpeg: the JPEG of the same exposure, which gives the picture its size and checks its place; None without one.
        parameters: the parameters.

    Raises:
        DataError: a file cannot be used, or the two do not show the same.
        ConfigurationError: rawpy is not installed, or does not know a parameter.
    """
    made = develop(raw, None if jpeg is None else read_image(jpeg), parameters)
    return DevelopedFile(encode_tiff(made.image_bgr), made.how)


def develop_raw(context: JobContext[DevelopArguments]) -> JobAnswer:
    """Develop the raw file of a job with the recorded parameters."""
    cv2.setNumThreads(1)
    arguments = context.arguments
    made = develop_file(context.input(arguments.raw), context.input(arguments.jpeg), arguments.parameters)
    tiff = context.keep_bytes(made.tiff, kind="developed", media_type="image/tiff", name=f"{arguments.viewpoint}.tif")
    answer = DevelopAnswer.model_validate({**asdict(made.how), "raw": arguments.raw})
    return JobAnswer({"largest_shift_px": made.how.largest_shift_px or 0.0}, (tiff,), answer)


def further_camera(context: JobContext[FurtherCameraArguments]) -> JobAnswer:
    """Find the spheres in every image, locate the camera by them, and join what the images agree on.

    An image that does not show enough spheres is left out, as is one that contradicts the others. If no pose results,
    the answer says why, and the registration of the first camera stands all the same.
    """
    arguments = context.arguments
    calibration = context.input(arguments.calibration)
    camera = read_camera_json(calibration)
    spheres = ScanSpheres(
        np.array(arguments.spheres_m), arguments.radius_m, covariance_m2=np.array(arguments.sphere_covariance_m2)
    )
    lens = _Lens.of(camera, read_camera_covariance(calibration))
    outlines = _outlines(context, camera)
    views, left_out = _views(outlines, lens, spheres)
    records = {name: [outline_record(outline) for outline in found] for name, found in outlines.items()}
    kept = context.keep_json(records, kind="outlines", name=f"{arguments.device}_outlines.json")
    answer = FurtherCameraAnswer(
        device=arguments.device,
        mounted=arguments.mounted,
        camera=camera_record(camera),
        calibration=arguments.calibration,
        outlines=kept.sha256,
        measured_on="jpeg" if arguments.developed is None else "raw",
    )
    try:
        pose = _pose(context, views, spheres)
    except ComputeError as error:
        return JobAnswer(
            {"views": 0.0, "excluded": float(len(arguments.images))},
            (kept,),
            answer.model_copy(update={"why": str(error), "excluded": left_out}),
        )
    answer = answer.model_copy(update=_stated(pose, left_out))
    measures = {"views": float(len(answer.views)), "excluded": float(len(answer.excluded))}
    measures |= {"consistency_mm": mm(pose.mean.rms_m), "consistency_mrad": mrad(pose.mean.rms_rad)}
    single = {name: {"T_scan_camera": v.T_scan_camera.tolist(), "rms_px": v.rms_px} for name, v in views.items()}
    stated = context.keep_json(
        {**answer.plain(), "single_views": single}, kind="further_camera", name=f"{arguments.device}.json"
    )
    return JobAnswer(measures, (stated, kept), answer)


@dataclass(frozen=True, slots=True)
class _Lens:
    """The intrinsics of a camera, and their covariance (8, 8); None: exact."""

    camera: CameraModel
    covariance: Array | None

    @classmethod
    def of(cls, camera: CameraModel, known: CameraCovariance | None) -> _Lens:
        return cls(camera, None if known is None else known.of_lens())


def _pose(
    context: JobContext[FurtherCameraArguments], views: Mapping[str, SightedPose], spheres: ScanSpheres
) -> FurtherPose:
    first = context.arguments.first
    if first is None:
        return fixed_pose(views)
    return rigid_pose(views, _frames(first, _lens_errors(context, first, views, spheres)))


def _lens_errors(
    context: JobContext[FurtherCameraArguments], first: FirstCamera, views: Iterable[str], spheres: ScanSpheres
) -> dict[str, Array]:
    """Return the covariance (6, 6) of the first camera's pose by its lens, its edges and the spheres, by viewpoint.

    An error of the principal point turns the camera in its own frame, which the registration of the scan does not
    show. Viewpoints whose images do not locate the first camera by themselves are left out.
    """
    stated = first.intrinsics_covariance
    known = None if stated is None else CameraCovariance(stated.parameters, np.array(stated.matrix))
    lens = _Lens.of(camera_of(first.camera), known)
    records = context.input_json(first.outlines)
    found: dict[str, Array] = {}
    for name in views:
        outlines = [outline_from_record(record, lens.camera) for record in records.get(name, ())]
        with suppress(ComputeError):
            found[name] = sighted_pose(outlines, lens.camera, spheres, lens.covariance).common
    return found


def _outlines(
    context: JobContext[FurtherCameraArguments], camera: CameraModel
) -> dict[str, tuple[SphereOutline, ...]]:
    """Return the outlines in every image, by viewpoint; measured in the developed raw files where there are any."""
    arguments = context.arguments
    files, options = [context.input(image.sha256) for image in arguments.images], options_for(arguments.colour)
    found = detect_all(
        files,
        camera,
        options,
        processes_for(len(files), IMAGE_MB),
        lambda done, total: context.progress(f"spheres in images of {arguments.device}", done, total),
    )
    by_name = {image.viewpoint: outlines for image, outlines in zip(arguments.images, found, strict=True)}
    if arguments.developed is None:
        return by_name
    raw = {name: context.input(sha256) for name, sha256 in arguments.developed.items()}
    return {
        name: tuple(o for o in remeasure_file(raw[name], camera, outlines, options) if o is not None)
        for name, outlines in by_name.items()
    }


def _views(
    outlines: Mapping[str, Sequence[SphereOutline]], lens: _Lens, spheres: ScanSpheres
) -> tuple[dict[str, SightedPose], dict[str, str]]:
    """Return the pose from each image, and the images without one with the reason."""
    views: dict[str, SightedPose] = {}
    left_out: dict[str, str] = {}
    for name, found in outlines.items():
        try:
            views[name] = sighted_pose(found, lens.camera, spheres, lens.covariance)
        except ComputeError as error:
            left_out[name] = error.what
    return views, left_out


def _frames(first: FirstCamera, own: Mapping[str, Array]) -> Mapping[str, OuterFrame]:
    """Return the first camera's poses, each with the registration's covariance plus the pose's `own` one."""
    T_world_scan, covariance = np.array(first.T_world_scan), np.array(first.covariance)[:6, :6]
    of_world = of_inverse(T_world_scan, covariance)
    nothing = np.zeros((6, 6))
    frames: dict[str, OuterFrame] = {}
    for name in first.T_scan_camera.keys() & own.keys():
        T_scan_first = np.array(first.T_scan_camera[name])
        T_world_first = T_world_scan @ T_scan_first
        shared = of_product(inverse(T_world_scan), T_world_first, of_world, nothing)
        frames[name] = OuterFrame(T_scan_first, shared + own[name])
    return frames


def _stated(pose: FurtherPose, left_out: Mapping[str, str]) -> dict[str, object]:
    mean = pose.mean
    contrary = {
        name: f"{mm(float(np.linalg.norm(d[:3]))):.2f} mm and {mrad(float(np.linalg.norm(d[3:]))):.2f} mrad off"
        for name, d, kept in zip(pose.names, mean.deviations, mean.kept, strict=True)
        if not kept
    }
    return {
        "T_outer_camera": matrix(mean.T),
        "covariance": matrix(pose.covariance),
        "views": tuple(name for name, kept in zip(pose.names, mean.kept, strict=True) if kept),
        "excluded": {**left_out, **contrary},
        "consistency_mm": mm(mean.rms_m),
        "consistency_mrad": mrad(mean.rms_rad),
        "chi2_reduced": mean.chi2_reduced,
    }


def further_view(context: JobContext[FurtherViewArguments]) -> JobAnswer:
    """Find the spheres in the image, and locate the camera by them if there are enough."""
    cv2.setNumThreads(1)  # the capture goes on in parallel
    arguments, image = context.arguments, context.arguments.image
    camera = read_camera_json(context.input(arguments.calibration))
    pixels = read_image_of(context.input(image.sha256), camera)
    outlines = detect_spheres(pixels, camera)
    measures, black = image_measures(pixels, outlines, camera)
    measures["spheres_seen"] = 0.0
    answer = FurtherViewAnswer(viewpoint=image.viewpoint, device=arguments.device, black=black)
    spheres = ScanSpheres(np.array(arguments.spheres_m), arguments.radius_m)
    try:
        seen = sighted_pose(outlines, camera, spheres, None)
    except ComputeError as error:
        answer = answer.model_copy(update={"reason": error.what})
    else:
        expected = expected_spheres(inverse(seen.T_scan_camera), spheres.centres_m, spheres.radius_m, camera)
        measures |= {"spheres_seen": float(seen.spheres), "spheres_expected": float(len(expected))}
        answer = answer.model_copy(update={"T_ct_camera": matrix(seen.T_scan_camera)})
    records = {image.viewpoint: [outline_record(outline) for outline in outlines]}
    kept = context.keep_json(records, kind="further_view", name=f"{image.viewpoint}.{arguments.device}.json")
    return JobAnswer(finite(measures), (kept,), answer)
