"""Every stopped step has a way on: every listed choice is taken by a runner, and leads on."""

from __future__ import annotations

import dataclasses
import inspect
import json
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import pytest
from typer.testing import CliRunner

from drivers import errors as device_errors
from drivers.errors import DeviceFaultError
from service.cli.main import app
from service.core import errors as core_errors
from service.core.errors import ComputeError, IntegrityError, OrthocaptureError
from service.core.protocol import irreversible_warning, parse_protocol
from service.core.records.run_events import OperatorAction, OperatorVerb, StepNote
from service.core.recovery import NEEDS_A_PERSON, REMEDIES, WayOn, takes_words, view_s, ways_on
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from service.core.step_params import StepParams
from service.runner.held_run import AnswerBy
from service.steps import step_kinds
from service.steps.context import StepContext, StepOutcome
from service.steps.measures import Count, MeasureRecord
from tests.support.record.core import GOOD, KINDS, Log, toy_protocol
from tests.support.record.core import TOY as TOY_TEXT
from tests.support.record.core_log import at_capture, at_spray, failure
from tests.support.rig.bench_rig import ScriptedOperator
from tests.support.runs.bench_run import Bench, begin_run, bench_store

# One step of each kind; every gate may be accepted, and every step but the irreversible ones skipped.
PROTOCOL = """\
id: all_kinds
version: "1"
title: One step of each kind
spheres: {radius_mm: 15, registration: 10, control: 3}
board: {columns: 4, rows: 5, square_mm: 15}
camera: {aperture_f: 22, exposure_s: 1/50, iso: 100}
steps:
  - {id: hands, kind: checklist, title: Hands, checklist: [done], skippable: true, gates: [{measure: m, max: 1, accept_by: supervisor}]}
  - {id: layout, kind: layout_check, title: Layout, skippable: true, gates: [{measure: m, max: 1, accept_by: supervisor}]}
  - {id: ct, kind: ct_import, title: CT, params: {spheres: 13}, skippable: true, gates: [{measure: m, max: 1, accept_by: supervisor}]}
  - {id: lens, kind: calibration, title: Lens, params: {solve: [intrinsics]}, skippable: true, gates: [{measure: m, max: 1, accept_by: supervisor}]}
  - {id: views, kind: viewpoint_capture, title: Views, params: {purpose: dataset, viewpoints: []}, skippable: true, gates: [{measure: m, max: 1, accept_by: supervisor}]}
  - {id: coat, kind: timed_application, title: Coat, params: {product: Blue, sublimates_after_s: 60, scan_within_s: 30}, skippable: true, gates: [{measure: m, max: 1, accept_by: supervisor}]}
  - {id: scan, kind: scan_import, title: Scan, params: {spheres: 10, application: coat, compare_with: ct}, skippable: true, gates: [{measure: m, max: 1, accept_by: supervisor}]}
  - {id: register, kind: registration, title: Register, params: {images_of: [views], calibration: lens, hand_eye: lens, scan: scan}, skippable: true, gates: [{measure: m, max: 1, accept_by: supervisor}]}
  - {id: judge, kind: evaluation, title: Judge, params: {registration: register, images_of: [views], scan: scan}, skippable: true, gates: [{measure: m, max: 1, accept_by: supervisor}]}
"""  # noqa: E501 - one step a line
STEPS = ("hands", "layout", "ct", "lens", "views", "coat", "scan", "register", "judge")


class Measured(MeasureRecord):
    """What every step of the protocol above yields."""

    m: Annotated[Count, "any number"] = None


@dataclass
class Fakes:
    """Steps that yield a figure or an error, in place of those that need devices."""

    failing: bool = True
    error: OrthocaptureError | None = None  # None: a figure outside its limit
    executed: list[str] = field(default_factory=list[str])

    def kinds(self) -> dict[str, Any]:
        return {name: dataclasses.replace(kind, execute=self.execute) for name, kind in step_kinds().items()}

    def execute(self, context: StepContext, _params: object) -> StepOutcome:
        self.executed.append(context.step.id)
        if self.failing and self.error is not None:
            raise self.error
        return StepOutcome(Measured(m=9.0 if self.failing else 0.5))


