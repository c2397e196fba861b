"""Two cameras in a run on the in-memory rig: both expose, both are retried, and nothing is lost or doubled."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.errors import DeviceUnavailableError
from service.core.records.run_events import FurtherExposure, ViewpointCaptured, ViewpointFailed
from service.rig import FurtherCameraSection
from service.steps.context import FurtherCamera
from tests.support.rig.bench_rig import BenchCamera
from tests.support.runs.bench_run import VIEWS, Bench, KilledError, say

CALIBRATION = '{"width": 60, "height": 40, "fx": 80, "fy": 80, "cx": 30, "cy": 20}'


@pytest.fixture
def add(bench: Bench, tmp_path: Path) -> Callable[..., BenchCamera]:
    """Adds a second camera to the rig of the run."""

    def second(**stated: object) -> BenchCamera:
        calibration, camera = tmp_path / "second.json", BenchCamera()
        calibration.write_text(CALIBRATION)
        section = FurtherCameraSection.model_validate({"mounted": "fixed", "calibration": "second.json", **stated})
        bench.rig.further = (FurtherCamera("second", camera, section, calibration),)
        return camera

    return second


def exposures(bench: Bench) -> dict[str, tuple[FurtherExposure, ...]]:
    """What counts, by viewpoint."""
    return {capture.viewpoint: capture.further for capture in bench.payloads(ViewpointCaptured)}


def test_both_cameras_expose_at_each_viewpoint(bench: Bench, add: Callable[..., BenchCamera]) -> None:
    add(mounted="rigid")
    assert bench.run().status == "completed"
    found = exposures(bench)
    assert list(found) == VIEWS
    assert [[one.device for one in further] for further in found.values()] == [["second"]] * 4
    assert len({one.artefacts[0].sha256 for further in found.values() for one in further}) == 4
    for capture in bench.payloads(ViewpointCaptured):
        (one,) = capture.further
        assert one.trigger_monotonic_s >= capture.arrival_monotonic_s
        assert one.mounted == "rigid"
    bench.must_verify()


def test_its_files_are_in_the_evidence_under_its_name(bench: Bench, add: Callable[..., BenchCamera]) -> None:
    add()
    bench.run()
    rows = [row for row in bench.store.artefacts(bench.run_id) if row.device == "second"]
    assert [row.ref.kind for row in rows].count("further_image") == 4
    assert [row.ref.kind for row in rows].count("camera_calibration") == 1  # once, with the first image
    assert {row.viewpoint for row in rows} == set(VIEWS)
    (calibration,) = (row for row in rows if row.ref.kind == "camera_calibration")
    assert bench.store.artefact_path(calibration.ref.sha256, verify=True).read_text() == CALIBRATION


def test_a_fault_of_the_second_camera_repeats_the_viewpoint_with_both(
    bench: Bench, add: Callable[..., BenchCamera]
) -> None:
    def fail(exposure: int) -> None:
        if exposure in (2, 3):
            raise DeviceUnavailableError("the link dropped", where="second")

    second = add()
    second.on_capture = fail
    assert bench.run().status == "completed"
    assert bench.captured() == VIEWS
    assert all(len(further) == 1 for further in exposures(bench).values())
    failures = bench.payloads(ViewpointFailed)
    assert [(f.viewpoint, f.skipped) for f in failures] == [("v002", False)] * 2
    assert second.opened == 3
    assert bench.rig.shutter.exposures == 6  # the first camera's images of the failed tries are not recorded
    bench.must_verify()


def test_a_second_camera_that_stays_away_stops_the_step_for_a_person(
    bench: Bench, add: Callable[..., BenchCamera]
) -> None:
    def fail(exposure: int) -> None:
        if 1 < exposure <= 4:
            raise DeviceUnavailableError("the link dropped", where="second")

    add().on_capture = fail
    bench.script("capture", "recovery", say("confirm"))
    state = bench.run()
    assert state.status == "completed"
    assert bench.captured() == VIEWS
    assert all(len(further) == 1 for further in exposures(bench).values())


def test_a_run_that_dies_between_the_two_exposures_goes_on_with_both(
    bench: Bench, add: Callable[..., BenchCamera]
) -> None:
    def die(exposure: int) -> None:
        if exposure == 3:
            raise KilledError

    second = add()
    second.on_capture = die
    with pytest.raises(KilledError):
        bench.run()
    before = exposures(bench)
    assert list(before) == VIEWS[:2]
    assert bench.run().status == "completed"
    assert bench.captured() == VIEWS  # each once
    after = exposures(bench)
    assert {name: after[name] for name in before} == before
    assert all(len(further) == 1 for further in after.values())
    bench.must_verify()


def test_a_camera_that_exposes_once_at_a_station(bench: Bench, add: Callable[..., BenchCamera]) -> None:
    second = add(every="station")
    assert bench.run().status == "completed"
    assert [len(further) for further in exposures(bench).values()] == [1, 0, 0, 0]
    assert second.exposures == 1


def test_settings_of_its_own_and_a_departure_from_them(bench: Bench, add: Callable[..., BenchCamera]) -> None:
    second = add(iso=800)
    second.exif = lambda applied: dataclasses.replace(applied, iso=400) if second.exposures == 2 else applied
    bench.script("capture", "recovery", say("confirm"))
    assert bench.run().status == "completed"
    assert second.applied is not None
    assert second.applied.iso == 800
    assert bench.rig.shutter.applied is not None
    assert bench.rig.shutter.applied.iso == 100
    assert bench.captured() == [*VIEWS, "v002"]  # its gate failed until the image was taken again
    taken = [capture for capture in bench.payloads(ViewpointCaptured) if capture.viewpoint == "v002"]
    assert [capture.verdicts["settings"] for capture in taken] == [False, True]
