"""A light box, a GRBL machine and a KUKA arm that `orthocapture doctor --record` heard are served by `--replay`."""

from __future__ import annotations

import json
import threading
from dataclasses import replace
from pathlib import Path
from socketserver import StreamRequestHandler, ThreadingTCPServer

import pytest
import serial

from drivers.errors import DeviceRefusedError, DeviceTimeoutError
from drivers.host.hosted_device import hosted
from drivers.interfaces import RobotArm, answers_of
from drivers.kuka import KukaConfig
from drivers.lightbox import LightboxConfig, SerialLightbox
from drivers.recording import RecordedDevice, Recording, readable
from tests.support.arms.grbl_simulator import LIFT, TURN, grbl_config, opened, table
from tests.support.arms.kuka_simulator import pendant, simulated_kuka
from tests.support.arms.ur_simulator import address
from tests.support.rig.doctor_recording import recorded
from tests.support.rig.patience import PATIENT_KUKA
from tests.support.rig.simulator_process import simulator


def by_question(device: RecordedDevice) -> dict[str, str]:
    return {exchange.question: exchange.answer for exchange in device.answers.exchanges}


def changed(file: Path, device: RecordedDevice, answers: dict[str, str]) -> None:
    """Write a recording in which other answers stand to some questions, or none for an empty one."""
    said = device.answers
    exchanges = tuple(
        exchange.model_copy(update={"answer": answers.get(exchange.question, exchange.answer)})
        for exchange in said.exchanges
        if answers.get(exchange.question, exchange.answer)
    )
    other = device.model_copy(update={"answers": said.model_copy(update={"exchanges": exchanges})})
    file.write_text(readable(Recording(by="a test", devices={device.kind: other})), encoding="utf-8")


# --- the light box ---


def box_section(port: Path) -> dict[str, object]:
    return {"driver": "lightbox", "port": str(port), "timeout_s": 10.0}


@pytest.mark.parametrize("firmware", ["1.2", "1.4"])
def test_a_light_box_is_the_same_on_the_replay_of_its_recording(tmp_path: Path, firmware: str) -> None:
    port = tmp_path / "box"
    with simulator("lightbox", "--link", str(port), "--firmware", firmware):
        with serial.Serial(str(port), timeout=10.0) as line:
            line.write(b"SHUTTER 1\n")
            assert line.readline()
        first = recorded(tmp_path / "first.json", "box", box_section(port))
    with simulator("lightbox", "--link", str(port), "--replay", str(tmp_path / "first.json")) as running:
        again = recorded(tmp_path / "again.json", "box", box_section(port))
    assert running.ready["not_served"] == ["*IDN?, serial number: (serial number 1)"]
    assert again.report == first.report
    assert again.report is not None
    assert again.report.identity.firmware == firmware
    assert again.report.details["shutter"] == "1"
    said, heard = (by_question(device) for device in (first, again))
    if firmware == "1.4":  # the pedal's clock goes on from where it was
        assert heard["PEDAL?"].rpartition(" ")[0] == said["PEDAL?"].rpartition(" ")[0]
        assert int(heard["PEDAL?"].rpartition(" ")[2]) >= int(said["PEDAL?"].rpartition(" ")[2])
        del said["PEDAL?"], heard["PEDAL?"]
    assert heard == said


