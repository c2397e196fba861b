"""Watches the parsing process: an input that kills or hangs it is a finding, which is kept and minimised."""

from __future__ import annotations

import base64
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from tests.support.rig.rig import REPOSITORY
from tests.support.torture.fuzz.minimise import minimised
from tests.support.torture.fuzz.slot import Reading, Slot

Engine = Literal["hypothesis", "atheris"]
START_S = 240.0  # imports and seeds on a busy machine
CLOCK_FACTOR = 10  # limit in wall time as a multiple of that in CPU time, because machines are shared
_POLL_S = 0.05
_REDUCING_S = 120.0  # each try needs a process of its own
_MOST_STARTS = 40
_TICK = os.sysconf("SC_CLK_TCK")
_FRAME = re.compile(r'File "([^"]+)", line (\d+) in (\S+)')


class HarnessError(Exception):
    """The sweep itself has failed."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A fault and the smallest input that shows it."""

    target: str
    fault: str
    data: bytes
    traceback: str = ""


@dataclass
class Outcome:
    """The results for one target."""

    inputs: int = 0
    refused: int = 0
    seconds: float = 0.0
    peak_mib: float = 0.0
    findings: list[Finding] = field(default_factory=list[Finding])

    def add(self, inputs: int, refused: int, spent_s: float, peak_kib: int) -> None:
        """Add the counts of one process."""
        self.seconds += spent_s
        self.inputs += inputs
        self.refused += refused
        self.peak_mib = max(self.peak_mib, peak_kib / 1024)


@dataclass(frozen=True, slots=True)
class _Death:
    """How, and at which input, a process ended prematurely."""

    fault: str
    at: Reading


