"""The interface of a step: its kind, the context in which it runs, what earlier steps left to it, and its outcome."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Literal, Protocol, Self, TypeVar

from pydantic import BaseModel, ValidationError

from drivers.interfaces import (
    Abandoned,
    Camera,
    CtSource,
    Device,
    DeviceReport,
    Lightbox,
    RobotArm,
    Scanner,
    Transform,
)
from service.computations import term
from service.computations.kind import JobKind, JobRecord
from service.computations.memory_grants import waiting_for_memory
from service.core.errors import ComputeError, ConfigurationError, IntegrityError, OrthocaptureError
from service.core.jobs import Each, Reference, answered_by, arguments_name, job_key
from service.core.protocol import Protocol as LabProtocol
from service.core.protocol import Step
from service.core.records.base import ArtefactRef, Moment, Record
from service.core.records.events import Payload
from service.core.records.import_list import ImportList
from service.core.records.run_events import ComputedBy, RecordedView, StepNote, Uncertainty
from service.core.run.decide import RunState, StepState
from service.core.run.state import WAITED, JobState
from service.core.step_params import StepParams
from service.followed_run import RunFollower
from service.rig import CollisionSection, FurtherCameraSection, LensSection, ObstacleSection, OpticsSection
from service.steps.measures import MeasureRecord
from service.store.records import NewArtefact, NewJob
from service.store.runs import RunLease

P = TypeVar("P", bound=StepParams)
A = TypeVar("A", bound=JobRecord)
R = TypeVar("R", bound=JobRecord)
M = TypeVar("M", bound=BaseModel)
_NO_REFERENCES: Mapping[str, Reference | Each | None] = {}


class StepInterruptedError(OrthocaptureError):
    """An operator paused or aborted while the step worked; the robot stands still when this is raised."""


@dataclass(frozen=True, slots=True)
class StationLayout:
    """A station of the rig: which arm stands there, and where the scene is in that arm's base frame."""

    name: str
    robot: str  # device name in rig.yaml
    scene_centre_m: tuple[float, float, float]
    approach: tuple[float, float, float]  # horizontal unit vector from the scene towards the base
    obstacles: tuple[tuple[str, ObstacleSection], ...] = ()  # the other things that stand there, by name
    is_arm: bool = True  # not axes of another kind, whose motions are not planned
    abandoned: Abandoned | None = None  # the end of a motion whose program died, if the driver's section says so


@dataclass(frozen=True, slots=True)
class LeaveToMove:
    """A person's recorded confirmation that the arms may move. Each arm uses it once; after a stop it needs another.

    `not_before_monotonic_s` is a time of the host's monotonic clock before the confirmation was given.
    """

    seq: int  # its event
    by: str
    not_before_monotonic_s: float


@dataclass(frozen=True, slots=True)
class ConnectionEnd:
    """The end of a connection to an arm, or that none could be made: `refused`."""

    device: str  # name in rig.yaml
    how: Literal["died", "stalled", "broken", "refused"]  # died and stalled: the driver's process
    error: str  # name of the error
    message: str


@dataclass(frozen=True, slots=True)
class FurtherCamera:
    """An open camera beside the first one, and its section in rig.yaml with the file of its intrinsics."""

    name: str  # device name in rig.yaml
    camera: Camera
    section: FurtherCameraSection
    calibration: Path


class Devices(Protocol):
    """The open devices of a rig, by role; opened on first use. Raises ConfigurationError if the rig has none."""

    def robot(self, station: str) -> RobotArm:
        """Return the arm at a station, configured with its payload, and free to move if a person has confirmed it.

        Raises SafetyStopError or LeaveNeededError if it was stopped after that confirmation.
        """
        ...

    def camera(self) -> Camera:
        """Return the first camera: the one on the arm, or the only one."""
        ...

    def further_cameras(self) -> tuple[FurtherCamera, ...]:
        """Return the further cameras of the rig, in the order of the rig file; mostly none."""
        ...

    def scanner(self, name: str | None = None) -> Scanner:
        """Return the scanner of this name; without a name, the only one."""
        ...

    def ct(self) -> CtSource:
        """Return the folder in which the CT suite puts its files."""
        ...

    def lightbox(self) -> Lightbox | None:
        """Return the light and environment box, if the rig has one."""
        ...

    def layout(self, station: str) -> StationLayout:
        """Return the arm and the scene of a station."""
        ...

    def nominal_T_flange_camera(self) -> Transform:
        """Return the camera's pose on the flange (4, 4) according to the drawing of the mount, metres."""
        ...

    def surroundings(self) -> tuple[CollisionSection, OpticsSection | None]:
        """Return the obstacles that the arm must avoid, and the lens if the rig file describes it."""
        ...

    def lens(self) -> LensSection | None:
        """Return focal length and sensor as the rig file gives them, if it does."""
        ...

    def imported(self) -> ImportList | None:
        """Return the files to import, in a run that imports an earlier capture; None in a run that captures."""
        ...

    def watch(self, on_open: Callable[[str, DeviceReport], None], before_open: Callable[[str], None]) -> None:
        """Call `before_open` and `on_open` around the opening of each device, with its name in rig.yaml."""
        ...

    def let_move(self, leave: LeaveToMove) -> None:
        """Let the arms move: each arm gets the leave once, when `robot` next asks for it."""
        ...

    def reopen(self, device: Device) -> None:
        """Open a device again after its connection was lost. An arm then needs a new leave to move."""
        ...

    def hold_arms(self) -> None:
        """Stop and close every open arm: it moves again only after it is reopened and a person has confirmed."""
        ...

    def ended_connections(self) -> tuple[ConnectionEnd, ...]:
        """Return the connections to arms that have ended since the last call, in order."""
        ...


