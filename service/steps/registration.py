"""What a registration is computed from: its parameters, the images with their poses, the camera, its mount, the scan.

Read from top to bottom: the registrations that a step asks for and waits for, then where each argument of its first
job, the search for spheres, comes from. The jobs that follow are in service/steps/registration_jobs.py.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Annotated, ClassVar, Literal

from pydantic import BaseModel, field_validator

from service.computations.calibration import CALIBRATE
from service.computations.further_cameras import DEVELOP, DevelopArguments
from service.computations.hand_held import HAND_BOARD, HAND_VIEW, HandViewAnswer
from service.computations.image_poses import SfmEffort
from service.computations.records import ArmCorrection, FurtherArm, Mounting, PosedPhotograph, image_of
from service.computations.registration import ARM, DETECT_SPHERES, DetectorName, DetectSpheresArguments
from service.computations.scans import LOCATE_SPHERES
from service.compute.photography import PARAMETERS
from service.core.errors import ConfigurationError
from service.core.jobs import Each, Reference
from service.core.protocol import Protocol, Step
from service.core.records.base import ArtefactRef, Record
from service.core.records.run_events import RecordedView, ViewHeld, ViewpointCaptured
from service.core.step_params import NAMES_CALIBRATION, NAMES_CAPTURE, NAMES_SCAN, RepeatedStep, StepParams
from service.core.units import metres
from service.core.words import counted
from service.steps.context import JobRequest, StepContext

References = dict[str, Reference | Each | None]  # what is recorded in the place of a job's arguments, by field

# --- the registrations of a step -----------------------------------------------------------------------------------

# "robot" is the paper's baseline: the arm's poses as reported. "robot_corrected" removes the arm's errors as the
# hand-eye calibration estimated them, and each pose's error as the spheres show it. "spheres" locates each image of a
# hand-held camera, or of one whose mount on its arm is unknown, by the spheres that it shows. "triangulated" is a
# bundle adjustment of the images' features that starts from the corrected robot poses; COLMAP and GLOMAP start
# without any poses.
Source = Literal["robot", "robot_corrected", "spheres", "triangulated", "colmap", "glomap", "hybrid"]
PLANNED = "sources_planned"  # the note with which a registration records what it waits for and what comes later
QUICK = (*ARM, "spheres")  # computed in seconds, from the outlines alone

_BY_PREFERENCE = ("robot_corrected", "robot", "spheres", "triangulated", "colmap", "glomap", "hybrid")


class StructureFromMotion(Record):
    """The effort of structure from motion: more features and pairs take longer."""

    max_image_size: int = 3200  # features are searched in images reduced to this longer side, px
    max_features: int = 8000  # features per image
    neighbours: int = 12  # images that each image is matched with, chosen by the robot's poses

    @property
    def effort(self) -> SfmEffort:
        """The same as an argument of jobs."""
        return SfmEffort(**self.model_dump())


class RegistrationParams(StepParams):
    """The images, the scan and the camera poses of the registrations."""

    gives: ClassVar = "registrations"
    repeated: ClassVar = RepeatedStep(
        "Compute it again; the same images give the same figures", same=True, device=False
    )

    images_of: Annotated[tuple[str, ...], NAMES_CAPTURE]  # capture steps with the images
    # Capture steps that see the control spheres, for the evaluation too.
    control_images_of: Annotated[tuple[str, ...], NAMES_CAPTURE] = ()
    calibration: Annotated[str, NAMES_CALIBRATION]  # step with the intrinsics
    # Step with T_flange_camera, or a list of steps with one for each arm; None: no robot carried the camera, or the
    # poses need no mount (spheres, colmap, glomap).
    hand_eye: Annotated[str | tuple[str, ...] | None, NAMES_CALIBRATION] = None
    scan: Annotated[str, NAMES_SCAN]  # step that imported the scan
    # The sources of the camera poses; each gives a registration.
    poses: tuple[Source, ...] = ("robot", "robot_corrected", "triangulated", "colmap", "glomap", "hybrid")
    structure_from_motion: StructureFromMotion = StructureFromMotion()  # sizes and numbers of features
    # The others search every image whole: "paper" is the published method without its networks, "grounded" has
    # Grounding DINO and SAM 2, and in "vote" it and the classical one must agree.
    detector: DetectorName = "classical"
    # Where outlines are measured once they are found. "raw" develops the raw file of each image first, which needs
    # the extra `raw` on the worker, and RAW+JPEG as the camera's `image_quality`. Further cameras that write no raw
    # files are measured in their JPEGs.
    measure_on: Literal["jpeg", "raw"] = "jpeg"
    reduced: tuple[str, ...] = ()  # such as 1920x1080: lower resolutions, for the paper's comparison
    reduced_poses: tuple[Literal["colmap", "glomap"], ...] = ("colmap",)  # sources of poses for the reduced images

    @field_validator("reduced")
    @classmethod
    def _sizes(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for size in value:
            if not re.fullmatch(r"[1-9]\d*x[1-9]\d*", size):
                raise ValueError(f"a resolution is written like 1920x1080, not {size!r}")
        return value

    @property
    def captures(self) -> tuple[str, ...]:
        """All capture steps whose images are used."""
        return (*self.images_of, *self.control_images_of)

    @property
    def hand_eyes(self) -> tuple[str, ...]:
        """The steps with the mount of the camera on each arm; none where the poses need no mount."""
        return (self.hand_eye,) if isinstance(self.hand_eye, str) else self.hand_eye or ()

    @property
    def registrations(self) -> dict[str, tuple[str, str]]:
        """Source and size ("" for the full one) of every registration, by its name."""
        full: dict[str, tuple[str, str]] = {source: (source, "") for source in self.poses}
        return full | {f"{p}_{size}": (p, size) for size in self.reduced for p in self.reduced_poses}


def decisive(protocol: Protocol, step: Step) -> tuple[str, ...]:
    """Return the registrations that a step waits for: those that gates name, and those that take seconds."""
    names = step.params_as(RegistrationParams).registrations
    measures = [gate.measure for s in (step, *evaluations_of(protocol, step)) for gate in s.gates]
    waited = {name for measure in measures for name in _named(measure, names)} | {n for n in names if n in QUICK}
    if not waited:
        waited = {most_preferred(names)}
    return tuple(name for name in names if name in waited)


def _named(measure: str, names: Iterable[str]) -> list[str]:
    """Return the longest name that a measure begins with: `robot_corrected_rms_px` does not belong to `robot`."""
    found = sorted((name for name in names if measure.startswith(f"{name}_")), key=len)
    return found[-1:]


def most_preferred(registrations: Iterable[str]) -> str:
    """Return the one of several registrations to build on; with corrected poses of the arm if there is one."""
    names = tuple(registrations)
    return next((name for name in _BY_PREFERENCE if name in names), names[0])


class _EvaluationParams(BaseModel):
    """The parameter of an evaluation step that names what it evaluates."""

    registration: str


def evaluated_step(evaluation: Step) -> str:
    """Return the registration step that an evaluation step evaluates."""
    return _EvaluationParams.model_validate(evaluation.params.model_dump()).registration


def evaluations_of(protocol: Protocol, registration: Step) -> tuple[Step, ...]:
    """Return the evaluation steps of a registration step."""
    every = (step for step in protocol.steps if step.gives == "accuracy")
    return tuple(step for step in every if evaluated_step(step) == registration.id)


def needing_mount(poses: Iterable[str]) -> tuple[str, ...]:
    """Return the sources that need the camera's mount on its arm; "triangulated" may start from the spheres."""
    names = tuple(poses)
    needing = ARM if "spheres" in names else (*ARM, "triangulated")
    return tuple(name for name in names if name in needing)


