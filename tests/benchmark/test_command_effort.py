"""What the commands of a method take, and how their failures are told."""

from __future__ import annotations

import platform
import subprocess
import sys
from pathlib import Path

import pytest

from service.benchmark.running import run_commands
from service.core.errors import ComputeError, ConfigurationError

HELD = 300 << 20
ROOT = Path(__file__).parents[2]


def program(lines: str) -> tuple[str, ...]:
    return (sys.executable, "-I", "-S", "-c", lines)


def test_the_peak_of_memory_is_the_command_s_own_and_not_that_of_the_program_that_runs_it(tmp_path: Path) -> None:
    held = b"1" * HELD
    small = run_commands((program("pass"),), tmp_path, tmp_path / "log")
    large = run_commands((program("a = b'1' * (200 << 20)"), program("pass")), tmp_path, tmp_path / "log")
    assert len(held) == HELD
    assert small.peak_memory_mb < 60
    assert 200 < large.peak_memory_mb < 270


def test_time_and_output_are_those_of_all_commands(tmp_path: Path) -> None:
    busy = "import time; end = time.process_time() + 0.3\nwhile time.process_time() < end: pass\nprint('done')"
    effort = run_commands((program(busy), program("import time; time.sleep(0.3)")), tmp_path, tmp_path / "log")
    assert effort.cpu_s >= 0.3
    assert effort.wall_s >= 0.6
    assert (tmp_path / "log").read_text().splitlines()[3:] == [
        "done",
        f"$ {sys.executable} -I -S -c 'import time; time.sleep(0.3)'",
    ]


def test_a_program_that_is_not_there_and_one_that_fails_are_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError) as absent:
        run_commands((("/nowhere/program", "--all"),), tmp_path, tmp_path / "log")
    assert absent.value.what == "/nowhere/program cannot be started: No such file or directory"
    assert absent.value.where == "/nowhere/program --all"
    with pytest.raises(ComputeError, match=r"ended with status 3:\n(.*\n)*nothing to see"):
        run_commands((program("import sys; print('nothing to see'); sys.exit(3)"),), tmp_path, tmp_path / "log")
    with pytest.raises(ComputeError, match="ended with status -9"):
        run_commands((program("import os; os.kill(os.getpid(), 9)"),), tmp_path, tmp_path / "log")
    with pytest.raises(ComputeError, match="was ended from outside"):
        run_commands((program("import os; os.kill(os.getppid(), 9)"),), tmp_path, tmp_path / "log")


FREED = """
from pathlib import Path
import numpy as np
from service.machine.resources import keep_freed_memory, return_freed_memory

def resident_mb():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6

keep_freed_memory()
maps, between = [], []
for _ in range(20):
    maps.append(np.ones(2 << 20))
    between.append(bytes(2000))
held = resident_mb()
maps.clear()
kept = resident_mb()
return_freed_memory()
print(held - kept, kept - resident_mb())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries keep and return as they do")
def test_freed_memory_is_kept_until_it_is_returned() -> None:
    done = subprocess.run([sys.executable, "-c", FREED], cwd=ROOT, capture_output=True, text=True, check=True)
    at_once, returned = map(float, done.stdout.split())
    assert at_once < 100
    assert returned > 200
