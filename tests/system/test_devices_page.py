"""The page of devices has a row for each installed driver and profile, and for nothing else."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from drivers.scan_profiles import PROFILES

ROOT = Path(__file__).parents[2]
GROUPS: dict[str, dict[str, str]] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
# What a row stands for: drivers, and the profiles that some drivers read.
OF_DEVICES: dict[str, set[str]] = {
    **{name: set(group) for name, group in GROUPS.items() if name == "orthocapture.drivers" or "_profiles" in name},
    "scan profiles": set(PROFILES),
}
_ROW = re.compile(r"^\| `(\w+)` \|(.*)\|$", re.MULTILINE)


def rows() -> list[tuple[str, list[str]]]:
    page = (ROOT / "docs" / "devices.md").read_text(encoding="utf-8")
    return [(name, [cell.strip() for cell in rest.split("|")]) for name, rest in _ROW.findall(page)]


@pytest.mark.parametrize("group", sorted(OF_DEVICES))
def test_each_entry_point_has_one_row(group: str) -> None:
    named = [name for name, _ in rows()]
    assert {name: named.count(name) for name in OF_DEVICES[group]} == dict.fromkeys(OF_DEVICES[group], 1)


def test_no_row_names_what_is_not_installed() -> None:
    assert {name for name, _ in rows()} <= set().union(*OF_DEVICES.values())


def test_each_row_says_how_the_device_was_tried() -> None:
    """Its last two cells are whether it was replayed from a recording and tried on the device."""
    for name, cells in rows():
        assert all(cells), name
        assert [cell.split(":")[0] in ("yes", "no") for cell in cells[-2:]] == [True, True], name
