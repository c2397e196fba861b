"""What a photograph states of its camera is read in one place, and its record stays as it was written."""

from __future__ import annotations

import json

from service.core.records.base import recorded
from service.core.records.run_events import RecordedOptics, ViewImported

PHOTOGRAPH = ViewImported(
    step="photographs", attempt=1, viewpoint="IMG_1", station="", artefacts=(), camera={}, imported_by="Ada",
    file_name="IMG_1.JPG", modified_utc="2024-03-01T10:03:00+00:00",
)  # fmt: skip


def photograph(**camera: object) -> ViewImported:
    return PHOTOGRAPH.model_copy(update={"camera": camera})


def test_a_photograph_is_written_again_as_it_was_with_keys_and_types_of_any_driver() -> None:
    camera = {"iso": "Hi 1", "aperture_f": 22, "lens": None, "drive": {"mode": "single"}, "focus_position": 0}
    written = json.dumps(recorded(photograph(**camera)))
    again = ViewImported.model_validate_json(written)
    assert again.camera == camera
    assert json.dumps(recorded(again)) == written
    assert again.optics == RecordedOptics(aperture_f=22.0, focus_position=0)


def test_zero_stands_for_a_number_that_the_camera_does_not_know_but_for_the_focus_motor() -> None:
    unknown = photograph(
        aperture_f=0.0, exposure_s=0, iso=0, focal_length_mm=0.0, focus_distance_m=0, width=0, height=0, model=""
    )
    assert unknown.optics == photograph().optics == RecordedOptics()
    assert photograph(focus_position=0).optics.focus_position == 0
