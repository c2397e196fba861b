"""The camera driver on what real Nikon Z bodies were recorded to state: all that it was ever connected to."""

from __future__ import annotations

import re
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import NamedTuple

import pytest

from drivers.errors import DeviceRefusedError
from drivers.gphoto.profiles import profile_for
from drivers.interfaces import CameraSettings
from simulators.nikon_camera.body import names
from simulators.nikon_camera.responder import described
from simulators.sony_camera.properties import U8, U16, CameraProperty, Enabled
from tests.support.rig.gphoto_rig import gphoto_rig

rig = partial(gphoto_rig, "nikon")


class Told(NamedTuple):
    """What the driver makes of a body: problems of its report, and a refusal of settings or of a capture."""

    focus: str
    problems: str = ""
    refuses_settings: str = ""
    refuses_capture: str = ""


# The owners' settings; the listings of the Z6_3, Z 9 and Z f have no properties of the maker's own.
TOLD = {
    "z30-v1.00": Told("Automatic", "program is Auto", "keeps f-number at f/3.5.*cannot be set now.*mode dial to M"),
    "z5-v1.00": Told("Automatic"),
    "z6-v1.00": Told("Manual", "program is P", "keeps f-number at f/4.*mode dial to M"),
    "z6_2-v1.00": Told("Automatic"),
    "z6_3-v1.00": Told("Manual", "states no f-number", "states no f-number", "states no f-number"),
    "z7-v1.01": Told("Manual"),
    "z9-v1.11": Told("Automatic", "no setting shutterspeed2", "keeps imagequality at Unknown value 000d"),
    "zf-v1.10": Told("Manual", "no setting shutterspeed2", "no setting shutterspeed2"),
}


def test_each_recorded_body_is_replayed_and_has_the_profile() -> None:
    assert set(names()) == set(TOLD)


@pytest.mark.parametrize("body", TOLD)
def test_a_recorded_body_is_driven_or_refused_in_words_that_help(body: str, tmp_path: Path) -> None:
    """Before, each of them was refused for `isoauto`, which on these bodies cannot be switched off."""
    told = TOLD[body]
    wanted = CameraSettings(8.0, 1 / 15, 100, told.focus, "JPEG")
    with rig([], "--fast", "--recorded", body) as (camera, _):
        report = camera.report()
        with refused(told.refuses_settings):
            assert camera.apply(wanted) == wanted
        with refused(told.refuses_capture):
            assert [camera.capture(tmp_path).counter for _ in range(2)] == [1, 2]
    assert report.details["profile"] == "nikon_z"
    assert profile_for("Nikon Corporation", report.identity.model, "", "here")[0] == "nikon_z"
    assert report.free_bytes is not None
    problems = "; ".join(report.problems)
    assert re.search(told.problems, problems) if told.problems else not problems


def refused(words: str) -> nullcontext[None] | pytest.RaisesExc[DeviceRefusedError]:
    """What is inside is refused with these words, or succeeds if there are none."""
    return pytest.raises(DeviceRefusedError, match=words) if words else nullcontext()


def test_raw_and_jpeg_of_one_exposure(tmp_path: Path) -> None:
    with rig([], "--fast", "--recorded", "z7-v1.01") as (camera, _):
        camera.apply(CameraSettings(8.0, 1 / 15, 100, "Manual", "RAW+JPEG"))
        image = camera.capture(tmp_path)
    assert [file.camera_name for file in image.files] == ["DSC_0001.JPG", "DSC_0001.NEF"]


@pytest.mark.parametrize(
    ("entry", "hexadecimal"),
    [
        (CameraProperty(0x5007, U16, 800, (560, 800)), "0750" "0400" "01" "0000" "2003" "02" "0200" "3002" "2003"),
        (CameraProperty(0x5001, U8, 60, None, (1, 100, 1), Enabled.GREY), "0150" "0200" "00" "00" "3c" "01" "016401"),
    ],
)  # fmt: skip
def test_golden_descriptions(entry: CameraProperty, hexadecimal: str) -> None:
    assert described(entry).hex() == hexadecimal
