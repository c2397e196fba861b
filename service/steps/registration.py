"""Step kind `registration`: T_world_scan from every image and marker, for each source of camera poses."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import field_validator

from service.compute.camera_model import CameraModel
from service.compute.resolution import camera_at
from service.core.model import Record
from service.steps.context import JobRequest, JobResult, StepContext, StepKind, StepOutcome
from service.steps.inputs import captured_images, hand_eye_of, intrinsics_covariance_of, result_of


class StructureFromMotion(Record):
    """How much effort structure from motion makes."""

    max_image_size: int = 3200
    max_features: int = 8000
    neighbours: int = 12  # pairs an image, chosen by the robot's poses


# "robot" is what the paper compares with: the arm's poses as reported. "robot_corrected" takes off what the hand-eye
# calibration found of the arm's errors, and what the spheres show of each pose's.
# "spheres" places each image of a hand-held camera by the spheres that it shows, before any registration.
Source = Literal["robot", "robot_corrected", "spheres", "colmap", "glomap", "hybrid"]


class Params(Record):
    """Which images, which scan, which camera poses."""

    images_of: tuple[str, ...]
    control_images_of: tuple[str, ...] = ()  # these see the control spheres and are kept for the evaluation too
    calibration: str  # step with the intrinsics
    hand_eye: str | None = None  # step with T_flange_camera; None: a person held the camera
    scan: str
    poses: tuple[Source, ...] = ("robot", "robot_corrected", "colmap", "glomap", "hybrid")
    structure_from_motion: StructureFromMotion = StructureFromMotion()
    detector: Literal["classical", "paper"] = "classical"  # "paper" searches every image whole, for comparison
    reduced: tuple[str, ...] = ()  # "1920x1080": lower resolutions, for the comparison that the paper makes
    reduced_poses: tuple[Literal["colmap", "glomap"], ...] = ("colmap",)

    @field_validator("reduced")
    @classmethod
    def _sizes(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for size in value:
            if not re.fullmatch(r"[1-9]\d*x[1-9]\d*", size):
                raise ValueError(f"a resolution reads 1920x1080, not {size!r}")
        return value


class Result(Record):
    """One registration for each source of poses and resolution, and the outlines at full resolution."""

    outlines_sha256: str
    registrations: dict[str, dict[str, Any]]


_MAPPERS = {"colmap": "incremental", "glomap": "global"}


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Detect spheres and reconstruct poses, then register each source; again at each reduced resolution."""
    images = captured_images(context, [*params.images_of, *params.control_images_of])
    camera = result_of(context, params.calibration)["camera"]
    scan = result_of(context, params.scan)
    shared = {
        "images": images,
        "camera": camera,
        **(
            {}
            if params.hand_eye is None
            else hand_eye_of(context, params.hand_eye, (image["station"] for image in images))
        ),
        "spheres_m": scan["spheres_m"],
        "sphere_covariance_m2": [sphere["covariance_m2"] for sphere in scan["details"]["spheres"]],
        "radius_m": context.protocol.spheres.radius_mm / 1000,
    }
    covariance = intrinsics_covariance_of(context, params.calibration)
    if covariance is not None:
        shared["intrinsics_covariance"] = covariance
    full = _at_one_resolution(context, params, shared, params.poses, None)
    answers = [full]
    for size in params.reduced:
        width, height = (int(n) for n in size.split("x"))
        reduced = camera_at(CameraModel.from_record(camera), width, height)
        arguments = {**shared, "camera": reduced.record(), "full_camera": camera}
        arguments.pop("intrinsics_covariance", None)  # it is of the full size
        prior = next(iter(full.by_poses.values())).result["T_scan_camera"]
        answers.append(_at_one_resolution(context, params, arguments, params.reduced_poses, prior))
    measures = dict(full.detected.measures)
    registrations: dict[str, dict[str, Any]] = {}
    for size, answer in zip(("", *params.reduced), answers, strict=True):
        for poses, registered in answer.by_poses.items():
            name = f"{poses}_{size}" if size else poses
            measures |= {f"{name}_{measure}": value for measure, value in registered.measures.items()}
            registrations[name] = dict(registered.result)
    result = Result(outlines_sha256=full.detected.artefacts[0].sha256, registrations=registrations)
    artefacts = tuple(ref for answer in answers for job in answer.jobs for ref in job.artefacts)
    return StepOutcome(measures, artefacts, result.model_dump(mode="json"))


@dataclass(frozen=True, slots=True)
class _Answers:
    """What the jobs of one resolution gave."""

    detected: JobResult
    reconstructed: tuple[JobResult, ...]
    by_poses: dict[str, JobResult]

    @property
    def jobs(self) -> tuple[JobResult, ...]:
        return (self.detected, *self.reconstructed, *self.by_poses.values())


def _at_one_resolution(
    context: StepContext,
    params: Params,
    shared: dict[str, Any],
    poses: Sequence[str],
    prior: dict[str, Any] | None,
) -> _Answers:
    run_jobs = context.evidence.run_jobs
    search: dict[str, Any] = {"detector": params.detector}
    if context.protocol.spheres.colour is not None:
        search["colour"] = context.protocol.spheres.colour
    (detected,) = run_jobs(JobRequest("detect_spheres", {**shared, **search}))
    markers = {**shared, "outlines": detected.artefacts[0].sha256}
    from_robot = {"robot": {**markers, "arm_correction": None}, "robot_corrected": markers, "spheres": markers}
    asked = [source for source in from_robot if source in poses]
    registered = run_jobs(*(JobRequest("register", {**from_robot[source], "poses": source}) for source in asked))
    by_poses = dict(zip(asked, registered, strict=True))
    wanted = [_MAPPERS[p] for p in poses if p in _MAPPERS]
    if "hybrid" in poses and not wanted:
        wanted = ["incremental"]
    if not wanted:
        return _Answers(detected, (), by_poses)
    if prior is None and by_poses:
        # Registered robot poses share one frame over both stations: they tell which images see the same thing.
        prior = by_poses[asked[-1]].result["T_scan_camera"]
    effort = params.structure_from_motion.model_dump()
    request = JobRequest("structure_from_motion", {**shared, "mappers": wanted, "effort": effort, "prior": prior})
    reconstructed = run_jobs(request)
    models = {ref.original_name.removesuffix(".json"): ref for ref in reconstructed[0].artefacts}
    sources = [p for p in poses if p in _MAPPERS]
    requests: list[JobRequest] = []
    for source in sources:
        mapper = _MAPPERS[source]
        model = {"model": models[mapper].sha256, "tracks": models[f"{mapper}_tracks.npz"].sha256}
        requests.append(JobRequest("register", {**markers, "poses": source, **model}))
    if "hybrid" in poses:
        # It starts from one reconstruction and adds the robot and the spheres.
        begun = {"model": models[wanted[0]].sha256, "tracks": models[f"{wanted[0]}_tracks.npz"].sha256}
        requests.append(JobRequest("hybrid", {**markers, **begun}))
    answers = run_jobs(*requests)
    by_poses |= dict(zip(sources, answers, strict=False))
    if "hybrid" in poses:
        adjusted = answers[-1]
        reconstructed += (adjusted,)
        model = {"poses": "hybrid", "model": adjusted.artefacts[0].sha256}
        (by_poses["hybrid"],) = run_jobs(JobRequest("register", {**markers, **model}))
    return _Answers(detected, reconstructed, by_poses)


KIND = StepKind("registration", Params, Result, execute)
