"""What a step is given and what it gives back: StepContext, StepOutcome, StepKind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Literal, Protocol, TypeVar

from drivers.interfaces import Camera, CtSource, Device, DeviceReport, Lightbox, RobotArm, Scanner, Transform
from service.core.errors import OrthocaptureError
from service.core.jobs.priorities import WAITED
from service.core.jobs.references import Each, Reference
from service.core.protocol.models import Protocol as LabProtocol
from service.core.protocol.models import Step
from service.core.records.events import ArtefactRef, Payload, Record, StepNote, Uncertainty, View
from service.core.records.import_list import ImportList
from service.core.run.decide import RunState, StepState
from service.core.run.state import JobState
from service.jobs.kind import JobKind, JobRecord
from service.rig import CollisionSection, LensSection, OpticsSection
from service.steps.measures import MeasureRecord
from service.store.records import NewArtefact

P = TypeVar("P", bound=Record)
A = TypeVar("A", bound=JobRecord)
_NOTHING: Mapping[str, Reference | Each | None] = {}


class StepInterruptedError(OrthocaptureError):
    """An operator paused or aborted while the step worked; the robot stands still when this is raised."""


@dataclass(frozen=True, slots=True)
class StationLayout:
    """What a technician knows of a station: which arm stands there and where the scene is, in its base frame."""

    name: str
    robot: str  # device name in rig.yaml
    scene_centre_m: tuple[float, float, float]
    approach: tuple[float, float, float]  # horizontal unit vector from the scene towards the base


@dataclass(frozen=True, slots=True)
class LeaveToMove:
    """A person's recorded confirmation, for the arms: each takes it once, so an arm that has lost it needs another.

    `not_before_monotonic_s` is the host's time.monotonic() when it was not given yet.
    """

    seq: int  # of its event
    by: str
    not_before_monotonic_s: float


class Devices(Protocol):
    """The open devices of a rig, by role; opened on first use. Raises ConfigurationError if the rig has none."""

    def robot(self, station: str) -> RobotArm:
        """The arm at a station, configured with its payload, and let move if a person has.

        Raises SafetyStopError, LeaveNeededError where it was stopped after that person had confirmed.
        """
        ...

    def camera(self) -> Camera:
        """The camera."""
        ...

    def scanner(self, name: str | None = None) -> Scanner:
        """The export folder of the scanner of this name, or of the only one."""
        ...

    def ct(self) -> CtSource:
        """The CT suite's folder."""
        ...

    def lightbox(self) -> Lightbox | None:
        """The light and environment box, if the rig has one."""
        ...

    def layout(self, station: str) -> StationLayout:
        """Where things are at a station."""
        ...

    def nominal_T_flange_camera(self) -> Transform:
        """The camera mount's drawing."""
        ...

    def surroundings(self) -> tuple[CollisionSection, OpticsSection | None]:
        """What the arm must keep clear of, and the lens where it is described."""
        ...

    def lens(self) -> LensSection | None:
        """Focal length and sensor as the rig file states them."""
        ...

    def imported(self) -> ImportList | None:
        """What was captured earlier, in a run that imports it; None in one that captures."""
        ...

    def watch(self, on_open: Callable[[str, DeviceReport], None], before_open: Callable[[str], None]) -> None:
        """Have every device that is opened from now on reported, by its name in rig.yaml, before and after."""
        ...

    def let_move(self, leave: LeaveToMove) -> None:
        """A person lets the arms move: each is told when it is next asked for by its station, once."""
        ...

    def reopen(self, device: Device) -> None:
        """Open a device again after its link dropped. An arm moves again after a new leave only."""
        ...


@dataclass(frozen=True, slots=True)
class JobRequest:
    """Work for the registration worker; `arguments` as they are recorded, with references to earlier answers."""

    kind: str
    arguments: Mapping[str, Any]
    priority: int = WAITED
    version: int = 1

    @classmethod
    def of(
        cls,
        kind: JobKind[A, Any],
        arguments: A,
        taken: Mapping[str, Reference | Each | None] = _NOTHING,
        priority: int = WAITED,
    ) -> JobRequest:
        """A request with typed arguments.

        Args:
            kind: of the job.
            arguments: with the values of whatever earlier jobs gave.
            taken: fields of the arguments (`camera`, `registrations/colmap`) in which such a value stands, and the
                reference that is recorded in its place; None where nothing can be referred to, so that the value
                itself is recorded.
            priority: see service.core.priorities.
        """
        recorded = arguments.plain()
        for path, reference in taken.items():
            if reference is not None:
                *parents, field = path.split("/")
                place = recorded
                for name in parents:
                    place = place[name]
                place[field] = reference.record()
        return cls(kind.name, recorded, priority, kind.version)


