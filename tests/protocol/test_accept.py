"""Accepting a gate that is outside its limits: who may do it, what it binds, and that every reader is told."""

from __future__ import annotations

import io
import json
import os
import pty
import re
import select
import termios
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from service.cli.main import app
from service.cli.operators import Display, SimulatedHands, TerminalOperator
from service.cli.terminal_output import Terminal
from service.core.errors import ProtocolError
from service.core.gates import dependent_steps, depends_on
from service.core.protocol import NEVER_ACCEPTED, load_protocol
from service.core.records.run_events import ActionRefused, OperatorAction
from service.core.run.actions import allowed_actions, unmet_requirements
from service.core.run.decide import AskOperator
from service.core.run.fold import fold
from service.core.run.state import RunState
from service.monitor.reporter import OpenDevices, Reporter
from service.people.sessions import People
from service.runner.held_run import AnswerBy
from service.steps import params_models
from service.store.store import Store
from tests.support.pages.web import WebSite, password_of
from tests.support.record.core import TOY, Log, load, toy_protocol
from tests.support.recorded.reported_run import record_reported_run
from tests.support.rig.bench_rig import BenchRig
from tests.support.runs.bench_run import PROTOCOL, Bench, begin_run, bench_store

ROOT = Path(__file__).parents[2]
TOY_ACCEPTING = TOY.replace("min: 3, unit: views}", "min: 3, unit: views, accept_by: supervisor}").replace(
    "max: 1.0}", "max: 1.0, accept_by: another_supervisor}"
)
ACCEPTING = PROTOCOL.replace("viewpoints_captured, min: 3", "viewpoints_captured, min: 5, accept_by: supervisor")


class LeftError(Exception):
    """The person has gone."""


def leave(_question: AskOperator, _state: RunState) -> OperatorAction:
    raise LeftError


def at_failed_capture(text: str = TOY_ACCEPTING, **measures: float) -> Log:
    """The toy protocol after a capture whose figures are outside their limits, confirmed by Bob."""
    log = Log(toy_protocol(text))
    log.do()
    log.act("confirm", actor="Bob")
    log.begin()
    log.measure(**({"views": 2.0, "sharp": 0.5} | measures))
    return log


def accept(log: Log, actor: str = "Emmy", **fields: object) -> None:
    given: dict[str, object] = {"role": "supervisor", "identified": "password", "reason": "enough for a pilot"}
    log.act("accept", actor, **{"signed_sha256": log.state.step.gates_sha256, **given, **fields})


def last_refusal(log: Log) -> str:
    deviation = log.state.deviations[-1]
    assert deviation.kind == "refused", deviation
    return deviation.text


# --- the protocol ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("measure", NEVER_ACCEPTED)
def test_the_protocol_cannot_let_invalid_evidence_be_accepted(measure: str) -> None:
    with pytest.raises(ProtocolError, match=r"nobody accepts it.*accept_by"):
        load(TOY.replace("measure: rms_mm, max: 0.1", f"measure: {measure}, accept_by: supervisor, max: 0.1"))


def test_nobody_but_a_supervisor_can_be_named() -> None:
    with pytest.raises(ProtocolError, match="accept_by"):
        load(TOY_ACCEPTING.replace("accept_by: supervisor", "accept_by: technician"))


# --- the rules -----------------------------------------------------------------------------------------------


def test_an_accepted_step_passes_and_counts_for_what_requires_it() -> None:
    log = at_failed_capture()
    assert "accept" in log.question.options
    accept(log)
    assert log.state.phase == "awaiting_operator"  # its signature is still due
    assert "accepted by Emmy (supervisor): enough for a pilot" in log.question.text
    log.sign()
    log.accept()
    assert log.state.current == "spray"
    assert unmet_requirements(log.protocol.step("spray"), log.state) == ()
    deviation = next(d for d in log.state.deviations if d.kind == "gate_accepted")
    assert deviation.actor == "Emmy"
    assert deviation.text.startswith("Board images used 2 views, allowed ≥ 3; accepted by Emmy")
    assert fold(log.protocol, log.events) == log.state


