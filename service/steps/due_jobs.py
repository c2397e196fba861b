"""The jobs that are due, also those on features while images arrive, and how long they still take."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import numpy as np

from service.computations import evaluate
from service.computations.calibration import CALIBRATE, CalibrateAnswer
from service.computations.image_poses import (
    FEATURES,
    HYBRID,
    MATCH,
    STRUCTURE_FROM_MOTION,
    FeaturesArguments,
    ImagesToMatch,
    PairsToMatch,
    SfmEffort,
)
from service.computations.kind import JobRecord, read_part
from service.computations.records import Camera, ImageFile
from service.computations.registration import DETECT_SPHERES, REGISTER
from service.compute.sfm.options import SfmOptions, pairs_of
from service.core.errors import ConfigurationError
from service.core.geometry import Transform
from service.core.jobs import Jobs, Reference, job_key, jobs_of, newest_job
from service.core.protocol import Protocol, Step
from service.core.records.run_events import ViewpointCaptured
from service.core.run.state import EARLY, LATER, WAITED, JobState, RunState
from service.steps.context import EarlierAnswer, JobRequest, StepContext
from service.steps.registration import RegistrationParams, evaluated_step, evaluations_of
from service.steps.registration_jobs import RegistrationJobs, Task, name_of, recorded_registration_jobs
from service.steps.viewpoints import Viewpoint
from service.store.records import NewJob

# --- features and matches, while the images arrive -----------------------------------------------------------------


_SOURCES_OF_IMAGES = frozenset({"colmap", "glomap", "hybrid", "triangulated"})


@dataclass
class EarlyFeatures:
    """Enqueues the features of every image as soon as it is captured. The capture never waits for them.

    Features and matches depend only on the images, so the result does not depend on when or in which process they
    were computed. The pairs to match early follow from the planned viewpoints.
    """

    context: StepContext
    camera: EarlierAnswer[CalibrateAnswer]
    effort: SfmEffort
    neighbours: Mapping[str, Sequence[str]]  # by viewpoint, as planned
    asked: set[str] = field(default_factory=set[str])

    @classmethod
    def begin(cls, context: StepContext, plan: Sequence[Viewpoint]) -> EarlyFeatures | None:
        """Prepare early features; None if no registration matches these images, or without a calibration."""
        registration = _registration_of(context.protocol, context.step.id)
        if registration is None:
            return None
        wanted = registration.params_as(RegistrationParams)
        try:
            camera = context.earlier_answer(wanted.calibration, CALIBRATE)
        except ConfigurationError:
            return None
        effort = wanted.structure_from_motion.effort
        options = SfmOptions(**effort.set_fields())
        nominal = context.devices.nominal_T_flange_camera()
        neighbours: dict[str, list[str]] = {}
        for station in dict.fromkeys(v.station for v in plan):
            poses = {v.name: v.T_base_camera for v in plan if v.station == station}
            poses |= _taken(context, wanted, station, nominal)
            for a, b in pairs_of(poses, poses, options):
                neighbours.setdefault(a, []).append(b)
                neighbours.setdefault(b, []).append(a)
        begun = cls(context, camera, effort, neighbours)
        jobs = context.evidence.jobs(context.step.id)
        begun.asked = {_image_of(job).sha256 for job in jobs if job.kind == "features"}
        return begun

    def look(self) -> None:
        """Enqueue the features of every new image. Returns at once."""
        for capture in self.context.evidence.captures(self.context.step.id):
            sha256 = capture.artefacts[0].sha256
            if sha256 in self.asked or not all(capture.verdicts.values()):
                continue
            self.asked.add(sha256)
            arguments = FeaturesArguments(
                camera=self.camera.answer.camera,
                effort=self.effort,
                images=(ImageFile(viewpoint=capture.viewpoint, sha256=sha256),),
                match_with=tuple(sorted(self.neighbours.get(capture.viewpoint, ()))),
            )
            references = {"camera": self.camera.reference("camera")}
            self.context.evidence.enqueue(JobRequest.of(FEATURES, arguments, references, EARLY), sha256)


def _registration_of(protocol: Protocol, capture: str) -> Step | None:
    """Return the step that will register the images of a capture by their features."""
    for step in protocol.steps:
        if step.gives == "registrations":
            wanted = step.params_as(RegistrationParams)
            if capture in wanted.captures and _SOURCES_OF_IMAGES.intersection(wanted.poses):
                return step
    return None


def _taken(
    context: StepContext, wanted: RegistrationParams, station: str, nominal: Transform
) -> dict[str, Transform]:
    """Return the approximate T_base_camera of the images of earlier steps at a station, by viewpoint."""
    earlier = [step for step in wanted.captures if step != context.step.id]
    captures = [c for step in earlier for c in context.evidence.captures(step) if isinstance(c, ViewpointCaptured)]
    return {c.viewpoint: np.array(c.T_base_flange) @ nominal for c in captures if c.station == station}


def early_matches(protocol: Protocol, state: RunState) -> list[NewJob]:
    """Return the matching jobs that are due: of each image with its planned neighbours, if both have features."""
    found: dict[str, tuple[str, JobState]] = {}
    pairs_done: set[tuple[str, str]] = set()
    matched: set[str] = set()
    for step in protocol.steps:
        for job in state.steps[step.id].jobs.values():
            if job.kind == "features" and job.priority == EARLY and job.status == "finished":
                found[_image_of(job).viewpoint] = (step.id, job)
            elif job.kind == "match" and job.priority == EARLY:
                pairs_done |= set(read_part(PairsToMatch, job.arguments).pairs)
                matched.add(job.idempotency_key.split("/")[3])
    jobs: list[NewJob] = []
    for name, (step_id, job) in found.items():
        sha256 = job.artefacts[0].sha256
        if sha256 in matched:
            continue
        there = [other for other in _asked_of(job).match_with if other in found]
        pairs = sorted({(min(name, other), max(name, other)) for other in there} - pairs_done)
        pairs_done |= set(pairs)
        if not pairs:
            continue
        named = {n: found[n][1].artefacts[0].sha256 for pair in pairs for n in pair}
        shared = {key: job.arguments[key] for key in ("camera", "effort")}  # references stay references
        arguments = {**shared, "features": named, "pairs": [list(pair) for pair in pairs]}
        key = job_key(state, step_id, "match", sha256)
        attempt = state.steps[step_id].attempt
        jobs.append(NewJob(MATCH.name, step_id, attempt, key, arguments, priority=EARLY, version=MATCH.version))
    return jobs


def _asked_of(job: JobState) -> ImagesToMatch:
    return read_part(ImagesToMatch, job.arguments)


def _image_of(job: JobState) -> ImageFile:
    """Return the image of an early job on features, which has only one."""
    return _asked_of(job).images[0]


# --- all jobs that are due -----------------------------------------------------------------------------------------


class _Evaluated(JobRecord):
    """The registrations of an evaluation job by name, as recorded: values or references."""

    registrations: dict[str, object]


def evaluation_tasks(state: RunState, step: Step, found: RegistrationJobs | None) -> dict[str, Task]:
    """Return the evaluation jobs of registrations that arrived after the step's own evaluation, by registration.

    Args:
        state: the run's state.
        step: the evaluation.
        found: the recorded jobs of the registration step that it evaluates; None if that has not started them.
    """
    if step.gives != "accuracy" or state.steps[step.id].skipped:
        return {}
    own = [j for j in state.steps[step.id].jobs.values() if j.kind == evaluate.KIND.name and j.priority == WAITED]
    newest = max(own, key=lambda job: job.enqueued_seq, default=None)
    if newest is None or newest.status != "finished" or found is None:
        return {}
    tasks: dict[str, Task] = {}
    evaluated = _Evaluated.model_validate(newest.arguments).registrations
    for name, job in found.arrived.items():
        if name not in evaluated:
            arguments = {**newest.arguments, "registrations": {name: Reference(job.job, "result").record()}}
            key = f"{name}-{name_of(newest)}"
            request = JobRequest(evaluate.KIND.name, arguments, evaluate.KIND.version, LATER)
            tasks[name] = Task(key, request, newest_job(state, step.id, request.kind, key))
    return tasks


def due(protocol: Protocol, state: RunState) -> list[NewJob]:
    """Return all jobs that can be enqueued now because the results they need exist; none in an aborted run."""
    if state.status == "aborted":
        return []
    jobs = early_matches(protocol, state)
    recorded = {step.id: recorded_registration_jobs(protocol, state, step) for step in protocol.steps}
    for step in protocol.steps:
        found = recorded[step.id]
        tasks = [] if found is None else found.due
        if step.gives == "accuracy":
            late = evaluation_tasks(state, step, recorded[evaluated_step(step)])
            tasks += [task for task in late.values() if task.job is None]
        jobs += [new_job(state, step.id, task) for task in tasks]
    return jobs


def new_job(state: RunState, step: str, task: Task) -> NewJob:
    """Return the job to enqueue for a task."""
    key = job_key(state, step, task.request.kind, task.name)
    request = task.request
    return NewJob(
        request.kind,
        step,
        state.steps[step].attempt,
        key,
        request.arguments,
        priority=request.priority,
        version=request.version,
    )


# Kinds of jobs that the run has not computed yet are estimated from other runs: seconds per image of 1920 × 1280 px
# on one core, in proportion to the number of pixels for jobs that search the image.

_NAMES = {
    "robot": "robot poses as reported",
    "robot_corrected": "robot poses, corrected",
    "spheres": "poses by the spheres in each image",
    "triangulated": "triangulation from corrected robot poses",
    "colmap": "COLMAP from scratch",
    "glomap": "GLOMAP from scratch",
    "hybrid": "images, robot and spheres together",
}
_GUESS_S = {  # per image
    DETECT_SPHERES.name: 0.3,
    REGISTER.name: 0.15,
    FEATURES.name: 1.5,
    MATCH.name: 0.4,
    STRUCTURE_FROM_MOTION.name: 1.5,
    HYBRID.name: 0.5,
    evaluate.KIND.name: 0.1,
}
_BY_PIXELS = frozenset({DETECT_SPHERES.name, FEATURES.name})
_PIXELS = 1920 * 1280
_SEVERAL_CORES = frozenset({DETECT_SPHERES.name})


@dataclass(frozen=True, slots=True)
class PendingResult:
    """A result that has not arrived: the estimated `seconds` until it does, or why it has `failed`."""

    name: str
    what: str
    seconds: float
    failed: str = ""
    waits: bool = False  # no job of the run is being computed: no worker runs, or it computes for other runs

    @property
    def text(self) -> str:
        """`COLMAP from scratch: still computing, about 4 min left`."""
        if self.failed:
            return f"{self.what}: there will be none, {self.failed}"
        takes = f"about {duration_words(self.seconds)}"
        return f"{self.what}: " + (
            f"waits for a worker, then {takes}" if self.waits else f"still computing, {takes} left"
        )


def duration_words(seconds: float) -> str:
    """Return a duration rounded to the precision of an estimate: `20 s`, `4 min`."""
    if seconds < 90:
        return f"{max(10, 10 * round(seconds / 10))} s"
    return f"{round(seconds / 60)} min"


def missing_results(
    protocol: Protocol, state: RunState, started_utc: Mapping[str, str], now_utc: str, cores: int
) -> list[PendingResult]:
    """Return the planned results that have not arrived, in the order in which they are expected.

    Args:
        protocol: the run's protocol.
        state: the run's state.
        started_utc: the start of each job that is being computed now, by job id.
        now_utc: the present time.
        cores: the number of jobs computed in parallel.
    """
    left: list[PendingResult] = []
    for step in protocol.steps if state.status != "aborted" else ():  # nothing follows in an aborted run
        found = recorded_registration_jobs(protocol, state, step)
        if found is not None:
            evaluation = next(iter(evaluations_of(protocol, step)), None)
            left += _left_of(state, step, evaluation, found, _JobTimes(state, started_utc, now_utc, cores))
    return sorted(left, key=lambda one: one.seconds)


class _Work(JobRecord):
    """The arguments of a job, of any kind, that its duration depends on."""

    poses: str = ""
    mappers: tuple[str, ...] = ()
    images: tuple[ImageFile, ...] = ()
    pairs: tuple[tuple[str, str], ...] = ()

    def count(self, kind: str) -> int:
        """Return the number of images, or of pairs."""
        return len(self.pairs if kind == MATCH.name else self.images)

    def size(self, kind: str) -> float:
        """Return the number, weighted by their pixels for jobs whose duration depends on them."""
        return self.count(kind)


class _Search(_Work):
    """Work whose duration depends on the size of the images, because they are searched as a whole."""

    camera: Camera | None = None
    reduced_to: tuple[int, int] | None = None

    def size(self, kind: str) -> float:
        """Return the number, weighted by their pixels."""
        if self.camera is None:
            return self.count(kind)
        width, height = self.reduced_to or (self.camera.width, self.camera.height)
        return self.count(kind) * width * height / _PIXELS


def _work(kind: str, arguments: Mapping[str, Any], jobs: Jobs) -> _Work:
    return read_part(_Search if kind in _BY_PIXELS else _Work, arguments, jobs)


@dataclass(frozen=True, slots=True)
class _JobTimes:
    """The durations of a run's jobs."""

    state: RunState
    started_utc: Mapping[str, str]
    now_utc: str
    cores: int

    def seconds(self, task: Task) -> float:
        """Return the seconds until a task is done, counted from its start; 0 if it is done."""
        job = task.job
        if job is not None and job.status != "enqueued":
            return 0.0
        kind = task.request.kind
        expected_s = self.expected_s(kind, _work(kind, task.request.arguments, jobs_of(self.state)))
        begun = None if job is None else self.started_utc.get(job.job)
        if begun is None:
            return expected_s
        gone_s = (datetime.fromisoformat(self.now_utc) - datetime.fromisoformat(begun)).total_seconds()
        return max(expected_s - max(0.0, gone_s), 0.1 * expected_s)  # negative: the clock was set back

    def expected_s(self, kind: str, work: _Work) -> float:
        """Return the expected duration of a job, from the jobs of its kind in this run if there are any."""
        jobs = jobs_of(self.state)
        ended = [job for job in jobs.values() if job.kind == kind and job.status == "finished"]
        done = [(job, _work(kind, job.arguments, jobs)) for job in ended]
        like = [(job, other) for job, other in done if _tells_of(other, work) and other.count(kind) > 0]
        if like:
            spent_s = sum(job.duration_s for job, _ in like)
            return work.size(kind) * spent_s / sum(other.size(kind) for _, other in like)
        return work.size(kind) * _GUESS_S.get(kind, 0.0) / (self.cores if kind in _SEVERAL_CORES else 1)


