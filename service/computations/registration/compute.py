"""Jobs of the registration: the outlines of the spheres in all images, and T_world_scan for one source of poses."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from service.computations.conversion import camera_record, camera_reduced, camera_used, lens_covariance
from service.computations.image_poses import HybridModel, ModelFile
from service.computations.image_poses.compute import joint_pose_covariance
from service.computations.inputs import photographs, read_outlines, robot_camera_poses
from service.computations.job import JobAnswer, JobContext
from service.computations.records import PosedPhotograph, has_poses, matrices, matrix
from service.computations.registration import (
    ARM,
    POSE_ERRORS,
    CommonError,
    Contradiction,
    DetectorName,
    DetectSpheresArguments,
    LeaveOneOut,
    RegisterArguments,
    Registration,
)
from service.compute.camera_model import CameraModel
from service.compute.hand_held import poses_by_spheres
from service.compute.markers.detect import options_for
from service.compute.markers.grounded import GroundedDetector, Weights, weights_in
from service.compute.markers.image_files import (
    DetectFile,
    LocatedOutlines,
    detect_all,
    locate_outlines,
    searched_whole,
)
from service.compute.markers.paper import Box, detect_file_by_masks
from service.compute.markers.records import DetectionOptions, SphereOutline, outline_record
from service.compute.markers.refine import remeasure_file
from service.compute.pipeline import INTRINSICS, PipelineResult, register_images
from service.compute.registration.accuracy import Alignment, leave_one_out
from service.compute.registration.contradictions import UNEXPLAINED, held_lens_covariance
from service.compute.registration.identity import identify
from service.compute.registration.problem import RegistrationSettings
from service.compute.registration.result import RegistrationResult, camera_errors, with_joint_pose_covariance
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform, inverse
from service.core.records.base import ArtefactRef
from service.core.units import mm
from service.machine.executors import IN_THIS_PROCESS
from service.machine.resources import IMAGE_MB, processes_for


def detect_spheres(context: JobContext[DetectSpheresArguments]) -> JobAnswer:
    """Detect the outlines of every sphere in every image, as one artefact that all registrations share.

    Poses predict where to search: the robot's, or those of a `model` from structure from motion, which has no scale.
    Without poses, or if they are too inaccurate, the images are searched whole. Images that are not in the model get
    no outlines.
    """
    arguments = context.arguments
    images, poses = _posed(context)
    weights = weights_in() if arguments.detector in ("grounded", "vote") else None
    located = _located(context, images, poses, weights)
    measured, lost = _measured(context, images, located.outlines)
    records = [[outline_record(outline) for outline in found] for found in measured]
    found = {image.viewpoint: [] for image in arguments.images}
    found |= dict(zip((image.viewpoint for image in images), records, strict=True))
    total = sum(map(len, records))
    ref = context.keep_json(found, kind="outlines", name="outlines.json")
    measures = {
        "outlines": float(total),
        "outlines_an_image": total / len(images),
        "images_searched_whole": float(located.count("searched")),
    } | lost
    if weights is None:
        return JobAnswer(measures, (ref,))
    used = {"detector": arguments.detector, "sha256": dict(weights.sha256())}
    return JobAnswer(measures, (ref, context.keep_json(used, kind="weights", name="weights.json")))


def _posed(context: JobContext[DetectSpheresArguments]) -> tuple[Sequence[PosedPhotograph], Array | None]:
    """Return the images to search, and (N, 4, 4) their poses; None: those of the robot."""
    arguments = context.arguments
    if arguments.model is None:
        return arguments.images, None
    model = ModelFile.model_validate(context.input_json(arguments.model)).T_world_camera
    images = tuple(image for image in arguments.images if image.viewpoint in model)
    return images, np.array([model[image.viewpoint] for image in images])


def _measured(
    context: JobContext[DetectSpheresArguments],
    images: Sequence[PosedPhotograph],
    outlines: Sequence[tuple[SphereOutline, ...]],
) -> tuple[Sequence[tuple[SphereOutline, ...]], dict[str, float]]:
    """Return the outlines measured in developed raw files, where there are any, and how many these do not show."""
    arguments = context.arguments
    if arguments.developed is None:
        return outlines, {}
    camera, options = camera_used(arguments), options_for(arguments.colour)
    out: list[tuple[SphereOutline, ...]] = []
    for done, (image, found) in enumerate(zip(images, outlines, strict=True), 1):
        again = remeasure_file(context.input(arguments.developed[image.viewpoint]), camera, found, options)
        out.append(tuple(outline for outline in again if outline is not None))
        context.progress("spheres in developed raw files", done, len(images))
    lost = sum(map(len, outlines)) - sum(map(len, out))
    return out, {"outlines_not_in_raw": float(lost)}


def _located(
    context: JobContext[DetectSpheresArguments],
    images: Sequence[PosedPhotograph],
    poses: Array | None,
    weights: Weights | None,
) -> LocatedOutlines:
    arguments = context.arguments
    files, camera = photographs(context, images), camera_used(arguments)
    posed = None
    if arguments.detector == "classical" and (poses is not None or has_poses(arguments, images)):
        posed = PosedImages(
            robot_camera_poses(arguments, images) if poses is None else poses,
            camera,
            groups=_numbered(image.station for image in images),
            metric=poses is None,
        )
    return search_outlines(
        files,
        camera,
        posed,
        ScanSpheres(np.array(arguments.spheres_m), arguments.radius_m),
        detect=detector_of(arguments.detector, weights, len(arguments.spheres_m)),
        scenes=_numbered(image.step for image in images),
        options=options_for(arguments.colour),
        workers=processes_for(len(files), IMAGE_MB),
        progress=partial(context.progress, "spheres in images"),
    )


def detector_of(
    name: DetectorName,
    weights: Weights | None,
    least: int,
    boxes: Mapping[str, Sequence[Box]] | None = None,
) -> DetectFile | None:
    """Return a detector for single files, which searches whole images; None for the classical one.

    Args:
        name: the detector's name.
        weights: those of the networks, for `grounded` and `vote`.
        least: the number of spheres below which the networks' threshold falls.
        boxes: those of another detector by file name, for `paper`; None: it finds them itself.
    """
    if name == "paper":
        return partial(detect_file_by_masks, boxes=boxes)
    return None if weights is None else GroundedDetector.of(weights, least, vote=name == "vote")


def search_outlines(
    files: Sequence[Path],
    camera: CameraModel,
    posed: PosedImages | None,
    spheres: ScanSpheres,
    *,
    detect: DetectFile | None,
    options: DetectionOptions,
    workers: int,
    progress: Callable[[int, int], None],
    scenes: Sequence[int] | None = None,
) -> LocatedOutlines:
    """Search the outlines of the spheres in images: where their poses predict them, or everywhere.

    Args:
        files: N images of the camera's size.
        camera: their camera.
        posed: their poses; None: the images are searched whole.
        spheres: the spheres that the poses predict.
        detect: a detector that searches whole images; None: the classical one.
        options: the detector's options.
        workers: the number of processes.
        progress: called with the number of images done and of all.
        scenes: (N,) images of the same number show the same spheres; None: all do.

    Raises:
        DataError: an image cannot be used.
    """
    if detect is not None or posed is None:
        # One process has the networks, which use all cores by themselves.
        at_once = IN_THIS_PROCESS if isinstance(detect, GroundedDetector) else workers
        return searched_whole(detect_all(files, camera, options, at_once, progress, detect=detect))
    return locate_outlines(files, posed, spheres, scenes=scenes, options=options, workers=workers, progress=progress)


def _numbered(names: Iterable[str]) -> list[int]:
    """Return a number for each name; equal names have equal numbers."""
    numbers: dict[str, int] = {}
    return [numbers.setdefault(name, len(numbers)) for name in names]


_LEAST_SPHERES = 4


def register(context: JobContext[RegisterArguments]) -> JobAnswer:
    """Compute T_world_scan for one source of poses. With robot poses, every station has its own base frame."""
    arguments, source = context.arguments, context.arguments.poses
    free = source == "spheres" and arguments.state_pose_errors
    refined = free or source == "robot_corrected"
    covariance_m2 = np.array(arguments.sphere_covariance_m2)
    spheres = ScanSpheres(np.array(arguments.spheres_m), arguments.radius_m, covariance_m2=covariance_m2)
    images = _posed_images(context)
    if free and not images.located:
        images = images.locatable(spheres)
    posed = images.posed(metric=source in (*ARM, "spheres", "hybrid"))
    lens = None if arguments.reduced else lens_covariance(arguments.intrinsics_covariance)
    solved = register_images(images.outlines, posed, spheres, calibrated=lens)
    images = replace(images, left_out=dict(solved.left_out))
    answer = placing = solved.registration
    again = partial(register_images, images.outlines, posed, spheres, assignments=solved.assignments, check=False)
    settings = RegistrationSettings(pose_covariance="free" if free else "estimate")
    if free:
        placing = again(settings).registration
    placed = _placed(context, images, answer, placing)
    components, judged = placed.components, placing
    if UNEXPLAINED in answer.components:
        components = components | {UNEXPLAINED: answer.components[UNEXPLAINED][:6, :6]}
    if lens is not None:
        judged = again(replace(settings, intrinsics_covariance=lens)).registration
        components = components | {INTRINSICS: held_lens_covariance(judged, lens, refined=refined)}
    covariance = np.sum(list(components.values()), axis=0)
    # Unless they are free, the poses of located images know every sphere: none is left out of them.
    left_out = None if images.located and not free else _leave_one_out(placing, refined=refined)
    record = _with_contradictions(
        _record(arguments, images, answer, _Judged(placed, components, covariance, left_out)), images, solved
    )
    alignment = Alignment(placed.T_world_scan, covariance)
    centre_m = np.array(arguments.spheres_m).mean(axis=0)
    measures = {
        "rms_px": answer.rms_px,
        "chi2_reduced": answer.chi2_reduced,
        "markers": float(len(solved.markers)),
        "images": float(answer.n_images),
        "excluded_outlines": float(len(answer.excluded)),
        "images_left_out": float(len(images.left_out)),
        "contradictions": solved.measures()["contradictions"],
        "predicted_error_mm": mm(float(np.sqrt(np.trace(alignment.covariance_at_m2(centre_m[None])[0])))),
    }
    if left_out is not None:
        measures["leave_one_out_mm"] = left_out.mean_radial_error_mm
    kept = {**record.plain(), **_residuals(answer, images.names)}
    files = [context.keep_json(kept, kind="registration", name=f"{source}.json")]
    if arguments.state_pose_errors:
        files.append(_kept_pose_errors(context, images, camera_errors(judged, refined=refined)))
    return JobAnswer(measures, tuple(files), record)


def _kept_pose_errors(context: JobContext[RegisterArguments], images: _ImagesToRegister, joint: Array) -> ArtefactRef:
    """Store the joint covariance (6 N, 6 N) of T_scan_camera of the images that are placed, with their names."""
    placed = np.isfinite(np.diag(joint))
    placed[[6 * i + k for i in images.left_out for k in range(6)]] = False
    buffer = io.BytesIO()
    listed = json.dumps([name for name, stated in zip(images.names, placed[::6], strict=True) if stated])
    np.savez(buffer, names=np.array(listed), covariance=joint[np.ix_(placed, placed)])
    return context.keep_bytes(
        buffer.getvalue(),
        kind=POSE_ERRORS,
        media_type="application/x-npz",
        name=f"{context.arguments.poses}_pose_errors.npz",
    )


@dataclass(frozen=True, slots=True)
class _ImagesToRegister:
    """The images that are registered.

    Attributes:
        images: the N photographs.
        poses: (N, 4, 4) poses of the cameras, in the frame of each image's group.
        groups: the group of each image; images of one group share a frame.
        camera: the camera at the size of the images.
        outlines: the outlines of each image.
        located: true if the poses come from the spheres that are registered.
        left_out: the images, by index, that contradict the others, and why; they have no pose.
    """

    images: Sequence[PosedPhotograph]
    poses: Array
    groups: Sequence[int]
    camera: CameraModel
    outlines: Sequence[Sequence[SphereOutline]]
    located: bool = False
    left_out: Mapping[int, str] = field(default_factory=dict[int, str])

    @property
    def names(self) -> list[str]:
        return [image.viewpoint for image in self.images]

    def posed(self, *, metric: bool) -> PosedImages:
        """Return the images as a registration takes them."""
        return PosedImages(self.poses, self.camera, groups=self.groups, metric=metric, names=self.names)

    def locatable(self, spheres: ScanSpheres) -> _ImagesToRegister:
        """Return the images that show four of the spheres, by which a camera can be located."""
        shown = identify(self.outlines, self.posed(metric=True), spheres)
        kept = [i for i, assigned in enumerate(shown) if len(assigned.markers) >= _LEAST_SPHERES]
        return replace(
            self,
            images=[self.images[i] for i in kept],
            poses=self.poses[kept],
            groups=[self.groups[i] for i in kept],
            outlines=[self.outlines[i] for i in kept],
        )

    def known(self, T_scan_camera: Array) -> dict[str, Transform]:
        """Return the poses that are known, by image."""
        pairs = enumerate(zip(self.names, T_scan_camera, strict=True))
        return {name: T for i, (name, T) in pairs if i not in self.left_out and np.isfinite(T).all()}

    def station(self, group: int) -> str:
        """Return the station whose images form a group."""
        return next(image.station for image, g in zip(self.images, self.groups, strict=True) if g == group)


def _posed_images(context: JobContext[RegisterArguments]) -> _ImagesToRegister:
    arguments = context.arguments
    images = arguments.images
    camera = camera_used(arguments)
    if arguments.poses == "spheres" and not has_poses(arguments, images):
        return _located_images(context, camera)
    if arguments.poses in (*ARM, "spheres"):
        stations = sorted({image.station for image in images})
        poses = robot_camera_poses(arguments, images)
        groups = [stations.index(image.station) for image in images]
    elif arguments.model is None:
        raise DataError(f"a registration with {arguments.poses} poses needs the file of these poses")
    else:
        model = ModelFile.model_validate(context.input_json(arguments.model)).T_world_camera
        images = tuple(image for image in images if image.viewpoint in model)
        poses = np.array([model[image.viewpoint] for image in images])
        groups = [0] * len(images)
    outlines = read_outlines(context.input_json, arguments.outlines, images, camera)
    return _ImagesToRegister(images, poses, groups, camera, outlines)


def _located_images(context: JobContext[RegisterArguments], camera: CameraModel) -> _ImagesToRegister:
    """Return the images whose spheres determine their poses; of an arm whose mount is unknown, or of a turntable."""
    arguments = context.arguments
    searched = read_outlines(context.input_json, arguments.outlines, arguments.images, camera)
    spheres = ScanSpheres(np.array(arguments.spheres_m), arguments.radius_m)
    found = poses_by_spheres(searched, [image.viewpoint for image in arguments.images], camera, spheres)
    located = [
        (image, outlines)
        for image, outlines in zip(arguments.images, searched, strict=True)
        if image.viewpoint in found
    ]
    images = tuple(image for image, _ in located)
    poses = np.array([found[image.viewpoint] for image in images])
    seen = [outlines for _, outlines in located]
    return _ImagesToRegister(images, poses, [0] * len(images), camera, seen, located=True)


@dataclass(frozen=True, slots=True)
class _Placed:
    """The estimated poses of the scan and the cameras.

    Attributes:
        T_world_scan: the registration.
        T_world_station: the station's pose, by station.
        T_scan_camera: the camera's pose, by image.
        components: the parts, (6, 6) each, of the covariance of T_world_scan.
        given: T_scan_camera by image and the covariance (6, 6) before the outlines refined the arm's corrected
            poses; None for other poses.
    """

    T_world_scan: Transform
    T_world_station: Mapping[str, Transform]
    T_scan_camera: Mapping[str, Transform]
    components: dict[str, Array]
    given: tuple[Mapping[str, Transform], Array] | None = None


def _placed(
    context: JobContext[RegisterArguments],
    images: _ImagesToRegister,
    answer: RegistrationResult,
    placing: RegistrationResult,
) -> _Placed:
    """Return the scan as `answer` has it, and the cameras as `placing` has them."""
    arguments = context.arguments
    stated = answer
    if arguments.tracks is not None:
        joint = joint_pose_covariance(context.input(arguments.tracks).read_bytes(), images.names)
        stated = with_joint_pose_covariance(answer, joint)
    placed = _Placed(
        answer.T_world_scan,
        {images.station(g): T for g, T in answer.T_world_group.items()},
        images.known(answer.T_scan_camera),
        {name: np.asarray(C, dtype=np.float64)[:6, :6] for name, C in stated.components.items()},
    )
    if placing is not answer:  # the outlines of each image alone show where its camera was
        return replace(
            placed,
            T_scan_camera=images.known(placing.T_scan_camera_refined),
            components=placing.refined_components(),
        )
    if arguments.poses == "robot_corrected":
        # The outlines measure the error of a single pose of the arm (some 0.3 mm) better than the arm itself.
        return replace(
            placed,
            T_scan_camera=images.known(answer.T_scan_camera_refined),
            components=answer.refined_components(),
            given=(placed.T_scan_camera, answer.covariance[:6, :6]),
        )
    if arguments.poses == "hybrid" and arguments.model is not None:
        # These poses were adjusted together with the spheres: only that adjustment knows the scan's covariance.
        adjusted = HybridModel.model_validate(context.input_json(arguments.model))
        T_world_scan = np.array(adjusted.T_world_scan)
        T_scan_world = inverse(T_world_scan)
        pairs = zip(images.names, images.poses, strict=True)
        own = {"adjustment": np.array(adjusted.scan_covariance)[:6, :6], "spheres": placed.components["spheres"]}
        return _Placed(
            T_world_scan,
            {station: np.array(T) for station, T in adjusted.T_world_station.items()},
            {name: T_scan_world @ T for name, T in pairs},
            own,
        )
    return placed


@dataclass(frozen=True, slots=True)
class _Judged:
    """The poses of the scan and the cameras, with their uncertainty."""

    placed: _Placed
    components: Mapping[str, Array]
    covariance: Array
    left_out: LeaveOneOut | None


def _record(
    arguments: RegisterArguments, images: _ImagesToRegister, answer: RegistrationResult, judged: _Judged
) -> Registration:
    placed, full = judged.placed, camera_reduced(arguments)
    record = Registration(
        poses=arguments.poses,
        camera=camera_record(images.camera),
        outlines=arguments.outlines,
        full_camera=None if full is None else camera_record(full),
        T_world_scan=matrix(placed.T_world_scan),
        scale=answer.scale,
        rms_px=answer.rms_px,
        T_world_station=matrices(placed.T_world_station),
        T_scan_camera=matrices(placed.T_scan_camera),
        excluded=tuple(f"{images.names[r.image]}, sphere {r.marker}: {r.reason}" for r in answer.excluded),
        covariance=matrix(judged.covariance),
        components=matrices(judged.components),
        leave_one_out=judged.left_out,
    )
    if arguments.state_pose_errors and arguments.poses in ARM:
        sigma_m, sigma_rad = answer.pose_sigma
        record = record.model_copy(update={"pose_sigma_m": sigma_m, "pose_sigma_rad": sigma_rad})
    if placed.given is None:
        return record
    cameras, covariance = placed.given
    given = {"T_scan_camera_given": matrices(cameras), "covariance_given": matrix(covariance)}
    return record.model_copy(update=given)


def _with_contradictions(record: Registration, images: _ImagesToRegister, solved: PipelineResult) -> Registration:
    """Return the record with what contradicts in the inputs."""
    beyond = solved.beyond
    found: dict[str, object] = {
        "findings": tuple(Contradiction(**asdict(one)) for one in solved.findings),
        "left_out": {images.names[i]: why for i, why in images.left_out.items()},
    }
    if beyond is not None:
        found["common_errors"] = tuple(CommonError(**asdict(one)) for one in beyond.errors)
        found["blur_px"] = beyond.blur_px
    return record.model_copy(update=found)


def _leave_one_out(answer: RegistrationResult, *, refined: bool) -> LeaveOneOut | None:
    """Return the errors of each sphere predicted from the others; None if a station sees too few spheres for it."""
    try:
        left_out = leave_one_out(answer, refined=refined)
    except ComputeError:
        return None
    return LeaveOneOut(
        mean_radial_error_mm=left_out.mean_radial_error_mm,
        mean_reprojection_error_px=left_out.mean_reprojection_error_px,
        spheres={str(m): row for m, row in left_out.per_sphere().items()},
    )


def _residuals(answer: RegistrationResult, names: Sequence[str]) -> dict[str, object]:
    return {
        "residuals": [
            {"image": names[r.image], "marker": r.marker, "rms_px": r.rms_px, "excluded": r.excluded}
            for r in answer.residuals
        ],
        "chi2_reduced": answer.chi2_reduced,
        "cost": answer.cost,
    }
