"""`captures`: the real programs capture on a simulated rig for an hour; their memory and files must not creep up.

The programs are `simulate rig` (with a sped-up arm), `run` with its driver processes and its worker, and `serve`,
whose pages are read all the time. A simulated person types the answers to the run's questions (person.py).
Every few seconds memory (its own and resident), descriptors and threads of every process are sampled, and the sizes
of the database, write-ahead log and logs. After a warm-up a line is fitted over the number of captures, which
creep.py judges.
"""

from __future__ import annotations

import subprocess
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import psutil
import yaml

from service.core.records.events import Payload
from service.core.records.run_events import ViewpointCaptured
from service.core.run.state import RunState
from service.followed_run import RunFollower
from service.run_start import recorded_run
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.pages.accounts import PASSWORD, invite_people
from tests.support.pages.serving import Server, serving
from tests.support.rig.rig import REPOSITORY, command, simulated_rig, without_calibration_and_ct
from tests.support.soak.creep import CHILD, FEWEST, Sample, judge, warmed_up
from tests.support.soak.person import Typist

_HOST = "127.0.0.81"
_SPEED_UP = 20
_WIDTH_PX = 640
_ROBOT_PORTS = {29999, 30001, 30002, 30003, 30004}  # fixed by the manufacturer
_LONGEST_S = 600.0  # until the first capture on a busy machine, and beyond the time until there are enough samples
_LOOK_S = 0.5  # between two page requests
_ENDS_S = 120.0  # for the runner to end after it was told to


