"""The process that parses inputs, target by target. It may be killed at any moment; its folder then shows the cause.

The folder holds plan.json (what to do), slot (the current input), told.jsonl (findings and finished targets), trace
(where it was when it crashed or was stopped), and the seeds and corpus of each target.
"""

from __future__ import annotations

import base64
import contextlib
import faulthandler
import importlib
import json
import logging
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path
from typing import Any

import hypothesis

from tests.support.rig.rig import REPOSITORY
from tests.support.torture.fuzz.minimise import minimised
from tests.support.torture.fuzz.mutations import mutated
from tests.support.torture.fuzz.slot import Slot
from tests.support.torture.fuzz.targets.table import targets_of
from tests.support.torture.fuzz.targets.target import Target, fault_of

INSTRUMENTED = ["service", "drivers", "simulators", "yaml", "trimesh", "pydicom"]
_CHUNK = 100  # examples per round of hypothesis
_MINIMISE_S = 4.0
_UNWANTED = (
    hypothesis.HealthCheck.too_slow,
    hypothesis.HealthCheck.data_too_large,
    hypothesis.HealthCheck.large_base_example,
)
_MIB = 1 << 20


class Reader:
    """Feeds inputs to one target and reports those that it did not refuse properly."""

    def __init__(self, target: Target, slot: Slot, folder: Path, known: set[str]) -> None:
        self.target = target
        self.seeds = _seeds(target, folder / target.name)
        self.refused = False
        self._slot, self._folder, self._known = slot, folder, known
        self._scratch = Path(tempfile.mkdtemp(prefix="fuzz-", dir=os.environ.get("TMPDIR")))
        slot.open(target.name, target.seconds)
        # The seeds first, so that what a parser loads at its first call is not attributed to an input.
        for seed in self.seeds:
            if fault := self._outcome(seed):
                self._keep(fault, seed)
        _bound_memory(target.memory_mib)
        _forget_peak()
        self._base_kib = _peak_kib()

    def read(self, data: bytes) -> None:
        """Parse one input."""
        fault = self._timed(data)
        grown_kib = max(_peak_kib() - self._base_kib, 0)
        self._slot.end(refused=self.refused, peak_kib=grown_kib)
        if not fault and grown_kib > self.target.memory_mib * 1024:
            fault = f"memory: more than {self.target.memory_mib} MiB"
            _forget_peak()
        if fault and fault not in self._known:
            self._keep(fault, data if fault.startswith("memory") else self._smallest(data, fault))

    def close(self) -> None:
        """Report the number of inputs and clean up."""
        slot = self._slot
        self._tell({"counts": [slot.inputs, slot.refused, slot.spent_s, slot.peak_kib]})
        shutil.rmtree(self._scratch, ignore_errors=True)

    def _timed(self, data: bytes) -> str:
        self._slot.begin(data, time.monotonic(), time.process_time())
        return self._outcome(data)

    def _smallest(self, data: bytes, fault: str) -> bytes:
        def shows(smaller: bytes) -> bool:
            same = self._timed(smaller) == fault
            self._slot.end(refused=not same, peak_kib=0)
            return same

        return minimised(data, shows, tries=3000, seconds=_MINIMISE_S)

    def _outcome(self, data: bytes) -> str:
        """The fault in how the target handled this input; "" if there is none."""
        error = self._raised(data)
        self.refused = error is not None
        fault = fault_of(self.target, error) if error is not None else ""
        return f"{fault} {_place(error)}" if error is not None and fault else ""

    def _raised(self, data: bytes) -> BaseException | None:
        folder = self._scratch / "input"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        try:
            self.target.parse(data, folder)
        except (KeyboardInterrupt, SystemExit):
            raise
        except BaseException as error:  # noqa: BLE001 - every kind of exception is what is looked for
            return error
        return None

    def _keep(self, fault: str, smallest: bytes) -> None:
        self._known.add(fault)
        error = self._raised(smallest)
        text = "" if error is None else "".join(traceback.format_exception(error))[-4000:]
        self._tell({"fault": fault, "input": base64.b64encode(smallest).decode(), "traceback": text})

    def _tell(self, line: dict[str, Any]) -> None:
        with (self._folder / "told.jsonl").open("a") as stream:
            stream.write(json.dumps({"target": self.target.name, **line}) + "\n")


