"""The light box over a pseudo-terminal and a socket: readings, noise, silence, unplugging."""

from __future__ import annotations

import json
import os
import signal
import socket
import threading
import tty
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

import pytest
import serial

from drivers.errors import DeviceFaultError, DeviceRefusedError, DeviceTimeoutError, DeviceUnavailableError
from drivers.interfaces import PedalReading, TowerLight
from drivers.lightbox import DRIVER, LightboxConfig, SerialLightbox, with_checksum
from tests.support.processes.waiting import until
from tests.support.rig.simulator_process import simulator


def box(port: str | Path, timeout_s: float = 2.0) -> SerialLightbox:
    return SerialLightbox(LightboxConfig(port=str(port), timeout_s=timeout_s))


@contextmanager
def opened(port: str | Path, timeout_s: float = 2.0) -> Generator[SerialLightbox]:
    driver = box(port, timeout_s)
    try:
        driver.open()
        yield driver
    finally:
        driver.close()


def line_of(reply: str) -> bytes:
    """A reply as a box of firmware 1.4 sends it."""
    return with_checksum(reply).encode() + b"\r\n"


def faults(**fields: object) -> tuple[str, str]:
    return "--faults", json.dumps([{"device": "lightbox", **fields}])


def test_the_signal_tower(tmp_path: Path) -> None:
    link = tmp_path / "lightbox"
    with simulator("lightbox", "--link", str(link)) as running, opened(link) as driver:
        assert all(driver.show_tower(light) for light in TowerLight)
        with serial.Serial(str(link), timeout=60) as other:
            other.write(b"TOWER?\nTOWER BLUE\n")
            assert other.read_until(b"\n") + other.read_until(b"\n") == line_of("TOWER RED") + line_of(
                "ERR 2 wrong argument"
            )
        assert running.process.poll() is None


def test_a_box_without_a_tower_is_no_error_and_is_asked_once(tmp_path: Path) -> None:
    link = tmp_path / "lightbox"
    with simulator("lightbox", "--link", str(link), "--firmware", "1.2"), opened(link) as driver:
        assert driver.open().firmware == "1.2"
        assert not driver.show_tower(TowerLight.STOPPED)
        assert driver.read().light_lux == 45_000.0
    asked: list[bytes] = []

    def old(line: bytes) -> bytes:
        asked.append(line)
        return b"*IDN a,b,c,1.0\n" if line.startswith(b"*IDN") else b"ERR 1 unknown request\n"

    with answering(old) as port, opened(port) as driver:
        assert not driver.show_tower(TowerLight.WORKING)
        assert not driver.show_tower(TowerLight.STOPPED)
        assert sum(line.startswith(b"TOWER") for line in asked) == 1


def test_another_box_that_answers_after_the_link_broke_is_not_read_before_it_is_opened(tmp_path: Path) -> None:
    """Its pedal could otherwise confirm, unseen."""
    serials = ["LB-1"]

    def reply(line: bytes) -> bytes:
        return f"*IDN a,b,{serials[-1]},1.0\n".encode() if line[:1] == b"*" else b"LIGHT 5.0\nTEMP 20\nSHUTTER 0\n"

    first, second = answering(reply), answering(reply)
    link = tmp_path / "lightbox"
    with first as one, second as other:
        link.symlink_to(one)
        with opened(link) as driver:
            assert driver.read().light_lux == 5.0
            driver.close()  # as after a broken link, which the next call opens again
            assert driver.read().light_lux == 5.0
            driver.close()
            link.unlink()
            link.symlink_to(other)
            serials.append("LB-2")
            for _ in range(2):
                with pytest.raises(DeviceUnavailableError, match="serial number LB-2, not LB-1"):
                    driver.read()
            assert driver.open().serial == "LB-2"
            assert driver.read().light_lux == 5.0


def test_a_box_that_does_not_know_a_light_has_a_tower_all_the_same() -> None:
    wrong = answering(lambda line: b"*IDN a,b,c,1.3\n" if line[:1] == b"*" else b"ERR 2 wrong argument\n")
    with wrong as port, opened(port) as driver:
        for _ in range(2):  # it is no box without a tower, which is asked once
            with pytest.raises(DeviceRefusedError, match="wrong argument"):
                driver.show_tower(TowerLight.STOPPED)


def test_a_tower_that_stays_dark_is_a_fault() -> None:
    dark = answering(lambda line: b"*IDN a,b,c,1.3\n" if line[:1] == b"*" else b"TOWER OFF\n")
    with dark as port, opened(port) as driver, pytest.raises(DeviceFaultError, match="it shows OFF"):
        driver.show_tower(TowerLight.STOPPED)


@contextmanager
def answering(reply: Callable[[bytes], bytes]) -> Generator[str]:
    """A pseudo-terminal on which every line that arrives is answered with `reply`."""
    master, slave = os.openpty()
    tty.setraw(slave)
    done = threading.Event()

    def serve() -> None:
        while not done.is_set():
            line = os.read(master, 256)
            if not done.is_set():
                os.write(master, reply(line))

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield os.ttyname(slave)
    finally:
        done.set()
        os.write(slave, b"\n")  # wakes the reader
        thread.join()
        os.close(slave)
        os.close(master)