class Walker(ScriptedOperator):
    """Takes every offered choice once wherever a step is stopped; those that leave the step come last."""

    def __init__(self, leave_by: OperatorVerb, ends_at: str = "") -> None:
        super().__init__()
        self.leave_by, self.ends_at = leave_by, ends_at
        self.taken: list[tuple[str, OperatorVerb, str]] = []  # stopped step, verb, step of the choice

    def poll(self, question: AskOperator, state: RunState) -> OperatorAction | AnswerBy | None:
        if question.for_ != "recovery":
            return super().poll(question, state)
        available = [way for way in question.ways if way.available]
        assert {way.verb for way in available} - {"abort"}, "to end the run is the only way"
        assert available[-1].verb == "abort"
        assert all(way.words and way.loses for way in available)
        here = question.step
        if here == self.ends_at:
            return self._take(here, available[-1], state)
        stays = [way for way in available if way.verb in ("confirm", "redo")]
        fresh = [way for way in stays if (here, way.verb, way.step) not in self.taken]
        if fresh:
            return self._take(here, fresh[0], state)
        return self._take(here, next(way for way in available if way.verb == self.leave_by), state)

    def _take(self, here: str, way: WayOn, state: RunState) -> OperatorAction | AnswerBy:
        self.taken.append((here, way.verb, way.step))
        action = OperatorAction(action=way.verb, step=way.step, reason="walked")
        if way.verb != "accept":
            return action
        signed = {"signed_sha256": state.step.gates_sha256, "role": "supervisor", "identified": "claimed"}
        return AnswerBy(action.model_copy(update=signed), "Emmy")


@pytest.fixture
def begin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Generator[Callable[[Fakes, Walker], Bench]]:
    with bench_store(tmp_path / "data") as store:

        def begun(fakes: Fakes, walker: Walker) -> Bench:
            monkeypatch.setattr("service.runner.loop.step_kinds", fakes.kinds)
            bench = begin_run(store, PROTOCOL, tmp_path)
            bench.operator = walker
            return bench

        yield begun


# --- the walk ------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("error", "leave_by"),
    [
        (None, "accept"),
        (None, "skip"),
        (DeviceFaultError("broken", where="device"), "skip"),
        (ComputeError("no answer"), "skip"),
        (IntegrityError("a file is damaged"), "skip"),
    ],
)
def test_every_choice_of_every_kind_of_step_is_taken_and_leads_on(
    begin: Callable[[Fakes, Walker], Bench], error: OrthocaptureError | None, leave_by: OperatorVerb
) -> None:
    fakes, walker = Fakes(error=error), Walker(leave_by)
    bench = begin(fakes, walker)
    state = bench.run()
    assert state.status == "completed"
    assert not [d for d in state.deviations if d.kind == "refused"]
    for step in STEPS:
        verbs = [verb for here, verb, _ in walker.taken if here == step]
        assert "confirm" in verbs, step
        assert leave_by in verbs, step
        # Once for each choice that leads back to it, and once for the first time.
        assert fakes.executed.count(step) > len([verb for verb in verbs if verb == "confirm"])
    redone = {(here, target) for here, verb, target in walker.taken if verb == "redo"}
    assert {("scan", "coat"), ("scan", "ct"), ("register", "scan"), ("judge", "register")} <= redone
    if leave_by == "accept":
        assert [d.step for d in state.deviations if d.kind == "gate_accepted"] == list(walker_exits(walker, "accept"))
    bench.must_verify()


def walker_exits(walker: Walker, verb: str) -> Iterator[str]:
    return (here for here, taken, _ in walker.taken if taken == verb)


@pytest.mark.parametrize("step", ["hands", "views", "judge"])
def test_ending_early_seals_what_is_there(begin: Callable[[Fakes, Walker], Bench], step: str) -> None:
    bench = begin(Fakes(), Walker("skip", ends_at=step))
    state = bench.run()
    assert (state.status, state.current) == ("aborted", step)
    bench.must_verify()


# --- what the list says -----------------------------------------------------------------------------------------


def test_nothing_is_listed_while_nothing_stops_a_run() -> None:
    log = Log()
    assert ways_on(log.protocol, log.state) == ()
    log.do()
    log.begin()
    assert ways_on(log.protocol, log.state) == ()


