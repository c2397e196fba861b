"""The GRBL axes are a plug-in: no module outside their own folders, and the entry points, knows of them."""

from __future__ import annotations

import tomllib

from tests.support.rig.rig import REPOSITORY

OWN = ("drivers/grbl/", "simulators/grbl/")


def test_no_module_of_the_program_names_them() -> None:
    sources = [
        path for folder in ("service", "drivers", "simulators") for path in (REPOSITORY / folder).rglob("*")
        if path.suffix in (".py", ".j2", ".js", ".yaml", ".css")
    ]  # fmt: skip
    assert len(sources) > 500
    naming = {
        name for path in sources
        if not (name := path.relative_to(REPOSITORY).as_posix()).startswith(OWN)
        and "grbl" in path.read_text(encoding="utf-8").lower()
    }  # fmt: skip
    assert naming == set()


def test_their_entry_points_are_all_that_installs_them() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))
    groups = project["project"]["entry-points"]
    named = {(group, value) for group, points in groups.items() for name, value in points.items() if "grbl" in name}
    assert named == {
        ("orthocapture.drivers", "drivers.grbl:DRIVER"),
        ("orthocapture.simulators", "simulators.grbl"),
    }