def test_reads_switches_and_counts(tmp_path: Path) -> None:
    link = tmp_path / "lightbox"
    with simulator("lightbox", "--link", str(link)) as running, opened(link) as driver:
        identity = driver.open()
        assert (identity.kind, identity.serial, identity.firmware) == ("lightbox", "LB-0001", "1.4")
        reading = driver.read()
        assert (reading.light_lux, reading.temperature_c) == (45_000.0, 21.5)
        assert not reading.shutter_relay_closed
        assert (driver.pedal().presses, driver.pedal().pressed_s) == (0, 0.0)
        running.process.send_signal(signal.SIGUSR1)
        until(lambda: driver.pedal().presses > 0, "the pedal's press is not counted")
        first, later = driver.pedal(), driver.pedal()
        assert first.presses == later.presses == 1
        assert first.pressed_s == later.pressed_s
        assert first.pressed_s is not None
        assert first.now_s is not None
        assert later.now_s is not None
        assert 0.0 < first.pressed_s <= first.now_s <= later.now_s
        report = driver.report()
        assert report.details["light"] == "45000.0 lx"
        assert report.problems == ()
    assert not link.is_symlink()


@pytest.mark.parametrize("kind", ["drop", "truncate", "corrupt", "banner"])
def test_one_spoiled_reply_is_overcome(tmp_path: Path, kind: str) -> None:
    link = tmp_path / "lightbox"
    plan = faults(on="LIGHT?", nth=1, kind=kind)
    with simulator("lightbox", "--link", str(link), *plan), opened(link) as driver:
        assert driver.read().light_lux == 45_000.0
        assert driver.read().temperature_c == 21.5


def test_a_late_reply_is_not_taken_for_another(tmp_path: Path) -> None:
    link = tmp_path / "lightbox"
    plan = faults(on="LIGHT?", nth=1, kind="stall", value=1.5)
    with simulator("lightbox", "--link", str(link), *plan), opened(link, 1.0) as driver:
        reading = driver.read()
        assert (reading.light_lux, reading.temperature_c) == (45_000.0, 21.5)


def test_silence_is_a_timeout(tmp_path: Path) -> None:
    link = tmp_path / "lightbox"
    plan = faults(on="TEMP?", nth=1, times=3, kind="drop")
    with simulator("lightbox", "--link", str(link), *plan), opened(link, 1.0) as driver:
        with pytest.raises(DeviceTimeoutError, match="TEMP") as caught:
            driver.read()
        assert caught.value.remedy
        assert driver.read().temperature_c == 21.5


def test_a_sensor_fault_is_a_refusal_and_a_problem_in_the_report(tmp_path: Path) -> None:
    link = tmp_path / "lightbox"
    plan = faults(on="LIGHT?", nth=1, times=2, kind="reject")
    with simulator("lightbox", "--link", str(link), *plan), opened(link) as driver:
        with pytest.raises(DeviceRefusedError, match="sensor fault"):
            driver.read()
        assert "sensor fault" in driver.report().problems[0]


def test_unplugged_and_plugged_in_again(tmp_path: Path) -> None:
    link = tmp_path / "lightbox"
    plan = faults(on="LIGHT?", nth=1, kind="unplug", value=0.3)
    with simulator("lightbox", "--link", str(link), *plan), opened(link) as driver:
        with pytest.raises(DeviceUnavailableError) as caught:
            driver.read()
        assert str(link) in caught.value.where
        until(link.exists, "it is not plugged in again")
        assert driver.read().light_lux == 45_000.0


def test_a_box_goes_on_after_a_client_that_asked_and_never_read(tmp_path: Path) -> None:
    """Its answers filled the line, and the box blocked for ever (found by bench/torture/fuzz)."""
    with simulator("lightbox", "--link", str(tmp_path / "box")):
        with serial.Serial(str(tmp_path / "box"), timeout=0.5, write_timeout=60) as rude:
            for _ in range(400):
                rude.write(b"*IDN?\n" * 10)
            until(lambda: answers_to(rude) == line_of("TOWER OFF"), "it does not go on", every_s=0)
        with opened(tmp_path / "box", timeout_s=20) as driver:
            assert driver.read().light_lux == 45_000.0


def answers_to(line: serial.Serial) -> bytes:
    """All that comes after a question; a box that is behind still answers to others before it."""
    line.reset_input_buffer()
    line.write(b"\nTOWER?\n")
    return line.read(100_000)


def test_no_such_port() -> None:
    for port in ("/dev/does-not-exist", "socket://127.0.0.1:1", "nonsense://x"):
        driver = DRIVER.build(DRIVER.config.model_validate({"port": port}))
        with pytest.raises(DeviceUnavailableError) as caught:
            driver.open()
        assert caught.value.where == port
        driver.close()