def test_a_mend_comes_first_and_costs_its_views() -> None:
    log = Log()
    log.do()
    log.begin()
    log.capture(["a", "b", "c"])  # a microsecond apart
    log.measure(views=2.0, sharp=0.5)
    first = ways_on(log.protocol, log.state)[0]
    assert (first.verb, first.minutes) != ("confirm", None)
    assert [way.verb for way in ways_on(log.protocol, log.state)][-2:] == ["abort", "accept"]
    accept = ways_on(log.protocol, log.state)[-1]
    assert not accept.available
    assert "allows nobody to accept Board images used" in accept.why_not


def test_a_step_whose_requirement_cannot_be_done_again_may_be_left_out() -> None:
    again = """\
  - id: spray_again
    kind: spray
    title: Again
    irreversible: true
    sign: true
    requires: [fix_it]
"""
    text = TOY_TEXT.replace("  - id: scan\n", f"{again}  - id: scan\n")
    log = Log(toy_protocol(text))
    log.act("skip", reason="it is fixed")
    log.do(**GOOD)
    log.do()
    assert log.state.current == "spray_again"
    ways = {way.verb: way for way in ways_on(log.protocol, log.state) if way.available}
    assert set(ways) == {"skip", "abort"}  # a redo would cross the irreversible step
    log.act("skip", reason="it cannot be released any more")
    assert log.state.current == "scan"


# The end of the paper's protocol: the specimen is released, and then the ground truth is judged.
JUDGED_AFTERWARDS = """\
  - id: freed
    kind: checklist
    title: Free the specimen
    irreversible: true
    cannot_be_undone: Once it is free, nothing can be measured again.
    sign: true
    requires: [scan, register]
  - id: fuse
    kind: registration
    title: Fuse
    confirm: false
    gates: [{measure: m, max: 1, accept_by: supervisor}]
"""


def test_a_step_that_fails_after_the_release_has_ways_on_that_are_possible() -> None:
    log = Log(toy_protocol(TOY_TEXT + JUDGED_AFTERWARDS))
    for measures in ({}, GOOD, {}, {"rms_mm": 0.05}, {}, {}):
        log.do(**measures)
    assert log.state.current == "fuse"
    log.begin()
    log.measure(m=2.0)
    assert log.question.for_ == "recovery"
    possible = {(way.verb, way.step) for way in log.question.ways if way.available}
    assert possible == {("confirm", "fuse"), ("accept", "fuse"), ("abort", "fuse")}


def test_before_the_release_a_person_reads_what_it_ends() -> None:
    protocol = toy_protocol(TOY_TEXT + JUDGED_AFTERWARDS)
    assert irreversible_warning(protocol, protocol.step("freed")) == (
        "Once it is free, nothing can be measured again. None of these can be done again: Scan, Register. What is "
        "judged only afterwards can then be computed again, accepted where the protocol allows it, or left as it is, "
        "but no longer be mended by new measurements: Fuse. Read the figures before you go on."
    )


def test_a_checklist_that_was_left_open_is_ticked_when_it_is_tried_again() -> None:
    text = TOY_TEXT.replace(
        "skippable: true\n  - id: capture", "confirm: false\n    gates: [{measure: open, max: 0}]\n  - id: capture", 1
    )
    log = Log(toy_protocol(text))
    log.begin()
    log.measure(open=2.0)
    assert log.question.checklist == ("wires hold", "board lies")
    log.act("confirm", checklist=log.question.checklist)
    assert log.state.step.ticked == ("wires hold", "board lies")


def test_every_error_of_a_device_and_every_kind_of_step_has_words() -> None:
    classes = {
        name
        for name, what in inspect.getmembers(device_errors, inspect.isclass)
        if issubclass(what, OrthocaptureError)
    }
    assert classes - {"OrthocaptureError"} <= set(REMEDIES)
    for name in (*REMEDIES, *NEEDS_A_PERSON):
        assert hasattr(device_errors, name) or hasattr(core_errors, name)
        assert name in REMEDIES


