"""The worked example of docs/howto/new_driver.md: installed as a package of its own, a device like any other."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Mapping
from pathlib import Path

import pytest
import trimesh

from tests.support.rig.rig import REPOSITORY, command

pytestmark = [pytest.mark.timeout(300)]
_RIG = "name: OR 3\ndevices:\n  scanner: {driver: zipped_scans, folder: arriving, path: unpacked, unit: mm}\n"
NOTHING: Mapping[str, str] = {}
_READ = """
import json, sys
from pathlib import Path
from service.rig import load_rig
from service.station import Station
station = Station(load_rig(Path("rig.yaml")))
scanner = station.scanner()
read = [scanner.read(export) for export in scanner.exports()]
station.close()
print(json.dumps([[one.source.name, float(one.mesh.vertices_m.max())] for one in read]))
"""


@pytest.mark.slow
def test_the_example_is_installed_opened_and_read(tmp_path: Path) -> None:
    source, site = tmp_path / "source", tmp_path / "site"
    shutil.copytree(REPOSITORY / "docs" / "howto" / "new_driver", source)
    _do(sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "install", "--no-deps", "--no-index",
        "--no-build-isolation", "--target", str(site), str(source))  # fmt: skip
    (tmp_path / "arriving").mkdir()
    (tmp_path / "rig.yaml").write_text(_RIG)
    trimesh.creation.icosphere(radius=150.0).export(tmp_path / "torso.ply")
    with zipfile.ZipFile(tmp_path / "arriving" / "torso.zip", "w") as archive:
        archive.write(tmp_path / "torso.ply", "torso.ply")
    (tmp_path / "arriving" / "half.zip").write_bytes((tmp_path / "arriving" / "torso.zip").read_bytes()[:2000])
    paths = {"PYTHONPATH": os.pathsep.join((str(site), str(REPOSITORY)))}

    told = json.loads(_do(*command("doctor", "--rig", "rig.yaml", "--json"), status=1, cwd=tmp_path, variables=paths))
    assert told["devices"]["scanner"]["details"] == {"archives": "2"}
    assert "half.zip" in json.dumps(told["devices"]["scanner"]["problems"])
    ((name, reach_m),) = json.loads(_do(sys.executable, "-c", _READ, cwd=tmp_path, variables=paths))
    assert (name, round(reach_m, 3)) == ("torso.ply", 0.15)


def _do(*words: str, status: int = 0, cwd: Path | None = None, variables: Mapping[str, str] = NOTHING) -> str:
    done = subprocess.run(
        words, cwd=cwd, env=os.environ | variables, capture_output=True, text=True, timeout=100, check=False
    )
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout
