"""The bytes of the simulated Canon EOS, written out by hand from what libgphoto2 reads; and its table of settings."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from simulators.canon_camera import events
from simulators.canon_camera.body import CanonBody
from simulators.canon_camera.properties import APERTURE_F, FORMATS, ISO, SHUTTER, Code, Properties, eos_r5
from simulators.canon_camera.responder import CanonResponder
from simulators.faults import FaultPlan
from simulators.ptpip import codec
from simulators.still_camera.body import BodyOptions, CameraFile
from simulators.still_camera.operations import NotWritableError, RefusedValueError
from simulators.still_camera.scene import StillLife


@pytest.mark.parametrize(
    ("record", "hexadecimal"),
    [
        (events.value(0xD101, struct.pack("<I", 0x50)), "10000000 89c10000 01d10000 50000000"),
        (events.value(0xD1AF, b"0420\0"), "14000000 89c10000 afd10000 30343230 00000000"),
        (events.choices(0xD108, 2, bytes(8)), "1c000000 8ac10000 08d10000 03000000 02000000 00000000 00000000"),
        (events.status(busy=True), "0c000000 8bc10000 01000000"),
        (events.END, "08000000 00000000"),
    ],
)
def test_records_of_events(record: bytes, hexadecimal: str) -> None:
    assert record.hex() == hexadecimal.replace(" ", "")


def test_records_of_files() -> None:
    file = CameraFile("IMG_0001.JPG", 0x3801, bytes(0x1234), 60, 40, "20261124T120000")
    added = events.object_added(0x30100001, 0x00010001, 0x30100000, file)
    assert [added[at : at + 4].hex() for at in (8, 12, 16, 28, 36)] == [
        "01001030", "01000100", "01380000", "34120000", "00001030",
    ]  # fmt: skip
    assert added[44:].rstrip(b"\0") == b"IMG_0001.JPG"
    wanted = events.transfer_wanted(0x40000001, file)
    assert [wanted[at : at + 4].hex() for at in (8, 12, 20)] == ["01000040", "01380000", "34120000"]
    assert wanted[28:].rstrip(b"\0") == b"IMG_0001.JPG"
    assert all(struct.unpack_from("<I", one)[0] == len(one) for one in (added, wanted))


def test_image_formats() -> None:
    assert FORMATS[0].encode().hex() == "01000000" + "10000000" + "01000000" + "00000000" + "03000000"
    both = FORMATS[2].encode()
    assert both.hex() == "02000000" + "10000000060000000000000004000000" + "10000000010000000000000003000000"


def test_codes_are_thirds_of_a_stop() -> None:
    """An eighth of a stop a step: nominal values are near, and full stops are exact."""
    assert (APERTURE_F[0x50], ISO[0x48], SHUTTER[0x58]) == (22, 100, (1, 15))
    for code, f_number in APERTURE_F.items():
        assert f_number == pytest.approx(2 ** ((code - 8) / 16), rel=0.04)
    for code, iso in ISO.items():
        assert iso == pytest.approx(100 * 2 ** ((code - 0x48) / 8), rel=0.04)
    for code, (numerator, denominator) in SHUTTER.items():
        assert numerator / denominator == pytest.approx(2 ** ((0x38 - code) / 8), rel=0.08)


def test_a_camera_without_a_cable_was_set_by_hand(tmp_path: Path) -> None:
    body = CanonBody(StillLife(240), FaultPlan(), BodyOptions(send_to=tmp_path))
    settings = body.exposure_settings()
    assert (settings.aperture_f, settings.exposure_fraction, settings.iso) == (22, (1, 15), 100)


def written(code: Code, value: int) -> bytes:
    return struct.pack("<III", 12, code, value)


def test_a_value_that_is_set_is_told_and_a_refused_one_is_not() -> None:
    table = Properties(eos_r5())
    table.set_from_client(written(Code.ISO, 0x48))
    assert table.news().hex() == "10000000" + "89c10000" + "03d10000" + "48000000" + events.END.hex()
    with pytest.raises(RefusedValueError):
        table.set_from_client(written(Code.ISO, 0x49))
    with pytest.raises(NotWritableError):
        table.set_from_client(written(Code.FOCUS, 0))
    with pytest.raises(RefusedValueError):
        table.set_from_client(b"\x0c\0\0\0")
    assert table.news() == events.END
    assert table.exposure_settings().iso == 100


def test_the_mode_dial_locks_aperture_and_time() -> None:
    table = Properties(eos_r5())
    table.put(Code.EXPOSURE_MODE, 2)
    with pytest.raises(NotWritableError, match="mode dial"):
        table.set_from_client(written(Code.APERTURE, 0x50))


def test_the_lens_is_driven_while_live_view_goes_to_the_computer() -> None:
    body = CanonBody(StillLife(96), FaultPlan(), BodyOptions(fast=True))
    responder = CanonResponder(body, FaultPlan())

    def drive(amount: int) -> int:
        return responder.handle(codec.Request(0x9155, 1, (amount,), False), b"").code

    assert drive(1) == 0xA102
    body.properties.put(Code.VIEWFINDER_OUTPUT, 2)
    assert [drive(amount) for amount in (3, 0x8001, 4)] == [0x2001, 0x2001, 0x201D]
    assert body.focus_steps == -64 + 1