def captures(folder: Path, minutes: float, every_s: float, planned: int, *, calibrated: bool) -> dict[str, Any]:
    """Capture for `minutes`, or for longer until there are enough samples; returns samples, fitted lines and faults.

    `planned` and `calibrated` are those of `protocol_of`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rig = folder / "rig"
    rig.mkdir()
    options = ("--scene", "7", "--image-width", str(_WIDTH_PX), "--speed-up", str(_SPEED_UP))
    with simulated_rig(rig, *options, host=_HOST) as ready, serving(rig / "rig.yaml") as server:
        soak = _Soak(
            rig / "data",
            protocol_of(folder, planned, calibrated=calibrated),
            Path(ready["rig"]),
            server,
            folder / "run.log",
        )
        soak.go(60 * minutes, every_s)
    report = verify(rig / "data")
    faults = soak.faults + [str(fault) for fault in report.faults]
    if (folder / "run.log").read_text().count("Traceback"):
        faults.append(f"the runner wrote a traceback: {(folder / 'run.log').read_text()[-500:]}")
    found = judge(soak.samples)
    return {
        "minutes": minutes,
        "captured": soak.samples[-1].captured if soak.samples else 0,
        "pages": soak.pages,
        "events": report.events,
        "jobs": report.jobs,
        "stops": soak.stops,
        "samples": len(soak.samples),
        **found,
        "faults": faults + found["faults"],
    }


def protocol_of(folder: Path, planned: int, *, calibrated: bool) -> Path:
    """Write a protocol that captures `planned` viewpoints at one station; returns the file.

    If `calibrated`, a camera calibration precedes the capture and a registration is planned after it but never
    reached, so the worker computes features and matches for every image. Live predictions are left out: each of their
    jobs reads what was found in all images before it, so their cost is not linear (docs/howto/soak.md).
    """
    whole = yaml.safe_load((REPOSITORY / "protocols" / "demo.yaml").read_text())
    steps: dict[str, dict[str, Any]] = {step["id"]: step for step in whole["steps"]}
    capture = steps["viewpoint_capture_1"]
    capture["params"]["viewpoints"][0]["arcs"] = [
        {"tilt_deg": 25, "azimuth_from_deg": -45, "azimuth_to_deg": 45, "count": planned, "distance_m": 0.64}
    ]
    capture["gates"][0]["min"] = planned
    if calibrated:
        capture["params"].pop("live")
        not_measured = ("predicted_target_error_mm", "specimen_coverage")
        capture["gates"] = [gate for gate in capture["gates"] if gate["measure"] not in not_measured]
        scan, registration = steps["scanning"], steps["registration"]
        scan["params"] = {"spheres": 10, "wait_s": 60}
        scan["gates"] = [gate for gate in scan["gates"] if gate["measure"] == "spheres_found"]
        registration["params"] |= {"images_of": [capture["id"]], "control_images_of": []}
        before = [steps[name] for name in ("camera_set_up", "camera_calibration", "board_removal")]
        whole["steps"] = [*before, capture, scan, registration]
    else:
        without_calibration_and_ct(capture)
        capture["simulated_hands"] = [{"action": "mount_camera"}]
        whole["steps"] = [capture]
    whole |= {"id": "soak", "title": "A capture that does not end"}
    path = folder / "protocol.yaml"
    path.write_text(yaml.safe_dump(whole, sort_keys=False))
    return path


@dataclass
class _Soak:
    data: Path
    protocol: Path
    rig: Path
    server: Server
    log: Path
    samples: list[Sample] = field(default_factory=list[Sample])
    faults: list[str] = field(default_factory=list[str])
    pages: int = 0
    stops: int = 0  # of the arm by its watchdog, after each of which the person let it go on

    def go(self, seconds: float, every_s: float) -> None:
        """Run, read pages and sample until the time is up and there are enough samples; then end all processes."""
        words = ("run", str(self.protocol), "--rig", str(self.rig), "--data", str(self.data))
        headers = self.server.signed_in()
        invite_people(self.data, [("tina", "technician")])
        with self.log.open("wb") as log:
            runner = subprocess.Popen(
                command(*words, "--operator", "tina", "--password-stdin", "--specimen", "soak", "--json"),
                cwd=REPOSITORY, stdin=subprocess.PIPE, stdout=log, stderr=log,
            )  # fmt: skip
        try:
            assert runner.stdin is not None
            runner.stdin.write(f"{PASSWORD}\n".encode())
            runner.stdin.flush()
            with httpx.Client(base_url=self.server.url, headers=headers, timeout=60) as client:
                self._follow(runner, client, seconds, every_s)
        finally:
            runner.terminate()
            with suppress(subprocess.TimeoutExpired):
                runner.wait(timeout=_ENDS_S)
            if runner.poll() is None:
                self.faults.append(f"the runner had not ended {_ENDS_S:.0f} s after SIGTERM")
                runner.kill()
                runner.wait()
            if runner.stdin is not None:
                with suppress(OSError):  # what the person typed last found nobody
                    runner.stdin.close()

    def _follow(self, runner: subprocess.Popen[bytes], client: httpx.Client, seconds: float, every_s: float) -> None:
        gives_up_s = time.monotonic() + _LONGEST_S
        ends_s = next_s = 0.0
        told_s = time.monotonic()
        assert runner.stdin is not None
        person = Typist(runner.stdin)
        with Store.open(self.data) as store:
            run: RunFollower | None = None
            count = seen = 0
            while not ends_s or time.monotonic() < ends_s or self._has_too_few_samples(ends_s):
                if runner.poll() is not None:
                    self.faults.append(f"the run ended by itself: {self.log.read_text()[-500:]}")
                    return
                if run is None and store.runs():
                    run_id = store.find_run("latest")
                    run = RunFollower(store, run_id, recorded_run(store, run_id)[0])
                if run is not None:
                    log = run.now()
                    count += sum(_is_of_the_capture(event.payload) for event in log.events[seen:])
                    seen = len(log.events)
                    self._look(client, log.run_id, log.state)
                    person.answer(log)
                    self.stops = person.stops
                    if person.puzzled:
                        self.faults.append(f"the run stopped: {person.puzzled}")
                        return
                if count and not ends_s:
                    ends_s = time.monotonic() + seconds
                if not ends_s and time.monotonic() > gives_up_s:
                    self.faults.append(f"nothing was captured: {self.log.read_text()[-500:]}")
                    return
                if count and time.monotonic() >= next_s:
                    next_s = time.monotonic() + every_s
                    self.samples.append(self._sample(runner.pid, count))
                if time.monotonic() - told_s > 60:
                    told_s = time.monotonic()
                    print(f"captures: {count} so far, {person.stops} stops", flush=True)
                time.sleep(_LOOK_S)

    def _has_too_few_samples(self, ends_s: float) -> bool:
        """Return whether a busy machine has left too few samples to fit lines to, which more time may mend."""
        return len(warmed_up(self.samples)) < FEWEST and time.monotonic() < ends_s + _LONGEST_S

    def _look(self, client: httpx.Client, run: str, state: RunState) -> None:
        """Request what an open page requests after each event, and whole pages in turn."""
        whole = ("/", f"/runs/{run}", f"/runs/{run}/capture", f"/audit/runs/{run}", "/metrics", "/health")
        parts = (f"/runs/{run}/parts/banner,control,vitals,step", f"/runs/{run}/capture/parts/image,plan,sheet")
        for address in (whole[self.pages % len(whole)], *parts):
            try:
                answer = client.get(address)
            except httpx.HTTPError as error:
                self.faults.append(f"{address} did not answer at event {state.seq}: {error!r}")
                return
            if answer.status_code != 200:
                self.faults.append(f"{address} answers {answer.status_code}: {answer.text[:200]}")
        self.pages += 1

    def _sample(self, runner: int, count: int) -> Sample:
        processes: dict[str, dict[str, float]] = {}
        children = 0
        for process in sorted(psutil.Process().children(recursive=True), key=lambda p: p.pid):
            with suppress(psutil.Error):
                name = role_of(process, runner)
                if name == CHILD:  # there are several, and they stay open
                    children += 1
                    name = f"{name} {children}"
                if name:
                    processes[name] = figures_of(process)
        sizes = {
            "database": _size(self.data / "orthocapture.sqlite"),
            "write-ahead log": _size(self.data / "orthocapture.sqlite-wal"),
            "logs": sum(_size(path) for path in (self.data / "logs").glob("*")),
            "monitor": sum(_size(path) for path in (self.data / "monitor").glob("*")),
        }
        return Sample(time.monotonic(), count, processes, sizes)


def _is_of_the_capture(payload: Payload) -> bool:
    return isinstance(payload, ViewpointCaptured) and payload.step == "viewpoint_capture_1"


def role_of(process: psutil.Process, runner: int) -> str:
    """The role of a process in a word or two; "" if it is not part of the run. Raises psutil.Error."""
    words = " ".join(process.cmdline())
    if process.pid == runner:
        return "runner"
    if "-m drivers.host" in words:
        ports = {link.raddr.port for link in process.net_connections("tcp") if link.raddr}
        return "driver of the robot" if ports & _ROBOT_PORTS else "driver of the camera"
    named = {
        "service.cli.main worker": "worker",
        "service.cli.main serve": "web",
        "simulators ur ": "simulated robot",
        "simulators camera ": "simulated camera",
        "simulators lightbox ": "simulated light box",
        "simulators rig ": "simulated rig",
    }
    if "multiprocessing.spawn" in words:
        return CHILD
    return next((name for part, name in named.items() if part in words), "")


def figures_of(process: psutil.Process) -> dict[str, float]:
    """Memory, descriptors and threads of one process. Raises psutil.Error.

    Its own memory is anonymous memory. The unique set size (USS) also counts pages of libraries while no other
    process maps them, and so changes by megabytes when another program on the machine begins or ends.
    """
    descriptors, of_database = _descriptors(process.pid)
    return {
        "own_mb": _anonymous_bytes(process.pid) / 1e6,
        "rss_mb": process.memory_info().rss / 1e6,
        "descriptors": float(descriptors - of_database),
        "database_descriptors": float(of_database),
        "threads": float(process.num_threads()),
    }


def _anonymous_bytes(pid: int) -> int:
    """Memory that no file backs, swapped out or not. Raises psutil.Error."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except (FileNotFoundError, ProcessLookupError) as error:
        raise psutil.NoSuchProcess(pid) from error
    return sum(1024 * int(line.split()[1]) for line in lines if line.startswith(("Anonymous:", "Swap:")))


def _descriptors(pid: int) -> tuple[int, int]:
    """The number of open descriptors, and how many of them are of the database. Raises psutil.Error."""
    targets: list[str] = []
    try:
        for link in Path(f"/proc/{pid}/fd").iterdir():
            with suppress(FileNotFoundError):  # closed since
                targets.append(str(link.readlink()))
    except (FileNotFoundError, ProcessLookupError) as error:
        raise psutil.NoSuchProcess(pid) from error
    return len(targets), sum("orthocapture.sqlite" in target for target in targets)


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