@dataclass(frozen=True, slots=True)
class JobRequest:
    """Work for the worker; `arguments` as they are recorded, with references to earlier answers."""

    kind: str
    arguments: Mapping[str, Any]
    version: int  # of the computation that is asked for
    priority: int = WAITED

    @classmethod
    def of(
        cls,
        kind: JobKind[A, Any],
        arguments: A,
        references: Mapping[str, Reference | Each | None] = _NO_REFERENCES,
        priority: int = WAITED,
    ) -> JobRequest:
        """Return a request with typed arguments.

        Args:
            kind: the job's kind.
            arguments: the values, also where they come from earlier jobs.
            references: the reference that is recorded instead of a value, by the argument's field (`camera`,
                `registrations/colmap`, `further_arms/0/arm_correction`); None where no job computed the value;
                the value itself is then recorded.
            priority: the job's priority (service.core.run.state).
        """
        recorded = arguments.plain()
        for path, reference in references.items():
            if reference is not None:
                *parents, field = path.split("/")
                place: Any = recorded
                for name in parents:
                    place = place[int(name)] if isinstance(place, list) else place[name]
                place[field] = reference.record()
        return cls(kind.name, recorded, kind.version, priority)


@dataclass(frozen=True, slots=True)
class JobResult:
    """The worker's answer to a job."""

    job: str
    measures: Mapping[str, float]
    artefacts: tuple[ArtefactRef, ...]
    result: Mapping[str, Any]

    @classmethod
    def of(cls, job: JobState) -> Self:
        """Return the answer of a finished job."""
        return cls(job.job, job.measures, job.artefacts, job.result)

    @property
    def source(self) -> ComputedBy:
        """The job, for a step that gives its measures under their own names."""
        return ComputedBy(job=self.job)


