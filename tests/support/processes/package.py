"""The distribution as users get it: sdist, wheel, and an environment with the wheel instead of the checkout."""

from __future__ import annotations

import fcntl
import os
import shutil
import site
import subprocess
import sys
import tarfile
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.support.rig.rig import REPOSITORY

PACKAGES = ("drivers", "protocols", "service", "simulators")
_PIP = (sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check")
_SDIST = "from setuptools import build_meta; build_meta.build_sdist('../dist')"


@dataclass(frozen=True)
class Package:
    """The built files, and the `bin` folder of an environment in which they are installed."""

    sdist: Path
    wheel: Path
    bin: Path

    def environment(self) -> dict[str, str]:
        """Environment variables without any reference to the checkout."""
        return {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}

    def run(self, *words: str, cwd: Path, timeout_s: float = 100, **more: str) -> subprocess.CompletedProcess[str]:
        """Run the installed `orthocapture` to its end in the folder `cwd`."""
        return subprocess.run(
            [self.bin / "orthocapture", *words], cwd=cwd, env=self.environment() | more, stdin=subprocess.DEVNULL,
            capture_output=True, text=True, timeout=timeout_s, check=False,
        )  # fmt: skip


def installed_package(factory: pytest.TempPathFactory) -> Package:
    """Build the sdist from the checkout and the wheel from the sdist, and install it; once for all test processes."""
    own = factory.getbasetemp()
    folder = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "package"
    folder.mkdir(exist_ok=True)
    done = folder / "done"
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            _build(folder)
            done.touch()
    (sdist,) = (folder / "dist").glob("*.tar.gz")
    (wheel,) = (folder / "dist").glob("*.whl")
    return Package(sdist, wheel, folder / "environment" / "bin")


def _build(folder: Path) -> None:
    source, unpacked, dist, environment = (folder / name for name in ("source", "sdist", "dist", "environment"))
    for name in PACKAGES:
        shutil.copytree(REPOSITORY / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("LICENSE", "README.md", "pyproject.toml"):
        shutil.copy(REPOSITORY / name, source)
    _do(sys.executable, "-c", _SDIST, cwd=source)
    with tarfile.open(next(dist.glob("*.tar.gz"))) as archive:
        archive.extractall(unpacked, filter="data")
    (root,) = unpacked.iterdir()
    _do(*_PIP, "wheel", "--no-build-isolation", "--no-deps", "--no-index", "--wheel-dir", str(dist), str(root))
    _do(sys.executable, "-m", "venv", "--without-pip", str(environment))
    # Uses the libraries of this environment. Lines of a .pth file add folders only, without their own .pth files, so
    # the checkout, which is installed there as editable, is not found.
    (here,) = (environment / "lib").glob("python*/site-packages")
    (here / "libraries.pth").write_text("\n".join(site.getsitepackages()) + "\n")
    (wheel,) = dist.glob("*.whl")
    python = environment / "bin" / "python"
    _do(*_PIP, "--python", str(python), "install", "--no-deps", "--no-index", "--ignore-installed", str(wheel))


def _do(*words: str, cwd: Path | None = None) -> None:
    done = subprocess.run(words, cwd=cwd, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