def test_another_makers_light_box_says_what_was_recorded_of_it(tmp_path: Path) -> None:
    """A reading that it refused is refused again, and one that it never gave is not given."""
    port, file = tmp_path / "box", tmp_path / "other.json"
    refusal = "LIGHT?: the light box refuses LIGHT?: 3 sensor fault"
    device = RecordedDevice.model_validate(
        {
            "kind": "lightbox",
            "driver": "lightbox",
            "answers": {
                "exchanges": [
                    {"question": "*IDN?", "answer": "Lux & Co,LX-9,77,2.0"},
                    {"question": "SHUTTER?", "answer": "0"},
                    {"question": "PEDAL?", "answer": "41 60000 90000"},
                    {"question": "HUMIDITY?", "answer": "40.0"},
                ],
                "silent": [refusal, "TEMP?: no usable reply to TEMP? in 3 × 1 s"],
            },
        }
    )
    changed(file, device, {})
    with simulator("lightbox", "--link", str(port), "--replay", str(file)) as running:
        box = SerialLightbox(LightboxConfig(port=str(port), timeout_s=0.2))
        identity = box.open()
        pedal = box.pedal()
        with pytest.raises(DeviceRefusedError, match="3 sensor fault"):
            box.read()
        with pytest.raises(DeviceTimeoutError, match="no usable reply to TEMP"):
            box.report()
        box.close()
    assert running.ready["not_served"] == ["HUMIDITY?: 40.0"]
    assert (identity.model, identity.serial, identity.firmware) == ("Lux & Co LX-9", "77", "2.0")
    assert (pedal.presses, pedal.pressed_s) == (41, 60.0)


@pytest.mark.parametrize(
    ("answers", "why"),
    [
        ({"*IDN?": ""}, "stated no identity"),
        ({"*IDN?": "a,b,c"}, "stated no identity"),
        ({"PEDAL?": "1 2"}, "neither one number nor three"),
    ],
)
def test_a_light_box_of_which_too_little_is_known_is_not_served(
    tmp_path: Path, answers: dict[str, str], why: str
) -> None:
    device = RecordedDevice.model_validate(
        {
            "kind": "lightbox",
            "driver": "lightbox",
            "answers": {
                "exchanges": [
                    {"question": "*IDN?", "answer": "Lux & Co,LX-9,77,2.0"},
                    {"question": "PEDAL?", "answer": "0"},
                ]
            },
        }
    )
    changed(tmp_path / "other.json", device, answers)
    command = ("lightbox", "--replay", str(tmp_path / "other.json"))
    with pytest.raises(AssertionError, match="no ready line") as refused, simulator(*command):
        pass
    assert why in str(refused.value)


# --- GRBL ---


def table_section(port: Path) -> dict[str, object]:
    return {"driver": "grbl", **grbl_config(port, TURN, LIFT).model_dump(mode="json", exclude_defaults=True)}


def test_a_grbl_machine_is_the_same_on_the_replay_of_its_recording(tmp_path: Path) -> None:
    """Also a setting of many digits, one of a fourth axis, and one that the simulator does not know."""
    settings = ("100=1234.568", "121=150.25", "130=360", "20=0", "1=25", "103=10", "140=7")
    with table(tmp_path, "--setting", "25=36000", "24=1200", *settings) as port:
        first = recorded(tmp_path / "first.json", "table", table_section(port))
    port = tmp_path / "again"
    with simulator("grbl", "--link", str(port), "--replay", str(tmp_path / "first.json")) as running:
        again = recorded(tmp_path / "again.json", "table", table_section(port))
    files = [json.loads((tmp_path / name).read_text()) for name in ("first.json", "again.json")]
    assert files[0]["devices"] == files[1]["devices"]
    assert again == first
    assert first.report is not None
    assert any("Soft limits are off" in problem for problem in first.report.problems)
    answers = [exchange.answer for exchange in first.answers.exchanges]
    assert {"$100=1234.568", "$103=10", "Alarm"} <= set(answers)
    assert running.ready["not_served"] == [
        "$I: [VER:1.1h.20190825:(serial number 1)]",
        "$$: $103: listed, but the simulated machine has 3 axes",
    ]


def test_a_grbl_machine_whose_settings_do_not_suit_is_refused_on_its_replay_as_well(tmp_path: Path) -> None:
    with table(tmp_path, "--setting", "22=0", "110=720.5") as port:
        first = recorded(tmp_path / "first.json", "table", table_section(port))
    assert "homing is off" in first.error
    assert "$110=720.5" in [exchange.answer for exchange in first.answers.exchanges]
    port = tmp_path / "again"
    with simulator("grbl", "--link", str(port), "--replay", str(tmp_path / "first.json")):
        assert recorded(tmp_path / "again.json", "table", table_section(port)) == first


