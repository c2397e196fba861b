"""The registrations of a run and their evaluations, early or late, and which of them is the run's own.

The run's own registration has the smallest error on the control spheres among those that the evaluation step judged:
it was signed, and the specimen was freed on it. One that arrives later may be better; it is reported as well and
does not replace it. Pages, report, exports and audit all follow this rule. Before the evaluation, the registration
with the smallest predicted error is shown (`best_registration`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

from pydantic import ValidationError

from service.computations import evaluate
from service.computations.evaluate import ErrorBudget, Row, best_row
from service.computations.further_cameras import FurtherCameraAnswer
from service.computations.image_poses import STRUCTURE_FROM_MOTION
from service.computations.kind import JobRecord
from service.computations.registration import REGISTER, Registration, Registrations
from service.core.errors import IntegrityError
from service.core.gates import late_words
from service.core.protocol import Protocol
from service.core.run.state import JobState, RunState, lane_of
from service.core.step_params import Gives

_R = TypeVar("_R", bound=JobRecord)


def last_result(protocol: Protocol, state: RunState, gives: Gives, record: type[_R]) -> _R | None:
    """Return the result of the last step that gives this and has one, read as `record`; None if there is none.

    Raises:
        IntegrityError: the recorded result is not such a record.
    """
    steps = (step.id for step in reversed(protocol.steps) if step.gives == gives)
    last = next((step for step in steps if state.steps[step].result), None)
    return None if last is None else result_of_step(state, last, record)


def result_of_step(state: RunState, step: str, record: type[_R]) -> _R:
    """Return the result of a step, read as `record`. Raises IntegrityError where it is not such a record."""
    try:
        return record.model_validate(state.steps[step].result)
    except ValidationError as error:
        first = error.errors()[0]
        path = "/".join(map(str, first["loc"]))
        raise IntegrityError(f"the result of step {step}: {path}: {first['msg']}") from error


def registration_name(record: Registration) -> str:
    """Return the name of a registration record: `colmap`, or `colmap_1920x1080` for images reduced to that size."""
    if record.full_camera is None:
        return record.poses
    return f"{record.poses}_{record.camera.width}x{record.camera.height}"


def registrations(protocol: Protocol, state: RunState) -> dict[str, Registration]:
    """Return every registration record by its name: those in the step's result, then those that arrived later."""
    result = last_result(protocol, state, "registrations", Registrations)
    found = {} if result is None else dict(result.registrations)
    for _, job in _finished(protocol, state, "registrations", REGISTER.name) if found else ():
        answer = REGISTER.read_answer(job.result)
        found.setdefault(registration_name(answer), answer)
    return found


def further_cameras(protocol: Protocol, state: RunState) -> dict[str, FurtherCameraAnswer]:
    """Return the further cameras of the rig by their names, as the registration step located them."""
    result = last_result(protocol, state, "registrations", Registrations)
    return {} if result is None else dict(result.cameras)


def evaluated(protocol: Protocol, state: RunState) -> list[Row]:
    """Return all rows of the paper's table; `late` says when a late row arrived, "" for a row of the evaluation."""
    rows = [row.model_copy(update={"late": ""}) for row in signed_rows(protocol, state)]
    known = {row.poses for row in rows}
    for _, job in later_evaluations(protocol, state) if rows else ():
        table = evaluate.KIND.read_answer(job.result).table
        rows += [
            row.model_copy(update={"late": arrived(protocol, state, job)}) for row in table if row.poses not in known
        ]
    return rows


def arrived(protocol: Protocol, state: RunState, job: JobState) -> str:
    """Say `arrived 12 min after the specimen was freed`, or `arrived after the evaluation` if that came first."""
    return "arrived after the evaluation" if job.late_s is None else late_words(protocol, state, job.late_s)


def shared_adjustment_note(protocol: Protocol, state: RunState) -> str:
    """Return a note that some rows share one adjustment, so that their agreement confirms nothing; "" without two.

    Incremental mapping, global mapping and triangulation each give initial poses from part of the tracks; the final
    model is one bundle adjustment of all tracks from there (service/compute/sfm/child.py).
    """
    if not any(
        job.kind == STRUCTURE_FROM_MOTION.name
        and "features" in job.arguments  # absent in older runs, which shared nothing
        for step in state.steps.values()
        for job in step.jobs.values()
    ):
        return ""
    rows = evaluated(protocol, state)
    alike = [row for row in rows if row.source in _ADJUSTED]
    names = {size: [r.poses for r in alike if r.resolution == size] for size in _sizes(alike)}
    shared = [" and ".join([", ".join(group[:-1]), group[-1]]) for group in names.values() if len(group) > 1]
    if not shared:
        return ""
    return (
        f"{'; '.join(shared)} come from the same features and matches and end in the same bundle adjustment; they "
        "differ only in its initial poses. Their agreement shows that the result does not depend on them. They are "
        "one measurement and do not confirm each other"
        + (
            "; hybrid starts from one of them and adds the robot's poses and the spheres"
            if any(row.source == "hybrid" for row in rows)
            else ""
        )
        + "."
    )


