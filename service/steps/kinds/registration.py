"""Step kind `registration`: T_world_scan from every image and marker, for each source of camera poses.

The step waits for the sources that its gates and those of the evaluation name, and for the robot's poses, which take
seconds. The others are computed while the run goes on (service/steps/registration_jobs.py).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, field_validator

from service.computations import calibrate, detect_spheres, further_camera, locate_spheres, register, term
from service.computations.records import Mounting, PosedPhotograph
from service.computations.register import Registration
from service.core.errors import ComputeError, ConfigurationError
from service.core.jobs import arguments_name
from service.core.protocol.step_params import NAMES_CALIBRATION, NAMES_CAPTURE, NAMES_SCAN, RepeatedStep, StepParams
from service.core.records.events import ComputedBy, Record
from service.core.units import metres
from service.steps.context import JobRequest, JobResult, StepContext, StepKind, StepOutcome
from service.steps.further_cameras import ExposureFiles, developed, locate_further_cameras
from service.steps.inputs import (
    CameraMounting,
    arms_without_hand_eye,
    captured_images,
    earlier_answer,
    intrinsics_covariance_of,
    mounting_of,
    raw_files,
)
from service.steps.measures import Count, ErrorMm, Measure, MeasureRecord, Px, Ratio, RegistrationMeasures
from service.steps.registration_jobs import RegistrationJobs, registration_jobs
from service.steps.registration_sources import (
    DEFAULT_SOURCES,
    PLANNED,
    Source,
    WantedRegistrations,
    decisive,
    needing_mount,
    of_arms,
    posed,
)


class StructureFromMotion(Record):
    """The effort of structure from motion: more features and pairs take longer."""

    max_image_size: int = 3200  # features are searched in images reduced to this longer side, px
    max_features: int = 8000  # features per image
    neighbours: int = 12  # images that each image is matched with, chosen by the robot's poses


class Params(StepParams):
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
    poses: tuple[Source, ...] = DEFAULT_SOURCES  # the sources of the camera poses; each gives a registration
    structure_from_motion: StructureFromMotion = StructureFromMotion()  # sizes and numbers of features
    # The others search every image whole: "paper" is the published method without its networks, "grounded" has
    # Grounding DINO and SAM 2, and in "vote" it and the classical one must agree.
    detector: detect_spheres.DetectorName = "classical"
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


class OneRegistration(MeasureRecord):
    """The measures of one registration."""

    rms_px: Annotated[Px, "rms distance of the outlines' points from the predicted outlines"] = None
    chi2_reduced: Annotated[
        Ratio, "chi-squared per degree of freedom: near 1 if the stated covariances are right"
    ] = None
    markers: Annotated[Count, "spheres that take part"] = None
    images: Annotated[Count, "images that take part"] = None
    excluded_outlines: Annotated[Count, "outlines left out as outliers"] = None
    images_left_out: Annotated[Count, "images left out because they contradict the others"] = None
    contradictions: Annotated[Count, "contradictions between the inputs that somebody has to look at"] = None
    predicted_error_mm: Annotated[ErrorMm, "predicted error at the centre of the spheres"] = None
    leave_one_out_mm: Annotated[ErrorMm, "mean radial error of each registration sphere as the others predict it"] = (
        None
    )


_CONSISTENCY = ("consistency_mm", "consistency_mrad")  # measures of the job that locates a further camera


class Measures(RegistrationMeasures[OneRegistration]):
    """The measures of the outlines, and of every registration."""

    outlines: Annotated[Count, "outlines of spheres found in all images"] = None
    outlines_an_image: Annotated[Count, "outlines found in an image, on average"] = None
    images_searched_whole: Annotated[Count, "images that were searched whole because no pose said where to look"] = (
        None
    )
    outlines_not_in_raw: Annotated[Count, "outlines of the JPEGs that the developed raw files do not show"] = None
    further_views: Annotated[Count, "images that locate a further camera, for the one that has fewest"] = None
    further_excluded: Annotated[
        Count, "images of further cameras without four spheres, or that contradict the rest"
    ] = None
    further_consistency_mm: Annotated[
        ErrorMm, "rms distance between the poses of a further camera by single images and by all, for the worst one"
    ] = None
    further_consistency_mrad: Annotated[
        float | None,
        Measure("mrad", 1e-3, 100),
        "rms angle between the poses of a further camera by single images and by all, for the worst one",
    ] = None


class Result(Record):
    """The registrations that the step was judged by, by source and resolution; the outlines at full size."""

    outlines_sha256: str
    registrations: dict[str, Registration]
    cameras: dict[str, further_camera.Answer] = Field(
        default_factory=dict[str, further_camera.Answer]
    )  # further ones


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Detect the spheres, and register every source that the step waits for; the others are enqueued as well."""
    waited = decisive(context.protocol, context.step)
    outlines = _search(context, params)
    root = arguments_name(outlines.arguments)
    later = [name for name in WantedRegistrations.of(params).registrations if name not in waited]
    context.note(PLANNED, decisive=list(waited), later=later)
    seen = -1
    while True:
        context.checkpoint()
        state = context.evidence.state()
        if state.seq == seen:
            context.wait(0.2)
            continue
        seen = state.seq
        found = registration_jobs(state, context.step, waited, outlines, root)
        for name in waited:
            if name in found.failed:
                raise ComputeError(
                    f"no registration with {name} poses: {found.failed[name]}",
                    where=context.step.id,
                    remedy="Correct what the message names, or take the missing images; then try again",
                )
        context.progress(_words(found), len(found.arrived.keys() & set(waited)), len(waited))
        if all(name in found.arrived for name in waited):
            outcome = _outcome(found)
            _tell_findings(context, outcome)
            return _with_further_cameras(
                outcome,
                locate_further_cameras(
                    context, params.images_of, outlines, found.arrived, on_raw=params.measure_on == "raw"
                ),
            )
        for task in found.due:
            context.evidence.enqueue(task.request, task.name)


