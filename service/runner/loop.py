"""The imperative loop: decide → act → append. Only this package executes decisions and drives hardware."""

from __future__ import annotations

import dataclasses
import socket
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from os import getpid

from drivers.errors import DeviceChangedError
from drivers.interfaces import DeviceReport, PedalReading
from service.core.errors import OrthocaptureError
from service.core.gates import describe_judged
from service.core.protocol import Protocol
from service.core.recorded_devices import CHANGED, NOT_CALIBRATED, exchanged, exchanged_words, recorded_report
from service.core.records.run_events import (
    ActionRefused,
    DeviceOpened,
    DeviceTrouble,
    OperatorAction,
    RunCompleted,
    SessionStarted,
    StepNote,
    StepPassed,
    StepRetried,
    StepStarted,
)
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
from service.core.run.state import HandWork, RunState
from service.monitor.reporter import host_clock
from service.runner.execution import Starvation, StepExecution, WorkerWatch, held_up_here
from service.runner.held_run import AnswerBy, HeldRun, Operator, held_run, software_versions
from service.runner.leave import LeaveWatch, Pedal
from service.runner.upkeep import PASSING, ClockWatch, DiskWatch, RecordTrouble, Seal, short_collections
from service.steps.context import Devices
from service.store.database.database import Changes
from service.store.signatures.second_place import SecondPlace
from service.store.signatures.timestamps import Authority
from service.store.store import Store

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
