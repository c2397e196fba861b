"""Drives a run: the execution of a step on the rig's devices, and the loop that decides, acts and appends."""

from __future__ import annotations

import dataclasses
import logging
import math
import socket
from collections.abc import Callable, Collection
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from os import getpid
from pathlib import Path
from typing import Protocol as Interface

from drivers.errors import DeviceChangedError, DeviceError
from drivers.interfaces import DeviceReport, PedalReading
from drivers.machine_pressure import HeldUp
from service.core.errors import OrthocaptureError, UnforeseenError
from service.core.gates import describe_judged
from service.core.protocol import Protocol, Step
from service.core.recorded_devices import CHANGED, NOT_CALIBRATED, exchanged, exchanged_words, recorded_report
from service.core.records.base import recorded
from service.core.records.events import Payload
from service.core.records.run_events import (
    ActionRefused,
    DeviceOpened,
    DeviceTrouble,
    OperatorAction,
    RunCompleted,
    SessionStarted,
    StepFailed,
    StepMeasured,
    StepNote,
    StepPassed,
    StepRetried,
    StepStarted,
)
from service.core.recovery import TRIED_AGAIN, recovery_policy
from service.core.run.actions import refuse
from service.core.run.decide import (
    Accept,
    AskOperator,
    EvaluateGates,
    FinishRun,
    Halt,
    Retry,
    RunStep,
    decide,
    evaluate_gates,
)
from service.core.run.expected import tries_words
from service.core.run.state import HandWork, JobState, RunState
from service.core.words import counted
from service.logs import at
from service.monitor.reporter import host_clock
from service.monitor.snapshot import living_workers
from service.runner.held_run import AnswerBy, HeldRun, Operator, held_run, software_versions
from service.runner.leave import LeaveWatch, Pedal
from service.runner.upkeep import PASSING, ClockWatch, DiskWatch, RecordTrouble, Seal, short_collections
from service.steps import step_kinds
from service.steps.context import Devices, Evidence, LeaveToMove, StepContext, StepInterruptedError, StepOutcome
from service.store.database.database import Changes
from service.store.durable_effects import Clock, moment_of
from service.store.signatures.second_place import SecondPlace
from service.store.signatures.timestamps import Authority
from service.store.store import Store

# --- the execution of a step --------------------------------------------------------------------------------------

_log = logging.getLogger(__name__)
_NOBODY_S = 30.0  # a worker that died has been replaced by then
_TOLD_AGAIN_S = 300.0
_EVERY_S = 5.0
# A machine is short of processors if this program could not run for this share of the time in which it wanted to, and
# for a second at least.
_SHORT_SHARE, _SHORT_S = 0.4, 1.0


class Starvation(Interface):
    """The time for which this program was prevented from running, since it was made."""

    @property
    def seconds(self) -> float:
        """The longest time that one of its threads has waited."""
        ...

    @property
    def share(self) -> float:
        """The part, 0 to 1, of the time in which it wanted to run and could not."""
        ...


def held_up_here() -> Starvation:
    """Measure this program from now on."""
    return HeldUp("self")


@dataclass
class WorkerWatch:
    """Notices that jobs of a step wait and no worker runs, and warns the operator, from time to time again."""

    data: Path
    tell: Callable[[str], None]
    clock: Clock
    _look_at_s: float = field(default=-math.inf, init=False)
    _tell_at_s: float | None = field(default=None, init=False)

    def look(self, jobs: Collection[JobState]) -> None:
        """Look at the jobs of the step under way. Called again and again; looks every few seconds."""
        now_s = self.clock.monotonic_s()
        if now_s < self._look_at_s:
            return
        self._look_at_s = now_s + _EVERY_S
        open_jobs = sum(job.status == "enqueued" for job in jobs)
        if not open_jobs or living_workers(self.data, self.clock):
            self._tell_at_s = None
            return
        if self._tell_at_s is None:
            self._tell_at_s = now_s + _NOBODY_S
        if now_s >= self._tell_at_s:
            self._tell_at_s = now_s + _TOLD_AGAIN_S
            waiting = f"{counted(open_jobs, 'computation')} wait{'s' if open_jobs == 1 else ''}"
            self.tell(f"{waiting}, and no worker is running. Start one with `orthocapture worker --data {self.data}`")


