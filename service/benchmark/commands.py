"""Runs the commands of a method, and measures what they take."""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
import time
from pathlib import Path

import psutil

from service.benchmark.method import Command
from service.benchmark.records import ComputingEffort, Machine
from service.core.errors import ComputeError, ConfigurationError
from service.core.units import gigabytes, megabytes

_LAST_LINES = 12  # of a failed program's output, for the message
_ANSWER_S = 10.0  # that the NVIDIA driver may take to name its GPU


def run_commands(commands: tuple[Command, ...], work: Path, log: Path) -> ComputingEffort:
    """Run commands one after the other in a folder, with their output in a file.

    Raises:
        ConfigurationError: a program cannot be started.
        ComputeError: one ended with another status than 0; the message has its last lines.
    """
    wall_s = cpu_s = peak_bytes = 0.0
    log.write_bytes(b"")
    for command in commands:
        with log.open("ab") as output:
            output.write(f"$ {shlex.join(command)}\n".encode())
            output.flush()
            began = time.monotonic()
            try:
                process = subprocess.Popen(
                    command, cwd=work, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT
                )
            except OSError as error:
                raise ConfigurationError(
                    f"{command[0]} cannot be started: {error.strerror}", where=shlex.join(command)
                ) from error
            _, status, used = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
        wall_s += time.monotonic() - began
        cpu_s += used.ru_utime + used.ru_stime
        peak_bytes = max(peak_bytes, 1024.0 * used.ru_maxrss)
        if process.returncode != 0:
            last = log.read_text(encoding="utf-8", errors="replace").splitlines()[-_LAST_LINES:]
            raise ComputeError(
                f"{command[0]} ended with status {process.returncode}:\n" + "\n".join(last),
                where=shlex.join(command),
                remedy=f"Its whole output is in {log}",
            )
    return ComputingEffort(
        wall_s=round(wall_s, 2), cpu_s=round(cpu_s, 2), peak_memory_mb=round(megabytes(peak_bytes))
    )


def this_machine() -> Machine:
    """The machine that this program runs on."""
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text(encoding="utf-8").splitlines() if cpu.exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return Machine(
        processor=models[0] if models else platform.processor() or platform.machine(),
        cores=os.cpu_count() or 1,
        memory_gb=round(gigabytes(psutil.virtual_memory().total), 1),
        gpu=_gpu(),
    )


def _gpu() -> str:
    program = shutil.which("nvidia-smi")
    if program is None:
        return ""
    try:
        answer = subprocess.run(
            [program, "--query-gpu=name", "--format=csv,noheader"],
            capture_output=True, text=True, timeout=_ANSWER_S, check=False,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return answer.stdout.strip().splitlines()[0] if answer.returncode == 0 and answer.stdout.strip() else ""