class Sweep:
    """Parses inputs for one group's targets in processes, and starts a new one after each death."""

    def __init__(self, group: str, engine: Engine, folder: Path, *, reducing_tries: int = 24) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._group, self._folder = group, folder
        self._engine: Engine = engine
        self._reducing_tries = reducing_tries
        # Files left by a killed process are deleted with the folder.
        (folder / "tmp").mkdir(exist_ok=True)
        self._environment = {**os.environ, "TMPDIR": str(folder / "tmp")}
        self.outcomes: dict[str, Outcome] = {}

    def run(self, inputs: Mapping[str, int], *, seconds: float, seed: int = 0) -> dict[str, Outcome]:
        """Run targets in one process, and in another after each death.

        Args:
            inputs: the number of inputs for each target, by its name.
            seconds: the time for each target.
            seed: of hypothesis.
        """
        began_s = time.monotonic()
        for start in range(_MOST_STARTS):
            left_s = len(inputs) * seconds - (time.monotonic() - began_s)
            left = {name: count - self._outcome(name).inputs for name, count in inputs.items()}
            share = {name: {"inputs": n, "seconds": min(seconds, left_s)} for name, n in left.items() if n > 0}
            if left_s <= 0 or not share:
                break
            death = self._process({"targets": share, "seed": seed + start})
            if death is None:
                break
            self._keep(death)
        return self.outcomes

    def _outcome(self, target: str) -> Outcome:
        return self.outcomes.setdefault(target, Outcome())

    def _keep(self, death: _Death) -> None:
        outcome = self._outcome(death.at.target)
        outcome.add(death.at.inputs, death.at.refused, death.at.spent_s, death.at.peak_kib)
        if death.fault not in self._known():
            outcome.findings.append(Finding(death.at.target, death.fault, self._reduced(death)))

    def _known(self) -> list[str]:
        return [finding.fault for outcome in self.outcomes.values() for finding in outcome.findings]

    def _process(self, plan: dict[str, Any]) -> _Death | None:
        """Run one process to its end. Raises HarnessError if it fails by itself."""
        for name in ("slot", "told.jsonl"):
            (self._folder / name).unlink(missing_ok=True)
        whole = {"group": self._group, "engine": self._engine, "known": self._known(), **plan}
        (self._folder / "plan.json").write_text(json.dumps(whole))
        slot = Slot(self._folder / "slot")
        command = [sys.executable, "-m", "tests.support.torture.fuzz.child", str(self._folder)]
        with (self._folder / "output").open("wb") as output:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=output, stderr=output, cwd=REPOSITORY, env=self._environment
            )
        try:
            death = self._watched(slot, process)
        finally:
            process.kill()
            process.wait()
            at = slot.read()
            slot.close()
        self._collect(at if death is None else None)
        if death is None and process.returncode != 0:
            said = (self._folder / "output").read_bytes()[-2000:].decode(errors="replace")
            raise HarnessError(f"{at.target}: the parsing process ended with {process.returncode}: {said}")
        return death

    def _watched(self, slot: Slot, process: subprocess.Popen[bytes]) -> _Death | None:
        began_s = time.monotonic()
        while process.poll() is None:
            time.sleep(_POLL_S)
            at = slot.read()
            if not at.target and time.monotonic() - began_s > START_S:
                raise HarnessError(f"the parsing process did not start within {START_S:g} s")
            if at.busy and self._takes_too_long(process, at):
                again = slot.read()
                if again == at and at.bound_s > 0:
                    return _Death(f"hangs beyond {at.bound_s:g} s {self._stopped_at(process)}", at)
        at = slot.read()
        if process.returncode == 0 or not at.busy:
            return None
        status = process.returncode
        how = signal.Signals(-status).name if status < 0 else f"exit {status}"
        return _Death(f"crashes ({how}) {self._last_place()}", at)

    def _takes_too_long(self, process: subprocess.Popen[bytes], at: Reading) -> bool:
        used_s = _processor_s(process.pid) - at.cpu_s
        return used_s > at.bound_s or time.monotonic() - at.began_s > CLOCK_FACTOR * at.bound_s

    def _stopped_at(self, process: subprocess.Popen[bytes]) -> str:
        """Find where the process hangs, then end it."""
        process.send_signal(signal.SIGUSR1)
        time.sleep(0.3)
        process.kill()
        process.wait()
        return self._last_place()

    def _last_place(self) -> str:
        """The innermost line of the project in faulthandler's output."""
        for path, line, name in _FRAME.findall((self._folder / "trace").read_text(errors="replace")):
            parts = Path(path).parts
            package = next((one for one in ("service", "drivers", "simulators") if one in parts), "")
            if package and "site-packages" not in parts:
                return f"at {'/'.join(parts[parts.index(package) :])}:{line} {name}"
        return "at unknown place"

    def _collect(self, at: Reading | None) -> None:
        """Collect the process's reports; for a target without an end (libFuzzer reports none), use the slot."""
        path = self._folder / "told.jsonl"
        ended: set[str] = set()
        for text in path.read_text().splitlines() if path.exists() else ():
            told: dict[str, Any] = json.loads(text)
            outcome = self._outcome(told["target"])
            if "fault" in told:
                data = base64.b64decode(told["input"])
                outcome.findings.append(Finding(told["target"], told["fault"], data, told["traceback"]))
            else:
                ended.add(told["target"])
                outcome.add(*told["counts"])
        if at is not None and at.target and at.target not in ended:
            self._outcome(at.target).add(at.inputs, at.refused, at.spent_s, at.peak_kib)

    def _reduced(self, death: _Death) -> bytes:
        """Minimise the input at which a process died or hung."""
        kind = death.fault.split()[0]
        trial = Sweep(self._group, self._engine, self._folder)

        def shows(data: bytes) -> bool:
            (self._folder / "once").write_bytes(data)
            share = {"inputs": 1, "seconds": 1.0}
            plan = {"targets": {death.at.target: share}, "seed": 0, "engine": "once"}
            again = trial._process(plan)
            return again is not None and again.fault.split()[0] == kind

        return minimised(death.at.data, shows, tries=self._reducing_tries, seconds=_REDUCING_S)


def _processor_s(pid: int) -> float:
    try:
        words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(words[11]) + int(words[12])) / _TICK


def all_findings(outcomes: Sequence[Outcome]) -> list[Finding]:
    """The findings of several outcomes, each fault once."""
    return list({(f.target, f.fault): f for outcome in outcomes for f in outcome.findings}.values())