def test_a_grbl_machine_with_few_settings_says_what_was_assumed(tmp_path: Path) -> None:
    """Its own version, name and state are served."""
    settings = ("$10=1", "$13=0", "$20=1", "$21=1", "$22=1", "$25=36000", "$27=1", "$110=3600", "$120=60", "$130=720")
    said = [{"question": "$$", "answer": line} for line in (*settings, "$N0=G54")]
    said += [
        {"question": "$I", "answer": "[VER:1.1f.20170801:mill]"},
        {"question": "$I", "answer": "[OPT:VL,35,254]"},
        {"question": "?", "answer": "Idle"},
    ]
    device = RecordedDevice.model_validate({"kind": "robot", "driver": "grbl", "answers": {"exchanges": said}})
    file, port = tmp_path / "mill.json", tmp_path / "mill"
    file.write_text(readable(Recording(by="a test", devices={"robot": device})), encoding="utf-8")
    with simulator("grbl", "--link", str(port), "--replay", str(file)) as running, opened(port, TURN) as axes:
        report = axes.report()
        assert answers_of(axes).exchanges[:10] == device.answers.exchanges[:10]
    assert (report.identity.firmware, report.identity.serial) == ("1.1f.20170801", "mill")
    assert report.details["state"] == "Idle"
    assumed = running.ready["not_served"]
    assert assumed[0] == "$$: $N0=G54"
    assert assumed[1] == "$$: $100 was not recorded; the machine moves as with 80"
    assert len(assumed) == 1 + 12 - 3


def test_a_grbl_machine_of_which_nothing_is_known_is_not_served(tmp_path: Path) -> None:
    device = RecordedDevice.model_validate({"kind": "robot", "driver": "grbl", "error": "no answer"})
    file = tmp_path / "mute.json"
    file.write_text(readable(Recording(by="a test", devices={"robot": device})), encoding="utf-8")
    with (
        pytest.raises(AssertionError, match="stated no settings or no version"),
        simulator("grbl", "--replay", str(file)),
    ):
        pass


# --- KUKA ---


def arm_section(host: str) -> dict[str, object]:
    return {"driver": "kuka_sunrise", "host": host, **PATIENT_KUKA}


def timeless(device: RecordedDevice) -> RecordedDevice:
    """The arm without its clock."""
    assert device.report is not None
    (sample,) = device.answers.samples
    fields = {name: values for name, values in sample.fields.items() if name != "time_s"}
    answers = device.answers.model_copy(update={"samples": (sample.model_copy(update={"fields": fields}),)})
    report = replace(device.report, clock_offset_s=None)
    return device.model_copy(update={"answers": answers, "report": report})


@pytest.mark.parametrize(
    ("options", "orders"),
    [
        (("--mode", "T1", "--initial-joints=0.1,0.4,-0.2,-1.1,0.3,1.2,-0.5"), ("override 40",)),
        (("--model", "LBR iiwa 14"), ("stop external_stop",)),
        ((), ("stop enabling_switch",)),
        ((), ("stop protective_stop",)),
    ],
)
def test_a_kuka_is_the_same_on_the_replay_of_its_recording(
    tmp_path: Path, options: tuple[str, ...], orders: tuple[str, ...]
) -> None:
    """The wire's own word is recorded: `external_stop` and `enabling_switch` are one state to a client."""
    with simulated_kuka(address(65), *options) as ready:
        for order in orders:
            pendant(ready["host"], order)
        first = recorded(tmp_path / "first.json", "arm", arm_section(ready["host"]))
    with simulated_kuka(address(66), "--replay", str(tmp_path / "first.json")) as ready:
        again = recorded(tmp_path / "again.json", "arm", arm_section(ready["host"]))
    assert timeless(again) == timeless(first)
    assert again.answers.samples[0].fields["time_s"] > first.answers.samples[0].fields["time_s"]
    assert ready["not_served"] == ["greeting, serial number: (serial number 1)"]
    safety = orders[0].removeprefix("stop ") if orders[0].startswith("stop ") else "normal"
    assert f"safety {safety}," in by_question(again)["state"]


