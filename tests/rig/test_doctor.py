"""`orthocapture doctor` shows what each device reports: problems, clocks, and matching marks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from drivers.interfaces import DeviceIdentity, DeviceReport
from service.cli.main import app


@dataclass
class _Devices:
    """A station whose devices answer with given reports."""

    reports: dict[str, DeviceReport]

    def names(self) -> list[str]:
        return list(self.reports)

    def report(self, name: str) -> DeviceReport:
        return self.reports[name]

    def close(self) -> None:
        pass


@pytest.mark.parametrize(
    ("report", "mark", "words"),
    [
        ({"problems": ("the card [A] is full: empty it",)}, "!", "the card [A] is full: empty it"),
        ({"clock_offset_s": -1279.0}, "!", "clock 1279.000 s behind this machine's, more than 5 s: set it"),
        ({"clock_offset_s": 0.5}, "✓", "clock 0.500 s ahead of this machine's"),
        ({"clock_offset_s": -1279.0, "clock": "uptime"}, "✓", "counts from when it was switched on, -1279.000 s"),
    ],
)
def test_doctor_tells_what_a_device_reports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, report: dict[str, Any], mark: str, words: str
) -> None:
    who = DeviceIdentity("camera", "model", "serial", "firmware", "driver", "1", "address")
    devices = _Devices({"camera": DeviceReport(who, **report)})
    monkeypatch.setattr("service.cli.doctor.Station", lambda _rig: devices)
    rig = tmp_path / "rig.yaml"
    rig.write_text("name: bare\ndevices:\n  camera: {driver: gphoto}\n")
    words_typed = ["doctor", "--rig", str(rig), "--data", str(tmp_path / "data")]
    result = CliRunner().invoke(app, words_typed, catch_exceptions=False)
    assert f"{mark} camera model" in result.output
    assert words in result.output


@pytest.mark.parametrize(
    ("who", "shown"),
    [
        (DeviceIdentity("scanner", "export folder", "", "", "scan_folder", "1", "/scans"), "✓ it export folder\n"),
        (DeviceIdentity("camera", "GE-1", "22334455", "", "genicam", "1", "host"), "✓ it GE-1, serial 22334455\n"),
        (DeviceIdentity("camera", "EOS", "42", "1.8", "gphoto", "1", "usb:"), "✓ it EOS, serial 42, 1.8\n"),
    ],
)
def test_doctor_names_a_device_by_what_it_states(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, who: DeviceIdentity, shown: str
) -> None:
    monkeypatch.setattr("service.cli.doctor.Station", lambda _rig: _Devices({"it": DeviceReport(who)}))
    rig = tmp_path / "rig.yaml"
    rig.write_text("name: bare\ndevices:\n  it: {driver: gphoto}\n")
    words = ["doctor", "--rig", str(rig), "--data", str(tmp_path / "data")]
    assert shown in CliRunner().invoke(app, words, catch_exceptions=False).output
