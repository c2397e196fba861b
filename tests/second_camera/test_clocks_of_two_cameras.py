"""The offset between the clocks of two cameras, from the times that their photographs state."""

from __future__ import annotations

from pathlib import Path

import pytest

from service.core.recorded_devices import clock_offset, clock_readings
from service.core.records.base import ArtefactRef
from service.core.records.run_events import DeviceOpened, FurtherExposure, ViewpointCaptured
from service.store.records import NewArtefact
from service.store.store import Store
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import captured, put_image, start_run

REF = ArtefactRef(sha256="0" * 64, kind="image", media_type="image/jpeg", size_bytes=1, original_name="a.jpg")


def pair(number: int, first: str, second: str, apart_s: float) -> ViewpointCaptured:
    """A viewpoint at which both exposed, the second one `apart_s` after the first by the host's clock."""
    exposure = FurtherExposure(
        device="second",
        mounted="fixed",
        artefacts=(REF,),
        calibration=REF,
        camera={"exif_time": second},
        trigger_monotonic_s=100.0 + number + apart_s,
        arrival_monotonic_s=101.0 + number + apart_s,
    )
    return captured(
        REF, f"v{number}", camera={"exif_time": first}, trigger_monotonic_s=100.0 + number, further=(exposure,)
    )


def test_the_time_between_the_exposures_is_taken_off() -> None:
    found = clock_offset(
        [
            pair(0, "2026:11:21 10:00:00.500+00:00", "2026:11:21 10:00:03.260+00:00", 1.25),
            pair(1, "2026:11:21 10:01:00.000+00:00", "2026:11:21 10:01:02.490+00:00", 1.0),
        ],
        "second",
    )
    assert found is not None
    assert found.offset_s == pytest.approx(1.5, abs=1e-6)
    assert found.sigma_s == pytest.approx(0.01, rel=0.01)  # 1.51 and 1.49 s
    assert found.photographs == 2


def test_whole_seconds_are_no_better_than_seconds() -> None:
    captures = [pair(n, "2026:11:21 10:00:00", "2026:11:21 10:00:03", 1.0) for n in range(4)]
    found = clock_offset(captures, "second")
    assert found is not None
    assert found.offset_s == pytest.approx(2.0)
    assert found.sigma_s == pytest.approx(1 / 6**0.5 / 2)


def test_two_models_are_no_better_known_than_their_delays() -> None:
    alike = [pair(n, f"2026:11:21 10:0{n}:00.000", f"2026:11:21 10:0{n}:02.500", 1.0) for n in range(4)]
    models = [
        capture.model_copy(
            update={
                "further": tuple(
                    one.model_copy(update={"camera": {**one.camera, "model": "B"}}) for one in capture.further
                )
            }
        )
        for capture in alike
    ]
    same, unlike = clock_offset(alike, "second"), clock_offset(models, "second")
    assert same is not None
    assert unlike is not None
    assert (same.unlike, unlike.unlike) == (False, True)
    assert unlike.offset_s == same.offset_s
    assert same.sigma_s < 0.01
    assert unlike.sigma_s >= 0.1


def test_zones_are_compared() -> None:
    found = clock_offset([pair(0, "2026:11:21 10:00:00.000+01:00", "2026:11:21 09:00:01.000+00:00", 1.0)], "second")
    assert found is not None
    assert found.offset_s == pytest.approx(0.0)


@pytest.mark.parametrize("stated", ["", "yesterday", "2026:11:21 10:00:00.000+01:00"])
def test_no_offset_without_comparable_times(stated: str) -> None:
    assert clock_offset([pair(0, "2026:11:21 10:00:00.000", stated, 1.0)], "second") is None
    assert clock_offset([pair(0, "2026:11:21 10:00:00", "2026:11:21 10:00:00", 1.0)], "third") is None


def test_the_clocks_of_a_run_list_it(tmp_path: Path) -> None:
    with Store.open(tmp_path / "data", SteppedClock()) as store:
        run_id = start_run(store)
        for name in ("camera", "second"):
            report = {"identity": {"kind": "camera"}, "clock_offset_s": 0.25}
            store.record(run_id, [DeviceOpened(device=name, report=report)], actor="runner")
        both = pair(0, "2026:11:21 10:00:00.000+00:00", "2026:11:21 10:00:08.500+00:00", 1.0)
        kept = put_image(store, "v0")
        further = tuple(one.model_copy(update={"artefacts": (kept,), "calibration": kept}) for one in both.further)
        both = both.model_copy(update={"artefacts": (kept,), "further": further})
        row = NewArtefact(kept, "camera", "capture", 1, "v0", "Ada")
        store.record(run_id, [both], actor="runner", artefacts=[row])
        readings = {(reading.device, reading.against): reading for reading in clock_readings(store.events(run_id))}
    found = readings["second", "first camera"]
    assert found.offset_s == pytest.approx(7.5)
    assert found.within is False
    assert found.words.startswith("The clock of second is 7.50 s ahead of the first camera's: more than 5 s")
    assert "1 pair of photographs" in found.note
    assert readings["second", "host UTC"].offset_s == 0.25