def test_a_kuka_of_a_model_that_is_not_known_is_recorded_with_its_greeting(tmp_path: Path) -> None:
    hello = {
        "is": "hello",
        "protocol": 1,
        "model": "LBR iiwa 7 R800",
        "serial": "4711",
        "software": "Sunrise.OS 1.16",
    }

    class Application(StreamRequestHandler):
        def handle(self) -> None:
            self.wfile.write(json.dumps(hello).encode() + b"\n")
            self.rfile.read()  # until the client goes

    with ThreadingTCPServer((address(65), 0), Application) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        host, port = server.server_address[:2]
        section = {**arm_section(str(host)), "port": port, "answer_timeout_s": 1.0}
        said = recorded(tmp_path / "iiwa7.json", "arm", section)
        server.shutdown()
    greeting = json.loads(by_question(said)["greeting"])
    assert (greeting["model"], greeting["software"]) == ("LBR iiwa 7 R800", "Sunrise.OS 1.16")
    assert "4711" not in (tmp_path / "iiwa7.json").read_text(encoding="utf-8")
    assert "the arm is a 'LBR iiwa 7 R800'" in said.error
    assert said.answers.silent == ("the stream: the model of the arm is not known",)


def test_an_older_recording_has_one_word_for_two_safety_states(tmp_path: Path) -> None:
    greeting = json.dumps({"model": "LBR Med 14", "serial": "77", "software": "Sunrise.OS Med 2.6"})
    answers = {"greeting": greeting, "state": "mode AUT, safety safeguard_stop, ready True, locked True"}
    exchanges = [{"question": question, "answer": answer} for question, answer in answers.items()]
    device = RecordedDevice.model_validate(
        {"kind": "robot", "driver": "kuka_sunrise", "answers": {"exchanges": exchanges}}
    )
    changed(tmp_path / "older.json", device, {})
    with simulated_kuka(address(66), "--replay", str(tmp_path / "older.json")) as ready:
        assert ready["not_served"] == [
            "state, safety safeguard_stop: the wire's own word was not recorded; served as external_stop"
        ]


def test_another_kuka_says_what_was_recorded_of_it(tmp_path: Path) -> None:
    """Its serial number, its software, and that it is not ready, which no option of the simulator says."""
    greeting = json.dumps({"model": "LBR Med 14", "serial": "77", "software": "Sunrise.OS Med 2.6"})
    device = RecordedDevice.model_validate(
        {
            "kind": "robot",
            "driver": "kuka_sunrise",
            "answers": {
                "exchanges": [
                    {"question": "greeting", "answer": greeting},
                    {"question": "state", "answer": "mode T2, safety normal, ready False, locked True"},
                ]
            },
        }
    )
    changed(tmp_path / "other.json", device, {})
    with simulated_kuka(address(66), "--replay", str(tmp_path / "other.json")) as ready:
        config = KukaConfig.model_validate({"host": ready["host"], **PATIENT_KUKA})
        arm = hosted(RobotArm, "drivers.kuka:DRIVER", config, call_timeout_s=60, name="robot")
        try:
            identity = arm.open()
            report = arm.report()
        finally:
            arm.close()
    assert (identity.serial, identity.firmware) == ("77", "Sunrise.OS Med 2.6")
    assert report.details["operating mode"] == "T2"
    assert any("ready" in problem for problem in report.problems)
    changed(tmp_path / "mute.json", device, {"greeting": ""})
    changed(tmp_path / "unknown.json", device, {"greeting": greeting.replace("Med 14", "Max 99")})
    for file, why in (("mute", "gave no greeting"), ("unknown", "is a 'LBR Max 99'; there is LBR Med 14")):
        command = ("kuka", "--replay", str(tmp_path / f"{file}.json"))
        with pytest.raises(AssertionError, match="no ready line") as refused, simulator(*command):
            pass
        assert why in str(refused.value)