# --- the search for spheres: its arguments and where each comes from -----------------------------------------------


def search_for_spheres(context: StepContext, params: RegistrationParams) -> JobRequest:
    """Return the search for outlines; the jobs after it share most of its arguments.

    Raises:
        ConfigurationError: an earlier step did not give what the search needs, or the images do not suit the sources.
    """
    images = captured_images(context, params.captures)
    if not posed(images) and not set(params.poses) <= {"colmap", "glomap"}:
        raise ConfigurationError(
            "no image has a pose, but the registration asks for poses that do not come from the images alone",
            where=f"step {context.step.id}",
            remedy="Set `poses` of the step to colmap and glomap",
        )
    by_arm = any(image.T_base_flange is not None and image.T_scene_camera is None for image in images)
    if params.hand_eye is None and by_arm and (unknown := needing_mount(params.poses)):
        raise ConfigurationError(
            f"an arm carried the camera, but no `hand_eye` says how, which {' and '.join(unknown)} poses need",
            where=f"step {context.step.id}",
            remedy="Set `hand_eye` of the step to the calibration, or `poses` to spheres, colmap or glomap",
        )
    scan = context.earlier_answer(params.scan, LOCATE_SPHERES)
    calibration = context.earlier_answer(params.calibration, CALIBRATE)
    mounting, references = _mounting(context, params, images)
    references |= {
        "camera": calibration.reference("camera"),
        "spheres_m": scan.reference("spheres_m"),
        "sphere_covariance_m2": scan.reference("details/spheres/*/covariance_m2"),
    }
    known = mounting.set_fields()  # a field that is not set is not recorded
    if calibration.answer.intrinsics_covariance is not None:
        known["intrinsics_covariance"] = calibration.answer.intrinsics_covariance
        references["intrinsics_covariance"] = calibration.reference("details/intrinsics/covariance")
    if context.protocol.spheres.colour is not None:
        known["colour"] = context.protocol.spheres.colour
    if params.measure_on == "raw":
        known["developed"] = developed(context, _exposures(context, images))
    arguments = DetectSpheresArguments(
        images=tuple(images),
        camera=calibration.answer.camera,
        spheres_m=scan.answer.spheres_m,
        sphere_covariance_m2=tuple(sphere.covariance_m2 for sphere in scan.answer.details.spheres),
        radius_m=metres(context.protocol.spheres.radius_mm),
        detector=params.detector,
        **known,
    )
    return JobRequest.of(DETECT_SPHERES, arguments, references)


