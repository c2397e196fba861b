"""Runs one case in a process of its own (simulators, proxy, rig, run, person), then applies the rules."""

from __future__ import annotations

import json
import logging
import os
import pickle
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from service.core.errors import OrthocaptureError, StoreError
from service.core.protocol import parse_protocol
from service.core.run.decide import AskOperator, initial_state
from service.core.run.state import RunState
from service.run_start import recorded_run, start_run
from service.runner.loop import Runner
from service.steps import params_models
from service.store.database.engine import database_path
from service.store.store import Store
from service.worker import loop
from tests.support.processes.faulty_disk import FaultyDisk, JumpingClock
from tests.support.rig.bench_rig import BenchArm, BenchCamera
from tests.support.torture.faults.acts import ACTS, MENDS, SEAMS
from tests.support.torture.faults.case import Case
from tests.support.torture.faults.judgement import rules
from tests.support.torture.faults.judgement.verdict import Verdict, errors_of, first_words, listed, masked, policy_of
from tests.support.torture.faults.place.ct_suite import Suite
from tests.support.torture.faults.place.laboratory import (
    CT,
    PROTOCOL,
    SCAN,
    TABLE,
    VIEWS,
    Laboratory,
    Simulators,
    exposed,
    write_rig,
)
from tests.support.torture.faults.place.material import FIVE, make_material, scan_folder
from tests.support.torture.faults.place.newer_rigs import (
    KUKA_STATION,
    TABLE_STATION,
    Film,
    OtherClient,
    gige_rig,
    kuka_rig,
    table_rig,
    video_rig,
)
from tests.support.torture.faults.place.older_rigs import (
    arm_rig,
    camera_rig,
    ct_rig,
    lightbox_rig,
    listen_rig,
    scan_rig,
)
from tests.support.torture.faults.place.person import ArmEye, EndedWaitingError, LeftError, Motions, Person, PlaceEye
from tests.support.torture.faults.wire.proxy import RunningProxy, Wire, start_proxy

STATIONS: dict[str, dict[str, Any]] = {
    "table": {"station": TABLE_STATION, "camera_m": 0.0},
    "kuka": {"station": KUKA_STATION},
    "fri": {"station": KUKA_STATION},
}
_UNSIGNED = "the record could not be signed"
_IMPORTS = ("scan", "ct", "listen")  # scenes without views, whose jobs are worked on here
_CAMERAS = ("camera", "canon", "video", "gige")  # scenes with a real camera
_SESSIONS = 3  # programs that drive the run in turn, if an error ends them


@dataclass
class Session:
    """How one program that drove the run ended: by itself, by an error, or with an open question."""

    status: str = ""
    error: OrthocaptureError | None = None
    open: AskOperator | None = None
    stopped: list[AskOperator] = field(default_factory=list[AskOperator])
    told: list[str] = field(default_factory=list[str])


