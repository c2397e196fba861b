"""Kills every process of a run at random moments, over the real wires, with the programs started as by a user."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.request import urlopen

import numpy as np
import psutil
import yaml

from bench.torture.crash.confirmed import confirmed
from service.core.protocol import Protocol, load_protocol
from service.core.records.events import Event
from service.core.records.run_events import OperatorAction, SessionStarted, ViewpointCaptured
from service.core.run.actions import refuse
from service.core.run.decide import AskOperator, decide
from service.core.run.fold import fold
from service.rig import load_rig
from service.run_start import recorded_run, start_run
from service.steps import params_models
from service.store.disk_space import leftovers, remove_leftovers
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.rig.rig import REPOSITORY, command, simulated_rig, without_calibration_and_ct

_HOST = "127.0.0.71"
_VIEWS = 6
_LONGEST_S = 420.0  # for a run with its kills on a busy machine
_ROBOT_PORTS = {29999, 30001, 30002, 30003, 30004}  # fixed by the manufacturer
_REVIVED_S = 2.0  # time until a killed device is switched on again
_STILL_M = 2e-4  # largest change of the camera's position within 0.2 s that counts as standing still


@dataclass(frozen=True, slots=True)
class Kill:
    """One SIGKILL: the process, the run, and the time since the previous one."""

    what: str
    run: int
    after_s: float


def random_kills(folder: Path, runs: int, kills: int, rng: Random) -> tuple[list[Kill], list[str]]:
    """Run `runs` runs with `kills` kills each; returns the kills, and the faults as sentences."""
    done: list[Kill] = []
    faults: list[str] = []
    targets: list[str] = []
    for number in range(1, runs + 1):
        inside = folder / f"run-{number}"
        inside.mkdir(parents=True)
        while len(targets) < kills:
            targets += rng.sample(_TARGETS, len(_TARGETS))
        mine, targets = targets[:kills], targets[kills:]
        run = _Run(inside, number, rng, mine)
        with simulated_rig(
            inside, "--scene", str(10 + number), "--image-width", "600", "--speed-up", "3",
            "--revive-after-s", str(_REVIVED_S), host=_HOST,
        ) as ready:  # fmt: skip
            run.go(ready)
        targets += run.targets  # these could not be killed before the run ended
        done += run.kills
        faults += [f"random run {number} ({', '.join(k.what for k in run.kills)}): {f}" for f in run.faults]
        print(f"random run {number}: {[k.what for k in run.kills]}, faults: {run.faults}", flush=True)
    return done, faults


_TARGETS = (
    "runner", "runner", "worker", "worker's child", "web",
    "driver of the robot", "driver of the camera",
    "simulated robot", "simulated camera", "simulated light box",
)  # fmt: skip


def protocol_of(folder: Path) -> Path:
    """Write a protocol: a capture over the wires, a scan for the worker, a signature before and after."""
    whole = yaml.safe_load((REPOSITORY / "protocols" / "demo.yaml").read_text())
    steps: dict[str, dict[str, Any]] = {step["id"]: step for step in whole["steps"]}
    capture, scan = steps["viewpoint_capture_1"], steps["control_scan"]
    capture["params"]["viewpoints"][0]["arcs"] = [
        {"tilt_deg": 25, "azimuth_from_deg": -40, "azimuth_to_deg": 40, "count": _VIEWS, "distance_m": 0.62}
    ]
    capture["gates"][0]["min"] = _VIEWS
    without_calibration_and_ct(capture)
    capture["simulated_hands"] = [{"action": "mount_camera"}]
    scan["params"].pop("compare_with")
    scan["gates"] = [gate for gate in scan["gates"] if gate["measure"] == "spheres_found"]
    removal = {**steps["control_sphere_removal"], "requires": [capture["id"]]}
    whole |= {"id": "torture_wires", "title": "A procedure to be killed", "steps": [capture, scan, removal]}
    path = folder / "protocol.yaml"
    path.write_text(yaml.safe_dump(whole, sort_keys=False))
    return path


@dataclass
class _Run:
    """One run with its kills. A person, Grace, answers all questions."""

    folder: Path
    number: int
    rng: Random
    targets: list[str]
    kills: list[Kill] = field(default_factory=list[Kill])
    faults: list[str] = field(default_factory=list[str])
    runner: subprocess.Popen[bytes] | None = None
    web: subprocess.Popen[bytes] | None = None
    port: int = 0

    @property
    def data(self) -> Path:
        """The data folder."""
        return self.folder / "data"

    def go(self, ready: dict[str, Any]) -> None:
        """Begin, kill, resume and answer until the run has ended; then check it."""
        loaded = load_protocol(protocol_of(self.folder), params_models())
        rig = load_rig(Path(ready["rig"]))
        with Store.open(self.data) as store:
            run_id = start_run(store, loaded, rig, operator="Ada", auto_confirm=False)
            protocol, _ = recorded_run(store, run_id)
            eye = _Eye(ready["world"])
            try:
                self._until_completed(store, run_id, protocol, ready)
            finally:
                starts = eye.close()
                for process in (self.runner, self.web):
                    if process is not None:
                        _kill_tree(process.pid)
            self._look(store, run_id, protocol, starts)

    # --- while it goes ---

    def _until_completed(self, store: Store, run_id: str, protocol: Protocol, ready: dict[str, Any]) -> None:
        self.port = _free_port()
        self.web = self._start("serve", "--rig", ready["rig"], "--port", str(self.port))
        began_s = since_s = time.monotonic()
        next_s = since_s + self.rng.uniform(2, 12)
        while True:
            if time.monotonic() - began_s > _LONGEST_S:
                state = fold(protocol, store.events(run_id))
                self.faults.append(f"it did not come to its end: {state.current}, {state.phase}")
                return
            if self.runner is None or self.runner.poll() is not None:
                if fold(protocol, store.events(run_id)).terminal:
                    break
                self.runner = self._start("resume", run_id, "--screens")
            self._answer(store, run_id, protocol)
            if self.targets and time.monotonic() > next_s:
                pid = self._find(self.targets[0], ready)
                if pid is not None:
                    with suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)
                        self.kills.append(Kill(self.targets.pop(0), self.number, time.monotonic() - since_s))
                        since_s = time.monotonic()
                        next_s = since_s + self.rng.uniform(1, 15)
            if self.web.poll() is not None:
                self.web = self._start("serve", "--rig", ready["rig"], "--port", str(self.port))
            time.sleep(0.1)
        if not self._web_answers():
            self.faults.append("the pages do not answer at the end")

    def _answer(self, store: Store, run_id: str, protocol: Protocol) -> None:
        """Do what `orthocapture act` does, once a runner of this session is there."""
        events = store.events(run_id)
        if not store.driven(run_id) or self.runner is None or _session(events) != self.runner.pid:
            return
        state = fold(protocol, events)
        question = decide(protocol, state)
        if not isinstance(question, AskOperator):
            return
        verb = "sign" if question.for_ == "sign" else "confirm"
        action = OperatorAction(
            action=verb,
            step=question.step,
            checklist=protocol.step(question.step).checklist if verb == "confirm" else (),
            meaning="reviewed" if verb == "sign" else "",
            signed_sha256=question.sign_sha256 if verb == "sign" else "",
        )
        refusal = refuse(protocol, state, action, "Grace")
        if refusal is None:
            store.record(run_id, [action], actor="Grace")

    def _start(self, *words: str) -> subprocess.Popen[bytes]:
        with (self.folder / f"{words[0]}.log").open("ab") as log:
            return subprocess.Popen(
                command(*words, "--data", str(self.data)),
                cwd=REPOSITORY, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True,
            )  # fmt: skip

    def _find(self, what: str, ready: dict[str, Any]) -> int | None:
        """The pid of a living process of this kind; None if there is none."""
        mine = psutil.Process()
        for process in mine.children(recursive=True):
            with suppress(psutil.Error):
                if _is(what, process, ready["rig"]) and process.status() != psutil.STATUS_ZOMBIE:
                    return process.pid
        return None

    def _web_answers(self) -> bool:
        deadline_s = time.monotonic() + 60
        while time.monotonic() < deadline_s:
            try:
                with urlopen(f"http://127.0.0.1:{self.port}/", timeout=5):
                    return True
            except HTTPError:
                return True  # it responds and asks for a sign-in
            except (URLError, OSError):
                time.sleep(0.5)
        return False

    # --- at the end ---

    def _look(self, store: Store, run_id: str, protocol: Protocol, starts: Sequence[float]) -> None:
        events = store.events(run_id)
        state = fold(protocol, events)
        if not self.faults and state.status != "completed":
            self.faults.append(f"the run is {state.status}")
        taken = Counter(e.payload.viewpoint for e in events if isinstance(e.payload, ViewpointCaptured))
        expected = {f"v1_{i:03d}": 1 for i in range(1, _VIEWS + 1)}
        if dict(taken) != expected:
            self.faults.append(f"viewpoints were recorded {dict(taken)} times")
        self.faults += [str(fault) for fault in verify(self.data).faults]
        for moment in starts:
            if not confirmed(events, protocol, moment):
                self.faults.append(f"the arm began to move at {moment:.1f} s, which nobody had confirmed")
        remove_leftovers(store, actor="Grace", min_age_s=0)
        if leftovers(store, min_age_s=0) or not verify(self.data).ok:
            self.faults.append("leftovers are left, or something of the record was taken with them")


def _is(what: str, process: psutil.Process, rig: str) -> bool:
    """Return whether a process is of the kind to be killed. Raises psutil.Error if it has ended meanwhile."""
    words = " ".join(process.cmdline())
    simulators = {"simulated robot": " ur ", "simulated camera": " camera ", "simulated light box": " lightbox "}
    if what in simulators:
        return "-m simulators" in words and simulators[what] in words and "--parent" in words
    if what.startswith("driver of"):
        return "-m drivers.host" in words and what == _driver(process)
    match what:
        case "runner":
            return "service.cli.main resume" in words
        case "worker":
            return "service.cli.main worker" in words
        case "worker's child":
            return "multiprocessing.spawn" in words and "spawn_main" in words
        case _:
            return "service.cli.main serve" in words and rig in words


def _driver(process: psutil.Process) -> str:
    """The device of a driver's process, found by its connections; the light box's driver has no process."""
    ports = {link.raddr.port for link in process.net_connections("tcp") if link.raddr}
    if ports & _ROBOT_PORTS:
        return "driver of the robot"
    return "driver of the camera" if ports else ""


def _session(events: Sequence[Event]) -> int:
    """The pid of the process that drives the run now, from its last session."""
    return next((e.payload.pid for e in reversed(events) if isinstance(e.payload, SessionStarted)), 0)


class _Eye:
    """Polls the laboratory five times a second and records when the arm began to move."""

    def __init__(self, world: str) -> None:
        host, _, port = world.rpartition(":")
        self._link = socket.create_connection((host, int(port)), timeout=30)
        self._over = threading.Event()
        self._starts: list[float] = []
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def close(self) -> list[float]:
        """Stop; returns the moments in monotonic seconds."""
        self._over.set()
        self._thread.join()
        self._link.close()
        return self._starts

    def _watch(self) -> None:
        lines = self._link.makefile()
        before = None
        moving = True  # a motion in progress at the start was not seen to begin
        while not self._over.wait(0.2):
            looked_s = time.monotonic()
            with suppress(OSError, ValueError):
                self._link.sendall(b'{"op": "view"}\n')
                here = np.array(json.loads(lines.readline())["T_world_camera"])[:3, 3]
                moves = before is not None and float(np.linalg.norm(here - before)) > _STILL_M
                if moves and not moving:
                    self._starts.append(looked_s)
                before, moving = here, moves


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _kill_tree(pid: int) -> None:
    with suppress(psutil.Error):
        process = psutil.Process(pid)
        for one in (*process.children(recursive=True), process):
            one.kill()
        process.wait(timeout=10)
