"""Results that arrived after the evaluation, and what they add to its table.

A registration that arrives late never replaces the run's own (registrations.py). Every reader is still told that it
arrived, when, and whether it is better.
"""

from __future__ import annotations

from dataclasses import dataclass

from service.core.protocol.models import Protocol
from service.core.run.state import RunState
from service.dataset.registrations import arrived, later_evaluations, own_registration, signed_rows
from service.jobs.registration import evaluate
from service.jobs.registration.evaluate import Row


@dataclass(frozen=True, slots=True)
class LateResult:
    """One row of the evaluation's table that arrived after the evaluation was made."""

    seq: int  # of the event that brought it
    at_utc: str
    step: str
    name: str  # of the registration
    text: str


def late_results(protocol: Protocol, state: RunState) -> list[LateResult]:
    """Every late result of a run, in order of arrival; empty before the evaluation."""
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
