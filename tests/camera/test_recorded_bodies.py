"""The camera driver on what real bodies were recorded to state, and on how they begin and announce."""

from __future__ import annotations

import json
import re
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest

from drivers.errors import DeviceRefusedError, DeviceStorageFullError, DeviceTimeoutError
from drivers.gphoto.profile import battery_fraction
from drivers.gphoto.profiles import profile_for
from drivers.interfaces import CameraSettings
from simulators.rig.cameras import as_recorded
from simulators.sony_camera.answers import HOWS
from simulators.sony_camera.recorded import names, recorded_table
from tests.support.recorded.listings import transcribe
from tests.support.rig.gphoto_rig import PAPER, gphoto_rig
from tests.support.vendor.camera_vendor_session import vendor_session

rig = partial(gphoto_rig, "camera")
NO_LENS = r"states no f-number.*lock the lens in place"
NO_LIST = "no values for iso.*Set ISO on the body"


@dataclass(frozen=True)
class Told:
    """What the driver makes of a body: problems of its report, and a refusal of settings or of a capture."""

    problems: str = ""
    refuses_settings: str = ""
    refuses_capture: str = ""


TOLD = {
    "ilce-1-1.31": Told("program is P"),
    "ilce-1m2-3.00": Told("capturemode is Continuous Shooting Mid: .*turn the drive dial to single"),
    "ilce-5000-1.0": Told(),
    "ilce-6700-1.02": Told(NO_LENS, NO_LENS, NO_LENS),
    "ilce-7c-1.00": Told("program is A", "keeps shutterspeed at 1/30.*cannot be set now.*mode dial to M"),
    "ilce-7m4-1.00": Told("program is A", NO_LIST),
    "ilce-7m5-2.00": Told(NO_LENS, NO_LENS, NO_LENS),
    "ilce-7rm2-1.0": Told("Battery at 4 %.*program is P"),
    "ilce-7rm3-1.0": Told("program is"),
    "ilce-7rm3a-1.0": Told("", "keeps focusmode at AF-A.*set their focus switch to MF"),
    "ilce-7rm4-1.00": Told("program is A", NO_LIST),
    "ilce-7rm4a-1.00": Told(NO_LENS, NO_LENS, NO_LENS),
    "ilce-7rm5-2.02": Told("", NO_LIST),
}


@contextmanager
def outcome(refusal: str) -> Generator[None]:
    """What is inside succeeds, or is refused with words that match."""
    if not refusal:
        yield
        return
    with pytest.raises(DeviceRefusedError, match=refusal):
        yield


def test_each_recorded_body_is_replayed() -> None:
    assert set(names()) == set(TOLD)


@pytest.mark.slow
@pytest.mark.parametrize("body", TOLD)
def test_a_recorded_body_is_driven_or_refused_in_words_that_help(body: str, tmp_path: Path) -> None:
    """Before, three of them ended the driver with SIGSEGV or hung at each setting for six seconds."""
    told, table = TOLD[body], recorded_table(body)
    with rig([], "--fast", "--recorded", body) as (camera, _):
        report = camera.report()
        with outcome(told.refuses_settings):
            assert camera.apply(PAPER) == PAPER
        with outcome(told.refuses_capture):
            assert camera.capture(tmp_path).model == table.model
    assert (report.identity.model, report.identity.firmware) == (table.model, table.firmware)
    assert report.details["profile"] == "sony_ilce"
    problems = "; ".join(report.problems)
    assert re.search(told.problems, problems) if told.problems else not problems


def test_a_recorded_body_whose_iso_was_set_by_hand_takes_the_settings_of_the_paper(tmp_path: Path) -> None:
    """What the driver asks a person to do; so the body of a simulated rig is prepared."""
    with rig([], "--fast", *as_recorded("ilce-7rm5-2.02")) as (camera, _):
        assert camera.apply(PAPER) == PAPER
        assert camera.capture(tmp_path).exif == PAPER