@dataclass(frozen=True, slots=True)
class JobResult:
    """What the worker answered."""

    measures: Mapping[str, float]
    artefacts: tuple[ArtefactRef, ...]
    result: Mapping[str, Any]


class Evidence(Protocol):
    """Where a step writes down what happens. Nothing that cannot be recorded is done."""

    def record(self, *payloads: Payload, artefacts: tuple[NewArtefact, ...] = (), actor: str = "") -> None:
        """Append events (and artefact rows) in one transaction."""
        ...

    def put_file(self, path: Path, *, kind: str, media_type: str, original_name: str) -> ArtefactRef:
        """Copy a file into the content-addressed store."""
        ...

    def put_bytes(self, data: bytes, *, kind: str, media_type: str, original_name: str) -> ArtefactRef:
        """Write bytes into the content-addressed store."""
        ...

    def path(self, ref: ArtefactRef) -> Path:
        """Where the bytes of an artefact lie."""
        ...

    def holds(self, sha256: str) -> bool:
        """Whether a file with these bytes is in the evidence of this run already."""
        ...

    def captures(self, step_id: str) -> tuple[View, ...]:
        """The valid captures of a step's current attempt, this moment's included, in order."""
        ...

    def run_jobs(self, *requests: JobRequest) -> tuple[JobResult, ...]:
        """Enqueue jobs (once, whatever restarts) and wait for the worker's results, in order."""
        ...

    def enqueue(self, request: JobRequest, name: str) -> None:
        """Enqueue a job without waiting for it, once for each `name` (and again after it has failed)."""
        ...

    def asked(self) -> tuple[Literal["release", "finish"], ...]:
        """What people at screens have asked of this step so far, in order."""
        ...

    def jobs(self, step_id: str) -> tuple[JobState, ...]:
        """The jobs of a step, as they stand at this moment, in the order in which they were enqueued."""
        ...

    def state(self) -> RunState:
        """The run as it stands at this moment."""
        ...

    def require_space(self) -> None:
        """Before each photograph: raises SpaceShortError where the disk would soon be full."""
        ...


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
    busy: Callable[[str], None] = lambda _what: None  # said before a call that takes its time, until the checkpoint

    @property
    def state(self) -> StepState:
        """The folded state of this step, as of the start of this execution."""
        return self.run.steps[self.step.id]

    def note(self, note: str, **data: Any) -> None:
        """Record a StepNote."""
        self.evidence.record(StepNote(step=self.step.id, attempt=self.attempt, note=note, data=data))


@dataclass(frozen=True, slots=True)
class StepOutcome:
    """The numbers a step measured (gates judge them), what it produced, and its Result."""

    measures: MeasureRecord
    artefacts: tuple[ArtefactRef, ...] = ()
    result: Mapping[str, Any] = field(default_factory=dict[str, Any])
    uncertainties: Mapping[str, Uncertainty] = field(default_factory=dict[str, Uncertainty])  # of some measures


@dataclass(frozen=True, slots=True)
class BeforeStep:
    """What a kind's words may tell: the step's title, how many images are to be taken, and at which stations."""

    title: str
    views_left: int
    stations: str  # "station 1 and station 2"; "" for none

    @property
    def at_stations(self) -> str:
        """` at station 1`, or nothing."""
        return f" at {self.stations}" if self.stations else ""

    def images(self, of: str = "") -> str:
        """`1 image`, `8 images of the board`."""
        return f"{self.views_left} {'image' if self.views_left == 1 else 'images'}{of}"


@dataclass(frozen=True, slots=True)
class Announcement:
    """What a confirmation does: the large words of its button after `Confirm: `, and a line below."""

    does: str
    below: str = "Nothing moves."


ROBOT_MOVES = "The robot moves. Everybody stays outside of its reach."


@dataclass(frozen=True, slots=True)
class StepKind(Generic[P]):
    """One kind of step, declared once.

    Attributes:
        name: in the protocol.
        params: its section of the protocol.
        measures: the numbers that it yields, for gates.
        result: what it leaves to later steps.
        execute: does it.
        registered_by: the step whose registrations the measures are of, where they are RegistrationMeasures; None:
            this step itself.
        words: what a person reads who is about to confirm it.
        drawing: that is shown beside the instructions (service/web/run/drawings), where the protocol names no other.
    """

    name: str
    params: type[P]
    measures: type[MeasureRecord]
    result: type[Record]
    execute: Callable[[StepContext, P], StepOutcome]
    registered_by: Callable[[P, Mapping[str, Step]], Step | None] | None = None
    words: Callable[[P, BeforeStep], Announcement] | None = None
    drawing: str = ""
