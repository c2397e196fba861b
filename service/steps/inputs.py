"""What earlier steps left behind, as typed arguments of jobs, with the references that are recorded."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from service.core.errors import ConfigurationError, IntegrityError
from service.core.jobs.references import Each, Reference
from service.core.records.events import ArtefactRef, View, ViewHeld, ViewpointCaptured
from service.core.run.state import JobState, StepState
from service.jobs.calibration import calibrate
from service.jobs.capture import hand_board, hand_view
from service.jobs.kind import JobKind, JobRecord
from service.jobs.records import ArmCorrection, Mounting, ParameterCovariance, Photograph
from service.steps.context import StepContext

R = TypeVar("R", bound=JobRecord)


@dataclass(frozen=True, slots=True)
class Taken(Generic[R]):
    """The answer with which an earlier step ended, and the job that gave it."""

    answer: R
    job: JobState | None  # None: nobody computed it in this run

    def reference(self, field: str) -> Reference | None:
        """A part of the answer (`details/spheres/*/covariance_m2`), "" for all of it; None without a job."""
        path = f"result/{field}" if field else "result"
        return None if self.job is None else Reference(self.job.job, path)


def taken(context: StepContext, step_id: str, kind: JobKind[Any, R]) -> Taken[R]:
    """What an earlier step's job of a kind answered. Raises ConfigurationError if the step has no such answer."""
    result = result_of(context, step_id)
    try:
        answer = kind.read_answer(result)
    except IntegrityError as error:
        raise ConfigurationError(
            f"step {context.step.id!r} needs {kind.words} of step {step_id!r}, which has none",
            where=f"step {context.step.id}",
            remedy="Name a step that gives it in the protocol",
        ) from error
    return Taken(answer, answered_by(context.run.steps[step_id]))


def answered_by(state: StepState) -> JobState | None:
    """The newest job whose answer is part of the step's result."""
    done = [job for job in state.jobs.values() if job.status == "finished" and job.result]
    for job in sorted(done, key=lambda job: job.enqueued_seq, reverse=True):
        if all(name in state.result and state.result[name] == value for name, value in job.result.items()):
            return job
    return None


def result_of(context: StepContext, step_id: str) -> Mapping[str, Any]:
    """The Result of an earlier step, as plain data; ConfigurationError if it has none."""
    state = context.run.steps.get(step_id)
    if state is None or not state.result:
        raise ConfigurationError(
            f"step {context.step.id!r} needs the result of step {step_id!r}, which has none",
            where=f"step {context.step.id}",
            remedy=f"Pass step {step_id!r} first, or correct the protocol",
        )
    return state.result


def artefact_of(context: StepContext, step_id: str, kind: str) -> ArtefactRef:
    """The newest artefact of one kind that an earlier step produced."""
    state = context.run.steps.get(step_id)
    found = [ref for ref in (state.artefacts if state else ()) if ref.kind == kind]
    if not found:
        raise ConfigurationError(
            f"step {context.step.id!r} needs a {kind} of step {step_id!r}, which has none",
            where=f"step {context.step.id}",
            remedy=f"Pass step {step_id!r} first, or correct the protocol",
        )
    return found[-1]


def captured_images(context: StepContext, step_ids: Iterable[str]) -> list[Photograph]:
    """Every valid photograph of the given capture steps with its pose, in order of capture.

    Events recorded since this step began (its own images) are read through the evidence, not the stale state.
    """
    images: list[Photograph] = []
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


def _photograph(capture: View, step_id: str, look: hand_view.Answer | None) -> Photograph:
    by_spheres = {} if look is None or look.T_scene_camera is None else {"T_scene_camera": look.T_scene_camera}
    return Photograph.model_validate(
        {
            "name": f"{capture.viewpoint}.jpg",
            "step": step_id,
            "viewpoint": capture.viewpoint,
            "station": capture.station,
            "sha256": capture.artefacts[0].sha256,
            **robot_pose_of(capture),
            **by_spheres,
        }
    )


def robot_pose_of(view: View) -> dict[str, Any]:
    """The robot's pose at a photograph, as fields of a Photograph; empty where there was no robot."""
    if isinstance(view, ViewpointCaptured):
        return {"T_base_flange": view.T_base_flange, "joints_rad": view.joints_rad}
    return {}


def held_views(context: StepContext, step_id: str) -> dict[str, hand_view.Answer]:
    """By photograph: what the worker found in the hand-held images of a step.

    Without a CT each image refines where all were: the newest poses count.
    """
    names = (hand_view.KIND.name, hand_board.KIND.name)
    done = [j for j in context.evidence.jobs(step_id) if j.kind in names and j.status == "finished"]
    looks = {str(job.arguments["image"]["sha256"]): hand_view.KIND.read_answer(job.result) for job in done}
    refined = hand_view.KIND.read_answer(done[-1].result).T_scene_cameras if done else {}
    return {
        sha256: look
        if look.viewpoint not in refined
        else look.model_copy(update={"T_scene_camera": refined[look.viewpoint]})
        for sha256, look in looks.items()
    }


@dataclass(frozen=True, slots=True)
class Mounted:
    """How the camera sat on the arm, and what of it is recorded as a reference."""

    mounting: Mounting
    taken: Mapping[str, Reference | Each | None]


def mounting_of(context: StepContext, step_id: str, stations: Iterable[str]) -> Mounted:
    """What turns the robot's poses into camera poses (worker/poses/robot_poses.py).

    The arm's correction is of one arm: it names the stations where that arm stood.
    """
    found = taken(context, step_id, calibrate.KIND)
    hand_eye = found.answer.hand_eye
    correction = None if hand_eye is None else hand_eye.arm_correction
    references = {"T_flange_camera": found.reference("T_flange_camera")}
    if correction is None:
        return Mounted(Mounting(T_flange_camera=found.answer.T_flange_camera, arm_correction=None), references)
    robots = set(result_of(context, step_id)["robots"])
    mine = tuple(sorted({station for station in stations if context.devices.layout(station).robot in robots}))
    mounting = Mounting(
        T_flange_camera=found.answer.T_flange_camera,
        arm_correction=ArmCorrection.model_validate(correction.plain()),
        arm_stations=mine,
    )
    return Mounted(mounting, {**references, "arm_correction": found.reference("hand_eye/arm_correction")})


def intrinsics_covariance_of(found: Taken[calibrate.Answer]) -> ParameterCovariance | None:
    """Of a calibration, with the names of its parameters; None where nobody has computed it."""
    record = found.answer.details.intrinsics
    return None if record is None else record.covariance