def _search(context: StepContext, params: Params) -> JobRequest:
    """Return the search for outlines; the jobs after it share most of its arguments."""
    images = captured_images(context, [*params.images_of, *params.control_images_of])
    if not posed(images) and not set(params.poses) <= {"colmap", "glomap"}:
        raise ConfigurationError(
            "no image has a pose, but the registration asks for poses that do not come from the images alone",
            where=f"step {context.step.id}",
            remedy="Set `poses` of the step to colmap and glomap",
        )
    if params.hand_eye is None and of_arms(images) and (unknown := needing_mount(params.poses)):
        raise ConfigurationError(
            f"an arm carried the camera, but no `hand_eye` says how, which {' and '.join(unknown)} poses need",
            where=f"step {context.step.id}",
            remedy="Set `hand_eye` of the step to the calibration, or `poses` to spheres, colmap or glomap",
        )
    scan = earlier_answer(context, params.scan, locate_spheres.KIND)
    calibration = earlier_answer(context, params.calibration, calibrate.KIND)
    mounted = _mounting(context, params, images)
    lens = intrinsics_covariance_of(calibration)
    known: dict[str, Any] = {} if lens is None else {"intrinsics_covariance": lens}
    if context.protocol.spheres.colour is not None:
        known["colour"] = context.protocol.spheres.colour
    arguments = detect_spheres.Arguments(
        images=tuple(images),
        camera=calibration.answer.camera,
        spheres_m=scan.answer.spheres_m,
        sphere_covariance_m2=tuple(sphere.covariance_m2 for sphere in scan.answer.details.spheres),
        radius_m=metres(context.protocol.spheres.radius_mm),
        detector=params.detector,
    ).model_copy(update={**mounted.mounting.set_fields(), **known})
    if params.measure_on == "raw":
        taken = [ExposureFiles(image.viewpoint, image.sha256, raw) for image, raw in raw_files(context, images)]
        arguments = arguments.model_copy(update={"developed": developed(context, taken)})
    references = {
        **mounted.references,
        "camera": calibration.reference("camera"),
        "spheres_m": scan.reference("spheres_m"),
        "sphere_covariance_m2": scan.reference("details/spheres/*/covariance_m2"),
    }
    if lens is not None:
        references["intrinsics_covariance"] = calibration.reference("details/intrinsics/covariance")
    return JobRequest.of(detect_spheres.KIND, arguments, references)


