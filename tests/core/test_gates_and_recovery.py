"""Gates judged from measures, and what follows a failure."""

from __future__ import annotations

import pytest

import drivers.errors as device_errors
import service.core.errors as core_errors
from service.core.errors import IntegrityError
from service.core.gates import describe, quantity, uncertain
from service.core.protocol import Recovery
from service.core.records.run_events import RunAborted, StepMeasured, StepRetried, Uncertainty, ViewpointFailed
from service.core.recovery import NEEDS_A_PERSON, TRIED_AGAIN, recovery_policy, ways_on
from service.core.run.decide import (
    Halt,
    Retry,
    RunStep,
    evaluate_gates,
)
from tests.support.record.core import GOOD, Log, toy_protocol
from tests.support.record.core_log import at_capture, failure, refused


@pytest.fixture
def log() -> Log:
    return Log()


# --- gates -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("measures", "passed"),
    [
        ({"views": 3.0, "sharp": 0.2}, True),
        ({"views": 3.0, "sharp": 1.0}, True),
        ({"views": 2.999, "sharp": 0.5}, False),
        ({"views": 3.0, "sharp": 1.001}, False),
        ({"views": 3.0}, False),
        ({"views": 3.0, "sharp": float("nan")}, False),
        ({"views": float("inf"), "sharp": 0.5}, False),
    ],
)
def test_gates(measures: dict[str, float], passed: bool) -> None:
    step = toy_protocol().step("capture")
    result = evaluate_gates(step, 1, measures)
    assert result.passed is passed
    assert [v.measure for v in result.verdicts] == ["views", "sharp"]


@pytest.mark.parametrize(
    ("lower", "upper", "outcome"),
    [(3.0, 4.0, "passed"), (2.0, 2.9, "failed"), (2.9, 4.0, "undecided")],
)
def test_a_number_with_its_uncertainty_is_judged_by_its_bounds(lower: float, upper: float, outcome: str) -> None:
    step = toy_protocol().step("capture")
    known = {"views": Uncertainty(sigma=0.2, lower=lower, upper=upper)}
    result = evaluate_gates(step, 1, {"views": 3.2, "sharp": 0.5}, uncertainties=known)
    verdict = result.verdicts[0]
    found = "passed" if verdict.passed else "undecided" if verdict.undecided else "failed"
    assert (found, result.passed) == (outcome, outcome == "passed")
    assert (verdict.lower, verdict.upper, verdict.sigma) == (lower, upper, 0.2)
    places = 2 if outcome == "failed" else 1
    assert f"Board images used {3.2:.{places}f} views, {lower:.{places}f} to {upper:.{places}f}, allowed" in describe(
        verdict
    )
    without = evaluate_gates(step, 1, {"views": 3.2, "sharp": 0.5}).verdicts[0]
    assert without.passed
    assert without.lower is None
    assert " to " not in describe(without)


@pytest.mark.parametrize(
    ("minimum", "maximum", "lower", "upper", "outcome"),
    [
        (None, None, -9.0, 9.0, "passed"),
        (3.0, None, 3.0, 4.0, "passed"),  # a bound on the limit is within it
        (3.0, None, 2.0, 3.0, "undecided"),
        (3.0, None, 2.0, 2.9, "failed"),
        (None, 5.0, 4.0, 5.0, "passed"),
        (None, 5.0, 5.0, 6.0, "undecided"),
        (None, 5.0, 5.1, 6.0, "failed"),
        (3.0, 5.0, 3.0, 5.0, "passed"),
        (3.0, 5.0, 2.9, 5.0, "undecided"),
        (3.0, 5.0, 3.0, 5.1, "undecided"),
        (3.0, 5.0, 2.0, 6.0, "undecided"),  # the whole of the limits and more
        (3.0, 5.0, 1.0, 2.0, "failed"),
        (3.0, 5.0, 6.0, 7.0, "failed"),
    ],
)
def test_bounds_are_judged_against_each_limit(
    minimum: float | None, maximum: float | None, lower: float, upper: float, outcome: str
) -> None:
    step = toy_protocol().step("capture")
    gate = step.gates[0].model_copy(update={"min": minimum, "max": maximum})
    step = step.model_copy(update={"gates": (gate,)})
    known = Uncertainty(sigma=0.2, lower=lower, upper=upper)
    judged = evaluate_gates(step, 1, {"views": (lower + upper) / 2}, uncertainties={"views": known})
    (verdict,) = judged.verdicts
    found = "passed" if verdict.passed else "undecided" if verdict.undecided else "failed"
    assert (found, judged.passed) == (outcome, outcome == "passed")
    missing = evaluate_gates(step, 1, {"views": float("nan")}, uncertainties={"views": known}).verdicts[0]
    assert (missing.passed, missing.undecided, missing.value, missing.sigma) == (False, False, None, None)
    assert (missing.lower, missing.upper) == (None, None)


