"""The camera driver on what real Canon EOS bodies told, in codes of logs or in words that have their numbers."""

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
from simulators.canon_camera.recorded import names
from tests.support.recorded.canon_listings import transcribe
from tests.support.rig.gphoto_rig import gphoto_rig
from tests.support.rig.simulator_process import simulator

rig = partial(gphoto_rig, "canon")


class Told(NamedTuple):
    """What the driver makes of a body: problems of its report, and a refusal of settings or of a capture."""

    focus: str
    problems: str = ""
    refuses_settings: str = ""
    refuses_capture: str = ""


# The owners' settings. Listings of some lack a setting that every body has: it is missing on the replay as well.
TOLD = {
    "eos-1000d-1.0.3": Told(
        "Manual", "no setting imageformat.*program is AV", "has no setting imageformat", "has no setting imageformat"
    ),
    "eos-100d-1.0.0": Told("Automatic", "program is P", "not offer aperture 8"),
    "eos-1200d-1.0.0": Told("Automatic", "program is AV", "keeps aperture at 5.6 instead of 8"),
    "eos-1300d-1.2.0": Told("Automatic"),
    "eos-1500d-1.0.0": Told("Manual"),
    "eos-1d-x-2.0.9": Told("Automatic", "program is P", "offers no values for aperture"),
    "eos-2000d-1.0.0": Told("Manual", "program is AV", "keeps aperture at 11 instead of 8"),
    "eos-5d-mark-iii-1.2.1": Told("Automatic", "program is TV", "not offer aperture 8"),
    "eos-5ds-r-1.0.1": Told("Automatic", "program is AV", "keeps aperture at 2.8 instead of 8"),
    "eos-600d-1.0.2": Told("Manual", "program is Night Portrait", "offers no values for aperture"),
    "eos-60d-1.1.0": Told("Manual", "program is AV", "keeps aperture at 4 instead of 8"),
    "eos-650d-1.0.1": Told("Automatic", "program is P", "not offer aperture 8"),
    "eos-6d-1.1.2": Told("Automatic", "program is P", "not offer aperture 8"),
    "eos-6d-mark-ii-1.0.2": Told(
        "Automatic", "no setting aperture.*program is P", "has no setting aperture", "has no setting aperture"
    ),
    "eos-700d-1.1.1": Told(
        "Automatic", "no setting aperture.*program is P", "has no setting aperture", "has no setting aperture"
    ),
    "eos-70d-1.1.1": Told("Automatic", "program is Flash Off", "not offer aperture 8"),
    "eos-750d-1.0.0": Told(
        "Automatic", "no setting aperture.*program is TV", "has no setting aperture", "has no setting aperture"
    ),
    "eos-760d-1.0.0": Told("Automatic", "program is AV", "keeps aperture at 4.5 instead of 8"),
    "eos-77d-1.0.2": Told("Automatic"),
    "eos-7d-1.1.0": Told("Manual", "no setting focusmode", "has no setting focusmode", "has no setting focusmode"),
    "eos-7d-mark-ii-1.0.2": Told("Automatic", "program is P", "offers no values for aperture"),
    "eos-90d-1.0.0": Told("Automatic", "program is Auto", "offers no values for aperture"),
    "eos-m10-14.0.1.0": Told("Automatic", "program is P", "does not offer imageformat JPEG"),
    "eos-m100-15.0.1.0": Told("Automatic", "program is P", "does not offer imageformat JPEG"),
    "eos-m200-1.0.0": Told("Automatic", "program is AV", "keeps aperture at 3.5 instead of 8"),
    "eos-m3-14.0.1.0": Told("Manual", "program is Custom", "does not offer imageformat JPEG"),
    "eos-m50-1.0.0": Told("Automatic", "program is Auto", "offers no values for aperture"),
    "eos-m50m2-1.0.0": Told("Manual"),
    "eos-m6-15.0.1.0": Told("Automatic", "program is Auto", "not offer aperture 8"),
    "eos-m6-mark-ii-1.0.0": Told("Automatic", "program is Fv", "keeps aperture at Unknown value 00ff instead of 8"),
    "eos-r-1.6.0": Told("Automatic", "program is Bulb", "offers no values for shutterspeed"),
    "eos-r1-1.0.1": Told("Automatic", "program is TV", "not offer aperture 8"),
    "eos-r10-1.0.1": Told("Automatic", "program is P", "not offer aperture 8"),
    "eos-r3-1.3.0": Told("Automatic", "program is Bulb", "keeps aperture at 2.8 instead of 8"),
    "eos-r5-1.2.0": Told("Automatic"),
    "eos-r50-1.0.0": Told("Manual"),
    "eos-r50-v-1.0.0": Told("Automatic"),
    "eos-r6-1.0.0": Told("Automatic", "program is P", "not offer aperture 8"),
    "eos-r6-mark-iii-1.0.0": Told("Automatic"),
    "eos-r6m2-1.0.0": Told("Automatic", "program is Fv", "keeps aperture at 32 instead of 8"),
    "eos-r8-1.0.0": Told("Automatic", "program is TV", "not offer aperture 8"),
    "eos-rebel-sl2-1.0.1": Told("Manual", "", "", "capt0000.jpg came from the camera's memory and not from its card"),
    "eos-rebel-t2i-1.0.9": Told("Manual", "", "does not offer iso 100"),
    "eos-rebel-t3-1.0.5": Told(
        "Manual", "no setting aperture.*program is Green", "has no setting focusmode", "has no setting focusmode"
    ),
    "eos-rebel-t6-1.1.1": Told(
        "Automatic", "program is Green.*drivemode is Timer 10 sec", "does not offer imageformat JPEG"
    ),
    "eos-rebel-t7i-1.0.1": Told("Manual"),
}
# One of each kind of answer, tried in every submission; of the others a tenth are drawn.
ALWAYS = (
    "eos-r5-1.2.0",  # does all that it is asked for
    "eos-1000d-1.0.3",  # lacks a setting
    "eos-1d-x-2.0.9",  # offers no values
    "eos-5d-mark-iii-1.2.1",  # does not offer the one wanted
    "eos-6d-mark-ii-1.0.2",
    "eos-r6m2-1.0.0",  # keeps another
    "eos-rebel-sl2-1.0.1",  # refuses the capture alone
)
A_LIST = """/main/status/cameramodel
Label: Camera Model
Readonly: 0
Type: TEXT
Current: Canon EOS R99
END
/main/status/deviceversion
Label: Device Version
Readonly: 0
Type: TEXT
Current: 3-1.0.0
END
/main/status/eosserialnumber
Label: Serial Number
Readonly: 0
Type: TEXT
Current: 012345678901
END
/main/imgsettings/imageformat
Label: Image Format
Readonly: 0
Type: RADIO
Current: RAW + Large Fine JPEG
Choice: 0 Large Fine JPEG
Choice: 1 Unknown value 0450
Choice: 2 RAW + Large Fine JPEG
Choice: 3 Panorama
END
/main/capturesettings/aperture
Label: Aperture
Readonly: 0
Type: RADIO
Current: 5.6
Choice: 0 4.5
Choice: 1 5.6
Choice: 2 6.7
END
/main/capturesettings/shutterspeed
Label: Shutter Speed
Readonly: 0
Type: RADIO
Current: 1/20
Choice: 0 1/20
Choice: 1 1/25
END
/main/capturesettings/drivemode
Label: Drive Mode
Readonly: 0
Type: RADIO
Current: Backwards
Choice: 0 Single
END
/main/capturesettings/alomode
Label: Auto Lighting Optimization
Readonly: 0
Type: RADIO
Current: x1
END
"""
A_LOG = """Manufacturer: Canon.Inc
  Model: Canon EOS R99
  device version: 3-1.0.0
event 0: EOS prop d105 info record, datasize is 4
event 0: currentvalue of d105 is 3
event 1: EOS prop d101 (EOS_Aperture) info record, datasize is 4
event 1: currentvalue of d101 (EOS_Aperture) is 38
event 2: EOS prop d138 info record, datasize is 4
event 3: EOS prop d120 info record, datasize is 36
event 3: decoded imageformat, currentvalue of d120 is 403
event 4: EOS prop d101 (EOS_Aperture) desc record, datasize 8, propxtype 3
event 4: propxtype is 3, prop is 0xd101, data type is 0x0004, propxcnt is 2.
event 4: suppval[0] of d101 is 0x30.
event 4: suppval[1] of d101 is 0x38.
event 0: EOS prop d101 info record, datasize is 4
event 0: currentvalue of d101 is 30
"""