def test_it_is_refused_where_the_protocol_does_not_say_so() -> None:
    log = at_failed_capture(TOY)
    assert "accept" not in log.question.options
    accept(log)
    assert "allows nobody to accept Board images used" in last_refusal(log)
    half = at_failed_capture(TOY_ACCEPTING.replace(", accept_by: another_supervisor", ""), sharp=3.0)
    accept(half)
    assert "allows nobody to accept Sharp outside" in last_refusal(half)


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"reason": " "}, "needs a reason"),
        ({"role": ""}, "only a supervisor may accept"),
        ({"role": "technician"}, "only a supervisor may accept"),
        ({"signed_sha256": "0" * 64}, "figures other than"),
        ({"automatic": True}, "only a person"),
        ({"via": "pedal"}, "only a person"),
        ({"actor": " "}, "only a supervisor may accept"),
        ({"step": "spray"}, "not the current one"),
    ],
)
def test_it_needs_a_person_a_role_a_reason_and_the_figures(fields: dict[str, object], why: str) -> None:
    log = at_failed_capture()
    before = log.state
    given = dict(fields)
    accept(log, str(given.pop("actor", "Emmy")), **given)
    assert why in last_refusal(log)
    assert log.state.steps == before.steps


@pytest.mark.parametrize("actor", ["Ada", "Bob"])  # Ada began the run, Bob confirmed the step
def test_another_supervisor_is_another_one(actor: str) -> None:
    log = at_failed_capture(sharp=3.0)
    accept(log, actor)
    assert "somebody other than" in last_refusal(log)
    accept(log, "Emmy")
    assert log.state.step.accepted is not None
    at_ease = at_failed_capture()  # `supervisor` alone: the operator may, if that is the required role
    accept(at_ease, actor)
    assert at_ease.state.step.accepted is not None


def test_what_was_not_measured_cannot_be_judged_by_anybody() -> None:
    log = at_failed_capture(views=float("nan"))
    assert "accept" not in allowed_actions(log.protocol, log.state)
    accept(log)
    assert "was not measured" in last_refusal(log)


def test_only_a_failed_gate_is_accepted_and_only_while_nothing_moves_on() -> None:
    log = Log(toy_protocol(TOY_ACCEPTING))
    accept(log)
    assert "no figure" in last_refusal(log)
    failed = at_failed_capture()
    failed.act("pause")
    accept(failed)
    assert "paused" in last_refusal(failed)
    failed.act("resume")
    failed.act("confirm")
    accept(failed)
    assert "tried again" in last_refusal(failed)


def test_a_redo_forgets_the_acceptance_and_keeps_the_deviation() -> None:
    log = at_failed_capture()
    accept(log)
    log.act("redo", step="capture", reason="better light now")
    assert log.state.step.accepted is None
    assert [d.kind for d in log.state.deviations] == ["gate_accepted", "redo"]


def test_later_steps_that_use_it_depend_on_it() -> None:
    paper = load_protocol(ROOT / "protocols" / "exvivo_spine.yaml", params_models()).protocol
    rest = dependent_steps(paper, "intrinsics")
    assert rest[:2] == ("hand_eye", "viewpoint_capture_1")
    assert {"registration", "evaluation"} <= set(rest)
    assert "scanning" not in rest
    assert dependent_steps(toy_protocol(), "capture") == ()  # `requires` is not the use of a result
    log = at_failed_capture()
    accept(log)
    assert [gate.step for gate in depends_on(log.protocol, log.state, "capture")] == ["capture"]
    assert depends_on(log.protocol, log.state, "register") == ()


# --- on the screen ---------------------------------------------------------------------------------------------


def failed_capture(web: WebSite) -> Bench:
    """A run whose capture waits for a decision on its screen; it has 4 of 5 views."""
    bench = web.begin_run(ACCEPTING)
    bench.script("capture", "recovery", leave)
    with pytest.raises(LeftError):
        bench.run()
    web.site.launcher.start(bench.run_id)
    return bench


def send(web: WebSite, bench: Bench, account: str, password: str | None = None, *, step: str = "capture") -> int:
    browser = web.browser("technician")
    web.take_control(bench.run_id, browser)
    page = browser.get(f"/runs/{bench.run_id}", params={"dialog": "accept"}).text
    assert re.search(r'<dialog id="dialog-accept"[^>]* open>', page)
    found = re.search(r'name="signed_sha256" value="(\w+)"', page)
    assert found is not None
    return browser.send_form(
        f"/runs/{bench.run_id}/actions",
        verb="accept",
        step=step,
        attempt=1,
        seen_seq=bench.state().seq,
        signed_sha256=found[1],
        reason="one view less",
        account=account,
        password=password_of(account) if password is None else password,
    ).status_code