@dataclass(frozen=True)
class StepExecution:
    """Executes steps of a held run with the devices of its rig."""

    run: HeldRun
    protocol: Protocol
    devices: Devices
    operator: Operator
    disk: DiskWatch
    workers: WorkerWatch
    leave: LeaveWatch
    clock: Clock
    held_up: Callable[[], Starvation] = held_up_here

    def execute(self, step_id: str, attempt: int) -> None:
        """Execute a step and record its outcome or failure; an interruption by an operator is only reported.

        No error of a step ends the run: after one that nobody foresaw the arms stand, and a person is asked.
        """
        step = self.protocol.step(step_id)
        starvation = self.held_up()
        at(step=step_id, viewpoint="")
        checkpoint = partial(self._checkpoint, step_id, attempt)
        context = self._context(step, attempt, checkpoint)
        self.leave.attempt()
        if (leave := self.run.state.leave) is not None:
            self.devices.let_move(LeaveToMove(leave.seq, leave.by, self.run.follower.leave_not_before_s))
        try:
            checkpoint()
            if step.needs_disk:
                self.disk.require()
            outcome = step_kinds()[step.kind].execute(context, step.params)
        except StepInterruptedError as interruption:
            self.operator.tell(str(interruption))
        except OrthocaptureError as error:
            self.failed(step_id, attempt, error, starvation)
        except Exception as error:  # noqa: BLE001 - of a library, over a stranger's file, say
            _log.info("%s", step_id, exc_info=True)  # below what the terminal shows
            if step.moves_robot:
                self.devices.hold_arms()
            self.failed(step_id, attempt, _unforeseen(step, error), starvation)
        else:
            self._measured(step_id, attempt, outcome)

    def note_connections(self) -> None:
        """Record which connections to arms have ended."""
        for end in self.devices.ended_connections():
            self.run.append(
                DeviceTrouble(device=end.device, error=end.error, message=end.message, connection=end.how)
            )

    def _context(self, step: Step, attempt: int, checkpoint: Callable[[], None]) -> StepContext:
        operator = self.operator
        return StepContext(
            protocol=self.protocol,
            step=step,
            attempt=attempt,
            run=self.run.state,
            devices=self.devices,
            evidence=Evidence(
                self.run.follower,
                self.run.lease,
                step.id,
                attempt,
                checkpoint,
                self._show,
                self.leave.wait_for_results,
                self.disk.require,
            ),
            checkpoint=checkpoint,
            progress=self._show,
            monotonic_s=self.clock.monotonic_s,
            wait=self.clock.sleep,
            operator=operator.name,
            tell=operator.tell,
            moment=partial(moment_of, self.clock),
            motion=self.leave.motion,
            wait_for_results=self.leave.wait_for_results,
            busy=operator.busy,
        )

    def _show(self, what: str, done: int, total: int) -> None:
        self.leave.progress(what, done)
        self.operator.show(what, done, total)

    def _measured(self, step: str, attempt: int, outcome: StepOutcome) -> None:
        self.run.append(
            StepMeasured(
                step=step,
                attempt=attempt,
                measures=outcome.measures.plain(),
                artefacts=outcome.artefacts,
                result={} if outcome.result is None else recorded(outcome.result),
                uncertainties=dict(outcome.uncertainties),
                computed_by=outcome.computed_by,
            )
        )

    def failed(
        self, step_id: str, attempt: int, error: OrthocaptureError, starvation: Starvation | None = None
    ) -> None:
        """Record that a step failed, and what follows; `starvation` is that of this program during the attempt."""
        self.note_connections()
        state = self.run.refresh().steps[step_id]
        name = type(error).__name__
        short = name in TRIED_AGAIN and starvation is not None and _short(starvation)
        policy = recovery_policy(self.protocol.step(step_id).recovery, name, state.failures + 1, starved=short)
        payloads: list[Payload] = []
        message = str(error)
        if short and starvation is not None:
            lacked = {"waited_s": round(starvation.seconds, 1), "share": round(starvation.share, 2)}
            payloads.append(StepNote(step=step_id, attempt=attempt, note="processor_short", data=lacked))
            message += (
                f". This computer is short of processor time: the program wanted to run and could not for "
                f"{lacked['waited_s']:.0f} s, {100 * lacked['share']:.0f} % of the time"
            )
        if isinstance(error, DeviceError):
            payloads.append(DeviceTrouble(device=error.where or step_id, error=name, message=str(error)))
        payloads.append(StepFailed(step=step_id, attempt=attempt, error=name, message=message, recovery=policy))
        self.run.append(*payloads)
        kept = self.run.state.origin
        self.operator.tell(f"{step_id}: {error}. What was {kept} is safe")

    def _checkpoint(self, step: str, attempt: int) -> None:
        """Called by steps wherever they may stop. Raises StepInterruptedError if an operator paused or ended it."""
        self.note_connections()
        state = self.run.refresh()
        self.leave.look(state)
        self.operator.attend("pausing" if state.paused else "working", state, pedal_armed=False)
        self.workers.look(state.steps[step].jobs.values())
        if state.paused:
            raise StepInterruptedError("paused")
        if state.terminal or (state.current, state.step.attempt, state.phase) != (step, attempt, "running"):
            raise StepInterruptedError(f"the operator has ended this attempt; the run is {state.status}")