def test_another_device_on_the_port() -> None:
    with answering(lambda _: b"*IDN Acme,Power supply\n") as port:
        driver = box(port)
        with pytest.raises(DeviceFaultError, match="not a light box"):
            driver.open()
        driver.close()
    with answering(lambda _: b"\xff\xfe\x00garbage") as port:
        driver = box(port, 0.1)
        with pytest.raises(DeviceTimeoutError, match="no usable reply"):
            driver.open()
        driver.close()


def test_values_that_are_not_numbers_are_skipped() -> None:
    replies = iter([b"LIGHT nan\n", b"LIGHT 4x\nLIGHT 12.5\n", b"TEMP 20\n", b"SHUTTER 1.5\n", b"SHUTTER 1\n"])
    with answering(lambda _: next(replies)) as port:
        driver = box(port, 1.0)
        reading = driver.read()
        assert (reading.light_lux, reading.shutter_relay_closed) == (12.5, True)
        driver.close()


def test_the_checksum_is_crc_16_xmodem() -> None:
    assert with_checksum("123456789") == "123456789*31<3"  # 0x31C3, the check value of the catalogue of CRCs


def test_what_noise_made_of_a_line_is_never_believed() -> None:
    """A light of 85000 lx, a press that nobody made: one bit each."""
    good = {b"LIGHT?": "LIGHT 45000.0", b"TEMP?": "TEMP 21.50", b"SHUTTER?": "SHUTTER 0", b"PEDAL?": "PEDAL 6 2 9"}
    asked: list[bytes] = []

    def disturbed(line: bytes) -> bytes:
        asked.append(line)
        if line.startswith(b"*IDN"):
            return line_of("*IDN a,b,c,1.4")
        reply = line_of(good[line.strip().partition(b"*")[0]])
        flipped = {b"L": (6, 0x0C), b"P": (6, 0x01)}.get(reply[:1])
        if flipped is None or len(asked) % 2:
            return reply
        place, bits = flipped
        return reply[:place] + bytes([reply[place] ^ bits]) + reply[place + 1 :]

    with answering(disturbed) as port, opened(port) as driver:
        assert driver.read().light_lux == 45_000.0
        assert all(driver.pedal() == PedalReading(6, 0.002, 0.009) for _ in range(3))
    assert all(b"*" in line for line in asked[1:])  # its own requests have one too


def test_a_request_that_was_disturbed_is_sent_again_at_once(tmp_path: Path) -> None:
    answers = iter([line_of("*IDN a,b,c,1.4"), line_of("ERR 4 wrong checksum"), line_of("TOWER RED")])
    with answering(lambda _: next(answers)) as port, opened(port, timeout_s=60.0) as driver:
        assert driver.show_tower(TowerLight.STOPPED)
    link = tmp_path / "lightbox"
    with simulator("lightbox", "--link", str(link)), serial.Serial(str(link), timeout=60) as other:
        other.write(b"TOWER RED*0000\n")
        lines = iter(lambda: other.read_until(b"\n"), b"")
        said = next(line for line in lines if not line.startswith(b"#"))  # the banner may come before, or get lost
    assert said == line_of("ERR 4 wrong checksum")


def test_a_box_that_should_send_checksums_and_does_not_is_not_opened() -> None:
    with answering(lambda _: b"*IDN a,b,c,1.4\n") as port:
        driver = box(port)
        with pytest.raises(DeviceFaultError, match="without the checksum"):
            driver.open()
        driver.close()


def test_a_count_on_which_no_two_readings_agree_is_a_fault() -> None:
    counts = iter(range(100))
    with answering(lambda line: b"*IDN a,b,c,1.3\n" if line[:1] == b"*" else b"PEDAL %d\n" % next(counts)) as port:
        driver = box(port)
        driver.open()
        with pytest.raises(DeviceFaultError, match="differs in each of 6 readings"):
            driver.pedal()
        driver.close()


def test_over_a_socket() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            link, _ = server.accept()
            with link, link.makefile("rb") as lines:
                link.sendall(b"# banner\r\n")
                for line in lines:
                    link.sendall(b"*IDN a,b,c,d\r\n" if line.startswith(b"*IDN?") else b"PEDAL 7\r\n")

        thread = threading.Thread(target=serve)
        thread.start()
        with opened(f"socket://127.0.0.1:{server.getsockname()[1]}") as driver:
            assert driver.pedal() == PedalReading(7)
        thread.join()


def test_the_box_asks_the_world(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        answer = {"light_lux": 1234.5, "temperature_c": 19.25, "pedal_presses": 3, "T_world_camera": []}
        done = threading.Event()

        def serve() -> None:
            server.settimeout(0.2)
            while not done.is_set():
                try:
                    link, _ = server.accept()
                except TimeoutError:
                    continue
                with link, link.makefile("rb") as lines:
                    assert json.loads(lines.readline()) == {"op": "view"}
                    link.sendall(json.dumps(answer).encode() + b"\n")

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            world = f"127.0.0.1:{server.getsockname()[1]}"
            with simulator("lightbox", "--world", world) as running, opened(running.ready["port"]) as driver:
                reading = driver.read()
                assert (reading.light_lux, reading.temperature_c) == (1234.5, 19.25)
                assert driver.pedal().presses == 3
        finally:
            done.set()
            thread.join()
