"""A data folder in which every page has something to show, recorded through the public interface without a rig."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path

import pytest

from service.core.records.run_events import ItemTicked, OperatorAction
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from tests.support.pages.web import web_site
from tests.support.recorded.calibrated_run import begin_calibrated_run
from tests.support.recorded.reported_run import record_reported_run
from tests.support.runs.held_run import left_held_run
from tests.support.runs.recorded_run import record_run


@dataclass(frozen=True)
class ShownSite:
    """The site in folder/data, folder/rig.yaml and folder/protocols."""

    folder: Path
    completed: str  # with a redo, a skipped viewpoint, a correction, a signature and a result
    registered: str  # scans with spheres and a registration
    calibrated: str  # a calibration, and a capture in progress
    listing: str  # waits for the confirmation of a checklist with one item ticked
    moving: str  # waits for the confirmation of a motion
    signing: str  # waits for the signature of an irreversible step
    failed: str  # waits for a decision: a gate has failed
    acceptable: str  # like `failed`, but a supervisor may accept it
    held: str  # images are taken by hand, one of which cannot be used

    @property
    def under_way(self) -> tuple[str, ...]:
        return self.calibrated, self.listing, self.moving, self.signing, self.failed, self.acceptable, self.held


def shown_site(folder: Path) -> ShownSite:
    """Create every kind of run, and the four people of tests.support.pages.web."""
    registered = record_run(folder)
    completed = record_reported_run(folder, person="grace")
    failed = record_reported_run(folder, error_mm=0.9, person="grace")
    acceptable = record_reported_run(folder, error_mm=0.9, person="grace", acceptable=True)
    with web_site(folder) as web:
        calibrated = begin_calibrated_run(web)
        listing = web.begin_run().run_id
        web.store.record(
            listing, [ItemTicked(step="fixation", attempt=1, item="wires hold", ticked=True)], actor="grace"
        )
        moving = web.begin_run().run_id
        web.store.record(moving, [skip("fixation")], actor="grace")
        signing = web.begin_run()
        signing.script("spraying", "sign", leave)
        with contextlib.suppress(_LeftError):
            signing.run()
        with pytest.MonkeyPatch.context() as monkeypatch:
            held = left_held_run(web.begin_run, monkeypatch, folder).run_id
    return ShownSite(
        folder, completed, registered, calibrated, listing, moving, signing.run_id, failed, acceptable, held
    )


class _LeftError(BaseException):
    """The person has gone."""


def leave(_question: AskOperator, _state: RunState) -> OperatorAction:
    raise _LeftError


def skip(step: str) -> OperatorAction:
    return OperatorAction(action="skip", step=step, reason="done the day before")
