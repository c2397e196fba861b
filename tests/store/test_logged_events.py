"""What the log says of recorded events: enough to find the event, and what it concerns."""

from __future__ import annotations

import logging
from typing import Any

import pytest

from service.core.records.events import Payload
from service.core.records.run_events import DeviceTrouble, JobFinished, StepNote, ViewpointFailed
from service.store.store import tell
from tests.support.record.core import Log


def said(caplog: pytest.LogCaptureFixture, payload: Payload) -> dict[str, Any]:
    """The fields of the one line about an event."""
    event = Log().event(payload, "worker 1")
    with caplog.at_level(logging.INFO, logger="service.store.store"):
        tell([event])
    (line,) = caplog.records
    assert line.getMessage() == payload.kind
    fields = vars(line)
    assert (fields["run"], fields["seq"], fields["actor"]) == ("run", 2, "worker 1")
    names = ("step", "attempt", "viewpoint", "device", "job", "job_kind", "duration_s", "note", "error", "words")
    return {name: fields[name] for name in names if name in fields}


def test_a_job_is_told_with_its_kind_step_and_duration(caplog: pytest.LogCaptureFixture) -> None:
    done = JobFinished(job="j1", job_kind="detect", step="views", attempt=2, worker="w", measures={}, duration_s=1.5)
    expected = {"job": "j1", "job_kind": "detect", "step": "views", "attempt": 2, "duration_s": 1.5}
    assert said(caplog, done) == expected


def test_a_failed_view_and_a_device_are_told_with_their_error_and_its_words(caplog: pytest.LogCaptureFixture) -> None:
    failed = ViewpointFailed(step="views", attempt=1, viewpoint="v3", error="BlurError", message="not sharp")
    expected = {"step": "views", "attempt": 1, "viewpoint": "v3", "error": "BlurError", "words": "not sharp"}
    assert said(caplog, failed) == expected
    caplog.clear()
    trouble = DeviceTrouble(device="camera", error="DeviceTimeoutError", message="gone")
    assert said(caplog, trouble) == {"device": "camera", "error": "DeviceTimeoutError", "words": "gone"}


def test_a_note_is_told(caplog: pytest.LogCaptureFixture) -> None:
    note = StepNote(step="views", attempt=1, note="station entered", data={})
    assert said(caplog, note) == {"step": "views", "attempt": 1, "note": "station entered"}


def test_a_log_that_nobody_keeps_costs_nothing(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, logger="service.store.store"):
        tell([Log().event(StepNote(step="views", attempt=1, note="a", data={}))])
    assert caplog.records == []
