"""`pip install` brings everything: all commands run from a wheel in an empty folder."""

from __future__ import annotations

import json
import subprocess
import tarfile
import zipfile
from pathlib import Path
from urllib.request import urlopen

import pytest

from service.core.records.events import ServiceStarted
from service.store.records import SITE
from service.store.store import Store
from tests.support.processes.package import PACKAGES, Package, installed_package
from tests.support.rig.rig import REPOSITORY

pytestmark = [pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Package:
    return installed_package(tmp_path_factory)


@pytest.mark.slow
def test_wheel_and_sdist_hold_every_file_of_the_packages(package: Package) -> None:
    files = {path.relative_to(REPOSITORY).as_posix() for name in PACKAGES for path in (REPOSITORY / name).rglob("*")
             if path.is_file() and path.suffix != ".pyc"}  # fmt: skip
    with zipfile.ZipFile(package.wheel) as wheel:
        held = {name for name in wheel.namelist() if name.split("/")[0] in PACKAGES}
    assert held == files
    with tarfile.open(package.sdist) as sdist:
        assert files <= {member.name.partition("/")[2] for member in sdist}


def test_nothing_is_looked_for_beside_a_source_file() -> None:
    """Packaged files are read with importlib.resources."""
    for name in PACKAGES:
        for path in (REPOSITORY / name).rglob("*.py"):
            assert "Path(__file__)" not in path.read_text(encoding="utf-8"), path


@pytest.mark.slow
def test_the_code_of_the_wheel_is_what_runs(package: Package, tmp_path: Path) -> None:
    told = subprocess.run(
        [package.bin / "python", "-c", "import service, protocols; print(service.__file__, protocols.__file__)"],
        cwd=tmp_path, env=package.environment(), capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    assert all(Path(file).is_relative_to(package.bin.parent) for file in told.stdout.split())
    assert package.run("--version", cwd=tmp_path).stdout == "orthocapture 0.1.0\n"


@pytest.mark.slow
def test_the_shell_completes_commands_and_options(package: Package, tmp_path: Path) -> None:
    for typed, offered in (("orthocapture dem", ["demo"]), ("orthocapture store gc --rem", ["--remove"])):
        answer = package.run(
            cwd=tmp_path, _ORTHOCAPTURE_COMPLETE="complete_bash", COMP_WORDS=typed, COMP_CWORD=str(typed.count(" "))
        )
        assert answer.stdout.split() == offered, typed


@pytest.mark.slow
def test_its_pages_are_served_with_their_styles_and_protocols(package: Package, tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    rig = "name: a small site\ndevices:\n  scanner: {driver: scan_folder, folder: scans}\n"
    (tmp_path / "rig.yaml").write_text(rig)
    words = [package.bin / "orthocapture", "serve", "--rig", "rig.yaml", "--data", "runs", "--port", "0", "--json"]
    with subprocess.Popen(
        words, cwd=tmp_path, env=package.environment(), stdout=subprocess.PIPE, text=True
    ) as server:
        try:
            assert server.stdout is not None
            url = json.loads(server.stdout.readline())["url"]
            with urlopen(url + "/sign-in", timeout=20) as page:
                assert b"Sign in" in page.read()
            with urlopen(url + "/static/orthocapture.css", timeout=20) as style:
                assert b"{" in style.read()
        finally:
            server.terminate()
        assert server.wait(timeout=20) == 0
    with Store.open(tmp_path / "runs") as store:
        started = next(event.payload for event in store.events(SITE) if isinstance(event.payload, ServiceStarted))
    names = {Path(file).name for file in started.configuration}
    assert names == {"rig.yaml", *(path.name for path in (REPOSITORY / "protocols").glob("*.yaml"))}
