"""The run page for any record: never a failure, and always the next thing to do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.core.gates import quantity
from service.core.measure_names import measure_name
from service.core.protocol import Protocol, load_protocol
from service.core.records.base import ArtefactRef
from service.core.records.run_events import (
    DeviceOpened,
    DeviceTrouble,
    FilesKept,
    ItemTicked,
    LeaveLapsed,
    OperatorVerb,
    SessionStarted,
    StepFailed,
    StepMeasured,
    StepPassed,
    StepRetried,
    ViewpointFailed,
)
from service.core.recovery import planned_views
from service.core.run.decide import AskOperator, decide, evaluate_gates
from service.core.run.expected import duration, tries_words
from service.core.run.fold import fold
from service.core.words import time_here
from service.monitor.snapshot import Message, Snapshot
from service.steps import params_models
from service.web.robot_banner import robot_banner
from service.web.run_frame import limit
from service.web.run_view import run_view
from service.web.run_view_records import RunView, Viewer, view_intervals_s
from tests.support.record.core import Log

PROTOCOLS = Path(__file__).parents[2] / "protocols"
DEMO: Protocol = load_protocol(PROTOCOLS / "demo.yaml", params_models()).protocol
PAPER: Protocol = load_protocol(PROTOCOLS / "exvivo_spine.yaml", params_models()).protocol
ME = Viewer(may_operate=True, in_control=True, holder="Ada", holder_screen="AB12CD")
STANDS = Snapshot(doing="asking", robot="standing")
WAYS = ("on", "on", "on", "on", "redo", "skip", "pause", "resume", "fail", "bad", "tick", "capture", "abort")


def figures(protocol: Protocol, step: str, *, good: bool) -> dict[str, float]:
    """Measures that pass every gate of a step, or fail the first."""
    gates = protocol.step(step).gates
    found = {g.measure: float(g.min if g.min is not None else g.max or 0.0) for g in gates}
    if gates and not good:
        first = gates[0]
        found[first.measure] = float(first.max) + 1 if first.max is not None else float(first.min or 0.0) - 1
    return found


def go(log: Log, way: str, pick: int = 0) -> None:
    """Let one more thing happen, if it can."""
    state, step = log.state, log.protocol.step(log.state.current)
    if state.terminal:
        return
    if way in ("pause", "resume", "abort", "skip"):
        log.act(cast(OperatorVerb, way), step=step.id, reason="asked")
    elif way == "redo":
        log.act("redo", step=log.protocol.step_ids[pick % len(log.protocol.steps)], reason="asked")
    elif way == "tick" and step.checklist:
        log.append(ItemTicked(step=step.id, attempt=state.step.attempt, item=step.checklist[0], ticked=pick % 2 == 0))
    elif state.status == "active":
        work(log, way)


def work(log: Log, way: str) -> None:
    """Do what the runner, or the person whom it asks, does next."""
    state = log.state
    step, now = state.current, state.step
    decision = decide(log.protocol, state)
    if isinstance(decision, AskOperator):
        if decision.for_ == "sign":
            log.sign()
        elif "confirm" in decision.options:
            log.confirm()
        return
    match now.phase:
        case "ready":
            log.begin()
        case "running" if way == "fail":
            log.append(
                StepFailed(step=step, attempt=now.attempt, error="SafetyStopError", message="stop", recovery="ask")
            )
        case "running" if way == "capture" or len(now.captured) < min(planned_views(log.protocol.step(step)), 2):
            if planned_views(log.protocol.step(step)):
                log.capture([f"v{len(now.captured)}"])
        case "running":
            measures = figures(log.protocol, step, good=way != "bad")
            log.append(StepMeasured(step=step, attempt=now.attempt, measures=measures))
        case "checking":
            skipped = log.state.skipped
            log.append(evaluate_gates(log.protocol.step(step), now.attempt, now.measures, skipped))
        case "awaiting_operator":
            log.append(StepPassed(step=step, attempt=now.attempt))
        case "recovering":
            log.append(StepRetried(step=step, attempt=now.attempt + 1, why="asked"))
        case _:
            pass


def view_of(
    log: Log, snapshot: Snapshot = STANDS, *, driven: bool = True, viewer: Viewer = ME, show: str = ""
) -> RunView:
    return run_view(log, snapshot, viewer, driven=driven, show=show)


def advance_to(protocol: Protocol, step: str) -> Log:
    log = Log(protocol)
    while log.state.current != step:
        go(log, "on")
    return log


@settings(max_examples=40, deadline=None)
@given(
    ways=st.lists(st.tuples(st.sampled_from(WAYS), st.integers(0, 30)), max_size=90),
    show=st.sampled_from(["", "nonsense", *DEMO.step_ids]),
    doing=st.sampled_from(["asking", "working", "pausing", "paused", "ended", "unknown"]),
    robot=st.sampled_from(["not_connected", "standing", "moving", "protective_stop", "emergency_stop", "unknown"]),
    driven=st.booleans(),
    control=st.booleans(),
)
def test_every_course_of_a_run_can_be_shown(
    ways: list[tuple[str, int]], show: str, doing: str, robot: str, driven: bool, control: bool
) -> None:
    log = Log(DEMO)
    for way, pick in ways:
        go(log, way, pick)
        view = view_of(log, driven=driven, show=show)
        assert view.shown.id == (show if show in DEMO.step_ids else log.state.current)
        if view.mode in ("ask", "sign", "paused", "died"):
            assert view.question.main is not None  # there is always a way on
        if log.state.terminal:
            assert (view.mode, view.question.main, view.question.options) == ("ended", None, ())
    snapshot = Snapshot.model_validate({"doing": doing, "robot": robot, "messages": (Message(at_utc="", text="x"),)})
    run_view(log, snapshot, replace(ME, in_control=control), driven=driven, show=show)
    assert robot_banner(log.state, snapshot, 0.0, driven=driven).title


def test_every_prefix_of_a_whole_run_can_be_shown() -> None:
    log = Log(DEMO)
    for _ in range(400):
        go(log, "on")
    assert log.state.status == "active"
    assert log.state.phase == "passed"
    done: list[int] = []
    for upto in range(1, len(log.events) + 1, 3):
        part = Log(DEMO)
        part.events, part.state = log.events[:upto], fold(DEMO, log.events[:upto])
        done.append(view_of(part).passed)
    assert done == sorted(done)


def test_a_step_that_moves_the_robot_is_held_and_says_what_will_happen() -> None:
    view = view_of(advance_to(PAPER, "viewpoint_capture_1"))
    assert view.question.main is not None
    assert view.question.main.hold
    assert view.question.main.text == "Confirm: the robot takes 54 images at station 1"
    assert view.progress.total == 108
    layout = view_of(advance_to(PAPER, "layout_check")).question.main
    assert layout is not None
    assert not layout.hold
    assert "photograph" in layout.text


def test_nothing_is_confirmed_before_everything_is_ticked() -> None:
    log = Log(DEMO)
    first = DEMO.steps[0]
    for item in first.checklist[:-1]:
        log.append(ItemTicked(step=first.id, attempt=1, item=item, ticked=True))
    main = view_of(log).question.main
    assert main is not None
    assert (main.enabled, main.why_not) == (False, "1 item is not ticked yet.")
    log.append(ItemTicked(step=first.id, attempt=1, item=first.checklist[-1], ticked=True))
    main = view_of(log).question.main
    assert main is not None
    assert main.enabled


def test_a_stopped_robot_is_not_asked_to_move() -> None:
    log = advance_to(DEMO, "viewpoint_capture_1")
    main = view_of(log, Snapshot(doing="asking", robot="protective_stop")).question.main
    assert main is not None
    assert not main.enabled
    assert "at the robot" in main.why_not


def test_paused_is_shown_only_once_the_robot_stands_still() -> None:
    log = advance_to(DEMO, "viewpoint_capture_1")
    go(log, "on")
    go(log, "on")
    log.act("pause")
    moving = Snapshot(doing="pausing", robot="moving")
    assert not view_of(log, moving).question.standing
    assert robot_banner(log.state, moving, 0.0, driven=True).key == "pausing"
    still = Snapshot(doing="paused", robot="standing")
    assert view_of(log, still).question.standing
    assert robot_banner(log.state, still, 0.0, driven=True).title.startswith("Paused")
    # A silent runner says nothing about the robot.
    silent = robot_banner(log.state, Snapshot(), 0.0, driven=True)
    assert silent.key == "unknown"


@pytest.mark.parametrize(
    ("robot", "words"),
    [
        ("standing", "The robot stands still."),
        ("not_connected", "The robot is not connected."),
        ("unknown", "The robot does not answer: take it as moving."),
        ("protective_stop", "The robot reports: protective stop."),
    ],
)
def test_a_paused_run_says_of_its_robot_what_is_known(robot: str, words: str) -> None:
    """It said that the robot stands still when nobody knew."""
    log = advance_to(DEMO, "viewpoint_capture_1")
    log.append(DeviceOpened(device="ur", report={"identity": {"kind": "robot"}}))
    log.act("pause")
    told = Snapshot.model_validate({"doing": "paused", "robot": robot})
    question = view_of(log, told).question
    assert (question.paused, question.standing) == (f"Paused. {words}", robot == "standing")
    log.append(DeviceTrouble(device="ur", error="DeviceUnavailableError", message="died", connection="died"))
    lost = view_of(log, told).question
    assert not lost.standing
    assert robot == "protective_stop" or "Take the robot as moving" in lost.paused


def test_a_dead_runner_offers_to_go_on() -> None:
    log = advance_to(DEMO, "ct_hand_over_out")
    view = view_of(log, Snapshot(), driven=False)
    main = view.question.main
    assert (view.mode, main and main.verb, main and main.hold) == ("died", "go-on", False)
    moving = view_of(advance_to(DEMO, "viewpoint_capture_1"), Snapshot(), driven=False).question.main
    assert moving is not None
    assert not moving.hold
    assert "asked again before the robot moves" in moving.note


def test_after_a_restart_the_robot_waits_for_a_confirmation_that_is_held() -> None:
    log = advance_to(DEMO, "viewpoint_capture_1")
    while log.state.phase != "running":
        go(log, "on")
    log.append(SessionStarted(resumed=True, software={}, host="h", pid=1))
    view = view_of(log)
    assert (view.mode, view.question.asked_anew) == ("ask", True)
    assert view.question.main is not None
    assert (view.question.main.verb, view.question.main.hold) == ("confirm", True)


def test_a_confirmation_that_no_longer_holds_says_why_it_is_asked_for_again() -> None:
    log = advance_to(DEMO, "viewpoint_capture_1")
    while log.state.phase != "running":
        go(log, "on")
    assert log.state.leave is not None
    log.append(LeaveLapsed(leave_seq=log.state.leave.seq, idle_s=93, limit_s=60, why="b001 failed twice: no file"))
    view = view_of(log)
    assert (view.mode, view.question.asked_anew) == ("ask", True)
    assert "for 93 s there was no visible progress, in which the run waited for this: b001 failed twice" in (
        view.question.lapsed
    )
    assert view.question.main is not None
    assert (view.question.main.verb, view.question.main.hold) == ("confirm", True)
    log.confirm()
    assert view_of(log).question.lapsed == ""


def test_what_is_tried_again_by_itself_is_said_by_the_step_and_the_banner() -> None:
    log = advance_to(DEMO, "viewpoint_capture_1")
    while log.state.phase != "running":
        go(log, "on")
    step, attempt = log.state.current, log.state.step.attempt
    why, message = "DeviceTimeoutError", "no file within 46 s [camera]. Look at the camera"
    failed = ViewpointFailed(step=step, attempt=attempt, viewpoint="b001", error=why, message=message, skipped=False)
    log.append(failed)
    log.append(failed)
    said = "b001 failed twice: no file within 46 s; try 3 since 00:00:00 UTC, by itself"
    assert view_of(log).tries == said
    for robot in ("moving", "standing", "not_connected"):
        snapshot = Snapshot(at_utc_s=1.8e9, doing="working", robot=robot)
        words = tries_words(log.protocol, log.state, time_here)
        assert f"{said}." in robot_banner(log.state, snapshot, 1.8e9, driven=True, tries=words).text
    log.append(StepFailed(step=step, attempt=attempt, error=why, message=message, recovery="retry"))
    assert "try 3 at 00:00:01 UTC" in view_of(log).tries
    log.append(StepRetried(step=step, attempt=attempt + 1, why="DeviceTimeoutError: no file within 46 s"))
    assert "try 3 since" in view_of(log).tries
    log.capture(["b001"])
    assert view_of(log).tries == ""


def test_who_lets_a_lost_arm_move_reads_what_that_says() -> None:
    log = advance_to(DEMO, "viewpoint_capture_1")
    log.append(DeviceOpened(device="ur", report={"identity": {"kind": "robot"}}))
    log.append(SessionStarted(resumed=True, software={}, host="h", pid=1))
    main = view_of(log).question.main
    assert main is not None
    assert main.note.startswith("You say with it that you have looked at ur, whose connection was lost.")


def test_the_time_left_is_measured_and_never_across_a_restart_or_a_pause() -> None:
    log = advance_to(DEMO, "viewpoint_capture_1")
    assert view_of(log).progress.left == "measuring" or len(view_intervals_s(log.events)) >= 2
    while log.state.phase != "running":
        go(log, "on")
    log.capture(["v1_001", "v1_002"])
    log.append(SessionStarted(resumed=True, software={}, host="h", pid=1))
    log.capture(["v1_003", "v1_004"])
    log.act("pause")
    log.late_s = 600.0
    log.act("resume")
    log.capture(["v1_005"])
    assert view_intervals_s(log.events, "viewpoint_capture_1") == [1.0, 1.0]  # the log's clock: one second per event
    assert max(log.state.view_gaps_s) < 1.0
    assert view_of(log).progress.step_left == duration(3.0)


def test_irreversible_steps_warn_and_bind_the_figures_that_release_them() -> None:
    view = view_of(advance_to(DEMO, "spraying"))
    assert view.mode == "sign"
    assert "never" in view.shown.warning
    assert view.question.signature is not None
    assert {title for title, _ in view.question.signature.figures} >= {"Viewpoint capture at station 1"}
    assert len(view.question.signature.sha256) == 64


def test_a_redo_says_what_it_resets() -> None:
    view = view_of(advance_to(DEMO, "station_change"))
    redo = next(r for r in view.question.redos if r.step == "viewpoint_capture_1")
    assert redo.resets == ("Control capture at station 1",)
    assert redo.images == 4


@pytest.mark.parametrize(
    ("measure", "words"),
    [
        ("rms_px", "RMS reprojection error"),
        ("five_fold_rms_px", "RMS reprojection error in cross-validation"),
        ("tilt_deg", "Largest tilt of the board"),
        ("views", "Board images used"),
    ],
)
def test_measures_have_names_for_people(measure: str, words: str) -> None:
    assert measure_name(measure) == words


def test_numbers_have_units_and_limits_words() -> None:
    assert quantity(0.712345, "px") == "0.7123 px"
    assert quantity(54.0, "views") == "54 views"
    assert quantity(None, "mm") == "not measured"
    assert limit(None, 0.5, "px") == "at most 0.5 px"
    assert [duration(s) for s in (7, 100, 3900)] == ["5 s", "2 min", "1 h 05 min"]


def test_photographs_of_the_layout_count_as_recorded() -> None:
    """They are no views, and a page that says "0 images are recorded" beside them is not believed."""
    log = advance_to(DEMO, "layout_check")
    go(log, "on")
    log.begin()
    image = ArtefactRef(
        sha256="0" * 64, size_bytes=1, media_type="image/jpeg", kind="layout_image", original_name="L.JPG"
    )
    for number in range(2):
        kept = image.model_copy(update={"sha256": f"{number:064x}"})
        log.append(FilesKept(step="layout_check", attempt=1, device="camera", note="one", artefacts=(kept,)))
    go(log, "fail")
    trouble = view_of(log).question.trouble
    assert trouble is not None
    assert trouble.safe == "Yes. 2 photographs are recorded, and every result so far."


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (1, None, "at least 1 coat"),
        (2, None, "at least 2 coats"),
        (0, 1, "at least 0 and at most 1 coat"),
        (1, 1, "exactly 1 coat"),
        (None, 0, "at most 0 coats"),
    ],
)
def test_a_limit_of_one_is_in_the_singular(low: float | None, high: float | None, expected: str) -> None:
    assert limit(low, high, "coats") == expected
