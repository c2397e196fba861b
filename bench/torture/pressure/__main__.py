"""What a machine under pressure does to each step of a run: `python -m bench.torture.pressure [--only starved …]`.

The demonstration with few views and all its steps is run with `--auto-confirm` on a simulated rig: as it is, with a
fraction of a processor for all its processes, with little memory, and with a driver killed in each step that takes
views. Where the command ends because a person must decide,
one is played from then on: the run is resumed with `--screens`, and what it asks is confirmed by `orthocapture act`.
Nothing else may end it. It needs root.

Figures go to bench/results/pressure-DATE. Exit status: 0 if every run was completed and verified, 1 otherwise.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil

from bench.machine import REPOSITORY, RESULTS, commit, machine
from bench.torture.pressure.groups import Group, Limits, group
from service.core.errors import OrthocaptureError
from service.core.records.base import seconds_between
from service.core.records.run_events import DeviceTrouble, StepFailed, StepPassed, StepStarted, ViewpointCaptured
from service.core.run.decide import AskOperator, decide, fold
from service.run_start import recorded_run
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.protocols.small_demo import COARSE, small_demo
from tests.support.rig.rig import command

_MOST_DECISIONS = 40  # of the person, after whom the run counts as going round in a circle


@dataclass(frozen=True, slots=True)
class Pressure:
    """Holds what is withheld from a run, and whether its drivers are killed."""

    words: str
    everything: Limits = field(default_factory=Limits)  # the rig's simulators among it
    program: Limits = field(default_factory=Limits)  # runner, worker and drivers
    kills: tuple[signal.Signals, ...] = ()


PRESSURES: Mapping[str, Pressure] = {
    "quiet": Pressure("as it is"),
    "starved": Pressure("0.3 of a processor for the rig and the program", everything=Limits(processors=0.3)),
    "starved more": Pressure("0.12 of a processor for the rig and the program", everything=Limits(processors=0.12)),
    "memory": Pressure("700 MB for the program", program=Limits(memory_mb=700)),
    "less memory": Pressure("380 MB for the program", program=Limits(memory_mb=380)),
    "killed": Pressure(
        "a driver is killed in each step that uses one", kills=(signal.SIGKILL, signal.SIGALRM, signal.SIGTERM)
    ),
}


@dataclass
class Killer:
    """Kills one driver of a run in each step that takes views, after the first of them."""

    signals: Sequence[signal.Signals]
    done: set[str] = field(default_factory=set[str])

    def look(self, data: Path, runner: psutil.Process) -> None:
        """Kill a driver if the step under way has not lost one yet."""
        step = _under_way(data)
        if not self.signals or step is None or step in self.done:
            return
        drivers = [child for child in runner.children(recursive=True) if "drivers.host" in " ".join(child.cmdline())]
        if drivers:
            victim = drivers[len(self.done) % len(drivers)]
            victim.send_signal(self.signals[len(self.done) % len(self.signals)])
            self.done.add(step)


def _under_way(data: Path) -> str | None:
    """The step that is running, if a view of it was captured."""
    with Store.open(data, create=False) as store:
        events = store.events(store.find_run("latest"))
    step = None
    for event in events:
        match event.payload:
            case StepStarted():
                step = None
            case ViewpointCaptured(step=name):
                step = name
            case StepPassed() | StepFailed():
                step = None
            case _:
                pass
    return step


def run(name: str, pressure: Pressure, folder: Path, host: str, longest_s: float) -> dict[str, Any]:
    """One whole run; its figures."""
    data = folder / "data"
    (folder / "rig").mkdir(parents=True)
    protocol = small_demo(folder / "small.yaml", every_step=True)
    killer = Killer(pressure.kills)
    statuses: list[int] = []
    began_s = time.monotonic()
    with (
        group(f"{name.replace(' ', '-')}-all", pressure.everything) as everything,
        group(f"{name.replace(' ', '-')}-program", pressure.program) as program,
        (folder / "log").open("w") as log,
    ):
        groups = (everything, program)
        rig = _begin_rig(folder / "rig", host, log, everything)
        try:
            assert rig.stdout is not None
            ready = json.loads(rig.stdout.readline())
            words = ["run", str(protocol), "--rig", ready["rig"], "--operator", "Ada", "--auto-confirm"]
            ends_s = began_s + longest_s
            while time.monotonic() < ends_s and (not statuses or statuses[-1] != 0):
                player = Person(data, killer, ends_s, program, attends=bool(statuses))
                statuses.append(_drive([*words, "--data", str(data)], log, groups, player))
                program.enlarge_memory(1.25)
                words = ["resume", "latest", "--screens"]
        finally:
            rig.terminate()
            rig.wait(90)
        throttled_s = everything.throttled_s()
    return {
        "pressure": pressure.words,
        "wall_s": round(time.monotonic() - began_s, 1),
        "throttled_s": round(throttled_s, 1),
        "statuses": statuses,
        **_figures(data, killer),
    }


def _begin_rig(folder: Path, host: str, log: Any, everything: Group) -> subprocess.Popen[str]:
    options = (
        "--scene",
        "7",
        "--image-width",
        "600",
        "--speed-up",
        "10",
        *COARSE,
        "--host",
        host,
        "--patience",
        "20",
    )
    return subprocess.Popen(
        [sys.executable, "-m", "simulators", "rig", "--dir", str(folder), "--parent", str(os.getpid()), *options],
        cwd=REPOSITORY, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=log, text=True,
        preexec_fn=everything.enter,  # noqa: PLW1509 - no threads here
    )  # fmt: skip


@dataclass
class Person:
    """Answers what a run asks at its screens, if somebody attends; meanwhile drivers are killed.

    Gives the program more memory where it says that a computation needs more than there is.
    """

    data: Path
    killer: Killer
    ends_s: float
    program: Group
    attends: bool
    asked: int = 0

    def look(self, runner: psutil.Process, log: Any) -> None:
        """Answer a question that is open. Ends the runner when there were too many, or it takes too long."""
        if not (self.data / "orthocapture.sqlite").exists():
            return
        self.killer.look(self.data, runner)
        if time.monotonic() > self.ends_s or self.asked > _MOST_DECISIONS:
            runner.terminate()
        elif self.attends and (verb := _asked(self.data)):
            self.asked += 1
            if _memory_short(self.data):
                self.program.enlarge_memory(1.5)
            words = (
                "act",
                verb,
                "--data",
                str(self.data),
                "--operator",
                "Grace",
                "--meaning",
                "checked and approved",
            )
            subprocess.run(command(*words), cwd=REPOSITORY, stdout=log, stderr=log, check=False)


def _asked(data: Path) -> str:
    """Return what a person has to do now: confirm, sign, or nothing."""
    with Store.open(data, create=False) as store:
        run_id = store.find_run("latest")
        if run_id not in store.driven_runs():
            return ""
        protocol, _ = recorded_run(store, run_id)
        decision = decide(protocol, fold(protocol, store.events(run_id)))
    if not isinstance(decision, AskOperator):
        return ""
    return "sign" if decision.for_ == "sign" else "confirm"


def _memory_short(data: Path) -> bool:
    """Return whether what failed last needs more memory than this machine has."""
    with Store.open(data, create=False) as store:
        events = store.events(store.find_run("latest"))
    failed = [event.payload for event in events if isinstance(event.payload, StepFailed)]
    return bool(failed) and any(text in failed[-1].message for text in ("and this machine has", "MB are free"))


def _drive(words: Sequence[str], log: Any, groups: Sequence[Group], person: Person) -> int:
    """Drive the run until the command ends; its exit status."""

    def enter() -> None:
        for one in groups:
            one.enter()

    with subprocess.Popen(
        command(*words),
        cwd=REPOSITORY,
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=log,
        preexec_fn=enter,  # noqa: PLW1509 - no threads here
    ) as process:
        runner = psutil.Process(process.pid)
        while process.poll() is None:
            time.sleep(1.0)
            with suppress(psutil.Error, OrthocaptureError):  # it ends, or its data folder is being made
                person.look(runner, log)
    return process.returncode


def _figures(data: Path, killer: Killer) -> dict[str, Any]:
    with Store.open(data, create=False) as store:
        run_id = store.find_run("latest")
        events = store.events(run_id)
        protocol, _ = recorded_run(store, run_id)
    steps: dict[str, dict[str, Any]] = {
        step.id: {"kind": step.kind, "began": "", "failed": Counter[str](), "by itself": 0, "asked": 0, "lost": 0}
        for step in protocol.steps
    }
    current = ""
    for event in events:
        match event.payload:
            case StepStarted(step=step):
                current = step
                steps[step]["began"] = steps[step]["began"] or event.at_utc
            case StepFailed(step=step, error=error, recovery=recovery):
                steps[step]["failed"][error] += 1
                steps[step]["by itself"] += recovery == "retry"
                steps[step]["asked"] += recovery != "retry"
            case DeviceTrouble(connection=connection) if connection in ("died", "stalled", "broken") and current:
                steps[current]["lost"] += 1
            case StepPassed(step=step):
                steps[step]["took_s"] = round(seconds_between(steps[step]["began"], event.at_utc), 1)
            case _:
                pass
    views = [event.payload.viewpoint for event in events if isinstance(event.payload, ViewpointCaptured)]
    report = verify(data, run_id)
    for figures in steps.values():
        figures.pop("began")
        figures["failed"] = dict(figures["failed"])
    return {
        "run": run_id,
        "completed": events[-1].payload.kind == "run_completed"
        or any(e.payload.kind == "run_completed" for e in events),
        "aborted": any(e.payload.kind == "run_aborted" for e in events),
        "verified": report.ok,
        "views": len(views),
        "killed_in": sorted(killer.done),
        "steps": steps,
    }


def _table(found: Mapping[str, Any]) -> str:
    lines = [
        "# A machine under pressure",
        "",
        "`python -m bench.torture.pressure`. One small run of the demonstration for each row. Exit statuses:",
        "0 completed, 75 a person must decide; then it is resumed with `--screens`, and a person answers.",
        "",
        "| pressure | run | verified | views | wall, held up | statuses | failures | tried again | asked |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in found["runs"].items():
        steps = row["steps"].values()
        took = f"{row['wall_s']:.0f} s, {row['throttled_s']:.0f} s"
        lines.append(
            f"| {name}: {row['pressure']} | {'completed' if row['completed'] else 'NOT COMPLETED'} | "
            f"{'yes' if row['verified'] else 'NO'} | {row['views']} | {took} | "
            f"{', '.join(map(str, row['statuses']))} | {sum(sum(s['failed'].values()) for s in steps)} | "
            f"{sum(s['by itself'] for s in steps)} | {sum(s['asked'] for s in steps)} |"
        )
    remarks = [f"{name}: {row['remark']}" for name, row in found["runs"].items() if "remark" in row]
    lines += ["", *remarks] if remarks else []
    names = list(found["runs"])
    lines += [
        "",
        f"| step | kind | {' | '.join(f'{name}: s, failures' for name in names)} |",
        "|---|---|" + "---|" * len(names),
    ]
    most = max((row["steps"] for row in found["runs"].values()), key=len)
    for step, figures in most.items():
        rows = [row["steps"].get(step) for row in found["runs"].values()]
        cells = ["" if row is None else _cell(row) for row in rows]
        lines.append(f"| {step} | {figures['kind']} | {' | '.join(cells)} |")
    return "\n".join([*lines, "", f"Machine: {found['machine']}; revision {found['commit']}.", ""])


def _cell(step: Mapping[str, Any]) -> str:
    failed = ", ".join(f"{count} {error}" for error, count in step["failed"].items())
    return f"{step.get('took_s', 'not passed')}{'; ' + failed if failed else ''}"


def main() -> int:
    """Measure, and write the figures; runs that are measured again on the same day replace the earlier ones."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=sorted(PRESSURES), default=list(PRESSURES))
    parser.add_argument("--longest-s", type=float, default=1800.0)
    parser.add_argument("--host", default="127.0.0.66", help="address of the simulated arm")
    options = parser.parse_args()
    day = datetime.datetime.now(datetime.UTC).date().isoformat()
    path = RESULTS / f"pressure-{day}.json"
    complete = True
    for name in options.only:
        with tempfile.TemporaryDirectory(prefix="orthocapture-pressure-") as folder:
            row = run(name, PRESSURES[name], Path(folder), options.host, options.longest_s)
        found: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {"runs": {}}
        runs = found["runs"] | {name: row}
        found = {"runs": {known: runs[known] for known in PRESSURES if known in runs}, "machine": machine()}
        found["commit"] = commit()
        path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        path.with_suffix(".md").write_text(_table(found), encoding="utf-8")
        print(name, row["statuses"], row["wall_s"], flush=True)
        complete = complete and row["completed"] and row["verified"]
    return 0 if complete else 1


if __name__ == "__main__":
    sys.exit(main())