@pytest.mark.parametrize(
    ("value", "unit", "words"),
    [
        (None, "px", "not measured"),
        (1.0, "images", "1 image"),
        (1.0, "s", "1 s"),
        (2.0, "images", "2 images"),
        (0.0, "images", "0 images"),
        (0.71234, "px", "0.7123 px"),
        (1234567.0, "points", "1234567 points"),
        (9_999_999.0, "points", "9999999 points"),
        (1e7, "points", "1e+07 points"),
        (-1e7, "", "-1e+07"),
    ],
)
def test_numbers_in_words(value: float | None, unit: str, words: str) -> None:
    assert quantity(value, unit) == words


@pytest.mark.parametrize(
    ("value", "lower", "upper", "words"),
    [
        (0.52, 0.41, 0.63, "0.52 mm, 0.41 to 0.63"),
        (523.4, 411.2, 631.9, "523 mm, 411 to 632"),
        (5.21, 4.13, 6.34, "5.2 mm, 4.1 to 6.3"),
        (0.00152, 0.00141, 0.00163, "0.0015 mm, 0.0014 to 0.0016"),
        (0.5, 0.5, 0.5, "0.50 mm, 0.50 to 0.50"),
    ],
)
def test_a_number_has_the_places_that_tell_its_bounds_apart(
    value: float, lower: float, upper: float, words: str
) -> None:
    assert uncertain(value, lower, upper, "mm") == words


def test_a_gate_falls_away_with_the_step_that_would_have_made_it_measurable() -> None:
    step = toy_protocol().step("capture")
    gates = tuple(g.model_copy(update={"unless_skipped": "ct"}) if g.measure == "sharp" else g for g in step.gates)
    step = step.model_copy(update={"gates": gates})
    assert not evaluate_gates(step, 1, {"views": 3.0}).passed
    without = evaluate_gates(step, 1, {"views": 3.0}, skipped={"ct"})
    assert without.passed
    assert [v.measure for v in without.verdicts] == ["views"]


def test_failed_gates_ask_and_can_be_overridden_only_with_leave_and_reason() -> None:
    log = at_capture()
    log.begin()
    log.measure(views=2.0, sharp=0.5)
    assert log.question.for_ == "recovery"
    assert "Board images used 2 views, allowed ≥ 3" in log.question.text
    assert set(log.question.options) == {"confirm", "redo", "skip", "pause", "abort"}
    refused(log, "needs a reason", action="skip")
    log.act("skip", reason="the animal moved")
    assert log.state.deviations[-1].kind == "gate_overridden"
    assert log.state.steps["capture"].skipped
    assert log.state.current == "spray"


def test_a_signature_takes_a_minute_and_to_leave_a_step_out_takes_none() -> None:
    """The person at the table chooses by what each way takes."""
    log = at_capture()
    log.begin()
    log.measure(views=2.0, sharp=0.5)
    takes = {way.verb: way.minutes for way in ways_on(log.protocol, log.state)}
    assert (takes["accept"], takes["skip"], takes["abort"]) == (1.0, 0.0, 0.0)


