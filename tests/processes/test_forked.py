"""The zygote of the tests: a fork of it is what a fresh process is, seen from outside and from inside."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import pytest

from drivers.host.doing import Note
from tests.support.processes.forked import INSTALLED, ROOT, SET_BY_IMPORTS, Forked
from tests.support.processes.waiting import until
from tests.support.rig.rig import command, simulated_rig

PROBE = (sys.executable, "-m", "tests.support.processes.probe")


@dataclass(frozen=True)
class Ended:
    """How a process ended, and what it said."""

    status: int
    out: str
    errors: str

    @property
    def told(self) -> dict[str, Any]:
        return json.loads(self.out.splitlines()[0])

    @property
    def last(self) -> tuple[str, ...]:
        """What it said after that: the last line of each stream."""
        return self.out.rpartition("\n")[2], (self.errors.strip().splitlines() or [""])[-1]


def ended(kind: type[subprocess.Popen[str]], *words: str, typed: str = "", **more: Any) -> Ended:
    """Run a process to its end, as a fork or by a real start."""
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    how: dict[str, Any] = {"cwd": ROOT, **pipes, **more}
    with kind(words, text=True, **how) as process:
        out, errors = process.communicate(typed, timeout=60)
    assert isinstance(process, Forked) == (kind is Forked)
    assert not isinstance(process, Forked) or process.is_fork
    return Ended(process.returncode, out, errors)


def lightbox(folder: Path, *options: str, cwd: Path = ROOT, **more: Any) -> Forked[str]:
    """A simulator that has told its ready line."""
    words = [sys.executable, "-m", "simulators", "lightbox", "--link", str(folder / "port"), *options]
    process = Forked(words, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **more)
    assert process.is_fork
    assert process.stdout is not None
    assert json.loads(process.stdout.readline())["ready"] is True
    return process


@pytest.mark.parametrize(
    "of_python", [{}, {"PYTHONPATH": f"/srv/some{os.pathsep}/srv/more", "PYTHONUNBUFFERED": "1"}]
)
def test_a_fork_finds_what_a_real_start_finds(tmp_path: Path, of_python: dict[str, str]) -> None:
    mine = {**os.environ, "ORTHOCAPTURE_MINE": "to be read later", **of_python}
    given: dict[str, Any] = {
        "typed": "two\nlines",
        "env": mine,
        "start_new_session": True,
        "stderr": subprocess.STDOUT,
    }
    with socket.socket() as passed, (tmp_path / "file").open("wb") as file:
        given["pass_fds"] = [passed.fileno(), file.fileno()]
        forked, real = (ended(kind, *PROBE, "0", "word", **given).told for kind in (Forked, subprocess.Popen))
    assert sum(" s" in at or at.startswith(f"{given['pass_fds'][1]} -") for at in forked["found"]["files"]) >= 2
    assert forked["found"]["environment"]["ORTHOCAPTURE_MINE"] == "to be read later"
    for told in (forked, real):  # what libraries set depends on which this process and the zygote have imported
        environment: dict[str, str] = told["found"]["environment"]
        told["found"]["environment"] = {k: v for k, v in environment.items() if k not in SET_BY_IMPORTS}
    assert forked["found"] == real["found"]
    assert forked["typed"] == real["typed"] == "two\nlines"
    with lightbox(Path(), cwd=tmp_path) as process:
        assert (tmp_path / "port").is_symlink()
        process.terminate()


@pytest.mark.parametrize("how", ["0", "3", "258", "words", "raise", "interrupt", "thread", "abort", "broken"])
def test_a_fork_ends_as_a_real_start_does(how: str) -> None:
    forked, real = (ended(kind, *PROBE, how) for kind in (Forked, subprocess.Popen))
    assert (forked.status, forked.last) == (real.status, real.last)
    assert ("at exit" in forked.last[0]) == (how not in ("abort", "broken"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "status"),
    [
        ([str(INSTALLED), "--help"], 0),
        (command("status", "latest", "--data", "nowhere"), 1),
        (command("status", "--no-such-option"), 2),
    ],
)
def test_a_command_says_what_it_says_when_it_is_typed(words: list[str], status: int) -> None:
    forked, real = (ended(kind, *words) for kind in (Forked, subprocess.Popen))
    assert forked == real
    assert forked.status == status


def test_each_has_its_own_chance() -> None:
    one, other = (ended(Forked, *PROBE, "0").told["drawn"] for _ in range(2))
    assert all(a != b for a, b in zip(one, other, strict=True))


def test_what_python_or_a_library_reads_at_its_start_makes_it_a_real_one() -> None:
    with Forked([*PROBE, "0"], cwd=ROOT, env={**os.environ, "PYTHONHASHSEED": "1"}, stdin=subprocess.DEVNULL) as one:
        assert not one.is_fork
        assert one.wait(60) == 0
    with Forked([sys.executable, "-I", "-c", "raise SystemExit(4)"]) as other:
        assert not other.is_fork
        assert other.wait(60) == 4
    with pytest.raises(FileNotFoundError):
        Forked([*PROBE, "0"], cwd=ROOT / "nowhere")


def test_it_is_the_process_with_its_id_below_this_one_until_it_is_told_to_end(tmp_path: Path) -> None:
    with lightbox(tmp_path) as process:
        seen = psutil.Process(process.pid)
        assert seen in psutil.Process().children(recursive=True)
        assert process.poll() is None
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.01)
        seen.suspend()
        until(lambda: seen.status() == psutil.STATUS_STOPPED, "it is not suspended")
        seen.resume()
        process.terminate()
        assert process.wait(30) == process.wait() == process.poll() == 0
        assert not seen.is_running()
        process.kill()  # of nobody
    assert not (tmp_path / "port").is_symlink()


def test_death_by_a_signal_is_told_as_such_of_the_one_that_died(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    with lightbox(tmp_path) as one, lightbox(tmp_path / "other", start_new_session=True) as other:
        one.kill()
        assert one.wait(30) == -signal.SIGKILL
        assert other.poll() is None
        os.killpg(other.pid, signal.SIGINT)  # what Ctrl-C does; the zygote is not in this group
        assert other.wait(30) == 0
    with lightbox(tmp_path / "other") as third:
        third.terminate()
        assert third.wait(30) == 0


def test_the_parent_that_it_watches_is_the_one_that_it_has(tmp_path: Path) -> None:
    with lightbox(tmp_path, "--parent", str(os.getpid())) as process:
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(1.2)  # it looks each half a second
        process.terminate()
        assert process.wait(30) == 0


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_the_devices_of_a_forked_rig_are_forks_too_and_end_with_it(tmp_path: Path, how: signal.Signals) -> None:
    words = ["rig", "--dir", str(tmp_path), "--scene", "3", "--image-width", "300", "--hand", "steady"]
    with Forked([sys.executable, "-m", "simulators", *words], stdout=subprocess.PIPE, text=True, cwd=ROOT) as rig:
        assert rig.is_fork
        assert rig.stdout is not None
        assert json.loads(rig.stdout.readline())["ready"] is True
        below = psutil.Process(rig.pid).children(recursive=True)
        assert len(below) == 3  # its zygote, camera and light box
        assert {process.cmdline()[2] for process in below} == {"tests.support.processes.zygote"}
        assert [process.ppid() for process in below[1:]] == [below[0].pid] * 2
        rig.send_signal(how)
        assert rig.wait(60) == (0 if how == signal.SIGTERM else -how)
        until(lambda: not any(process.is_running() for process in below), "its processes have not ended")
    assert not (tmp_path / "lightbox").is_symlink()  # the light box ended in order


@pytest.mark.slow
def test_the_drivers_of_a_forked_command_are_forks_too(tmp_path: Path) -> None:
    """They were real starts for long, since each command silences OpenCV by a variable of the environment."""
    seen: dict[int, list[str]] = {}
    options = ("--scene", "3", "--image-width", "300", "--hand", "steady")
    with (
        simulated_rig(tmp_path, *options, host="127.0.0.76") as ready,
        Forked(command("doctor", "--rig", ready["rig"]), cwd=ROOT, stdout=subprocess.DEVNULL) as doctor,
    ):

        def has_ended() -> bool:
            with contextlib.suppress(psutil.NoSuchProcess):
                for process in psutil.Process(doctor.pid).children(recursive=True):
                    seen[process.pid] = process.cmdline()[1:3]
            return doctor.poll() is not None

        until(has_ended, "the doctor has not ended")
        assert doctor.returncode == 0
    assert len(seen) >= 2  # its zygote and the camera's driver
    assert [line for line in seen.values() if line not in ([], ["-m", "tests.support.processes.zygote"])] == []


@pytest.mark.parametrize("kind", [Forked, subprocess.Popen])
def test_a_driver_has_the_connection_that_it_is_passed_and_ends_with_it(kind: type[subprocess.Popen[str]]) -> None:
    ours, theirs = socket.socketpair()
    note = Note()
    given: dict[str, Any] = {
        "pass_fds": [theirs.fileno(), note.descriptor],
        "env": {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"},
        "start_new_session": True,
    }
    words = [sys.executable, "-m", "drivers.host", str(theirs.fileno()), str(note.descriptor)]
    with kind(words, cwd=ROOT, text=True, **given) as driver:
        assert not isinstance(driver, Forked) or driver.is_fork
        theirs.close()
        with pytest.raises(subprocess.TimeoutExpired):
            driver.wait(0.5)
        ours.close()
        assert driver.wait(60) == 0


def test_forks_and_zygote_end_with_the_tests_however_these_end(tmp_path: Path) -> None:
    program = (
        "import os, sys\n"
        "from pathlib import Path\n"
        "from tests.processes.test_forked import lightbox\n"
        "process = lightbox(Path(sys.argv[1]))\n"
        "print(process.pid, os.popen(f'ps -o ppid= -p {process.pid}').read(), flush=True)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    done = ended(subprocess.Popen, sys.executable, "-c", program, str(tmp_path))
    assert done.status == -signal.SIGKILL, done.errors
    fork, zygote = (int(word) for word in done.out.split())
    assert fork != zygote
    until(lambda: not psutil.pid_exists(fork) and not psutil.pid_exists(zygote), "they outlive their tests")