class Trial:
    """The running case. Acts and repairs (tests/support/torture/faults/acts.py) access the rig through it."""

    def __init__(self, case: Case, folder: Path, seed: int) -> None:
        self.case, self.folder, self.seed = case, folder, seed
        self.data = folder / "data"
        self.simulators = Simulators(folder)
        self.proxy: RunningProxy | None = None
        self.arm_host = f"127.{101 + os.getpid() % 100}.{os.getpid() // 100 % 250}.1"
        self.armed = False
        self.acted = False
        self.ends: list[Callable[[], None]] = []  # clean-up functions
        self.scene_folder = folder / "export"
        self.material = folder.parent / "material"
        self.arm: BenchArm | None = None
        self.shutter: BenchCamera | None = None
        self.disk: FaultyDisk | None = None
        self.clock: JumpingClock | None = None
        self.words: list[str] = []
        self.verdict = Verdict(case.name)
        self.film: Film | None = None
        self.other: OtherClient | None = None
        self.suite: Suite | None = None
        self._eye: Motions = Motions()

    # --- the rig ------------------------------------------------------------------------------------------

    def wired(self, *wires: Wire) -> None:
        """Put the proxy between the driver and these wires, if the case spoils messages."""
        if self.case.spoil is not None:
            self.proxy = start_proxy(list(wires), self.case.spoil, self.folder / "wire.jsonl", self.seed)

    def watch(self, eye: PlaceEye) -> None:
        """Observe the motions of the device through the world."""
        eye.begin()
        self.ends.append(eye.close)
        self._eye = eye

    def stopped(self) -> None:
        """Note that a person stopped the arm now."""
        self._eye.stopped_s.append(time.monotonic())

    def plan(self) -> list[str]:
        """Words that give the simulator the case's faults."""
        return ["--faults", json.dumps(list(self.case.faults))] if self.case.faults else []

    def _laboratory(self) -> Laboratory:
        devices = {
            "arm": lambda: arm_rig(self),
            "camera": lambda: camera_rig(self, "camera"),
            "canon": lambda: camera_rig(self, "canon"),
            "lightbox": lambda: lightbox_rig(self),
            "scan": lambda: scan_rig(self),
            "ct": lambda: ct_rig(self),
            "listen": lambda: listen_rig(self),
            "table": lambda: {"robot": table_rig(self, self.plan())},
            "kuka": lambda: {"robot": kuka_rig(self, self.plan())},
            "fri": lambda: {"robot": kuka_rig(self, self.plan(), fri=True)},
            "video": lambda: {"camera": video_rig(self)},
            "gige": lambda: {"camera": gige_rig(self, self.plan())},
        }
        scene = self.case.scene
        rig = write_rig(self.folder, devices[scene]() if scene in devices else {}, **STATIONS.get(scene, {}))
        self.arm = arm = None if scene in ("arm", "table", "kuka", "fri") else BenchArm()
        self.shutter = shutter = None if scene in _CAMERAS else BenchCamera(picture=exposed)
        if arm is not None:
            arm.on_move = self._eye.began
        elif scene == "arm":
            eye = ArmEye(self.arm_host)
            self.ends.append(eye.close)
            self._eye = eye
        return Laboratory(rig, arm, shutter)

    @property
    def near_host(self) -> str:
        """Address of the driver's end of a wire."""
        return self.arm_host[:-1] + "2"

    # --- the run ------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Run the case to its end, or to the question that is left open."""
        began_s = time.monotonic()
        station = self._laboratory()
        self._log()
        try:
            with Store.open(self.data) as store:
                run_id = self._begin(store, station)
            self._drive(run_id, station)
        finally:
            for end in reversed(self.ends):
                with suppress(OSError):
                    end()
            self.simulators.stop()
            self.verdict.seconds = round(time.monotonic() - began_s, 1)

    def _log(self) -> None:
        """Configure the log; only now, because the forked simulators and the proxy have logs of their own."""
        words = "%(levelname)s %(name)s: %(message)s"
        logging.basicConfig(filename=self.folder / "program.log", level=logging.INFO, format=words)
        for chatty in ("transitions", "alembic"):
            logging.getLogger(chatty).setLevel(logging.WARNING)

    def _begin(self, store: Store, station: Laboratory) -> str:
        text = {"scan": SCAN, "ct": CT, "listen": CT, "table": TABLE}.get(self.case.scene, PROTOCOL)
        distance_m = self.case.value.get("distance_m", 0.5 if self.case.scene == "arm" else 0.6)
        source = text.replace("DISTANCE", str(distance_m)).encode()
        loaded = parse_protocol(source, params_models(), name="faults.yaml")
        return start_run(store, loaded, station.rig, operator="Ada", auto_confirm=False)

    def _drive(self, run_id: str, station: Laboratory) -> None:
        person = Person(fix=self._mend, patience=self.case.patience, look=self._look)
        person.on_prepare = lambda: self._prepare(person.prepared[-1][0])
        person.on_show = lambda _what: self._work()
        self._arm_now(-1)
        status = ""
        for _ in range(_SESSIONS):
            if self.case.scene == "store":
                ended = self._apart(lambda: self._session(run_id, station, person))
            else:
                ended = self._session(run_id, station, person)
            person.open, person.stopped = ended.open, ended.stopped
            status = ended.status
            unsigned = [words for words in ended.told if words.startswith(_UNSIGNED)]
            if ended.error is None and not unsigned:
                break
            if ended.error is None:  # the person reads this, does what it says and resumes; then it is signed
                self.words += unsigned[:1]
                self.verdict.policy.append("told")
                self._mend()
                continue
            # What the command line prints; the person does what it says and resumes.
            self.words.append(str(ended.error))
            self.verdict.policy.append("stop")
            self.verdict.errors.append(type(ended.error).__name__)
            if not rules.tells(str(ended.error)):
                words = f"{type(ended.error).__name__}: {ended.error}"
                self.verdict.broken.append(f"no place or no remedy: {words}")
            self._mend()
        self._judge(run_id, person, status)

    def _session(self, run_id: str, station: Laboratory, person: Person) -> Session:
        """Drive the run to its end, as one program does."""
        ended = Session()
        person.told = []
        try:
            with Store.open(self.data, **SEAMS.get(self.case.act, lambda _trial: {})(self)) as store:
                protocol, _ = recorded_run(store, run_id)
                try:
                    ended.status = Runner(store, run_id, protocol, station, person).run().status
                finally:
                    station.close()
        except LeftError:
            pass
        except EndedWaitingError as waited:
            ended.error = StoreError(str(waited))
        except OrthocaptureError as error:
            ended.error = error
        ended.open, ended.stopped, ended.told = person.open, person.stopped, person.told
        return ended

    def _apart(self, session: Callable[[], Session]) -> Session:
        """Run a session in a forked process, which dies at its end like a program.

        Arm and camera stay in this one.
        """
        path = self.folder / "session.pickle"
        pid = os.fork()
        if pid == 0:
            status = 1
            try:
                ended = session()
                assert self.shutter is not None
                told = (ended, self._eye, self.shutter.exposures, self.disk, self.acted, self.armed)
                path.write_bytes(pickle.dumps(told))
                status = 0
            except BaseException:  # noqa: BLE001 - the case's process reads the status
                traceback.print_exc()
            finally:
                os._exit(status)
        _, status = os.waitpid(pid, 0)
        if status:
            raise RuntimeError("an exception escaped from the program that drives the run")
        ended, self._eye, exposures, self.disk, self.acted, self.armed = pickle.loads(path.read_bytes())
        assert self.shutter is not None
        self.shutter.exposures = exposures
        if self.arm is not None:
            self.arm.on_move = self._eye.began
        return ended

    def _look(self, state: RunState) -> None:
        self._arm_now(len(state.steps["capture"].captured) if "capture" in state.steps else 0)
        if self.suite is not None:
            self.suite.look()
        if state.current and self.case.scene in _IMPORTS:
            self._work()

    def _arm_now(self, captured: int) -> None:
        """Arm the fault once `captured` images are recorded."""
        if self.armed or captured < self.case.after:
            return
        self.armed = True
        if self.proxy is not None:
            self.proxy.arm()
        act = ACTS.get(self.case.act)
        if act is not None:
            act(self)
            self.acted = True

    def _prepare(self, step: str) -> None:
        """Prepare a step, as a technician does."""
        if self.case.scene in ("ct", "listen") and step == "scan":
            scan_folder(self.folder / "scans", self.material, FIVE)

    def _mend(self) -> None:
        mend = MENDS.get(self.case.mend)
        if mend is not None:
            mend(self)
        elif self.proxy is not None and self.case.spoil is not None and self.case.spoil.column.startswith("away_"):
            self.await_return()

    def await_return(self) -> None:
        """Wait until the device is back, unless it never comes back."""
        assert self.proxy is not None
        assert self.case.spoil is not None
        if self.case.spoil.column == "away_never":
            return
        deadline_s = time.monotonic() + 35.0
        while time.monotonic() < deadline_s:
            deeds = self.proxy.deeds()
            if not any(d["what"].startswith("away_") for d in deeds) or deeds[-1]["what"] == "back":
                return
            time.sleep(0.1)

    def _work(self) -> None:
        """Work on jobs in this process, as a worker process does."""
        if self.case.scene not in _IMPORTS:
            return
        if not database_path(self.data).exists():
            return
        with Store.open(self.data) as store:
            if store.open_jobs():
                loop.work(store, until_idle=True, stop=lambda: False, progress=lambda _what, _done, _total: None)

    # --- the verdict --------------------------------------------------------------------------------------

    def _judge(self, run_id: str, person: Person, status: str) -> None:
        verdict = self.verdict
        with Store.open(self.data) as store:
            events = store.events(run_id)
        deeds = self.proxy.deeds() if self.proxy is not None else []
        wire = any(deed["what"] == (self.case.spoil.column if self.case.spoil else "") for deed in deeds)
        disk = self.disk is None or self.disk.failed > 0
        verdict.reached = wire or (self.acted and disk) or bool(self.case.faults)
        verdict.policy = policy_of(events) + verdict.policy
        verdict.errors = list(dict.fromkeys([*errors_of(events), *verdict.errors]))
        verdict.events = {}
        for event in events:
            verdict.events[event.payload.kind] = verdict.events.get(event.payload.kind, 0) + 1
        verdict.words = first_words(events, person.stopped, self.words)
        verdict.end = "completed" if status == "completed" else listed(person.open)
        if not verdict.end:
            verdict.end = f"the run is {status or 'stopped'}"
            verdict.broken.append(f"{verdict.end}, but no way on is listed")
        views = VIEWS if self.case.scene not in _IMPORTS else ()
        logs = (self.folder / "program.log", self.folder / "said.log", self.folder / "received.log")
        if self.suite is not None:
            column = self.case.spoil.column if self.case.spoil else ""
            self.suite.check(content=column not in ("corrupt", "mutated"))
            verdict.broken += self.suite.faults
        verdict.broken += rules.broken(events, self._eye, self.data, views, status, logs)


def prepare_seed(folder: Path) -> Path:
    """Create an empty data folder, which each case copies, and load what all cases need."""
    with Store.open(folder):
        pass
    loaded = parse_protocol(PROTOCOL.replace("DISTANCE", "0.5").encode(), params_models(), name="faults.yaml")
    make_material(folder.with_name("material"))
    initial_state(loaded.protocol)  # builds the table of its states
    return folder


def run_in_child(case: Case, folder: Path, seed: int) -> None:
    """Run the case in the forked process and write verdict.json; an escaping exception is a fault of its own."""
    trial = Trial(case, folder, seed)
    try:
        trial.run()
    except BaseException as error:  # noqa: BLE001 - what nobody has caught is what the sweep looks for
        traceback.print_exc()
        trial.verdict.broken.append(f"{type(error).__name__} escaped: {error}")
    trial.verdict.words = masked(trial.verdict.words, folder)
    (folder / "verdict.json").write_text(json.dumps(trial.verdict.told()))