def test_each_recorded_body_is_replayed_and_has_the_profile() -> None:
    assert set(names()) == set(TOLD)


@pytest.mark.slow
@pytest.mark.parametrize(
    "body", [pytest.param(body, marks=pytest.mark.sweep(always=body in ALWAYS)) for body in TOLD]
)
def test_a_recorded_body_is_driven_or_refused_in_words_that_help(body: str, tmp_path: Path) -> None:
    """Before, a setting that a body lacks was a fault of the driver, and an EOS-1D X had no profile."""
    told = TOLD[body]
    wanted = CameraSettings(8.0, 1 / 15, 100, told.focus, "JPEG")
    with rig([], "--fast", "--recorded", body) as (camera, _):
        report = camera.report()
        with refused(told.refuses_settings) as refusal:
            assert camera.apply(wanted) == wanted
        with refused(told.refuses_capture):
            assert [camera.capture(tmp_path).counter for _ in range(2)] == [1, 2]
    assert report.details["profile"] == "canon_eos"
    assert profile_for("Canon.Inc", report.identity.model, "", "here")[0] == "canon_eos"
    problems = "; ".join(report.problems)
    assert re.search(told.problems, problems) if told.problems else not problems
    if refusal is not None and re.search("aperture|shutterspeed", told.refuses_settings):
        assert "mode dial to M" in refusal.value.remedy