@dataclass
class Evidence:
    """A step's access to the record during one execution; if recording fails it raises, so nothing is unrecorded."""

    log: RunFollower
    lease: RunLease
    step: str
    attempt: int
    checkpoint: Callable[[], None]
    progress: Callable[[str, int, int], None]
    wait: Callable[[float], None]
    space: Callable[[], None]

    def record(self, *payloads: Payload, artefacts: tuple[NewArtefact, ...] = (), actor: str = "runner") -> None:
        """Append events and artefact rows in one transaction."""
        self.log.store.record(self.log.run_id, payloads, actor=actor, artefacts=artefacts, lease=self.lease)

    def put_file(self, path: Path, *, kind: str, media_type: str, original_name: str) -> ArtefactRef:
        """Copy a file into the store durably; nothing refers to it until `record`."""
        return self.log.store.put_file(path, kind=kind, media_type=media_type, original_name=original_name)

    def put_bytes(self, data: bytes, *, kind: str, media_type: str, original_name: str) -> ArtefactRef:
        """Write bytes into the store durably; nothing refers to them until `record`."""
        return self.log.store.put_bytes(data, kind=kind, media_type=media_type, original_name=original_name)

    def path(self, ref: ArtefactRef) -> Path:
        """Return the file of an artefact. Raises IntegrityError if it is missing."""
        return self.log.store.artefact_path(ref.sha256)

    def holds(self, sha256: str) -> bool:
        """Return whether the run has recorded a file with this content."""
        return self.log.store.holds(self.log.run_id, sha256)

    def captures(self, step_id: str) -> tuple[RecordedView, ...]:
        """Return the valid captures of a step's current attempt, in the order of capture."""
        return self.log.now().captures(step_id)

    def run_jobs(self, *requests: JobRequest) -> tuple[JobResult, ...]:
        """Enqueue jobs, each only once also after restarts, and wait for their results, returned in order.

        Raises ComputeError with the worker's message if a job failed for good.
        """
        keys = [self._key(request) for request in requests]
        jobs = [
            NewJob(r.kind, self.step, self.attempt, key, r.arguments, priority=r.priority, version=r.version)
            for r, key in zip(requests, keys, strict=True)
        ]
        self.log.store.record(self.log.run_id, [], actor="runner", jobs=jobs, lease=self.lease)
        while True:
            self.checkpoint()
            self.space()  # workers begin no jobs while the disk is nearly full
            state = self.log.refresh()
            mine = {job.idempotency_key: job for job in state.steps[self.step].jobs.values()}
            if any(key not in mine for key in keys):
                raise IntegrityError(
                    "a job just enqueued is not in the record",
                    where=f"step {self.step}",
                    remedy="Run `orthocapture audit verify` on the data folder",
                )
            for key in keys:
                if mine[key].status == "failed":
                    raise ComputeError(
                        f"the worker could not do {term(mine[key].kind)}: {mine[key].message}",
                        where=f"step {self.step}",
                        remedy="Correct what the message names, or take what is missing; then try again",
                    )
            done = sum(mine[key].status == "finished" for key in keys)
            waiting = waiting_for_memory(self.log.store.database_path.parent)
            left = [mine[key] for key in keys if mine[key].status != "finished"]
            doing = dict.fromkeys(f"{term(job.kind)} {waiting.get(job.job, '')}".rstrip() for job in left)
            self.progress(", ".join(doing) or "computed", done, len(keys))
            if done == len(keys):
                return tuple(JobResult.of(mine[key]) for key in keys)
            self.wait(0.2)

    def enqueue(self, request: JobRequest, name: str) -> None:
        """Enqueue a job without waiting for it, unless the same work is already enqueued under this name."""
        key = job_key(self.log.refresh(), self.step, request.kind, name)
        if all(job.idempotency_key != key for job in self.jobs(self.step)):
            job = NewJob(
                request.kind,
                self.step,
                self.attempt,
                key,
                request.arguments,
                priority=request.priority,
                version=request.version,
            )
            self.log.store.record(self.log.run_id, [], actor="runner", jobs=[job], lease=self.lease)

    def asked(self) -> tuple[Literal["release", "finish"], ...]:
        """Return what people at screens have asked of this step, in order."""
        return self.log.refresh().steps[self.step].asked

    def computing(self) -> bool:
        """Return whether a worker computes a job of this run at this moment."""
        return bool(self.log.store.jobs_started(self.log.run_id))

    def jobs(self, step_id: str) -> tuple[JobState, ...]:
        """Return the jobs of a step, in the order in which they were enqueued."""
        jobs = self.log.refresh().steps[step_id].jobs.values()
        return tuple(sorted(jobs, key=lambda job: job.enqueued_seq))

    def state(self) -> RunState:
        """Return the run's state as of now. Raises IntegrityError for an impossible event."""
        return self.log.refresh()

    def require_space(self) -> None:
        """Raise SpaceShortError if the disk is nearly full."""
        self.space()

    def _key(self, request: JobRequest) -> str:
        """Return the same key for the same work, so that a restart or retry reuses the result."""
        return job_key(self.log.refresh(), self.step, request.kind, arguments_name(request.arguments))


@dataclass(frozen=True, slots=True)
class EarlierAnswer(Generic[R]):
    """The answer that became an earlier step's result, and the job that computed it."""

    answer: R
    job: JobState | None  # None: no job of this run computed it

    def reference(self, field: str) -> Reference | None:
        """Refer to a part of the answer (`details/spheres/*/covariance_m2`; "": all of it); None without a job."""
        path = f"result/{field}" if field else "result"
        return None if self.job is None else Reference(self.job.job, path)


