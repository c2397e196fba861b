"""Results of earlier steps as typed arguments of jobs, with the references that are recorded in their place."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from pydantic import BaseModel, ValidationError

from service.computations import calibrate, hand_board, hand_view
from service.computations.kind import JobKind, JobRecord
from service.computations.records import (
    ArmCorrection,
    FurtherArm,
    Matrix,
    Mounting,
    ParameterCovariance,
    PosedPhotograph,
    image_of,
)
from service.core.errors import ConfigurationError, IntegrityError
from service.core.jobs import Each, Reference, answered_by
from service.core.records.events import ArtefactRef, RecordedView, ViewHeld, ViewpointCaptured
from service.core.run.state import JobState
from service.core.text.words import counted
from service.steps.context import StepContext

R = TypeVar("R", bound=JobRecord)
M = TypeVar("M", bound=BaseModel)


@dataclass(frozen=True, slots=True)
class EarlierAnswer(Generic[R]):
    """The answer that became an earlier step's result, and the job that computed it."""

    answer: R
    job: JobState | None  # None: no job of this run computed it

    def reference(self, field: str) -> Reference | None:
        """Refer to a part of the answer (`details/spheres/*/covariance_m2`; "": all of it); None without a job."""
        path = f"result/{field}" if field else "result"
        return None if self.job is None else Reference(self.job.job, path)


def earlier_answer(context: StepContext, step_id: str, kind: JobKind[Any, R]) -> EarlierAnswer[R]:
    """Return the result of an earlier step, as the answer of a kind of job.

    Raises ConfigurationError if it is not one.
    """
    result = _result_of(context, step_id)
    try:
        answer = kind.read_answer(result)
    except IntegrityError as error:
        raise ConfigurationError(
            f"step {context.step.id!r} needs {kind.words} of step {step_id!r}, which has none",
            where=f"step {context.step.id}",
            remedy="Name a step in the protocol that computes it",
        ) from error
    return EarlierAnswer(answer, answered_by(context.run.steps[step_id]))


def _result_of(context: StepContext, step_id: str) -> Mapping[str, Any]:
    """Return the Result of an earlier step, as plain data; ConfigurationError if it has none."""
    state = context.run.steps.get(step_id)
    if state is None or not state.result:
        raise ConfigurationError(
            f"step {context.step.id!r} needs the result of step {step_id!r}, which has none",
            where=f"step {context.step.id}",
            remedy=f"Pass step {step_id!r} first, or correct the protocol",
        )
    return state.result


def earlier_result(context: StepContext, step_id: str, model: type[M]) -> M:
    """Return the Result of an earlier step of a known kind. Raises ConfigurationError if it has none, or another."""
    result = _result_of(context, step_id)
    try:
        return model.model_validate(result)
    except ValidationError as error:
        raise ConfigurationError(
            f"step {context.step.id!r} cannot use the result of step {step_id!r}, a step of another kind",
            where=f"step {context.step.id}",
            remedy="Correct the protocol",
        ) from error


def artefact_of(context: StepContext, step_id: str, kind: str) -> ArtefactRef:
    """Return the newest artefact of one kind that an earlier step produced."""
    state = context.run.steps.get(step_id)
    found = [ref for ref in (state.artefacts if state else ()) if ref.kind == kind]
    if not found:
        raise ConfigurationError(
            f"step {context.step.id!r} needs a {kind} of step {step_id!r}, which has none",
            where=f"step {context.step.id}",
            remedy=f"Pass step {step_id!r} first, or correct the protocol",
        )
    return found[-1]


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
            photograph = capture.artefacts[0]
            look = held.get(photograph.sha256)
            if isinstance(capture, ViewHeld) and (look is None or not look.used):
                continue
            images.append(_photograph(capture, step_id, look))
    if not images:
        raise ConfigurationError(
            f"no usable image from {', '.join(step_ids)}",
            where=f"step {context.step.id}",
            remedy="Take the images again",
        )
    return images


def raw_files(context: StepContext, images: Iterable[PosedPhotograph]) -> list[tuple[PosedPhotograph, str]]:
    """Return each photograph with the SHA-256 of its raw file.

    Raises:
        ConfigurationError: a photograph has none.
    """
    wanted = list(images)
    raws: dict[str, str] = {}
    for step_id in dict.fromkeys(image.step for image in wanted):
        for capture in context.evidence.captures(step_id):
            raw = raw_of(capture.artefacts)
            if raw is not None:
                raws[capture.artefacts[0].sha256] = raw
    missing = [image.viewpoint for image in wanted if image.sha256 not in raws]
    if missing:
        raise ConfigurationError(
            f"{counted(len(missing), 'image')} of {len(wanted)} without a raw file, the first is {missing[0]}",
            where=f"step {context.step.id}",
            remedy="Set `image_quality` of the camera to RAW+JPEG and take the images again, or `measure_on` to jpeg",
        )
    return [(image, raws[image.sha256]) for image in wanted]


def raw_of(files: Iterable[ArtefactRef]) -> str | None:
    """Return the SHA-256 of the raw file among the files of an exposure; None without one."""
    return next((ref.sha256 for ref in files if ref.kind == "raw"), None)


