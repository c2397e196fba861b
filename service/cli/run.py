"""`orthocapture run` and `resume`: run a protocol from its first step to its last, with the worker beside it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Annotated, cast

import psutil
import typer

from drivers.interfaces import Camera, Lightbox, RobotArm
from service.cli.common import (
    DEFAULT_DATA,
    PROTOCOL_HELP,
    DataOption,
    JsonOption,
    RunArgument,
    console,
    error_console,
    print_json,
    protocol_file,
    reporting_errors,
)
from service.cli.ending import ExitStatus, stop_requested
from service.cli.operators import (
    AutomaticOperator,
    Display,
    ImportOperator,
    ScreenOperator,
    SimulatedHands,
    TerminalOperator,
)
from service.cli.options import (
    OperatorOption,
    PasswordOption,
    PurposeOption,
    RemarksOption,
    SiteOption,
    SpecimenOption,
    acting_person,
    described,
)
from service.cli.runs import status_record
from service.core.errors import ConfigurationError, PersonNeededError
from service.core.protocol import Protocol, load_protocol
from service.core.records.entered import about_run
from service.core.run.fold import fold
from service.core.run.state import RunState
from service.followed_run import RunFollower
from service.logs import file_log
from service.monitor.alarm import alarm_of
from service.monitor.reporter import OpenDevices, Reporter
from service.people.approvals import approve
from service.people.sessions import Identity, People
from service.rig import Rig, load_rig
from service.run_record import results_to_come
from service.run_start import (
    recorded_rig,
    recorded_run,
    require_rig_free,
    require_runnable,
    require_simulated,
    second_place,
    start_run,
    time_stamp_authority,
)
from service.runner.loop import Runner
from service.station import Station, devices_of, layout_of
from service.steps import params_models
from service.steps.due_jobs import duration_words
from service.store.data_folder import kept_to
from service.store.signatures.second_place import away_words
from service.store.signatures.timestamps import stamp_end
from service.store.store import Store


@contextmanager
def sigterm_like_ctrl_c() -> Generator[None]:
    """Let SIGTERM end this block like Ctrl-C: devices and lease are released, and started processes are ended."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def end_with_children(process: subprocess.Popen[bytes] | subprocess.Popen[str], grace_s: float) -> None:
    """Terminate a process; whatever is left of it and its children after `grace_s` is killed."""
    children = _children(process)
    process.terminate()
    try:
        process.wait(timeout=grace_s)
    except subprocess.TimeoutExpired:
        children += _children(process)  # those that it has started meanwhile
        process.kill()
        process.wait()
        grace_s = 0.0
    _, left = psutil.wait_procs(children, timeout=grace_s)
    for child in left:
        child.kill()