def _short(starvation: Starvation) -> bool:
    return starvation.seconds >= _SHORT_S and starvation.share >= _SHORT_SHARE


def _unforeseen(step: Step, error: Exception) -> UnforeseenError:
    if step.moves_robot:
        remedy = "The robot was stopped and moves for nobody until you confirm: look at it, then repeat the step"
    else:
        remedy = "Take the file away that it was about, or use another one, then repeat the step"
    return UnforeseenError(
        f"this was not foreseen: {type(error).__name__}: {error}",
        where=str(getattr(error, "filename", None) or f"step {step.id}"),
        remedy=f"{remedy}; the log says more",
    )


# --- the loop -----------------------------------------------------------------------------------------------------

_POLL_S = 0.1


@dataclass
class Runner:
    """Drives one run to its end, by the store's clock.

    `authority`, if given, stamps the record when the run ends; `second_place` gets copies of the signatures;
    `held_up` begins to measure how long the machine prevents this program from running.
    """

    store: Store
    run_id: str
    protocol: Protocol
    devices: Devices
    operator: Operator
    authority: Authority | None = None
    second_place: SecondPlace | None = None
    held_up: Callable[[], Starvation] = held_up_here
    _run: HeldRun = field(init=False)
    _changes: Changes = field(init=False)
    _seal: Seal = field(init=False)
    _pedal: Pedal = field(init=False)
    _clocks: ClockWatch = field(init=False)
    _leave: LeaveWatch = field(init=False)
    _steps: StepExecution = field(init=False)
    _unprepared: set[str] = field(init=False, default_factory=set[str])  # steps whose simulated technician failed

    def run(self) -> RunState:
        """Take the lease, record the session, and execute decisions until the run ends; a paused run waits here.

        Only a person ends the run: what fails is asked about or waited out. Raises LeaseHeldError if another runner
        drives the run, LeaseLostError if one has taken it over, IntegrityError if the record is not what it was,
        PersonNeededError if nobody attends who could decide.
        """
        operator, clock = self.operator, self.store.clock
        with (
            short_collections(),
            closing(self.store.changes("chains")) as self._changes,
            held_run(self.store, self.run_id, self.protocol) as self._run,
        ):
            place = self.second_place or SecondPlace([], clock)
            self._seal = Seal(self.store, self.run_id, self.authority, place, operator.busy, operator.tell)
            if self._run.state.terminal:
                self._seal.sign_if_missing()
                return self._run.state
            disk = DiskWatch(self._run, self.protocol, operator.tell, clock.monotonic_s)
            self._pedal = Pedal(self._pedal_reading, clock.monotonic_s, operator.tell)
            self._clocks = ClockWatch(self._run.follower, operator.tell)
            data = self.store.database_path.parent
            workers = WorkerWatch(data, operator.tell, clock)
            self._leave = LeaveWatch(self._run, self.protocol, data, clock, operator.tell)
            self._steps = StepExecution(
                self._run, self.protocol, self.devices, operator, disk, workers, self._leave, clock, self.held_up
            )
            self._begin_session()
            disk.forecast()
            trouble = RecordTrouble(self.store, self.devices, operator)
            try:
                while not self._run.state.terminal:
                    try:
                        trouble.over(self._note_wait)
                        self._go_on()
                    except PASSING as error:
                        trouble.wait_out(error)
                return self._run.state
            finally:
                self._seal.sign(ended=self._run.state.terminal)

    def _go_on(self) -> None:
        """Read what is new, and do what is due."""
        state = self._run.refresh()
        if not state.terminal:
            self._leave.look(state)
            self._steps.note_connections()
            self._act(state)

    def _note_wait(self, why: str, waited_s: float) -> None:
        """Record that the run could not go on for a time; what lets the robot move does not outlast that."""
        state = self._run.refresh()
        if state.terminal:
            return
        data = {"why": why, "waited_s": round(waited_s, 1)}
        self._run.append(StepNote(step=state.current, attempt=state.step.attempt, note="run_waited", data=data))
        self._leave.end(self._run.refresh(), why)

    def submit(self, action: OperatorAction, actor: str) -> None:
        """Record an action if it is allowed now; otherwise record its refusal and show the operator the reason."""
        refusal = refuse(self.protocol, self._run.refresh(), action, actor)
        if refusal is None:
            self._leave.given_here()
            self._run.append(action, actor=actor)
            return
        self._run.append(ActionRefused(action=action.action, step=action.step, why=str(refusal)), actor=actor)
        self.operator.tell(f"refused: {refusal}")

    def _begin_session(self) -> None:
        resumed = self._run.state.sessions > 0
        if resumed:
            self._seal.sign(ended=False)  # sign what the last runner could not sign any more
        self._run.append(
            SessionStarted(
                resumed=resumed,
                software=software_versions(),
                host=socket.gethostname(),
                pid=getpid(),
                host_clock=host_clock(),
            )
        )
        self.devices.watch(self._opened, lambda name: self.operator.busy(f"connecting the {name}"))

    def _act(self, state: RunState) -> None:
        decision = decide(self.protocol, state)
        match decision:
            case AskOperator():
                self._ask(decision, state)
            case RunStep(step, attempt, begin):
                if begin:
                    if not self._prepared(step, attempt):
                        return
                    self._run.append(StepStarted(step=step, attempt=attempt))
                elif step in self._unprepared and not self._prepared(step, attempt):
                    return
                self._steps.execute(step, attempt)
                self._clocks.look()
            case EvaluateGates():
                self._judge(decision, state)
            case Accept(step, attempt):
                self._run.append(StepPassed(step=step, attempt=attempt))
                self._seal.sign(ended=False)
                self.operator.tell(f"{self.protocol.step(step).title}: passed")
            case Retry():
                self._retry(decision, state)
            case FinishRun(deviations):
                self._run.append(RunCompleted(deviations=deviations))
            case Halt():
                self.operator.show("paused", 0, 0)
                self.operator.attend("paused", state, pedal_armed=False)
                self._changes.wait(_POLL_S)

    def _prepared(self, step: str, attempt: int) -> bool:
        """Let a simulated technician do what was confirmed; if that fails, so does the attempt."""
        self._unprepared.add(step)
        try:
            self.operator.prepare(step, attempt)
        except OrthocaptureError as error:
            if self._run.state.phase == "ready":
                self._run.append(StepStarted(step=step, attempt=attempt))
            self._steps.failed(step, attempt, error)
            return False
        self._unprepared.discard(step)
        return True

    def _judge(self, due: EvaluateGates, state: RunState) -> None:
        step = self.protocol.step(due.step)
        verdicts = evaluate_gates(step, due.attempt, due.measures, state.skipped, due.uncertainties)
        self._run.append(verdicts)
        for verdict in verdicts.verdicts:
            if not verdict.passed:
                outside = "" if verdict.undecided else ": outside its limits"
                self.operator.tell(f"{due.step}: {describe_judged(verdict)}{outside}")

    def _retry(self, decision: Retry, state: RunState) -> None:
        """Begin again after the wait, unless the decision has changed by then, such as by a pause or an abort."""
        left_s = decision.wait_s
        if not state.step.retry_granted:
            self.operator.tell(tries_words(self.protocol, state) or decision.why)
        while left_s > 0:
            self.store.clock.sleep(min(_POLL_S, left_s))
            left_s -= _POLL_S
            now = self._run.refresh()
            if decide(self.protocol, now) != decision or self._leave.lapsed(now):
                return
            self._steps.note_connections()
            self.operator.attend("working", now, pedal_armed=False)
        if not state.step.retry_granted and self._leave.lapsed(self._run.refresh()):
            return
        unable = None
        if state.step.retry_granted:
            hands = () if state.step.mend is None else state.step.mend.hands
            unable = self._mended(decision, hands)
        self._run.append(StepRetried(step=decision.step, attempt=decision.attempt, why=decision.why))
        if unable is not None:
            self._steps.failed(decision.step, decision.attempt, unable)

    def _mended(self, decision: Retry, hands: tuple[HandWork, ...]) -> OrthocaptureError | None:
        """Let a simulated technician do what the step asked for; the error if that cannot be done."""
        try:
            self.operator.mend(decision.step, decision.attempt, hands)
        except OrthocaptureError as error:
            return error
        return None

    def _ask(self, question: AskOperator, state: RunState) -> None:
        answer = self._by_pedal(question, state) or self.operator.poll(question, state)
        self.operator.attend("asking", state, pedal_armed=self._pedal.armed, asked=question)
        if answer is None:
            self._changes.wait(_POLL_S)
        elif isinstance(answer, AnswerBy):
            self.submit(answer.action, answer.actor)
        else:
            self.submit(answer, self.operator.name)

    def _by_pedal(self, question: AskOperator, state: RunState) -> OperatorAction | None:
        if not self._pedal.confirms(question, moves_robot=self.protocol.step(question.step).moves_robot):
            return None
        ticked = self.operator.ticked(question, state)
        return OperatorAction(action="confirm", step=question.step, checklist=ticked, via="pedal")

    def _pedal_reading(self) -> PedalReading | None:
        lightbox = self.devices.lightbox()
        return None if lightbox is None else lightbox.pedal()

    def _opened(self, device: str, report: DeviceReport) -> None:
        """Record what was opened.

        Raises DeviceChangedError if it is another one than before, until a person has decided to go on.
        """
        before = self._run.follower.now().events
        opened = DeviceOpened(device=device, report=dataclasses.asdict(report))
        self._run.append(opened)
        self._clocks.look()
        identity = recorded_report(opened.report).identity
        other = exchanged(before, device, identity)
        if other is None:
            return
        changed = DeviceChangedError(
            exchanged_words(device, other, identity),
            where=device,
            remedy="What was calibrated with the other one does not hold for this one: connect the other one again, "
            "or repeat the calibration",
        )
        if identity.kind not in NOT_CALIBRATED:
            raise changed
        self.operator.tell(changed.what)
        self._run.append(DeviceTrouble(device=device, error=CHANGED, message=changed.what))
