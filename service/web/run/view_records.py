"""The parts of the run page as plain records; service.web.run.view fills them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol as Interface

from service.core.gates.acceptance import AcceptedGate
from service.core.protocol.models import Protocol
from service.core.records.events import Event, OperatorVerb
from service.core.run.state import Deviation, RunState
from service.jobs.registration.evaluate import Row
from service.run_record import OpenJob
from service.web.run.figures import CaptureProgress, GateLine, Reading


class RecordOfRun(Interface):
    """A run's record: service.run_record.RunRecord."""

    @property
    def protocol(self) -> Protocol:
        """The protocol as it was when the run began."""
        ...

    @property
    def events(self) -> Sequence[Event]:
        """All events, in order."""
        ...

    @property
    def state(self) -> RunState:
        """Their fold."""
        ...


@dataclass(frozen=True, slots=True)
class Viewer:
    """Who looks, and how they stand to the control of this run."""

    may_operate: bool = False
    may_sign: bool = False  # with or without control
    role: str = ""
    loses_release: bool = False  # this person could release the run, and acting on it ends that
    may_take_over: bool = False
    in_control: bool = False  # this screen
    holder: str = ""  # name of whoever has control; "" for nobody
    holder_screen: str = ""
    mine_elsewhere: bool = False  # the same person, on another screen
    asked_by: str = ""  # name of who asks for control
    asked_by_screen: str = ""
    asked_by_me: bool = False
    refused_by: str = ""  # name of who refused this screen's request
    refused_utc: str = ""
    taken_over_by: str = ""  # name of who took control from this person, if that was the last change of control
    taken_over_utc: str = ""
    taken_over_reason: str = ""


@dataclass(frozen=True, slots=True)
class StepLine:
    """A step in the list at the side."""

    id: str
    title: str
    word: str
    tone: str
    icon: str
    shown: bool
    reachable: bool  # something of it can be looked at


@dataclass(frozen=True, slots=True)
class ChecklistItem:
    """An item of the checklist."""

    text: str
    ticked: bool


@dataclass(frozen=True, slots=True)
class JudgedStep:
    """A step that passed while nobody decided anything."""

    step: str
    title: str
    seq: int  # of the event by which it passed
    figures: tuple[str, ...]
    accepted: bool  # outside its limits


@dataclass(frozen=True, slots=True)
class StepView:
    """The step on the screen."""

    id: str
    title: str
    number: int
    attempt: int
    by_hand: bool  # a person takes its images
    only_ticks: bool  # it is nothing but its checklist
    why: str
    instructions: str
    drawing: str
    picture: str  # SHA-256 of the photograph on which the step shows what it found; "" without one
    station: str
    status: str
    current: bool
    checklist: tuple[ChecklistItem, ...]
    open_items: int
    gates: tuple[GateLine, ...]
    warning: str  # of an irreversible step that has not been done
    requires: tuple[tuple[str, bool], ...]
    captured: int
    unused: int  # of them, board images without use
    planned: int
    signed_by: str
    skipped: bool
    started_utc: str
    ended_utc: str
    table: Sequence[Row]  # of an evaluation
    usual: str  # how long it usually takes; "" if that is not known, or it is done
    depends: tuple[AcceptedGate, ...]  # figures accepted outside their limits that this step depends on


@dataclass(frozen=True, slots=True)
class MainAction:
    """The one large target."""

    verb: str  # an operator's verb, or go-on
    text: str
    note: str = ""
    hold: bool = False
    enabled: bool = True
    why_not: str = ""
    recommended: bool = True  # False where the table of ways recommends another one


@dataclass(frozen=True, slots=True)
class StepRedo:
    """A step that can be done again, and what that resets."""

    step: str
    title: str
    resets: tuple[str, ...]
    images: int  # whose evidence stays, but which no longer count


@dataclass(frozen=True, slots=True)
class SignedContent:
    """What a signature binds."""

    sha256: str
    title: str
    figures: tuple[tuple[str, tuple[str, ...]], ...]  # by step
    meaning: str  # offered; the person may change it


@dataclass(frozen=True, slots=True)
class Acceptance:
    """The figures outside their limits that can be accepted now, and who may accept them."""

    sha256: str  # of the figures that the acceptance binds
    title: str
    figures: tuple[str, ...]
    role: str
    another: bool  # neither who began the run nor who confirmed the step
    affects: tuple[str, ...]  # later steps whose results depend on it, and will say so


@dataclass(frozen=True, slots=True)
class StepTrouble:
    """A step that needs a decision."""

    title: str
    short: str  # why it is stopped, and what is recommended
    what: str
    safe: str
    advice: str


@dataclass(frozen=True, slots=True)
class StepMore:
    """What a step asks for in its normal course before it can be judged."""

    title: str
    advice: str
    open: tuple[str, ...]  # figures that what there is does not decide


@dataclass(frozen=True, slots=True)
class Choice:
    """A choice of what to do now."""

    verb: OperatorVerb
    step: str
    words: str
    takes: str
    loses: str
    why_not: str  # "" where it can be taken
    button: str


@dataclass(frozen=True, slots=True)
class Question:
    """What the run asks of people now, and what they can do.

    Attributes:
        main: the one large button; None if there is nothing to press.
        options: further actions.
        can_pause: whether this person can pause the run.
        asked_anew: the program that drove the robot has ended, or the confirmation was too long ago, so nothing moves
            before somebody confirms again.
        lapsed: why the confirmation no longer holds; "" where the program has ended.
        standing: the run is paused and the robot is known to stand still.
        paused: how it stands with a paused run and its robot, in words.
        more: what the step asks for in its normal course; None for nothing, or where something went wrong.
        trouble: why the run is stopped; None if it is not.
        ways: what can be done about that, the recommended one first.
        signature: what is to be signed; None for nothing.
        acceptance: what could be accepted outside its limits; None for nothing.
        redos: steps that can be done again.
        skip_overrides: whether a skip would now override figures outside their limits.
    """

    main: MainAction | None
    options: tuple[OperatorVerb, ...]
    can_pause: bool
    asked_anew: bool
    lapsed: str
    standing: bool
    more: StepMore | None
    paused: str
    trouble: StepTrouble | None
    ways: tuple[Choice, ...]
    signature: SignedContent | None
    acceptance: Acceptance | None
    redos: tuple[StepRedo, ...]
    skip_overrides: bool


@dataclass(frozen=True, slots=True)
class RunView:
    """The run page."""

    run_id: str
    title: str
    seq: int
    status: str  # active, paused, completed, aborted
    mode: str  # ask, sign, more, recover, work, paused, died, ended
    headline: str  # news for screen readers when it changes
    tab: str  # title of the page
    current: str
    attempt: int
    steps: tuple[StepLine, ...]
    passed: int
    shown: StepView
    judged: tuple[JudgedStep, ...]  # since a person last decided something, the newest first
    question: Question
    viewer: Viewer
    progress: CaptureProgress
    readings: tuple[Reading, ...]
    working: tuple[str, int, int]
    takes: tuple[str, ...]  # how long the work usually takes, and until when nobody is needed
    work_left: str  # how long the rest of the run usually takes; "" if that is not known
    tries: str  # what failed and is tried again by itself, in words; "" for nothing
    deviations: tuple[Deviation, ...]
    news: tuple[tuple[str, str], ...]
    to_come: tuple[str, ...]  # results that are still being computed, with the time left
    computing: tuple[OpenJob, ...]  # jobs that wait or are computed, which a person may end
    pedal_armed: bool
    stop_reason: str
    operator: str
    released_by: str