def test_a_supervisor_accepts_on_the_technicians_screen(web: WebSite) -> None:
    bench = failed_capture(web)
    assert send(web, bench, "emmy") == 303
    accepted = bench.state().steps["capture"].accepted
    assert accepted is not None
    assert (accepted.by, accepted.role, accepted.identified) == ("emmy", "supervisor", "password")
    page = web.browser("auditor").get(f"/runs/{bench.run_id}", params={"step": "capture"}).text
    assert "This depends on an accepted gate" in page
    bench.operator.script = {}
    assert bench.run().status == "completed"  # the irreversible step that requires it continues
    bench.must_verify()


@pytest.mark.parametrize(("account", "password"), [("grace", None), ("emmy", "guessed"), ("", ""), ("nobody", "x")])
def test_a_technician_a_wrong_password_and_a_stranger_are_refused(
    web: WebSite, account: str, password: str | None
) -> None:
    bench = failed_capture(web)
    assert send(web, bench, account, password) in (401, 403)
    assert bench.state().steps["capture"].accepted is None


def test_it_is_not_offered_where_the_protocol_does_not_allow_it(web: WebSite) -> None:
    bench = web.begin_run(ACCEPTING.replace(", accept_by: supervisor", ""))
    bench.script("capture", "recovery", leave)
    with pytest.raises(LeftError):
        bench.run()
    web.site.launcher.start(bench.run_id)
    browser = web.browser("supervisor")
    web.take_control(bench.run_id, browser)
    assert 'id="dialog-accept"' not in browser.get(f"/runs/{bench.run_id}").text
    answered = browser.send_form(
        f"/runs/{bench.run_id}/actions",
        verb="accept",
        step="capture",
        attempt=1,
        seen_seq=bench.state().seq,
        signed_sha256=bench.state().step.gates_sha256,
        reason="please",
        account="emmy",
        password=password_of("emmy"),
    )
    assert answered.status_code == 409
    assert bench.payloads(ActionRefused)[-1].action == "accept"


# --- on the command line -----------------------------------------------------------------------------------------


def invoke(*arguments: object, typed: str | None = None) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments], input=typed, catch_exceptions=False)


def act(folder: Path, run: str, name: str, typed: str | None = None) -> Result:
    command = ["act", "accept", "--run", run, "--data", folder / "data", "--reason", "enough", "--operator", name]
    return invoke(*command, *(["--password-stdin"] if typed is not None else []), typed=typed)


@pytest.mark.slow
def test_act_asks_for_the_password_of_an_account_of_that_role(web: WebSite) -> None:
    bench = failed_capture(web)
    assert act(web.folder, bench.run_id, "emmy", "wrong\n").exit_code == 1
    assert "this needs a supervisor" in act(web.folder, bench.run_id, "grace", password_of("grace") + "\n").output
    assert bench.state().steps["capture"].accepted is None
    assert act(web.folder, bench.run_id, "Emmy", password_of("emmy") + "\n").exit_code == 0
    accepted = bench.state().steps["capture"].accepted
    assert accepted is not None
    assert (accepted.by, accepted.identified) == ("emmy", "password")


def plainly(folder: Path, run: str, verb: str, name: str, typed: str | None = None) -> Result:
    command = ["act", verb, "--run", run, "--data", folder / "data", "--operator", name]
    return invoke(*command, *(["--password-stdin"] if typed is not None else []), typed=typed)


@pytest.mark.slow
def test_whoever_acts_in_the_name_of_an_account_gives_its_password(web: WebSite) -> None:
    bench = failed_capture(web)
    assert plainly(web.folder, bench.run_id, "confirm", "emmy", "guessed\n").exit_code == 1
    assert not bench.state().step.retry_granted
    assert plainly(web.folder, bench.run_id, "pause", "emmy").exit_code == 0, "nobody is kept from pausing"
    assert plainly(web.folder, bench.run_id, "resume", "Emmy", password_of("emmy") + "\n").exit_code == 0
    assert plainly(web.folder, bench.run_id, "confirm", "A Stranger").exit_code == 1
    assert not bench.state().step.retry_granted
    assert plainly(web.folder, bench.run_id, "confirm", "emmy", password_of("emmy") + "\n").exit_code == 0
    with Store.open(web.folder / "data") as store:
        events = [event for event in store.events(bench.run_id) if isinstance(event.payload, OperatorAction)]
    known = [(event.actor, event.payload.model_dump()["identified"]) for event in events[-3:]]
    assert known == [("claimed:emmy", "claimed"), ("emmy", "password"), ("emmy", "password")]