def test_verdicts_that_do_not_follow_from_the_measures_are_no_evidence() -> None:
    log = at_capture()
    log.begin()
    log.append(StepMeasured(step="capture", attempt=1, measures={"views": 1.0, "sharp": 0.5}))
    honest = evaluate_gates(log.protocol.step("capture"), 1, {"views": 1.0, "sharp": 0.5})
    with pytest.raises(IntegrityError, match="do not follow"):
        log.append(honest.model_copy(update={"passed": True}))


# --- recovery --------------------------------------------------------------------------------------------


def test_a_retry_keeps_what_was_captured_and_raises_the_attempt() -> None:
    log = at_capture()
    log.begin()
    log.capture(["a", "b"])
    log.append(failure(log))
    assert log.decision == Retry("capture", 2, "DeviceTimeoutError: no answer", 1.0)
    log.append(StepRetried(step="capture", attempt=2, why="timeout"))
    assert log.decision == RunStep("capture", 2, begin=False)
    assert set(log.state.step.captured) == {"a", "b"}
    assert log.state.step.failures == 1
    log.capture(["c"])
    assert log.state.step.failures == 0  # progress in between
    assert log.state.deviations == ()


def test_figures_are_progress_too() -> None:
    log = at_capture()
    log.begin()
    log.append(failure(log))
    log.append(StepRetried(step="capture", attempt=2, why="timeout"))
    log.append(StepMeasured(step="capture", attempt=2, measures=GOOD))
    assert log.state.step.failures == 0


def test_an_operator_grants_a_retry_and_what_was_given_up_gets_another_chance() -> None:
    log = at_capture()
    log.begin()
    log.append(ViewpointFailed(step="capture", attempt=1, viewpoint="b", error="E", message="m", skipped=True))
    log.append(failure(log, "SafetyStopError", "ask"))
    assert log.question.for_ == "recovery"
    with pytest.raises(IntegrityError, match="neither the policy nor the operator"):
        log.append(StepRetried(step="capture", attempt=2, why="by itself"))
    log.act("confirm")
    assert log.decision == Retry("capture", 2, "the operator asked for it", 0.0)
    refused(log, "already confirmed", action="confirm")
    log.append(StepRetried(step="capture", attempt=2, why="asked"))
    assert log.state.step.skipped_viewpoints == ()
    assert log.state.step.failures == 0


def test_a_protocol_can_recommend_to_end_the_run_and_only_a_person_ends_it(log: Log) -> None:
    log.begin()
    log.append(failure(log, "ComputeError", "abort"))
    assert log.question.for_ == "recovery"
    assert "The protocol recommends to end the run here" in log.question.text
    assert log.question.ways[0].verb == "abort"
    log.append(RunAborted(reason="evidence"))  # as earlier versions recorded it without asking
    assert log.decision == Halt("aborted")
    assert log.state.stop_reason == "evidence"


@pytest.mark.parametrize(
    ("error", "failures", "on_failure", "expected"),
    [
        ("DeviceUnavailableError", 1, "ask", "retry"),
        ("DeviceTimeoutError", 2, "abort", "retry"),
        ("DeviceTimeoutError", 3, "ask", "ask"),
        ("DeviceBusyError", 1, "ask", "ask"),
        ("DeviceBusyError", 3, "abort", "abort"),
        ("SafetyStopError", 1, "abort", "ask"),
        ("DeviceStorageFullError", 1, "abort", "ask"),
        ("IntegrityError", 1, "abort", "ask"),
        ("ComputeError", 1, "ask", "ask"),
        ("ComputeError", 1, "abort", "abort"),
    ],
)
def test_the_recovery_policy(error: str, failures: int, on_failure: str, expected: str) -> None:
    recovery = Recovery.model_validate({"retries": 2, "on_failure": on_failure})
    assert recovery_policy(recovery, error, failures) == expected


def test_the_policy_names_errors_that_exist() -> None:
    for name in TRIED_AGAIN | NEEDS_A_PERSON:
        assert hasattr(device_errors, name) or hasattr(core_errors, name)