def _children(process: subprocess.Popen[bytes] | subprocess.Popen[str]) -> list[psutil.Process]:
    if process.poll() is not None:
        return []
    try:
        return psutil.Process(process.pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


_GRACE_S = 10.0
_POLL_S = 0.5
_FIRST_WAIT_S, _LONGEST_WAIT_S = 1.0, 60.0  # before a dead worker is replaced; doubled each time


@contextmanager
def worker_beside(data: Path, tell: Callable[[str], object]) -> Generator[None]:
    """Run a worker process until the end of this block or of this process; `tell` is called when one dies."""
    beside = _WorkerProcess(data, tell)
    keeper = threading.Thread(target=beside.keep, name="keeper of the worker", daemon=True)
    keeper.start()
    try:
        yield
    finally:
        beside.over.set()
        keeper.join()
        beside.end()


class _WorkerProcess:
    def __init__(self, data: Path, tell: Callable[[str], object]) -> None:
        self.over = threading.Event()
        self._tell = tell
        # Pass the parent's process id: a worker that asks for it itself may ask after the parent has died.
        words = ["worker", "--data", str(data), "--json", "--parent", str(os.getpid())]
        self._command = [sys.executable, "-m", "service.cli.main", *words]
        self._process = self._start()

    def keep(self) -> None:
        """Replace the worker whenever it dies, until `over`. Its successor begins the interrupted job again."""
        wait_s = _FIRST_WAIT_S
        while not self.over.wait(_POLL_S):
            status = self._process.poll()
            if status is None:
                continue
            self._tell(f"the worker process has ended (status {status}); another one is started")
            if self.over.wait(wait_s):
                return
            wait_s = min(2 * wait_s, _LONGEST_WAIT_S)
            try:
                self._process = self._start()
            except OSError as error:  # for want of memory, say
                self._tell(f"no worker could be started: {error.strerror}")

    def end(self) -> None:
        """End the worker and all its child processes. The next worker begins a job that was killed again."""
        end_with_children(self._process, _GRACE_S)

    def _start(self) -> subprocess.Popen[bytes]:
        # In its own session, so that Ctrl-C reaches only the runner, which ends its worker in an orderly way.
        return subprocess.Popen(
            self._command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, start_new_session=True
        )


_LOOK_S = 2.0  # reading a whole run takes a sixth of a second, which the computation also needs


def wait_for_results(store: Store, run_id: str, protocol: Protocol, display: Display) -> None:
    """Show what is still being computed until all is done; Ctrl-C leaves it to another worker and loses nothing."""
    run = RunFollower(store, run_id, protocol)
    pending = [one for one in results_to_come(run.now()) if not one.failed]
    if not pending or not store.open_jobs(run_id):
        return
    display.tell("The run is complete. Results for comparison are still being computed; Ctrl-C leaves them for later")
    seen: set[str] = set()
    total = len(pending)
    try:
        with stop_requested() as leave:  # an exception could get lost in a finaliser or callback
            while store.open_jobs(run_id) and not leave.is_made():
                left = results_to_come(run.now())
                for one in left:
                    if one.failed and one.name not in seen:
                        seen.add(one.name)
                        display.tell(one.text)
                pending = [one for one in left if not one.failed]
                last_s = max((one.seconds for one in pending), default=0.0)
                names = ", ".join(one.name for one in pending[:3]) + (" …" if len(pending) > 3 else "")
                display.show(
                    f"{names or 'computing'}: about {duration_words(last_s)} left", total - len(pending), total
                )
                leave.wait(_LOOK_S)
    finally:
        display.clear()
    if leave.is_made():
        data = store.database_path.parent
        display.tell(f"Left for later: `orthocapture worker --data {data} --until-idle` computes what is missing")


RigOption = Annotated[Path, typer.Option("--rig", help="The rig file: devices and stations of this site.")]
AutoOption = Annotated[
    bool,
    typer.Option(
        "--auto-confirm",
        help="Answer every question automatically; simulated rigs only. Ends with 75 where a person must decide.",
    ),
]
WorkerOption = Annotated[
    bool, typer.Option("--worker/--no-worker", help="Compute in this command, or leave it to other workers.")
]


def run_command(
    protocol: Annotated[Path, typer.Argument(help=PROTOCOL_HELP)],
    rig: RigOption,
    data: DataOption = DEFAULT_DATA,
    operator: OperatorOption = "",
    auto_confirm: AutoOption = False,
    worker: WorkerOption = True,
    password_stdin: PasswordOption = False,
    approve_change: Annotated[
        str,
        typer.Option("--approve-change", help="Reason to approve a protocol whose content has changed."),
    ] = "",
    specimen: SpecimenOption = "",
    purpose: PurposeOption = "",
    site: SiteOption = "",
    remarks: RemarksOption = "",
    json: JsonOption = False,
) -> None:
    """Run a protocol step by step. Nothing moves before you have confirmed it."""
    with reporting_errors(json):
        loaded = load_protocol(protocol_file(protocol), params_models())
        rig_file = load_rig(rig)
        if auto_confirm:
            require_simulated(rig_file)
        require_runnable(loaded, rig_file, devices_of(rig_file))
        if auto_confirm:  # nobody attends: a simulated rig has the specimen of its scene
            about = about_run(specimen=specimen, purpose=purpose, site=site, text=remarks)
        else:
            about = described(specimen, purpose=purpose, site=site, remarks=remarks)
        with Store.open(data) as store:
            who = acting_person(store, operator, "operate", password_stdin=password_stdin)
            if not auto_confirm:  # simulated rigs need no approval
                approve(store, loaded, who.name, reason=approve_change, identified=who.identified)
            run_id = start_run(store, loaded, rig_file, operator=who.name, auto_confirm=auto_confirm, about=about)
            with _waiting_run_named(run_id, data):
                state = drive(store, run_id, rig_file, data=data, auto_confirm=auto_confirm, worker=worker, who=who)
        _report_end(run_id, state, json=json)


def resume_command(
    run: RunArgument = "latest",
    data: DataOption = DEFAULT_DATA,
    auto_confirm: AutoOption = False,
    worker: WorkerOption = True,
    screens: Annotated[
        bool, typer.Option("--screens", help="Questions are answered in the browser (`orthocapture serve`).")
    ] = False,
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    json: JsonOption = False,
) -> None:
    """Continue a run after a crash, a power failure or a pause; nothing captured is lost or taken twice."""
    with reporting_errors(json), Store.open(data, create=False) as store:
        run_id = store.find_run(run)
        _, root = recorded_run(store, run_id)
        rig = recorded_rig(store, root)
        who = None
        if not (auto_confirm or screens):
            who = acting_person(store, operator or root.operator, "operate", password_stdin=password_stdin)
        with _waiting_run_named(run_id, data):
            state = drive(
                store, run_id, rig, data=data, auto_confirm=auto_confirm, worker=worker, screens=screens, who=who
            )
        _report_end(run_id, state, json=json)


@contextmanager
def _waiting_run_named(run_id: str, data: Path) -> Generator[None]:
    """Let the error of a run that waits for a person name the run; say after Ctrl-C how to continue it."""
    try:
        yield
    except KeyboardInterrupt:
        error_console.print(f"Run {run_id} stays open. Continue it with: orthocapture resume {run_id} --data {data}")
        raise
    except PersonNeededError as error:
        where = f"run {run_id}, {error.where}".removesuffix(", ")
        raise PersonNeededError(error.what, where=where, remedy=error.remedy) from error


def drive(
    store: Store,
    run_id: str,
    rig: Rig,
    *,
    data: Path,
    auto_confirm: bool,
    worker: bool,
    screens: bool = False,
    who: Identity | None = None,
) -> RunState:
    """Run the runner in this process, with a worker beside it, until the run ends.

    Args:
        store: the store of the data folder `data`.
        run_id: the run.
        rig: its devices.
        data: the data folder.
        auto_confirm: a simulated technician answers every question.
        worker: start a worker process beside the run.
        screens: people answer in the browser.
        who: the person at this terminal; None if nobody answers there.
    """
    protocol, root = recorded_run(store, run_id)
    require_rig_free(store, rig.path, run_id=run_id)
    station = Station(rig)
    clock = store.clock
    alarm = alarm_of(rig, run_id, clock)
    reporter = Reporter(data, run_id, partial(open_devices, station), station.camera_named, alarm, clock=clock)
    display = Display(error_console, reporter)
    hands = SimulatedHands(rig.section.hands if rig.section.simulated else None)
    if auto_confirm:
        require_simulated(rig)
        operator = AutomaticOperator(root.operator, protocol, display, hands)
    elif screens or who is None:
        operator = ScreenOperator(root.operator, protocol, display, hands)
    elif rig.section.imported is not None:
        listing = rig.section.imported
        operator = ImportOperator(who.name, protocol, display, hands, people=People(store), who=who, listing=listing)
    else:
        preview = partial(_preview, protocol, rig)
        operator = TerminalOperator(
            who.name, protocol, display, hands, preview=preview, people=People(store), who=who
        )
    beside = worker_beside(data, error_console.print) if worker else nullcontext()
    with sigterm_like_ctrl_c(), kept_to(data), file_log(data, "runner", run=run_id), beside:
        authority, elsewhere = time_stamp_authority(rig), second_place(rig, store)
        reporter.begin()
        try:
            state = Runner(store, run_id, protocol, station, operator, authority, elsewhere).run()
            reporter.outcome = f"it is {state.status}: {state.stop_reason}".removesuffix(": ")
        finally:
            reporter.end()
            display.clear()
            operator.close()
            station.close()
        if worker and state.status == "completed":
            wait_for_results(store, run_id, protocol, display)
            stamp_end(store, run_id, authority)
            away = elsewhere.update()
            if away is not None:
                error_console.print(away_words(away), markup=False)
            state = fold(protocol, store.events(run_id))
        return state


def open_devices(station: Station) -> OpenDevices:
    """Return the devices that are open now, for the screens."""
    return OpenDevices(
        robots=cast(dict[str, RobotArm], station.opened("robot")),
        cameras=cast(dict[str, Camera], station.opened("camera")),
        lightboxes=cast(dict[str, Lightbox], station.opened("lightbox")),
    )


def _preview(protocol: Protocol, rig: Rig, step: str) -> str:
    """Describe what a capture step will do for the person who is asked to confirm it."""
    # Planning takes half a second to load, which a run that is answered on the screen does without.
    from service.steps.plan_preview import preview_board_poses, preview_plans  # noqa: PLC0415

    try:
        plans = preview_plans(protocol, protocol.step(step), rig, partial(layout_of, rig))
        board = preview_board_poses(protocol, protocol.step(step), rig, partial(layout_of, rig))
    except ConfigurationError as error:
        return str(error)
    return "; ".join([plan.text for plan in plans] + ([board.text] if board is not None else []))


def _report_end(run_id: str, state: RunState, *, json: bool) -> None:
    if json:
        print_json(status_record(run_id, state))
    else:
        console.print(f"Run {run_id} is {state.status}; {state.deviations_told}. Evidence: audit verify")
    if state.status != "completed":
        raise typer.Exit(ExitStatus.FAILED)