def posed(images: Iterable[PosedPhotograph]) -> bool:
    """Return whether the pose of any of the images is known, from a robot or from the spheres."""
    return any(image.T_base_flange is not None or image.T_scene_camera is not None for image in images)


# --- the images and their poses ------------------------------------------------------------------------------------


def captured_images(context: StepContext, step_ids: Iterable[str]) -> list[PosedPhotograph]:
    """Return every valid photograph of the given capture steps with its pose, in the order of capture.

    They are read from the evidence, because the context's state does not have the events since the step began, such
    as the step's own images.
    """
    images: list[PosedPhotograph] = []
    for step_id in step_ids:
        held = held_views(context, step_id)
        for capture in context.evidence.captures(step_id):
            if not all(capture.verdicts.values()):
                continue
            look = held.get(capture.artefacts[0].sha256)
            if isinstance(capture, ViewHeld) and (look is None or not look.used):
                continue
            image = PosedPhotograph(
                name=f"{capture.viewpoint}.jpg",
                step=step_id,
                viewpoint=capture.viewpoint,
                station=capture.station,
                sha256=capture.artefacts[0].sha256,
            )
            image = with_robot_pose(image, capture)
            if look is not None and look.T_scene_camera is not None:
                image = image.model_copy(update={"T_scene_camera": look.T_scene_camera})
            images.append(image)
    if not images:
        raise ConfigurationError(
            f"no usable image from {', '.join(step_ids)}",
            where=f"step {context.step.id}",
            remedy="Take the images again",
        )
    return images


def with_robot_pose(photograph: PosedPhotograph, view: RecordedView) -> PosedPhotograph:
    """Add the robot's pose to a photograph; return it unchanged if no robot held the camera."""
    if isinstance(view, ViewpointCaptured):
        return photograph.model_copy(update={"T_base_flange": view.T_base_flange, "joints_rad": view.joints_rad})
    return photograph


def held_views(context: StepContext, step_id: str) -> dict[str, HandViewAnswer]:
    """Return the worker's findings in the hand-held images of a step, by the SHA-256 of the photograph.

    Without a CT, each new image refines the poses of all: the newest ones are used.
    """
    names = (HAND_VIEW.name, HAND_BOARD.name)
    done = [j for j in context.evidence.jobs(step_id) if j.kind in names and j.status == "finished"]
    looks = {image_of(job).sha256: HAND_VIEW.read_answer(job.result) for job in done}
    refined = HAND_VIEW.read_answer(done[-1].result).T_scene_cameras if done else {}
    return {
        sha256: look
        if look.viewpoint not in refined
        else look.model_copy(update={"T_scene_camera": refined[look.viewpoint]})
        for sha256, look in looks.items()
    }


# --- the camera's mount on the arm ---------------------------------------------------------------------------------


class _CarriedBy(BaseModel):
    """The part of a calibration step's Result that no job computes: the robots that carried the camera."""

    robots: tuple[str, ...]


def _mounting(
    context: StepContext, params: RegistrationParams, images: Sequence[PosedPhotograph]
) -> tuple[Mounting, References]:
    """Return how the camera was mounted on the arm; empty where a person held it."""
    if not params.hand_eyes:
        return Mounting(), {}
    stations = {image.station for image in images}
    known = {r for step_id in params.hand_eyes for r in context.earlier_result(step_id, _CarriedBy).robots}
    strange = sorted({context.devices.layout(station).robot for station in stations if station} - known)
    if strange:
        context.tell(
            f"No hand-eye calibration was taken with {' and '.join(strange)}: its camera poses are computed with the "
            "mount of another arm, without its correction. Add a calibration at its station, and name both steps in "
            "hand_eye"
        )
        context.note("hand_eye_of_another_arm", robots=strange)
    return mounting_of(context, params.hand_eyes, stations)


