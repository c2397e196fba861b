"""Runs the commands of a method, and measures what they take."""

from __future__ import annotations

import json
import os
import platform
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import psutil

from service.benchmark.method import Command
from service.benchmark.programs import measured
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
        took = _measured(command, work, log)
        wall_s += took["wall_s"]
        cpu_s += took["cpu_s"]
        peak_bytes = max(peak_bytes, took["peak_bytes"])
        if took["status"] != 0:
            last = log.read_text(encoding="utf-8", errors="replace").splitlines()[-_LAST_LINES:]
            raise ComputeError(
                f"{command[0]} ended with status {took['status']}:\n" + "\n".join(last),
                where=shlex.join(command),
                remedy=f"Its whole output is in {log}",
            )
    return ComputingEffort(
        wall_s=round(wall_s, 2), cpu_s=round(cpu_s, 2), peak_memory_mb=round(megabytes(peak_bytes))
    )


def _measured(command: Command, work: Path, log: Path) -> dict[str, Any]:
    """Run a command, and return its status and what it took, as `programs/measured.py` says it."""
    reading, writing = os.pipe()
    with log.open("ab") as output, os.fdopen(reading, "rb") as said:
        output.write(f"$ {shlex.join(command)}\n".encode())
        output.flush()
        try:
            process = subprocess.Popen(
                [sys.executable, "-I", "-S", measured.__file__, str(writing), *command],
                cwd=work, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT, pass_fds=(writing,),
            )  # fmt: skip
        finally:
            os.close(writing)
        answer = said.read()
        process.wait()
    if not answer:
        raise ComputeError(f"{command[0]} was ended from outside", where=shlex.join(command))
    took: dict[str, Any] = json.loads(answer)
    if "refused" in took:
        raise ConfigurationError(f"{command[0]} cannot be started: {took['refused']}", where=shlex.join(command))
    return took


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
