"""Job `register`: the registration of the scan with one source of camera poses."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial

import numpy as np

from service.computations import register as job
from service.computations.conversion import camera_record, camera_reduced, camera_used, lens_covariance
from service.computations.detect_spheres.compute import read_outlines
from service.computations.hybrid import HybridModel
from service.computations.inputs import robot_camera_poses
from service.computations.job import JobAnswer, JobContext
from service.computations.records import PosedPhotograph, has_poses, matrices, matrix
from service.computations.structure_from_motion import ModelFile
from service.computations.structure_from_motion.compute import joint_pose_covariance
from service.compute.camera_model import CameraModel
from service.compute.hand_held import poses_by_spheres
from service.compute.markers.records import SphereOutline
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

_LEAST_SPHERES = 4


def register(context: JobContext[job.Arguments]) -> JobAnswer:
    """Compute T_world_scan for one source of poses. With robot poses, every station has its own base frame."""
    arguments, source = context.arguments, context.arguments.poses
    free = source == "spheres" and arguments.state_pose_errors
    refined = free or source == "robot_corrected"
    covariance_m2 = np.array(arguments.sphere_covariance_m2)
    spheres = ScanSpheres(np.array(arguments.spheres_m), arguments.radius_m, covariance_m2=covariance_m2)
    images = _posed_images(context)
    if free and not images.located:
        images = images.locatable(spheres)
    posed = images.posed(metric=source in (*job.ARM, "spheres", "hybrid"))
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


def _kept_pose_errors(context: JobContext[job.Arguments], images: _ImagesToRegister, joint: Array) -> ArtefactRef:
    """Store the joint covariance (6 N, 6 N) of T_scan_camera of the images that are placed, with their names."""
    placed = np.isfinite(np.diag(joint))
    placed[[6 * i + k for i in images.left_out for k in range(6)]] = False
    buffer = io.BytesIO()
    listed = json.dumps([name for name, stated in zip(images.names, placed[::6], strict=True) if stated])
    np.savez(buffer, names=np.array(listed), covariance=joint[np.ix_(placed, placed)])
    return context.keep_bytes(
        buffer.getvalue(),
        kind=job.POSE_ERRORS,
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


def _posed_images(context: JobContext[job.Arguments]) -> _ImagesToRegister:
    arguments = context.arguments
    images = arguments.images
    camera = camera_used(arguments)
    if arguments.poses == "spheres" and not has_poses(arguments, images):
        return _located_images(context, camera)
    if arguments.poses in (*job.ARM, "spheres"):
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


def _located_images(context: JobContext[job.Arguments], camera: CameraModel) -> _ImagesToRegister:
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
    context: JobContext[job.Arguments],
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
    left_out: job.LeaveOneOut | None


def _record(
    arguments: job.Arguments, images: _ImagesToRegister, answer: RegistrationResult, judged: _Judged
) -> job.Registration:
    placed, full = judged.placed, camera_reduced(arguments)
    record = job.Registration(
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
    if arguments.state_pose_errors and arguments.poses in job.ARM:
        sigma_m, sigma_rad = answer.pose_sigma
        record = record.model_copy(update={"pose_sigma_m": sigma_m, "pose_sigma_rad": sigma_rad})
    if placed.given is None:
        return record
    cameras, covariance = placed.given
    given = {"T_scan_camera_given": matrices(cameras), "covariance_given": matrix(covariance)}
    return record.model_copy(update=given)


def _with_contradictions(
    record: job.Registration, images: _ImagesToRegister, solved: PipelineResult
) -> job.Registration:
    """Return the record with what contradicts in the inputs."""
    beyond = solved.beyond
    found: dict[str, object] = {
        "findings": tuple(job.Contradiction(**asdict(one)) for one in solved.findings),
        "left_out": {images.names[i]: why for i, why in images.left_out.items()},
    }
    if beyond is not None:
        found["common_errors"] = tuple(job.CommonError(**asdict(one)) for one in beyond.errors)
        found["blur_px"] = beyond.blur_px
    return record.model_copy(update=found)


def _leave_one_out(answer: RegistrationResult, *, refined: bool) -> job.LeaveOneOut | None:
    """Return the errors of each sphere predicted from the others; None if a station sees too few spheres for it."""
    try:
        left_out = leave_one_out(answer, refined=refined)
    except ComputeError:
        return None
    return job.LeaveOneOut(
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