def _tells_of(done: _Work, work: _Work) -> bool:
    return (done.poses, done.mappers) == (work.poses, work.mappers)


def _left_of(
    state: RunState,
    step: Step,
    evaluation: Step | None,
    found: RegistrationJobs,
    clock: _JobTimes,
) -> list[PendingResult]:
    """Return the missing results of a step, with its jobs scheduled on the cores in the order of their priority."""
    wanted = step.params_as(RegistrationParams)
    evaluations = {} if evaluation is None else evaluation_tasks(state, evaluation, found)
    free_s = [0.0] * clock.cores
    ready_s: dict[tuple[str, str], float] = {}
    left: list[PendingResult] = []
    first = read_part(_Work, found.tasks[0].request.arguments) if found.tasks else _Work()
    for name, (source, size) in wanted.registrations.items():
        what = _NAMES.get(source, source) + (f" at {size.replace('x', ' × ')}" if size else "")
        if name in found.failed:
            left.append(PendingResult(name, what, 0.0, found.failed[name]))
            continue
        evaluating = evaluations.get(name)
        if name in found.arrived and (evaluating is None or (evaluating.job and evaluating.job.status != "enqueued")):
            continue
        steps = found.tasks_for.get(name, ())
        at_s = 0.0
        for task in steps:
            key = (task.request.kind, task.name)
            if key not in ready_s:
                core = free_s.index(min(free_s))
                begin_s = max(at_s, free_s[core])
                ready_s[key] = begin_s + clock.seconds(task)
                if ready_s[key] > begin_s:
                    free_s[core] = ready_s[key]
            at_s = max(at_s, ready_s[key])
        last = steps[-1].request if steps else None
        if last is not None and name not in found.arrived:
            rest = _Work(images=first.images, poses=source)
            at_s += sum(clock.expected_s(kind, rest) for kind in _rest(source, last.kind))
        if evaluation is not None and any(task.request.priority != WAITED for task in steps):
            at_s += clock.expected_s(evaluate.KIND.name, first)
        left.append(PendingResult(name, what, at_s))
    return left


_MODELLED = (FEATURES.name, MATCH.name, STRUCTURE_FROM_MOTION.name)
_CHAINS = {
    "triangulated": _MODELLED,
    "colmap": _MODELLED,
    "glomap": _MODELLED,
    "hybrid": (*_MODELLED, HYBRID.name),
}


def _rest(source: str, last: str) -> tuple[str, ...]:
    """Return the kinds of jobs that follow the last one that is planned."""
    chain = (DETECT_SPHERES.name, *_CHAINS.get(source, ()), REGISTER.name)
    return chain[chain.index(last) + 1 :] if last in chain else ()