@dataclass(frozen=True, slots=True)
class StepContext:
    """Everything that a step may touch."""

    protocol: LabProtocol
    step: Step
    attempt: int
    run: RunState
    devices: Devices
    evidence: Evidence
    checkpoint: Callable[[], None]  # raises StepInterruptedError after a pause or abort; call it often
    progress: Callable[[str, int, int], None]  # what, done, of how many
    monotonic_s: Callable[[], float]
    wait: Callable[[float], None]
    operator: str
    tell: Callable[[str], None]  # one line of news for the operator
    moment: Callable[[], Moment]  # now, in both clocks: for times that are stored and compared later
    # Surrounds each motion of an arm; raises StepInterruptedError if nobody has let it move for too long.
    motion: Callable[[], AbstractContextManager[None]]
    wait_for_results: Callable[[float], None]  # does the same as `wait`, where jobs are awaited
    busy: Callable[[str], None] = lambda _what: None  # call before a long call, with what it does

    @property
    def state(self) -> StepState:
        """The folded state of this step, as of the start of this execution."""
        return self.run.steps[self.step.id]

    def earlier_answer(self, step_id: str, kind: JobKind[Any, R]) -> EarlierAnswer[R]:
        """Return the result of an earlier step, as the answer of a kind of job.

        Raises ConfigurationError if it is not one.
        """
        result = self._result_of(step_id)
        try:
            answer = kind.read_answer(result)
        except IntegrityError as error:
            raise ConfigurationError(
                f"step {self.step.id!r} needs {kind.words} of step {step_id!r}, which has none",
                where=f"step {self.step.id}",
                remedy="Name a step in the protocol that computes it",
            ) from error
        return EarlierAnswer(answer, answered_by(self.run.steps[step_id]))

    def earlier_result(self, step_id: str, model: type[M]) -> M:
        """Return the Result of an earlier step of a known kind.

        Raises ConfigurationError if it has none, or another.
        """
        result = self._result_of(step_id)
        try:
            return model.model_validate(result)
        except ValidationError as error:
            raise ConfigurationError(
                f"step {self.step.id!r} cannot use the result of step {step_id!r}, a step of another kind",
                where=f"step {self.step.id}",
                remedy="Correct the protocol",
            ) from error

    def earlier_artefact(self, step_id: str, kind: str) -> ArtefactRef:
        """Return the newest artefact of one kind that an earlier step produced.

        Raises ConfigurationError if it has none.
        """
        state = self.run.steps.get(step_id)
        found = [ref for ref in (state.artefacts if state else ()) if ref.kind == kind]
        if not found:
            raise ConfigurationError(
                f"step {self.step.id!r} needs a {kind} of step {step_id!r}, which has none",
                where=f"step {self.step.id}",
                remedy=f"Pass step {step_id!r} first, or correct the protocol",
            )
        return found[-1]

    def _result_of(self, step_id: str) -> Mapping[str, Any]:
        """Return the Result of an earlier step, as plain data; ConfigurationError if it has none."""
        state = self.run.steps.get(step_id)
        if state is None or not state.result:
            raise ConfigurationError(
                f"step {self.step.id!r} needs the result of step {step_id!r}, which has none",
                where=f"step {self.step.id}",
                remedy=f"Pass step {step_id!r} first, or correct the protocol",
            )
        return state.result

    def note(self, note: str, **data: Any) -> None:
        """Record a StepNote."""
        self.evidence.record(StepNote(step=self.step.id, attempt=self.attempt, note=note, data=data))


@dataclass(frozen=True, slots=True)
class StepOutcome:
    """A step's measures (gates judge them), the files it produced, its Result, and the jobs that computed them.

    Audit and replay follow `computed_by` from a step's numbers to the jobs: name each job whose measures are given.
    """

    measures: MeasureRecord
    artefacts: tuple[ArtefactRef, ...] = ()
    result: Record | None = None
    uncertainties: Mapping[str, Uncertainty] = field(default_factory=dict[str, Uncertainty])  # of some measures
    computed_by: tuple[ComputedBy, ...] = ()


@dataclass(frozen=True, slots=True)
class BeforeStep:
    """The facts that a kind's announcement may mention: title, number of images still to take, and stations."""

    title: str
    views_left: int
    stations: str  # "station 1 and station 2"; "" for none

    @property
    def at_stations(self) -> str:
        """The phrase ` at station 1`, or "" without stations."""
        return f" at {self.stations}" if self.stations else ""

    def images(self, of: str = "") -> str:
        """Return `1 image`, `8 images of the board`."""
        return f"{self.views_left} {'image' if self.views_left == 1 else 'images'}{of}"


@dataclass(frozen=True, slots=True)
class Announcement:
    """The effect of a confirmation: the text of its button after `Confirm: `, and a line below it."""

    does: str
    below: str = "Nothing moves."


ROBOT_MOVES = "The robot moves. Everybody stays outside of its reach."


@dataclass(frozen=True, slots=True)
class StepKind(Generic[P]):
    """One kind of step, declared once.

    Attributes:
        name: the kind's name in the protocol.
        params: the type of its section of the protocol.
        measures: the type of the numbers that it yields, for gates.
        result: the type of what it leaves to later steps.
        execute: does the step.
        registered_by: the step whose registrations the measures are of, where they are RegistrationMeasures; None:
            this step itself.
        words: returns what a person reads before confirming it.
        drawing: the drawing beside the instructions if the protocol names no other: the name of one in
            service/web/drawings, or, for a kind of a plug-in, an SVG itself (`<svg …`).
    """

    name: str
    params: type[P]
    measures: type[MeasureRecord]
    result: type[Record]
    execute: Callable[[StepContext, P], StepOutcome]
    registered_by: Callable[[P, Mapping[str, Step]], Step | None] | None = None
    words: Callable[[P, BeforeStep], Announcement] | None = None
    drawing: str = ""