def test_without_accounts_a_name_is_a_claim_and_the_record_says_so(tmp_path: Path) -> None:
    run = record_reported_run(tmp_path, error_mm=0.9)
    assert act(tmp_path, run, "Emmy").exit_code == 1  # this protocol allows nobody to accept it
    other = tmp_path / "other"
    other.mkdir()
    with bench_store(other / "data") as store:
        bench = begin_run(store, ACCEPTING, other)
        bench.script("capture", "recovery", leave)
        with pytest.raises(LeftError):
            bench.run()
        assert act(other, bench.run_id, "Emmy").exit_code == 0
        accepted = bench.state().steps["capture"].accepted
    assert accepted is not None
    assert accepted.identified == "claimed"
    assert "(supervisor, by claim)" in bench_text(other, bench.run_id)


def bench_text(folder: Path, run: str) -> str:
    return str(json.loads(invoke("status", run, "--data", folder / "data", "--json").stdout)["deviations"])


class Typed:
    """A terminal operator on a pseudo-terminal, asked about a failed capture."""

    def __init__(self, folder: Path, people: People) -> None:
        self.log = at_failed_capture()
        self.master, self.slave = pty.openpty()
        self.screen = io.StringIO()
        reporter = Reporter(folder, "run", OpenDevices, BenchRig().camera_named)
        display = Display(Terminal(file=self.screen, width=500), reporter)
        self.operator = TerminalOperator(
            "Ada", self.log.protocol, display, SimulatedHands(None), descriptor=self.slave, people=people
        )

    def line(self, text: str) -> OperatorAction | AnswerBy | None:
        """The operator's interpretation of a typed line."""
        self.operator.poll(self.log.question, self.log.state)  # asks, with an empty line buffer
        os.write(self.master, text.encode() + b"\n")
        while not select.select([self.slave], [], [], 0.1)[0]:
            pass
        return self.operator.poll(self.log.question, self.log.state)

    @property
    def told(self) -> str:
        """The last line that was printed."""
        return self.screen.getvalue().splitlines()[-1]

    @property
    def echoes(self) -> bool:
        return bool(termios.tcgetattr(self.slave)[3] & termios.ECHO)

    def close(self) -> None:
        self.operator.close()
        os.close(self.master)
        os.close(self.slave)


def test_at_the_terminal_a_supervisor_types_name_and_hidden_password(web: WebSite) -> None:
    typed = Typed(web.folder, web.people)
    try:
        assert typed.line("accept") is None
        assert "needs a reason" in typed.told
        assert typed.line("accept one view less") is None
        assert "The name of the supervisor" in typed.told
        assert typed.line("emmy") is None
        assert not typed.echoes
        assert typed.line("guessed") is None
        assert typed.echoes
        assert "do not belong together" in typed.told
        for text in ("accept one view less", "Emmy"):
            assert typed.line(text) is None
        spoken = typed.line(password_of("emmy"))
        assert isinstance(spoken, AnswerBy)
        assert (spoken.actor, spoken.action.role, spoken.action.identified) == ("emmy", "supervisor", "password")
        state = typed.log.append(spoken.action, spoken.actor)
        assert state.step.accepted is not None
        assert typed.echoes
    finally:
        typed.close()


def test_at_the_terminal_a_name_that_nobody_has_ends_no_run(tmp_path: Path) -> None:
    with Store.open(tmp_path / "data") as store:
        typed = Typed(tmp_path, People(store))
        try:
            for name in ("runner", "\u0435mmy", "em\u200bmy"):
                for text in ("accept one view less", name):
                    assert typed.line(text) is None
                assert typed.line("") is None
                assert "cannot be a person's name" in typed.told
            for text in ("accept one view less", "李明"):
                assert typed.line(text) is None
            spoken = typed.line("")
            assert isinstance(spoken, AnswerBy)
            assert (spoken.actor, spoken.action.identified) == ("李明", "claimed")
        finally:
            typed.close()