@pytest.mark.parametrize("body", names())
def test_a_recorded_body_is_named_by_its_profile_and_nothing_in_its_table_names_a_person(body: str) -> None:
    table = recorded_table(body)
    assert profile_for("Sony Corporation", table.model, "", "here")[0] == "sony_ilce"
    texts = {one.value for one in table.properties if isinstance(one.value, str)}
    assert texts <= {"", "DSC", "----", "FE 28mm F2", table.firmware}


def test_without_a_lens_the_driver_lives_and_says_so(tmp_path: Path) -> None:
    """Before, the first read of the f-number ended the process: died of SIGSEGV, open the device again."""
    with rig([], "--fast", "--no-lens") as (camera, _):
        report = camera.report()
        for act in (camera.settings, lambda: camera.apply(PAPER), lambda: camera.capture(tmp_path)):
            with pytest.raises(DeviceRefusedError, match=NO_LENS):
                act()
        assert camera.preview()[:2] == b"\xff\xd8"
    assert report.details["f-number"] == "not stated"
    assert re.search(NO_LENS, report.problems[0])


def test_what_the_lens_fixes_is_named_at_once() -> None:
    """Before, after 6.2 s, with "Turn the mode dial to M"."""
    with (
        rig([], "--fast", "--lens-switch", "MF") as (camera, _),
        pytest.raises(DeviceRefusedError, match=r"cannot be set now.*focus switch"),
    ):
        camera.apply(CameraSettings(22.0, 1 / 15, 100, "Automatic"))


@pytest.mark.parametrize(
    ("word", "fraction"), [("253%", None), ("-1%", None), ("87%", 0.87), ("0%", 0.0), ("100%", 1.0), ("Low", 0.05)]
)
def test_a_charge_that_no_battery_has_is_unknown(word: str, fraction: float | None) -> None:
    assert battery_fraction(word) == fraction


def test_a_body_that_does_not_know_its_charge_shows_none() -> None:
    """Before, 253 %."""
    with rig([], "--battery", "-1") as (camera, _):
        report = camera.report()
    assert report.battery_fraction is None
    assert report.problems == ()


def test_an_old_file_in_the_memory_is_not_the_first_photograph(tmp_path: Path) -> None:
    with rig([], "--fast", "--old-file", "--first-counter", "7") as (camera, _):
        assert camera.capture(tmp_path).counter == 8


def test_a_body_that_announces_without_a_parameter(tmp_path: Path) -> None:
    with rig([], "--fast", "--bare-event") as (camera, _):
        assert [camera.capture(tmp_path).counter for _ in range(2)] == [1, 2]


def test_a_body_that_takes_nothing_yet_is_released_once_more(tmp_path: Path) -> None:
    """Before, the first exposure was given up after 40 s."""
    with rig([], "--fast", "--not-ready-s", "3") as (camera, _):
        assert camera.capture(tmp_path).counter == 1
        assert camera.capture(tmp_path).counter == 2


def test_a_card_of_which_no_storage_is_listed_is_known_by_its_slots(tmp_path: Path) -> None:
    """The 1M2 was recorded without a card in either slot."""
    with rig([], "--fast", "--recorded", "ilce-1m2-3.00", capture_target="card") as (camera, _):
        with pytest.raises(DeviceStorageFullError, match="no card in the camera"):
            camera.capture(tmp_path)
        assert any("no card in the camera" in problem for problem in camera.report().problems)


def stated(**values: int) -> str:
    return json.dumps([{"code": code[1:], "how": "value", "value": value} for code, value in values.items()])


def test_what_goes_to_the_computer_and_what_changes_a_photograph_is_set() -> None:
    """Before, small JPEGs or only one of the files went to the computer, and the rest was asked of a person."""
    codes = {"xd268": 2, "xd269": 2, "x5013": 0x18010, "xd0d9": 2, "xd0df": 3, "xd0db": 2, "xd219": 2, "xd203": 3}
    with rig([], "--fast", "--answers", stated(**codes)) as (camera, simulator):
        assert camera.report().problems == (), "all of these can be set"
        camera.apply(PAPER)
        camera.close()
        words = ("d268", "d269", "5013", "d0d9", "d0df", "d0db", "d219", "d203")
        found = vendor_session(simulator.gphoto_port, *(["value", word] for word in words))
    assert found == ["1", "1", "1", "1", "2", "1", "1", "1"]