def _seeds(target: Target, folder: Path) -> list[bytes]:
    """The target's seeds, made once for all processes of a sweep; the other engine's corpus begins with them."""
    place = folder / "seeds"
    if not place.exists():
        with tempfile.TemporaryDirectory(prefix="seeds-") as made_in:
            seeds = target.seeds(Path(made_in))
        for part in (folder / "corpus", place):
            part.mkdir(parents=True)
            for number, data in enumerate(seeds):
                (part / f"{number:03d}").write_bytes(data)
    return [path.read_bytes() for path in sorted(place.iterdir())]


def _bound_memory(mib: int) -> None:
    """Set the kernel's memory limit well above the bound that is checked, which applies to the memory really used."""
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (mapped + (3 * mib + 1024) * _MIB, most))
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 30, 1 << 30))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _forget_peak() -> None:
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _peak_kib() -> int:
    # Not ru_maxrss of this process, which begins with the value of its parent.
    with Path("/proc/self/status").open("rb") as status:
        own = next(int(line.split()[1]) for line in status if line.startswith(b"VmHWM"))
    return max(own, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)


def _place(error: BaseException) -> str:
    """The innermost line of the project that the exception passed, which identifies a finding."""
    found = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        path = Path(frame.f_code.co_filename)
        if path.is_relative_to(REPOSITORY) and ".venv" not in path.parts:
            found = f"{path.relative_to(REPOSITORY)}:{line} {frame.f_code.co_name}"
    return f"at {found or 'unknown place'}"


# --- engines ----------------------------------------------------------------------------------------------------


def explore(reader: Reader, *, seed: int, inputs: int, seconds: float) -> None:
    """Fuzz with hypothesis: mutated seeds, reproducible for a given `seed`."""
    ends_s = time.monotonic() + seconds
    done = rounds = 0
    while done < inputs and time.monotonic() < ends_s:

        @hypothesis.seed(seed * 1_000_003 + rounds)
        @hypothesis.settings(
            max_examples=min(_CHUNK, inputs - done),
            database=None,
            deadline=None,
            phases=(hypothesis.Phase.generate,),
            suppress_health_check=_UNWANTED,
        )
        @hypothesis.given(mutated(reader.seeds, reader.target.mutations))
        def one(data: bytes) -> None:
            nonlocal done
            if done < inputs and time.monotonic() < ends_s:
                done += 1
                reader.read(data)

        before = done
        one()
        rounds += 1
        if done == before:
            return


def explore_by_coverage(reader: Reader, atheris: Any, folder: Path, *, seed: int, seconds: float) -> None:
    """Fuzz with atheris: libFuzzer with a corpus that starts with the seeds and grows by coverage. Never returns."""
    words = [sys.argv[0], str(folder / reader.target.name / "corpus"), f"-max_total_time={max(1, round(seconds))}"]
    words += [f"-seed={seed + 1}", "-rss_limit_mb=0", "-max_len=65536", "-verbosity=0", "-timeout=3600"]
    atheris.Setup([*words, f"-artifact_prefix={folder}/"], reader.read)
    atheris.Fuzz()


def main() -> None:
    """Do what the plan says."""
    folder = Path(sys.argv[1])
    plan: dict[str, Any] = json.loads((folder / "plan.json").read_text())
    trace = (folder / "trace").open("w")
    faulthandler.enable(trace)
    faulthandler.register(signal.SIGUSR1, trace, all_threads=False)
    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)  # simulators log what they refuse
    slot = Slot(folder / "slot")
    atheris = importlib.import_module("atheris") if plan["engine"] == "atheris" else None
    with atheris.instrument_imports(include=INSTRUMENTED) if atheris else contextlib.nullcontext():
        targets = targets_of(plan["group"])
    for target in targets:
        share = plan["targets"].get(target.name)
        if share is None:
            continue
        reader = Reader(target, slot, folder, set(plan["known"]))
        try:
            if plan["engine"] == "once":
                reader.read((folder / "once").read_bytes())
            elif atheris is not None:
                explore_by_coverage(reader, atheris, folder, seed=plan["seed"], seconds=share["seconds"])
            else:
                explore(reader, seed=plan["seed"], inputs=share["inputs"], seconds=share["seconds"])
        finally:
            reader.close()


if __name__ == "__main__":
    main()
