"""What a rig file may not hold: keys given twice, text that is no YAML, nesting without end."""

from __future__ import annotations

from pathlib import Path

import pytest

from service.core.errors import ConfigurationError
from service.rig import parse_rig

RIG = "name: a\nsimulated: false\ndevices: {scanner: {driver: scan_folder, folder: scans}}\n"


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (RIG + "simulated: true\n", r"simulated: duplicate key, first given on line 2 \[.*rig.yaml:4\]"),
        (RIG.replace("folder: scans", "folder: a, folder: b"), r"devices.scanner.folder: duplicate key"),
        ('{"name": "a", "simulated": false, "simulated": true}', "'simulated' is given twice"),
        ('{"import": ' + "[" * 100_000, "nested more than 100 deep"),
        ("devices: " + "[" * 100_000, r"nested more than 50 deep \[.*rig.yaml:1\]"),
        ("name: a: b\n", r"not valid YAML.* \[.*rig.yaml:1\]"),
        ('{"name": ', "not valid JSON"),
        ("- a\n", "holds no mapping"),
        ("name: \xe9\n", "not UTF-8"),
    ],
)
def test_it_is_refused_with_its_place(source: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        parse_rig(source.encode("latin-1"), Path("rig.yaml"))


def test_a_plain_one_is_read() -> None:
    assert not parse_rig(RIG.encode(), Path("rig.yaml")).section.simulated