def _mounting(context: StepContext, params: Params, images: list[PosedPhotograph]) -> CameraMounting:
    """Return how the camera was mounted on the arm; empty where a person held it."""
    steps = (params.hand_eye,) if isinstance(params.hand_eye, str) else params.hand_eye or ()
    if not steps:
        return CameraMounting(Mounting(), {})
    stations = [image.station for image in images]
    strange = arms_without_hand_eye(context, steps, stations)
    if strange:
        names = " and ".join(strange)
        context.tell(
            f"No hand-eye calibration was taken with {names}: its camera poses are computed with the mount of "
            "another arm, without its correction. Add a calibration at its station, and name both steps in hand_eye"
        )
        context.note("hand_eye_of_another_arm", robots=strange)
    return mounting_of(context, steps, stations)


def _words(found: RegistrationJobs) -> str:
    working = [task.request.kind for task in found.tasks if task.job and task.job.status == "enqueued"]
    return ", ".join(map(term, dict.fromkeys(working))) or "registration"


def _outcome(found: RegistrationJobs) -> StepOutcome:
    """Return the registrations so far, including any that arrived although the step did not wait for them."""
    done = [(task, task.job) for task in found.tasks if task.job is not None and task.job.status == "finished"]
    outlines = next(job for task, job in done if task.request.kind == detect_spheres.KIND.name)
    registrations = {name: OneRegistration.read(job.measures) for name, job in found.arrived.items()}
    measures = Measures.read(outlines.measures).model_copy(update={"registrations": registrations})
    result = Result(
        outlines_sha256=outlines.artefacts[0].sha256,
        registrations={name: register.KIND.read_answer(job.result) for name, job in found.arrived.items()},
    )
    artefacts = tuple(ref for _, job in done for ref in job.artefacts)
    sources = (ComputedBy(job=job.job, prefix=f"{name}_") for name, job in found.arrived.items())
    return StepOutcome(measures, artefacts, result, computed_by=(ComputedBy(job=outlines.job), *sources))


def _tell_findings(context: StepContext, outcome: StepOutcome) -> None:
    """Report what contradicts in the inputs, once for registrations that show the same."""
    assert isinstance(outcome.result, Result)
    shown: dict[str, list[str]] = {}
    for name, record in outcome.result.registrations.items():
        for one in record.findings:
            shown.setdefault(one.text, []).append(name)
    for text, names in shown.items():
        context.tell(f"{', '.join(names)}: {text}")


def _with_further_cameras(outcome: StepOutcome, located: Mapping[str, JobResult]) -> StepOutcome:
    """Return the outcome with the poses of the further cameras, and the measures of the worst of them."""
    if not located:
        return outcome
    measured = [job.measures for job in located.values()]
    off = {f"further_{name}": [m[name] for m in measured if name in m] for name in _CONSISTENCY}
    worst = {name: max(values) for name, values in off.items() if values}
    worst |= {
        "further_views": min(m["views"] for m in measured),
        "further_excluded": sum(m["excluded"] for m in measured),
    }
    cameras = {name: further_camera.KIND.read_answer(job.result) for name, job in located.items()}
    assert isinstance(outcome.result, Result)
    return replace(
        outcome,
        measures=outcome.measures.model_copy(update=worst),
        artefacts=(*outcome.artefacts, *(ref for job in located.values() for ref in job.artefacts)),
        result=outcome.result.model_copy(update={"cameras": cameras}),
    )


KIND = StepKind(
    "registration",
    Params,
    Measures,
    Result,
    execute,
)