def _photograph(capture: RecordedView, step_id: str, look: hand_view.Answer | None) -> PosedPhotograph:
    image = PosedPhotograph(
        name=f"{capture.viewpoint}.jpg",
        step=step_id,
        viewpoint=capture.viewpoint,
        station=capture.station,
        sha256=capture.artefacts[0].sha256,
    )
    by_robot = with_robot_pose(image, capture)
    if look is None or look.T_scene_camera is None:
        return by_robot
    return by_robot.model_copy(update={"T_scene_camera": look.T_scene_camera})


def with_robot_pose(photograph: PosedPhotograph, view: RecordedView) -> PosedPhotograph:
    """Add the robot's pose to a photograph; return it unchanged if no robot held the camera."""
    if isinstance(view, ViewpointCaptured):
        return photograph.model_copy(update={"T_base_flange": view.T_base_flange, "joints_rad": view.joints_rad})
    return photograph


def held_views(context: StepContext, step_id: str) -> dict[str, hand_view.Answer]:
    """Return the worker's findings in the hand-held images of a step, by the SHA-256 of the photograph.

    Without a CT, each new image refines the poses of all: the newest ones are used.
    """
    names = (hand_view.KIND.name, hand_board.KIND.name)
    done = [j for j in context.evidence.jobs(step_id) if j.kind in names and j.status == "finished"]
    looks = {image_of(job).sha256: hand_view.KIND.read_answer(job.result) for job in done}
    refined = hand_view.KIND.read_answer(done[-1].result).T_scene_cameras if done else {}
    return {
        sha256: look
        if look.viewpoint not in refined
        else look.model_copy(update={"T_scene_camera": refined[look.viewpoint]})
        for sha256, look in looks.items()
    }


class _CarriedBy(BaseModel):
    """The part of a calibration step's Result that no job computes: the robots that carried the camera."""

    robots: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class CameraMounting:
    """The camera's mounting on the arm, and the references that are recorded in its place."""

    mounting: Mounting
    references: Mapping[str, Reference | Each | None]


def mounting_of(context: StepContext, step_ids: Sequence[str], stations: Iterable[str]) -> CameraMounting:
    """Return what turns robot poses into camera poses (service/computations/inputs.py), with the references to it.

    A correction belongs to one arm: it is given with the stations at which that arm stood.

    Args:
        context: the step's surroundings: devices, evidence, clock.
        step_ids: the hand-eye calibrations; those after the first are of further arms.
        stations: the stations at which the images were taken.
    """
    first, *further = step_ids
    at = sorted(set(stations))
    arm = _arm_of(context, first, at)
    mounting, references = Mounting(T_flange_camera=arm.T_flange_camera, arm_correction=None), arm.references()
    if arm.correction is not None:
        mounting = mounting.model_copy(update={"arm_correction": arm.correction, "arm_stations": arm.stations})
    others = [_arm_of(context, step_id, at) for step_id in further]
    if others:
        mounting = mounting.model_copy(update={"further_arms": tuple(other.further() for other in others)})
        for index, other in enumerate(others):
            references |= other.references(f"further_arms/{index}/")
    return CameraMounting(mounting, references)


def arms_without_hand_eye(context: StepContext, step_ids: Sequence[str], stations: Iterable[str]) -> list[str]:
    """Return the names of the robots that carried the camera at these stations, and in none of these calibrations."""
    known = {robot for step_id in step_ids for robot in earlier_result(context, step_id, _CarriedBy).robots}
    return sorted({context.devices.layout(station).robot for station in stations if station} - known)


@dataclass(frozen=True, slots=True)
class _CalibratedArm:
    """One arm's hand-eye calibration, and the stations at which this arm stood."""

    found: EarlierAnswer[calibrate.Answer]
    T_flange_camera: Matrix
    correction: ArmCorrection | None
    stations: tuple[str, ...]

    def further(self) -> FurtherArm:
        return FurtherArm(
            T_flange_camera=self.T_flange_camera, arm_correction=self.correction, stations=self.stations
        )

    def references(self, at: str = "") -> dict[str, Reference | None]:
        named = {"T_flange_camera": "T_flange_camera"}
        if self.correction is not None:
            named |= {"arm_correction": "hand_eye/arm_correction"}
        return {f"{at}{field}": self.found.reference(part) for field, part in named.items()}


def _arm_of(context: StepContext, step_id: str, stations: Sequence[str]) -> _CalibratedArm:
    found = earlier_answer(context, step_id, calibrate.KIND)
    if found.answer.T_flange_camera is None:
        raise ConfigurationError(
            f"step {step_id!r} has no hand-eye calibration",
            where=f"step {context.step.id}, hand_eye",
            remedy="Name the step that solves hand_eye",
        )
    answer = None if found.answer.hand_eye is None else found.answer.hand_eye.arm_correction
    correction = None if answer is None else ArmCorrection.model_validate(answer.plain())
    robots = set(earlier_result(context, step_id, _CarriedBy).robots)
    mine = tuple(station for station in stations if context.devices.layout(station).robot in robots)
    return _CalibratedArm(found, found.answer.T_flange_camera, correction, mine)


def intrinsics_covariance_of(found: EarlierAnswer[calibrate.Answer]) -> ParameterCovariance | None:
    """Return the covariance of a calibration's intrinsics, with the parameters' names; None if not computed."""
    record = found.answer.details.intrinsics
    return None if record is None else record.covariance
