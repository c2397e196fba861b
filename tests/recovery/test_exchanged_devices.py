"""A device with another serial number that comes back in mid-run is recorded, said, and asked about before use."""

from __future__ import annotations

import pytest

from drivers.errors import DeviceUnavailableError
from service.core.recorded_devices import RecordedIdentity, exchanged
from service.core.records.run_events import DeviceOpened, DeviceTrouble, OperatorAction, StepFailed
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from tests.support.record.core import Log, toy_protocol
from tests.support.rig.bench_rig import BenchArm, BenchCamera, answer
from tests.support.runs.bench_run import VIEWS, Bench, KilledError


def unplug(bench: Bench, name: str, serial: str) -> None:
    """Let the link of a device drop once, after which another one answers."""
    device: BenchArm | BenchCamera = bench.rig.arm if name == "robot" else bench.rig.shutter

    def drop(number: int) -> None:
        if number == 2 and device.serial != serial:
            device.serial = serial
            if name == "robot":
                bench.rig.arm.connected = False
            else:
                raise DeviceUnavailableError("the link dropped", where="camera")

    if name == "robot":
        bench.rig.arm.on_move = drop
    else:
        bench.rig.shutter.on_capture = drop


@pytest.mark.parametrize(("name", "before", "serial"), [("camera", "C-1", "C-2"), ("robot", "A-1", "A-2")])
def test_another_device_that_comes_back_is_asked_about_before_the_next_view(
    bench: Bench, name: str, before: str, serial: str
) -> None:
    asked: list[list[str]] = []

    def look(question: AskOperator, _state: RunState) -> OperatorAction:
        asked.append(bench.captured())
        assert f"{name} is another {name}: it has the serial number {serial}, the one before had {before}" in (
            question.text
        )
        assert "What was calibrated with the other one does not hold for this one" in question.text
        return answer(question, "confirm")

    unplug(bench, name, serial)
    bench.script("capture", "recovery", look)
    state = bench.run()
    assert state.status == "completed"
    assert asked == [["v001"]]
    assert [f.error for f in bench.payloads(StepFailed)] == ["DeviceChangedError"]
    assert any(t.error == "DeviceChangedError" and t.device == name for t in bench.payloads(DeviceTrouble))
    assert any("is another" in line for line in bench.operator.told)
    assert bench.captured() == VIEWS
    bench.must_verify()


def test_the_one_from_before_is_used_again_without_a_further_question(bench: Bench) -> None:
    asked: list[str] = []

    def put_back(question: AskOperator, _state: RunState) -> OperatorAction:
        asked.append(question.text)
        bench.rig.shutter.serial = "C-1"
        return answer(question, "confirm")

    unplug(bench, "camera", "C-2")
    drop = bench.rig.shutter.on_capture
    bench.rig.shutter.on_capture = lambda number: None if asked else drop(number)
    bench.script("capture", "recovery", put_back)
    assert bench.run().status == "completed"
    assert len(asked) == 1
    assert bench.captured() == VIEWS


def test_another_camera_in_a_resumed_run_is_asked_about(bench: Bench) -> None:
    def die(number: int) -> None:
        if number == 2 and bench.rig.shutter.serial == "C-1":
            raise KilledError

    bench.rig.shutter.on_capture = die
    with pytest.raises(KilledError):
        bench.run()
    bench.rig.shutter = BenchCamera(serial="C-2")
    bench.rig.arm = BenchArm()
    asked: list[str] = []

    def look(question: AskOperator, _state: RunState) -> OperatorAction:
        asked.append(question.text)
        return answer(question, "confirm")

    bench.script("capture", "recovery", look)
    assert bench.run().status == "completed"
    assert len(asked) == 1
    assert "the one before had C-1" in asked[0]


OWN = RecordedIdentity(kind="camera", model="M", serial="1")


def opened(serial: str, model: str = "M", kind: str = "camera", device: str = "eye") -> DeviceOpened:
    return DeviceOpened(device=device, report={"identity": {"kind": kind, "model": model, "serial": serial}})


@pytest.mark.parametrize(
    ("recorded", "now", "other"),
    [
        ([], OWN, False),
        ([opened("1")], OWN, False),
        ([opened("2")], OWN, True),
        ([opened("2", device="another eye")], OWN, False),
        ([opened(""), opened("")], OWN, False),
        ([opened("", model="N")], OWN, True),
        ([opened("2"), opened("1")], OWN, True),
        ([opened("2"), opened("1"), OperatorAction(action="confirm", step="capture")], OWN, True),
        (
            [
                opened("2"),
                opened("1"),
                DeviceTrouble(device="eye", error="DeviceChangedError", message="m"),
                OperatorAction(action="confirm", step="capture"),
            ],
            OWN,
            False,
        ),
        (
            [
                opened("2", kind="lightbox"),
                opened("1", kind="lightbox"),
                DeviceTrouble(device="eye", error="DeviceChangedError", message="m"),
            ],
            RecordedIdentity(kind="lightbox", model="M", serial="1"),
            False,
        ),
    ],
)
def test_which_device_is_the_runs_own(
    recorded: list[DeviceOpened | DeviceTrouble | OperatorAction], now: RecordedIdentity, other: bool
) -> None:
    log = Log(toy_protocol())
    for payload in recorded:
        log.append(payload)
    assert (exchanged(log.events, "eye", now) is not None) == other


def test_another_light_box_is_told_and_recorded_and_nobody_is_asked(bench: Bench) -> None:
    box = bench.rig.box
    assert box is not None
    serials = ["L-1", "L-2"]

    def lose() -> None:
        if serials:
            box.serial = serials.pop(0)
            raise DeviceUnavailableError("the light box is not connected", where="lightbox")

    reads: list[int] = []

    def lose_often() -> None:
        reads.append(1)
        if len(reads) in (1, 4):
            lose()

    box.on_read = lose_often
    assert bench.run().status == "completed"
    words = "lightbox is another lightbox: it has the serial number L-2, the one before had L-1"
    assert bench.operator.told.count(words) == 1
    assert [t.message for t in bench.payloads(DeviceTrouble) if t.device == "lightbox"] == [words]
    assert not bench.payloads(StepFailed)