def refused(words: str) -> nullcontext[None] | pytest.RaisesExc[DeviceRefusedError]:
    """What is inside is refused with these words, or succeeds if there are none."""
    return pytest.raises(DeviceRefusedError, match=words) if words else nullcontext()


def test_words_of_settings_become_codes_and_what_is_not_known_is_named() -> None:
    """A list with 6.7 is one of half stops, so that its 4.5 has another number than that of a list of thirds."""
    answers = transcribe(A_LIST, "a test").devices["camera"].answers
    assert answers.listing is not None
    found = {one.code: (one.value, one.numbers) for one in answers.listing.properties}
    assert found == {
        "d101": (0x30, (0x2C, 0x30, 0x34)),
        "d102": (0x5B, (0x5B, 0x5D)),
        "d120": (0x0C03, (0x03FF, 0x0C50, 0x0C03)),
        "d1af": ("", ()),
    }
    assert answers.silent == (
        "numbers that imageformat offers: Panorama",
        "the number of drivemode Backwards",
        "codes of settings: alomode",
    )


def test_a_log_of_events_gives_codes_and_numbers_until_events_are_counted_anew() -> None:
    answers = transcribe(A_LOG, "a test").devices["camera"].answers
    assert answers.listing is not None
    found = {one.code: (one.value, one.numbers, one.access) for one in answers.listing.properties}
    assert found == {
        "d105": (3, (), "ro"),
        "d101": (0x38, (0x30, 0x38), "rw"),
        "d120": (0x0C03, (), "ro"),
        "d1af": ("", (), "ro"),
    }
    assert answers.silent == ("numbers of properties that its log has as bytes: d138",)


def test_what_a_listing_does_not_give_is_named_in_the_ready_line() -> None:
    with simulator("canon", "--port", "0", "--recorded", "eos-r50-1.0.0") as started:
        assert any("codes of settings: movierecordtarget" in line for line in started.ready["not_served"])
