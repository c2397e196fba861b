"""One serial number for one camera, whatever its connection and its photographs state."""

from __future__ import annotations

from service.core.recorded_devices import RecordedIdentity, bodies_of

SONY = RecordedIdentity(kind="camera", serial="3282933005318008")


def test_the_bodys_own_number_is_shown_and_the_longer_one_explained() -> None:
    known = bodies_of([("camera", SONY)], ["05318008", "05318008", ""])
    assert known.shown(SONY) == "05318008"
    assert len(known.explained) == 1
    assert "3282933005318008" in known.explained[0]
    assert known.strange == ""


def test_before_the_first_photograph_there_is_nothing_to_explain() -> None:
    known = bodies_of([("camera", SONY)], [])
    assert (known.shown(SONY), known.explained, known.strange) == ("3282933005318008", (), "")


def test_another_body_is_not_taken_for_the_same() -> None:
    known = bodies_of([("camera", SONY)], ["05318009"])
    assert known.shown(SONY) == "3282933005318008"
    assert "05318009" in known.strange
    mixed = bodies_of([("camera", SONY)], ["05318008", "05318009"])
    assert mixed.shown(SONY) == "05318008"
    assert "05318009" in mixed.strange
    assert "05318008 " not in mixed.strange


def test_each_of_two_cameras_has_its_own() -> None:
    other = RecordedIdentity(kind="camera", serial="000000042")
    known = bodies_of([("left", SONY), ("right", other)], ["42", "05318008"])
    assert (known.shown(SONY), known.shown(other)) == ("05318008", "42")
    assert known.strange == ""


def test_a_camera_that_states_no_number_contradicts_nothing_and_a_robot_has_its_own() -> None:
    known = bodies_of(
        [
            ("camera", RecordedIdentity(kind="camera", serial="")),
            ("robot", RecordedIdentity(kind="robot", serial="8")),
        ],
        ["5"],
    )
    assert known.strange == ""
    assert known.shown(RecordedIdentity(kind="robot", serial="05318008")) == "05318008"
    assert known.explained == ()
