"""Golden bytes of the simulated camera's wire, and its operations without a socket."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from simulators.faults import FaultPlan
from simulators.ptpip import codec
from simulators.ptpip.codec import PacketType
from simulators.serve import SimulatorError
from simulators.sony_camera.alpha_7r_v import alpha_7r_v
from simulators.sony_camera.body import SonyBody
from simulators.sony_camera.properties import Code, PropertyTable
from simulators.sony_camera.responder import SonyResponder
from simulators.still_camera.body import BodyOptions
from simulators.still_camera.operations import NotWritableError, RefusedValueError
from simulators.still_camera.scene import PictureFiles, StillLife, exposure_gain
from tests.support.processes.waiting import until

GUID = bytes(range(16))


def request(operation: int, *parameters: int) -> codec.Request:
    return codec.Request(operation, 7, parameters, sends_data=False)


@pytest.fixture
def body() -> SonyBody:
    return SonyBody(StillLife(240), FaultPlan(), BodyOptions(fast=True))


def test_golden_init_exchange() -> None:
    assert codec.parse_header(bytes.fromhex("2400000001000000")) == (PacketType.INIT_COMMAND_REQUEST, 28)
    hello = codec.parse_init_command(bytes.fromhex("000102030405060708090a0b0c0d0e0f7200690067000000") + b"\0\0\1\0")
    assert hello == codec.InitCommand(GUID, "rig", 0x00010000)
    assert codec.init_command_ack(1, GUID, "A7").hex() == (
        "2600000002000000" + "01000000" + GUID.hex() + "410037000000" + "00000100"
    )
    assert codec.parse_init_event(bytes.fromhex("01000000")) == 1
    assert codec.packet(PacketType.INIT_EVENT_ACK).hex() == "0800000004000000"


def test_golden_operation() -> None:
    set_iso = codec.parse_request(bytes.fromhex("02000000" + "0592" + "05000000" + "1ed20000"))
    assert set_iso == codec.Request(0x9205, 5, (0xD21E,), sends_data=True)
    assert codec.parse_start_data(bytes.fromhex("05000000" + "04000000ffffffff")) == 4
    assert codec.response(0x2001, 5).hex() == "0e00000007000000" + "0120" + "05000000"
    assert (
        codec.event(0xC201, 0xFFFFFFFF, (0xFFFFC001,)).hex() == "1200000008000000" + "01c2" + "ffffffff" + "01c0ffff"
    )


def test_golden_data_phase_in_chunks() -> None:
    packets = [one.hex() for one in codec.data_packets(3, b"abcdef", chunk_bytes=4)]
    assert packets == [
        "1400000009000000" + "03000000" + "0600000000000000",
        "100000000a000000" + "03000000" + b"abcd".hex(),
        "0e0000000c000000" + "03000000" + b"ef".hex(),
    ]


@pytest.mark.parametrize("header", ["0700000001000000", "0800000063000000", "00000000", "ffffffff01000000"])
def test_impossible_headers(header: str) -> None:
    with pytest.raises(codec.CodecError):
        codec.parse_header(bytes.fromhex(header))


@pytest.mark.parametrize("body_hex", ["", "0100000001100100", "01000000011001000000ff", "00" * 34])
def test_impossible_requests(body_hex: str) -> None:
    with pytest.raises(codec.CodecError):
        codec.parse_request(bytes.fromhex(body_hex))


def test_golden_strings_and_object_info() -> None:
    assert codec.string("").hex() == "00"
    assert codec.string("A7").hex() == "03410037000000"
    info = codec.ObjectInfo(0x00010001, 0x3801, 44_000_000, 9504, 6336, "DSC00001.JPG", "20261121T040000").encode()
    assert info[:12].hex() == "01000100" + "0138" + "0000" + "00639f02"
    assert struct.unpack_from("<II", info, 26) == (9504, 6336)
    assert codec.string("DSC00001.JPG") in info


def test_golden_property_entry_has_its_choices_twice() -> None:
    table = PropertyTable(alpha_7r_v())
    table.set_from_client(Code.FILE_FORMAT, b"\x02\x00\x00\x00")
    blob = table.encode_all()
    entry = bytes.fromhex("53d2" + "0200" + "0101" + "00" + "02" + "02" + "0300010203" + "0300010203")
    assert entry in blob
    assert struct.unpack_from("<Q", blob)[0] == len(table.codes())


def test_f_number_comes_in_four_bytes_and_strange_values_are_refused() -> None:
    table = PropertyTable(alpha_7r_v())
    table.set_from_client(Code.F_NUMBER, struct.pack("<I", 2200))
    table.set_from_client(Code.SHUTTER_SPEED, struct.pack("<I", 1 << 16 | 15))
    settings = table.exposure_settings()
    assert settings.aperture_f == 22.0
    assert settings.exposure_s == pytest.approx(1 / 15)
    with pytest.raises(RefusedValueError):
        table.set_from_client(Code.F_NUMBER, struct.pack("<I", 2300))
    with pytest.raises(RefusedValueError):
        table.set_from_client(Code.F_NUMBER, b"\x01")


def test_extension_info_announces_version_3(body: SonyBody) -> None:
    reply = SonyResponder(body, FaultPlan()).handle(request(0x9202, 0x12C, 1), b"")
    assert reply.data is not None
    assert struct.unpack_from("<H", reply.data)[0] == 300
    assert reply.data.endswith(bytes.fromhex("04000000" + "c1d2" + "c2d2" + "d1d2" + "d2d2"))


def test_in_pc_remote_no_storage_and_no_object_is_listed(body: SonyBody) -> None:
    """As every listing of a body shows it; newer ones answer StoreNotAvailable."""
    responder = SonyResponder(body, FaultPlan())
    assert responder.handle(request(0x1004), b"").data == bytes(4)
    assert responder.handle(request(0x1007, 0xFFFFFFFF, 0, 0), b"").code == 0x2013


def test_while_only_raw_is_set_nothing_of_a_jpeg_can_be() -> None:
    table = PropertyTable(alpha_7r_v())
    table.set_from_client(Code.FILE_FORMAT, b"\x01")
    assert table.value(Code.JPEG_QUALITY) == 0
    for code in (Code.JPEG_QUALITY, Code.IMAGE_SIZE):
        with pytest.raises(NotWritableError):
            table.set_from_client(code, b"\x01")
    table.set_from_client(Code.FILE_FORMAT, b"\x03")
    table.set_from_client(Code.JPEG_QUALITY, b"\x01")
    assert table.exposure_settings().jpeg_level == 1


def test_the_memory_says_one_while_the_file_is_written(body: SonyBody, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[int] = []
    put = body.properties.put

    def listen(code: int, value: int) -> None:
        said.extend([value] if code == Code.OBJECTS_IN_MEMORY else [])
        put(code, value)

    monkeypatch.setattr(body.properties, "put", listen)
    body.shoot()
    until(lambda: len(said) == 2, "no file in its memory", every_s=0.01)
    assert said == [1, 0x8001]
    info = SonyResponder(body, FaultPlan()).handle(request(0x1008, 0xFFFFC001), b"").data
    assert info is not None
    assert struct.unpack_from("<I", info)[0] == 0x00010000
    assert struct.unpack_from("<II", info, 26) == (0, 0), "neither width nor height"


def test_exposure_through_the_operations(body: SonyBody) -> None:
    ready: list[int] = []
    body.on_object = lambda: ready.append(1)
    responder = SonyResponder(body, FaultPlan())
    assert responder.handle(request(0x1008, 0xFFFFC001), b"").code == 0x2009
    assert responder.handle(request(0x9207, 0xD2C1), b"\x02\x00").code == 0x2001
    assert responder.handle(request(0x9207, 0xD2C2), b"\x02\x00").code == 0x2001
    until(lambda: body.properties.value(Code.OBJECTS_IN_MEMORY) == 0x8001, "no image in its memory", every_s=0.01)
    info = responder.handle(request(0x1008, 0xFFFFC001), b"").data
    file = responder.handle(request(0x1009, 0xFFFFC001), b"").data
    assert info is not None
    assert file is not None
    assert struct.unpack_from("<I", info, 8)[0] == len(file)
    assert file[:2] + file[-2:] == b"\xff\xd8\xff\xd9"
    assert body.properties.value(Code.OBJECTS_IN_MEMORY) == 0
    assert responder.handle(request(0x1009, 0xFFFFC001), b"").code == 0x2009


@pytest.mark.parametrize(
    ("operation", "parameters", "data", "code"),
    [
        (0x9999, (), b"", 0x2005),
        (0x1005, (5,), b"", 0x2008),
        (0x9205, (0xD218,), b"\x05\x00\x00\x00", 0x200F),
        (0x9205, (0xABCD,), b"\x05\x00", 0x200F),
        (0x9205, (Code.ISO,), b"\x7b\x00\x00\x00", 0x201C),
        (0x9207, (0xD2FF,), b"\x02\x00", 0x201C),
    ],
)
def test_refusals(body: SonyBody, operation: int, parameters: tuple[int, ...], data: bytes, code: int) -> None:
    assert SonyResponder(body, FaultPlan()).handle(request(operation, *parameters), data).code == code


def test_brightness_follows_aperture_time_and_iso() -> None:
    table = PropertyTable(alpha_7r_v())
    source = StillLife(240)

    def brightness(f_number: int, denominator: int, iso: int) -> tuple[float, float]:
        table.set_from_client(Code.F_NUMBER, struct.pack("<H", f_number))
        table.set_from_client(Code.SHUTTER_SPEED, struct.pack("<I", 1 << 16 | denominator))
        table.set_from_client(Code.ISO, struct.pack("<I", iso))
        settings = table.exposure_settings()
        return exposure_gain(settings), float(source.develop(source.freeze(1), settings).mean())

    gain, reference = brightness(2200, 15, 100)
    assert gain == pytest.approx(1.0)
    assert brightness(2200, 30, 100)[1] < reference < brightness(1600, 15, 100)[1]
    assert brightness(2200, 15, 200)[0] == pytest.approx(2.0)


def test_missing_picture_file_is_refused_at_the_start(tmp_path: Path) -> None:
    with pytest.raises(SimulatorError, match="nowhere"):
        PictureFiles([tmp_path / "nowhere.jpg"], None)
