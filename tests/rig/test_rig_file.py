"""What a rig file may not contain: duplicate keys, invalid YAML, endless nesting."""

from __future__ import annotations

from pathlib import Path

import pytest

from service.core.errors import ConfigurationError
from service.rig import load_rig, parse_recorded_rig, parse_rig
from service.station import Station

RIG = "name: a\nsimulated: false\ndevices: {scanner: {driver: scan_folder, folder: scans}}\n"

STATION = """\
name: a
devices: {arm: {driver: ur, host: 127.0.0.9}}
stations:
  left: {robot: arm,
    scene_centre_m: [0, 0.8, 0],
    approach_azimuth_deg: -90}
"""


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (RIG + "simulated: true\n", r"duplicate key, first given on line 2 \[rig.yaml:4 simulated\]"),
        (
            RIG.replace("folder: scans", "folder: a, folder: b"),
            r"duplicate key, first given on line 3 \[rig.yaml:3 devices.scanner.folder\]",
        ),
        (
            STATION.replace("robot: arm", "robot: leg"),
            r"'leg' is not among the devices: arm .*:4 stations.left.robot\]",
        ),
        (STATION.replace("-90", "'-90'"), r"valid number \(it is \"-90\"\) \[rig.yaml:6 stations.left.approach"),
        (
            STATION.replace("    approach", "    aproach_azimuth_deg: 3, approach"),
            r"unknown field \(did you mean 'appr",
        ),
        (
            STATION.replace("-90}", "-90,\n    scene_up: [0, 0, -1]}"),
            r"upright.* \[rig.yaml:7 stations.left.scene_up\]",
        ),
        (
            RIG + "cameras: {side: {mounted: fixed, calibration: side.json}}\n",
            r"'side' is not among the devices: scanner \[rig.yaml:4 cameras.side\]",
        ),
        (
            RIG + "cameras: {scanner: {mounted: rigid, calibration: s.json, every: station}}\n",
            r"exposes at every viewpoint: leave `every` out",
        ),
        (RIG + "signing: {pin: yes}\n", r"valid boolean \(it is \"yes\"\) \[rig.yaml:4 signing.pin\]"),
        ('{"name": "a", "simulated": false, "simulated": true}', "'simulated' is given twice"),
        ('{"import": ' + "[" * 100_000, "nested more than 100 deep"),
        ('{"import": ' + "[" * 150 + "]" * 150 + "}", "nested more than 100 deep"),
        ("devices: " + "[" * 100_000, r"nested more than 50 deep \[.*rig.yaml:1\]"),
        ("name: a: b\n", r"not valid YAML.* \[.*rig.yaml:1\]"),
        ('{"name": ', "not valid JSON"),
        ("- a\n", "is not a mapping of fields"),
        ("name: \xe9\n", "not UTF-8"),
    ],
)
def test_it_is_refused_with_its_place(source: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        parse_rig(source.encode("latin-1"), Path("rig.yaml"))


def test_a_plain_one_is_read() -> None:
    assert not parse_rig(RIG.encode(), Path("rig.yaml")).section.simulated


def test_all_that_is_wrong_is_told_at_once_in_the_order_of_its_lines(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(
        "name: 7\n"
        "devices: {arm: {driver: ur, host: 127.0.0.9}}\n"
        "payload:\n"
        "  mass_kg: heavy\n"
        "  mass_kg: 2\n"
        "stations:\n"
        "  left: {robot: leg, scene_centre_m: [0, 0.8], approach_azimuth_deg: -90}\n"
    )
    with pytest.raises(ConfigurationError) as caught:
        load_rig(path)
    lines = str(caught.value).splitlines()
    assert lines[0] == "6 things are wrong in this rig file:"
    assert [" ".join(line.removeprefix(f"  {path}:").split()[:2]) for line in lines[1:7]] == [
        "1 name:",
        "3 payload.centre_of_gravity_m:",
        "4 payload.mass_kg:",
        "5 payload.mass_kg:",
        "7 stations.left.robot:",
        "7 stations.left.scene_centre_m[2]:",
    ]
    assert 'valid string (it is 7); put it in quotes: "…"' in lines[1]


def test_what_a_driver_finds_wrong_has_its_line_too(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text("name: a\ndevices:\n  scanner:\n    driver: scan_folder\n    foldre: scans\n")
    with pytest.raises(ConfigurationError) as caught:
        Station(load_rig(path)).scanner()
    shown = str(caught.value)
    assert "rig.yaml:5 devices.scanner.foldre: unknown field (did you mean 'folder'?)" in shown
    assert "rig.yaml:3 devices.scanner.folder: missing field" in shown


def test_a_recorded_rig_is_read_as_it_was_read_then() -> None:
    source = STATION.replace("-90", "'-90'").replace("robot: arm", "scene_up: [0, 0, -1], robot: arm").encode()
    assert parse_recorded_rig(source, Path("rig.yaml")).section.stations["left"].approach_azimuth_deg == -90
    with pytest.raises(ConfigurationError, match=r"missing field \[rig.yaml:1 devices\]"):
        parse_recorded_rig(b"name: a\n", Path("rig.yaml"))