_ADJUSTED = ("triangulated", "colmap", "glomap")


def _sizes(rows: Iterable[Row]) -> list[str]:
    return list(dict.fromkeys(row.resolution for row in rows))


def budgets(protocol: Protocol, state: RunState) -> dict[str, ErrorBudget]:
    """Return the error budget of each registration, by its name."""
    result = last_result(protocol, state, "accuracy", evaluate.Answer)
    found = {} if result is None else result.budgets
    for _, job in later_evaluations(protocol, state):
        found = {**evaluate.KIND.read_answer(job.result).budgets, **found}
    return found


def own_registration(protocol: Protocol, state: RunState) -> str | None:
    """Return the name of the run's own registration (see the module's docstring); None before the evaluation."""
    rows = signed_rows(protocol, state)
    return best_row(rows).poses if rows else None


def best_registration(protocol: Protocol, state: RunState) -> str | None:
    """Return the name of the registration to show: the run's own; before the evaluation, the most certain one.

    Reduced resolutions are for comparison; before the evaluation they are not shown. None where there is none.
    """
    own, found = own_registration(protocol, state), registrations(protocol, state)
    if own in found:
        return own
    full = [name for name, record in found.items() if record.full_camera is None]
    return min(full, key=lambda name: _predicted_m2(found[name]), default=None)


def better_later(protocol: Protocol, state: RunState) -> Row | None:
    """Return the table's best row if it arrived after the evaluation and is better than the run's own; else None."""
    own = own_registration(protocol, state)
    rows = evaluated(protocol, state)
    best = best_row(rows) if rows else None
    signed = {row.poses for row in signed_rows(protocol, state)}
    return best if own is not None and best is not None and best.poses not in signed else None


def signed_rows(protocol: Protocol, state: RunState) -> list[Row]:
    """Return the rows of the table that the evaluation step made: those that were judged and signed."""
    result = last_result(protocol, state, "accuracy", evaluate.Answer)
    return [] if result is None else list(result.table)


def _predicted_m2(record: Registration) -> float:
    """Return the variance of the position that a registration states of itself, over all three axes."""
    return float(sum(record.covariance[axis][axis] for axis in range(3)))


def later_evaluations(protocol: Protocol, state: RunState) -> list[tuple[str, JobState]]:
    """Return (step, job) of every evaluation of a registration that arrived after the evaluation step's own."""
    jobs = _finished(protocol, state, "accuracy", evaluate.KIND.name)
    return [(step, job) for step, job in jobs if lane_of(job.priority) == "background"]


def _finished(protocol: Protocol, state: RunState, gives: Gives, job_kind: str) -> Iterator[tuple[str, JobState]]:
    for step in protocol.steps:
        if step.gives == gives:
            jobs = state.steps[step.id].jobs.values()
            yield from ((step.id, job) for job in jobs if job.kind == job_kind and job.status == "finished")


# Results that arrived after the evaluation, and what they add to its table.
#
# A registration that arrives late never replaces the run's own (registrations.py). Every reader is still told that
# it arrived, when, and whether it is better.


@dataclass(frozen=True, slots=True)
class LateResult:
    """One row of the evaluation's table that arrived after the evaluation was made."""

    seq: int  # number of the event that brought it
    at_utc: str
    step: str
    name: str  # the registration's name
    text: str


def late_results(protocol: Protocol, state: RunState) -> list[LateResult]:
    """Return every late result of a run, in order of arrival; empty before the evaluation."""
    own = own_registration(protocol, state)
    before = signed_rows(protocol, state)
    if own is None:
        return []
    mine = next(row for row in before if row.poses == own)
    known = {row.poses for row in before}
    found: list[LateResult] = []
    for step, job in later_evaluations(protocol, state):
        for row in evaluate.KIND.read_answer(job.result).table:
            name = row.poses
            if name not in known:
                known.add(name)
                text = f"{name}: {arrived(protocol, state, job)}. {_changed(row, mine)}"
                found.append(LateResult(job.ended_seq, job.ended_utc, step, name, text))
    return sorted(found, key=lambda result: result.seq)


def _changed(row: Row, own: Row) -> str:
    error_mm, own_mm = row.mean_radial_error_mm, own.mean_radial_error_mm
    better = "better than" if error_mm < own_mm else "not better than"
    return (
        f"It adds a row to the table, with a mean radial error of {error_mm:.3f} mm: {better} the run's own, "
        f"{own.poses} with {own_mm:.3f} mm, which stays the one that was judged and signed"
    )
