"""Compiles the application of the KUKA controller, and runs its engine on the JVM with a simulated arm."""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
import tempfile
from collections.abc import Generator
from functools import cache
from pathlib import Path
from typing import Any

from drivers.kuka.robot import HEARTBEAT_S
from tests.support.rig.patience import PATIENCE_S

ROOT = Path(__file__).parents[3]
APPLICATION = ROOT / "drivers" / "kuka" / "sunrise"
TEST_SIDE = ROOT / "tests" / "sunrise"
# Small and quick to start; what the engine does does not depend on them.
_JVM = ("-Xmx64m", "-Xshare:auto", "-XX:TieredStopAtLevel=1", "-XX:+UseSerialGC")
_NO_JDK = (
    "there is no javac, and the application of the KUKA controller must compile: "
    "`sudo apt-get install default-jdk-headless` on Debian and Ubuntu"
)


def compile_java(target: Path, *folders: Path) -> None:
    """Compile all sources of the folders, for the oldest Java that the compiler knows; a warning is an error."""
    javac = shutil.which("javac")
    assert javac is not None, _NO_JDK
    helped = subprocess.run([javac, "--help"], capture_output=True, text=True, timeout=60, check=True).stdout
    release = helped.partition("Supported releases: ")[2].partition(",")[0]
    sources = [str(path) for folder in folders for path in sorted(folder.rglob("*.java"))]
    quick = "-J-XX:TieredStopAtLevel=1"
    command = [
        javac,
        quick,
        "--release",
        release,
        "-encoding",
        "UTF-8",
        "-Xlint:all,-options",
        "-Werror",
        "-d",
        str(target),
    ]
    done = subprocess.run([*command, *sources], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr


@cache
def engine_classes() -> Path:
    """A folder with the compiled engine and the simulated arm; kept until the test process ends."""
    folder = tempfile.TemporaryDirectory(prefix="orthocapture-java-")
    _FOLDERS.append(folder)
    compile_java(Path(folder.name), APPLICATION / "engine", TEST_SIDE / "simulated")
    return Path(folder.name)


_FOLDERS: list[tempfile.TemporaryDirectory[str]] = []


@contextlib.contextmanager
def java_program(name: str, *words: str, stdin: int | None = None) -> Generator[subprocess.Popen[str]]:
    """Run a main class of tests/sunrise/simulated; its standard output is a pipe."""
    java = shutil.which("java")
    assert java is not None, _NO_JDK
    command = [java, *_JVM, "-cp", str(engine_classes()), f"orthocapture.sunrise.simulated.{name}", *words]
    with subprocess.Popen(command, stdin=stdin, stdout=subprocess.PIPE, encoding="utf-8") as process:
        try:
            yield process
        finally:
            process.kill()


@contextlib.contextmanager
def sunrise_engine(host: str, *, patience_s: float = PATIENCE_S) -> Generator[dict[str, Any]]:
    """Run the application's engine at the ports of `simulated_kuka`; yields its ready line."""
    with java_program("Main", host, str(max(HEARTBEAT_S, patience_s))) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line, "the engine did not start"
        yield json.loads(line)
        assert process.poll() is None, "the engine ended by itself"