def test_what_only_a_person_can_set_is_a_problem() -> None:
    values = {"d268": 2, "d269": 2, "d0d9": 2, "d0df": 3}
    answers: list[dict[str, object]] = [{"code": c, "how": "value", "value": v} for c, v in values.items()]
    answers.extend({"code": code, "how": "read_only"} for code in values)
    with rig([], "--fast", "--answers", json.dumps(answers)) as (camera, _):
        assert camera.apply(PAPER) == PAPER
        problems = "; ".join(camera.report().problems)
    for words in (
        "pcsaveimgsize is 2M",
        "pcsaveimgformat is JPEG Only",
        "imagestabilization is On",
        "shuttertype is",
    ):
        assert words in problems


def test_files_that_do_not_come_name_what_keeps_them_from_the_computer(tmp_path: Path) -> None:
    with (
        rig([{"on": "image", "kind": "no_image"}], "--fast", capture_timeout_s=0.5) as (camera, _),
        pytest.raises(DeviceTimeoutError, match=r"RAW\+J PC Save Image must be RAW & JPEG"),
    ):
        camera.capture(tmp_path)


@pytest.mark.parametrize("how", HOWS[:-1])
def test_an_answer_that_nobody_expects_ends_no_driver(how: str, tmp_path: Path) -> None:
    """Of every property: bench/results/camera_answers-2026-11-27.md. Here, four that are shown and not needed."""
    codes = ("5005", "d0d9", "d218", "d268")
    answers = json.dumps([{"code": code, "how": how, "value": 99} for code in codes])
    with rig([], "--fast", "--answers", answers) as (camera, _):
        assert camera.report().details["f-number"] == "f/8"
        assert camera.apply(PAPER) == PAPER
        assert camera.capture(tmp_path).counter == 1


def test_a_value_that_is_stated_late_is_waited_for() -> None:
    answers = json.dumps([{"code": "d21e", "how": "late", "value": 1.0}])
    with rig([], "--fast", "--answers", answers) as (camera, _):
        assert camera.apply(PAPER) == PAPER


def test_a_full_card_is_named_where_the_camera_refuses_to_release_for_it(tmp_path: Path) -> None:
    with (
        rig([{"on": "shutter", "kind": "disk_full"}], "--fast") as (camera, _),
        pytest.raises(DeviceStorageFullError, match="no photograph fits on its card"),
    ):
        camera.capture(tmp_path)


LISTING = """Camera summary:
Model: ILCE-1M2
  Version: 3.00
  Serial Number: 00000000000000001234567890123456
White Balance             (5005 rw u16): Enumeration [2,4,32785] value: Daylight (4)
[Unknown Property]        (d1ce rw str): 'A. Person'
[Unknown Property]        (d07b ro str): 'FE 28mm F2'
Battery Level             (d218 ro i8 ): Range [-1 - 100, step 1] value: 255
F-Number(0x5007):(readwrite) (type=0x4) Range [100 - 100, step 1] value: f/6.6e+02 (65534)
File Format Still         (d253 rw u8 ): Enumeration [] value: 1
Capture(0xd2c2): error 2002 on query.
[Unknown Property]        (d0d0 ro u8 ): Enumeration [1,2"""


def test_a_listing_is_transcribed_without_what_names_a_person() -> None:
    recording = transcribe(LISTING, "here")
    listing = recording.devices["camera"].answers.listing
    assert listing is not None
    assert (recording.source, listing.model, listing.firmware, listing.protocol) == ("here", "ILCE-1M2", "3.00", 300)
    assert listing.controls == ("d2c2",)
    assert [(one.code, one.type, one.access, one.form, one.numbers, one.value) for one in listing.properties] == [
        ("5005", "u16", "rw", "enum", (2, 4, 32785), 4),
        ("d1ce", "str", "rw", "none", (), ""),
        ("d07b", "str", "ro", "none", (), "FE 28mm F2"),
        ("d218", "i8", "ro", "range", (-1, 100, 1), -1),
        ("5007", "u16", "rw", "range", (100, 100, 1), 65534),
        ("d253", "u8", "rw", "enum", (), 1),
    ]
