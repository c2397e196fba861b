"""The composition root: devices by name and by role, reported when opened, rebuilt after they were away."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml

from drivers.errors import DeviceError, DeviceUnavailableError
from drivers.host.device_lock import DeviceLock
from drivers.interfaces import DeviceReport
from service.core.errors import ConfigurationError
from service.rig import load_rig
from service.station import Station

ROOT = Path(__file__).parents[2]
RIG = """\
name: folders
devices:
  scanner: {driver: scan_folder, folder: scans}
  ct: {driver: dicom_folder, folder: ct}
  arm: {driver: ur, host: 127.0.0.9}
stations:
  station_1: {robot: arm, scene_centre_m: [0, 0.8, 0], approach_azimuth_deg: -90}
"""


@contextmanager
def station_of(folder: Path, text: str = RIG) -> Generator[tuple[Station, list[str]]]:
    (folder / "scans").mkdir()
    (folder / "rig.yaml").write_text(text)
    station, opened = Station(load_rig(folder / "rig.yaml")), list[str]()

    def note(name: str, report: DeviceReport) -> None:
        opened.append(f"{name}: {report.identity.kind}")

    station.watch(note, lambda _name: None)
    try:
        yield station, opened
    finally:
        station.close()


def test_a_device_is_opened_once_and_reported(tmp_path: Path) -> None:
    with station_of(tmp_path) as (station, opened):
        assert station.scanner() is station.scanner() is station.device("scanner")
        assert opened == ["scanner: scanner"]
        assert station.lightbox() is None


def test_a_device_that_stays_away_is_built_anew_when_it_is_back(tmp_path: Path) -> None:
    with station_of(tmp_path) as (station, opened):
        scanner = station.scanner()
        (tmp_path / "scans").rmdir()
        with pytest.raises(DeviceError, match="no such folder"):
            station.reopen(scanner)
        with pytest.raises(DeviceError, match="no such folder"):
            station.scanner()
        (tmp_path / "scans").mkdir()
        assert station.scanner().exports() == ()
        assert opened == ["scanner: scanner"] * 2


def test_an_arm_that_could_not_be_connected_is_told_and_other_devices_are_not(tmp_path: Path) -> None:
    with station_of(tmp_path) as (station, _):
        with pytest.raises(DeviceError):
            station.robot("station_1")
        (ended,) = station.ended_connections()
        assert (ended.device, ended.how) == ("arm", "refused")
        assert ended.message
        assert station.ended_connections() == ()
        (tmp_path / "scans").rmdir()
        with pytest.raises(DeviceError):
            station.scanner()
        assert station.ended_connections() == ()


def test_layouts_point_from_the_scene_to_the_base(tmp_path: Path) -> None:
    with station_of(tmp_path) as (station, _):
        layout = station.layout("station_1")
        assert layout.robot == "arm"
        assert layout.approach == pytest.approx((0.0, -1.0, 0.0), abs=1e-12)
        with pytest.raises(ConfigurationError, match="station_2"):
            station.layout("station_2")


def test_what_a_rig_lacks_is_named(tmp_path: Path) -> None:
    with station_of(tmp_path) as (station, _):
        with pytest.raises(ConfigurationError, match="exactly one camera, the rig has 0"):
            station.camera()
        with pytest.raises(ConfigurationError, match="T_flange_camera_nominal"):
            station.nominal_T_flange_camera()
        with pytest.raises(ConfigurationError, match="no device 'pump'"):
            station.device("pump")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("robot: arm", "robot: leg", "'leg' is not among the devices"),
        ("scene_centre_m: [0, 0.8, 0]", "scene_centre_m: [0, 0.8]", "scene_centre_m"),
        ("name: folders", "name: [", "not valid YAML"),
        ("name: folders", "nome: folders", "nome"),
    ],
)
def test_a_wrong_rig_file_says_where(tmp_path: Path, old: str, new: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words), station_of(tmp_path, RIG.replace(old, new)):
        pass


HOLDER = """
import os, signal
from drivers.host.device_lock import DeviceLock
os.umask(0o077)
lock = DeviceLock.take("ur 127.0.0.9", "arm")
print("held", flush=True)
signal.pause()
"""


ANOTHER_USER = """
import os
from drivers.host.device_lock import DeviceLock
from drivers.errors import DeviceUnavailableError
if os.getuid() == 0:
    os.setuid(65534)
try:
    DeviceLock.take("ur 127.0.0.9", "arm")
except DeviceUnavailableError as error:
    print(error)
"""


def test_a_user_of_the_machine_is_told_that_another_user_drives_the_arm() -> None:
    with subprocess.Popen([sys.executable, "-c", HOLDER], cwd=ROOT, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        other = [sys.executable, "-c", ANOTHER_USER]
        told = subprocess.run(other, cwd=ROOT, capture_output=True, text=True, timeout=60, check=True).stdout
        assert f"another process drives this device (ur 127.0.0.9): process {holder.pid}" in told
        holder.kill()


@pytest.mark.parametrize(
    ("device", "other"),
    [
        ("{driver: genicam, camera: 127.0.0.91, aperture_f: 8}", "genicam 127.0.0.92"),
        ("{driver: gphoto, port: 'usb:', model: ILCE-1}", "gphoto ILCE-7RM5"),
    ],
)
def test_two_cameras_of_one_driver_are_two_devices(tmp_path: Path, device: str, other: str) -> None:
    """A rig with two industrial cameras could not open the second."""
    rig = RIG.replace("devices:", f"devices:\n  eye: {device}")
    own = yaml.safe_load(device)
    for address, words in ((f"{own['driver']} {own.get('camera') or own['model']}", True), (other, False)):
        lock = DeviceLock.take(address, "elsewhere")
        folder = tmp_path / str(words)
        folder.mkdir()
        with station_of(folder, rig) as (station, _), pytest.raises(DeviceError) as refused:
            station.device("eye")
        assert ("another process" in str(refused.value)) == words
        lock.release()


def test_an_arm_is_driven_by_one_process_whatever_rig_file_names_it(tmp_path: Path) -> None:
    with (
        station_of(tmp_path) as (station, _),
        subprocess.Popen([sys.executable, "-c", HOLDER], cwd=ROOT, stdout=subprocess.PIPE, text=True) as holder,
    ):
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(DeviceUnavailableError, match=f"another process drives .*: process {holder.pid}"):
            station.robot("station_1")
        holder.kill()
        holder.wait()
        for _ in range(2):  # a device that could not be opened is closed
            with pytest.raises(DeviceError) as refused:
                station.robot("station_1")
            assert "another process" not in str(refused.value)


@pytest.mark.parametrize(
    ("device", "known"),
    [
        ("{driver: lightbox, port: /dev/../LINE-BY-ID}", "lightbox LINE"),
        ("{driver: lightbox, port: link/line}", "lightbox LINE"),
        ("{driver: ur, host: localhost}", "ur 127.0.0.1"),
    ],
)
def test_another_name_of_a_device_is_the_same_device(tmp_path: Path, device: str, known: str) -> None:
    line = tmp_path / "line"
    line.touch()
    (tmp_path / "by-id").symlink_to(line)
    (tmp_path / "link").symlink_to(tmp_path)
    text = RIG.replace("{driver: ur, host: 127.0.0.9}", device.replace("LINE-BY-ID", f"..{tmp_path}/by-id"))
    lock = DeviceLock.take(known.replace("LINE", str(line.resolve())), "elsewhere")
    try:
        with (
            station_of(tmp_path, text) as (station, _),
            pytest.raises(DeviceUnavailableError, match="another process drives this device"),
        ):
            station.device("arm")
    finally:
        lock.release()