def test_status_lists_them_for_other_programs(begin: Callable[[Fakes, Walker], Bench], tmp_path: Path) -> None:
    bench = begin(Fakes(), Walker("skip", ends_at="layout"))
    bench.operator.script = {}

    class LeftError(Exception):
        pass

    class Leaving(Walker):
        def poll(self, question: AskOperator, state: RunState) -> OperatorAction | AnswerBy | None:
            if question.for_ == "recovery":
                raise LeftError
            return super().poll(question, state)

    bench.operator = Leaving("skip")
    with pytest.raises(LeftError):
        bench.run()
    answer = CliRunner().invoke(app, ["status", bench.run_id, "--data", str(tmp_path / "data"), "--json"])
    ways = json.loads(answer.stdout)["ways_on"]
    assert [way["verb"] for way in ways] == ["confirm", "accept", "skip", "abort"]
    assert all(way["available"] for way in ways)


def test_before_two_views_are_taken_the_time_for_one_is_that_of_the_planned_motions() -> None:
    log = at_capture()
    log.begin()
    assert view_s(log.protocol, log.state, log.protocol.step("capture")) is None
    outcomes = ("feasible", "nudged", "refused")
    views = [{"viewpoint": f"v{i}", "outcome": outcome, "reason": ""} for i, outcome in enumerate(outcomes)]
    plan = {"stations": [{"station": "station_1", "order": "as_listed", "estimated_s": 30.0, "views": views}]}
    log.append(StepNote(step="capture", attempt=1, note="motion_plan", data={"text": "planned", **plan}))
    assert view_s(log.protocol, log.state, log.protocol.step("capture")) == 15.0


@pytest.mark.parametrize(
    ("images", "again", "afresh"),
    [
        (0, "Nothing.", None),
        (1, "Nothing. The image is kept.", "1 image no longer counts. All of it stays in the record."),
        (2, "Nothing. The 2 images are kept.", "2 images no longer count. All of it stays in the record."),
    ],
)
def test_each_way_says_what_is_lost_by_it(images: int, again: str, afresh: str | None) -> None:
    text = TOY_TEXT.replace("max: 0.1, unit: mm}", "max: 0.1, unit: mm, unless_skipped: capture}")
    log = Log(toy_protocol(text))
    log.do()
    log.begin()
    log.capture([f"v{i}" for i in range(images)])
    log.measure(views=2.0, sharp=0.5)
    loses = {way.verb: way.loses for way in ways_on(log.protocol, log.state)}
    assert loses["confirm"] == again
    assert loses.get("redo") == afresh
    assert loses["skip"] == "Its result does not count. These cannot begin: Spray. Not judged later: rms_mm."


class UsingParams(StepParams):
    """Uses earlier steps."""

    of: list[str]


def test_ways_that_are_refused_for_one_reason_are_told_as_one_with_the_titles_whole() -> None:
    """Beyond an irreversible step, none of those before it can be redone."""
    text = TOY_TEXT.replace("title: Capture", "title: 'Views: first set'").replace(
        "title: Fix", "title: 'Bench: fix'"
    )
    text = text.replace(
        "  - id: scan\n    kind: checklist\n", "  - id: scan\n    kind: using\n    params: {of: [fix_it, capture]}\n"
    )
    log = Log(parse_protocol(text.encode(), {**KINDS, "using": UsingParams}, name="lab.yaml").protocol)
    log.do()
    log.do(**GOOD)
    log.do()
    assert log.state.current == "scan"
    log.begin()
    log.measure(rms_mm=0.5)
    refused = [way for way in ways_on(log.protocol, log.state) if not way.available]
    assert len({way.why_not for way in refused}) == len(refused) > 1
    (redo,) = (way for way in refused if way.verb == "redo")
    assert redo.words == "Do an earlier step again: Views: first set, Bench: fix"


def test_half_of_an_irreversible_step_may_be_done_again_and_nothing_is_lost() -> None:
    log = at_spray()
    log.begin()
    log.append(failure(log, "SafetyStopError", "ask"))
    redo = next(way for way in ways_on(log.protocol, log.state) if way.verb == "redo")
    assert (redo.step, redo.words) == ("spray", "Do this step again from its beginning")
    assert (redo.loses, redo.available) == ("Nothing.", True)


def test_minutes_in_words() -> None:
    assert [takes_words(m) for m in (None, 0.0, 0.4, 12.4)] == [
        "not known",
        "no time",
        "under a minute",
        "about 12 min",
    ]
