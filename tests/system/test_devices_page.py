"""The page of devices has a row for each installed driver and profile, and for nothing else."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
GROUPS: dict[str, dict[str, str]] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
# A plug-in of the kinds of devices: drivers, and the profiles that some drivers read.
OF_DEVICES = sorted(name for name in GROUPS if name == "orthocapture.drivers" or name.endswith("_profiles"))
_ROW = re.compile(r"^\| `(\w+)` \|(.*)\|$", re.MULTILINE)


def rows() -> list[tuple[str, list[str]]]:
    page = (ROOT / "docs" / "devices.md").read_text(encoding="utf-8")
    return [(name, [cell.strip() for cell in rest.split("|")]) for name, rest in _ROW.findall(page)]


@pytest.mark.parametrize("group", OF_DEVICES)
def test_each_entry_point_has_one_row(group: str) -> None:
    named = [name for name, _ in rows()]
    assert {name: named.count(name) for name in GROUPS[group]} == dict.fromkeys(GROUPS[group], 1)


def test_no_row_names_what_is_not_installed() -> None:
    assert {name for name, _ in rows()} <= {name for group in OF_DEVICES for name in GROUPS[group]}


def test_each_row_says_how_the_device_was_tried() -> None:
    """Its last two cells are whether it was replayed from a recording and tried on the device."""
    for name, cells in rows():
        assert all(cells), name
        assert [cell.split(":")[0] in ("yes", "no") for cell in cells[-2:]] == [True, True], name