def mounting_of(
    context: StepContext, step_ids: Sequence[str], stations: Iterable[str]
) -> tuple[Mounting, References]:
    """Return what turns robot poses into camera poses (service/computations/inputs.py), with the references to it.

    A correction belongs to one arm: it is given with the stations at which that arm stood.

    Args:
        context: the step's surroundings: devices, evidence, clock.
        step_ids: the hand-eye calibrations; those after the first are of further arms.
        stations: the stations at which the images were taken.
    """
    at = sorted(set(stations))
    (arm, references), *others = (_calibrated_arm(context, step_id, at) for step_id in step_ids)
    mounting = Mounting(T_flange_camera=arm.T_flange_camera, arm_correction=arm.arm_correction)
    if arm.arm_correction is not None:
        mounting = mounting.model_copy(update={"arm_stations": arm.stations})
    if others:
        mounting = mounting.model_copy(update={"further_arms": tuple(other for other, _ in others)})
    for index, (_, more) in enumerate(others):
        references |= {f"further_arms/{index}/{field}": reference for field, reference in more.items()}
    return mounting, references


def _calibrated_arm(context: StepContext, step_id: str, stations: Sequence[str]) -> tuple[FurtherArm, References]:
    """Return one arm's hand-eye calibration with the stations at which it stood, and the references to it."""
    found = context.earlier_answer(step_id, CALIBRATE)
    if found.answer.T_flange_camera is None:
        raise ConfigurationError(
            f"step {step_id!r} has no hand-eye calibration",
            where=f"step {context.step.id}, hand_eye",
            remedy="Name the step that solves hand_eye",
        )
    answer = None if found.answer.hand_eye is None else found.answer.hand_eye.arm_correction
    robots = context.earlier_result(step_id, _CarriedBy).robots
    arm = FurtherArm(
        T_flange_camera=found.answer.T_flange_camera,
        arm_correction=None if answer is None else ArmCorrection.model_validate(answer.plain()),
        stations=tuple(station for station in stations if context.devices.layout(station).robot in robots),
    )
    references: References = {"T_flange_camera": found.reference("T_flange_camera")}
    if answer is not None:
        references["arm_correction"] = found.reference("hand_eye/arm_correction")
    return arm, references


# --- developed raw files -------------------------------------------------------------------------------------------


def developed(context: StepContext, exposures: Sequence[DevelopArguments]) -> dict[str, str]:
    """Let the worker develop the raw file of each exposure of one camera; return the files by viewpoint."""
    results = context.evidence.run_jobs(*(JobRequest.of(DEVELOP, exposure) for exposure in exposures))
    return {one.viewpoint: result.artefacts[0].sha256 for one, result in zip(exposures, results, strict=True)}


def exposure_of(viewpoint: str, files: Sequence[ArtefactRef]) -> DevelopArguments | None:
    """Return how to develop the raw file among the files of an exposure; None without one."""
    raw = next((ref.sha256 for ref in files if ref.kind == "raw"), None)
    if raw is None:
        return None
    return DevelopArguments(viewpoint=viewpoint, raw=raw, jpeg=files[0].sha256, parameters=PARAMETERS)


def _exposures(context: StepContext, images: Sequence[PosedPhotograph]) -> list[DevelopArguments]:
    """Return how to develop the raw file of each photograph.

    Raises:
        ConfigurationError: a photograph has none.
    """
    steps = dict.fromkeys(image.step for image in images)
    captures = [capture for step_id in steps for capture in context.evidence.captures(step_id)]
    found = [exposure_of(capture.viewpoint, capture.artefacts) for capture in captures]
    by_jpeg = {exposure.jpeg: exposure for exposure in found if exposure is not None}
    missing = [image.viewpoint for image in images if image.sha256 not in by_jpeg]
    if missing:
        raise ConfigurationError(
            f"{counted(len(missing), 'image')} of {len(images)} without a raw file, the first is {missing[0]}",
            where=f"step {context.step.id}",
            remedy="Set `image_quality` of the camera to RAW+JPEG and take the images again, or `measure_on` to jpeg",
        )
    return [by_jpeg[image.sha256] for image in images]
