"""Step kind `registration`: T_world_scan from every image and marker, for each source of camera poses."""

from __future__ import annotations

from typing import Any, Literal

from service.core.model import Record
from service.steps.context import JobRequest, JobResult, StepContext, StepKind, StepOutcome
from service.steps.inputs import captured_images, hand_eye_of, result_of


class StructureFromMotion(Record):
    """How much effort structure from motion makes."""

    max_image_size: int = 3200
    max_features: int = 8000
    neighbours: int = 12  # pairs an image, chosen by the robot's poses


class Params(Record):
    """Which images, which scan, which camera poses."""

    images_of: tuple[str, ...]
    control_images_of: tuple[str, ...] = ()  # these see the control spheres and are kept for the evaluation too
    calibration: str  # step with the intrinsics
    hand_eye: str  # step with T_flange_camera
    scan: str
    poses: tuple[Literal["robot", "colmap", "glomap", "hybrid"], ...] = ("robot", "colmap", "glomap", "hybrid")
    structure_from_motion: StructureFromMotion = StructureFromMotion()


class Result(Record):
    """One registration for each source of poses, and the outlines that all of them share."""

    outlines_sha256: str
    registrations: dict[str, dict[str, Any]]


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Detect spheres and reconstruct poses, then register each source."""
    images = captured_images(context, [*params.images_of, *params.control_images_of])
    camera = result_of(context, params.calibration)["camera"]
    hand_eye = hand_eye_of(context, params.hand_eye, (image["station"] for image in images))
    shared = {"images": images, "camera": camera, **hand_eye}
    mappers = {"colmap": "incremental", "glomap": "global"}
    spheres = {
        "spheres_m": result_of(context, params.scan)["spheres_m"],
        "radius_m": context.protocol.spheres.radius_mm / 1000,
    }
    (detected,) = context.evidence.run_jobs(JobRequest("detect_spheres", {**shared, **spheres}))
    markers = {**shared, **spheres, "outlines": detected.artefacts[0].sha256}
    by_poses: dict[str, JobResult] = {}
    if "robot" in params.poses:
        (by_poses["robot"],) = context.evidence.run_jobs(JobRequest("register", {**markers, "poses": "robot"}))
    wanted = [mappers[p] for p in params.poses if p in mappers]
    if "hybrid" in params.poses and not wanted:
        wanted = ["incremental"]
    reconstructed: tuple[JobResult, ...] = ()
    if wanted:
        # Registered robot poses share one frame over both stations: they tell which images see the same thing.
        prior = by_poses["robot"].result["T_scan_camera"] if by_poses else None
        effort = params.structure_from_motion.model_dump()
        request = JobRequest("structure_from_motion", {**shared, "mappers": wanted, "effort": effort, "prior": prior})
        reconstructed = context.evidence.run_jobs(request)
        models = {ref.original_name.removesuffix(".json"): ref for ref in reconstructed[0].artefacts}
        sources = [p for p in params.poses if p in mappers]
        requests = [
            JobRequest("register", {**markers, "poses": p, "model": models[mappers[p]].sha256}) for p in sources
        ]
        if "hybrid" in params.poses:
            # It starts from one reconstruction and adds the robot and the spheres.
            begun = {"model": models[wanted[0]].sha256, "tracks": models[f"{wanted[0]}_tracks.npz"].sha256}
            requests.append(JobRequest("hybrid", {**markers, **begun}))
        answers = context.evidence.run_jobs(*requests)
        by_poses |= dict(zip(sources, answers, strict=False))
        if "hybrid" in params.poses:
            adjusted = answers[-1]
            reconstructed += (adjusted,)
            model = {"poses": "hybrid", "model": adjusted.artefacts[0].sha256}
            (by_poses["hybrid"],) = context.evidence.run_jobs(JobRequest("register", {**markers, **model}))
    measures = dict(detected.measures)
    for poses, answer in by_poses.items():
        measures |= {f"{poses}_{name}": value for name, value in answer.measures.items()}
    result = Result(
        outlines_sha256=detected.artefacts[0].sha256,
        registrations={poses: dict(answer.result) for poses, answer in by_poses.items()},
    )
    artefacts = tuple(ref for answer in (detected, *reconstructed, *by_poses.values()) for ref in answer.artefacts)
    return StepOutcome(measures, artefacts, result.model_dump(mode="json"))


KIND = StepKind("registration", Params, Result, execute)
