"""What the gphoto driver does with answers that nobody expects: every property × absent, fixed, empty, and so on.

    nice python -m bench.cameras.answers

Each case starts the simulated ILCE-7RM5 with one property changed, and the driver in its process as in a run: it is
opened, reports, is given the paper's settings and takes an exposure; then it must still report. The table goes to
bench/results. A case fails if the driver's process died, or if a call took longer than LONGEST_S.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench.machine import RESULTS, commit, machine
from drivers.errors import DeviceError, DeviceUnavailableError
from simulators.sony_camera.alpha_7r_v import alpha_7r_v
from simulators.sony_camera.answers import HOWS
from simulators.sony_camera.properties import CameraProperty, Code
from tests.support.rig.camera_simulator import camera_simulator
from tests.support.rig.gphoto_rig import PAPER, driver

LONGEST_S = 30.0
_NAME = "camera_answers-2026-11-27"
_LATE_S = 1.0
_OUTSIDE = 99  # in no list of the body


@dataclass
class Case:
    """One property that answers otherwise, and what became of each call."""

    code: str
    name: str
    how: str
    calls: dict[str, str] = field(default_factory=dict[str, str])
    longest_s: float = 0.0
    died: bool = False

    @property
    def verdict(self) -> str:
        """works, refuses in words, or what is wrong."""
        if self.died:
            return "DIED"
        if self.longest_s > LONGEST_S:
            return "TOO LONG"
        return "works" if all(one == "yes" for one in self.calls.values()) else "refuses"


def _answers(entry: CameraProperty, how: str) -> str:
    value = {"late": _LATE_S, "value": _OUTSIDE}.get(how)
    return json.dumps([{"code": f"{entry.code:04x}", "how": how, "value": value}])


def _try(case: Case, entry: CameraProperty) -> None:
    with camera_simulator((), "--fast", "--answers", _answers(entry, case.how)) as simulator:
        camera = driver(simulator.gphoto_port, capture_timeout_s=12.0)
        calls: dict[str, Callable[[], Any]] = {
            "open": camera.open,
            "report": camera.report,
            "apply": lambda: camera.apply(PAPER),
            "capture": lambda: camera.capture(Path(tempfile.mkdtemp())),
            "still there": camera.report,
        }
        try:
            for name, call in calls.items():
                began_s = time.monotonic()
                try:
                    call()
                    case.calls[name] = "yes"
                except DeviceError as error:
                    case.calls[name] = f"{type(error).__name__}: {error.what}. {error.remedy}"
                    case.died |= isinstance(error, DeviceUnavailableError) and "died of" in error.what
                case.longest_s = max(case.longest_s, time.monotonic() - began_s)
                if name == "open" and case.calls[name] != "yes":
                    break
        finally:
            camera.close()


def _table(cases: list[Case]) -> str:
    counts = Counter(case.verdict for case in cases)
    lines = [
        "# What the gphoto driver does with answers that nobody expects",
        "",
        f"Simulated ILCE-7RM5, one property changed in each of {len(cases)} cases: "
        + ", ".join(f"{number} {verdict}" for verdict, number in sorted(counts.items()))
        + f". Longest call {max(case.longest_s for case in cases):.1f} s. Made by `bench/cameras/answers.py`.",
        "",
        "| property | how it answers | verdict | first call that is refused, and its words |",
        "|---|---|---|---|",
    ]
    for case in cases:
        refused = next((f"{name}: {said}" for name, said in case.calls.items() if said != "yes"), "")
        lines.append(f"| {case.code} {case.name} | {case.how} | {case.verdict} | {refused.replace('|', '/')} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Try every case, write the table; 1 if the driver died or a call took too long."""
    cases: list[Case] = []
    for entry in alpha_7r_v().properties:
        for how in HOWS:
            case = Case(f"{entry.code:04X}", Code(entry.code).name.lower(), how)
            _try(case, entry)
            print(case.code, case.how, case.verdict, f"{case.longest_s:.1f} s", flush=True)
            cases.append(case)
    rows = [{**vars(case), "verdict": case.verdict} for case in cases]
    words = json.dumps({"commit": commit(), "machine": machine(), "cases": rows}, indent=1)
    (RESULTS / f"{_NAME}.json").write_text(words + "\n")
    (RESULTS / f"{_NAME}.md").write_text(_table(cases))
    return int(any(case.verdict not in ("works", "refuses") for case in cases))


if __name__ == "__main__":
    sys.exit(main())
