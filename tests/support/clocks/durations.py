"""The durations that gates and timers judge, each with the code that judges it."""

from __future__ import annotations

import os
from datetime import UTC, datetime
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import patch

import numpy as np
import trimesh
from psutil import boot_time
from sqlalchemy import update

from drivers.photo_watch import PhotoWatch, PhotoWatchConfig
from service.core.records.base import elapsed
from service.core.records.run_events import OperatorAction, SessionStarted
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from service.monitor.figures import read_health
from service.monitor.reporter import OpenDevices, Reporter
from service.monitor.snapshot import (
    STALE_S,
    SignOfLife,
    ask_for_frames,
    frame_path,
    frames_wanted,
    living_workers,
    read_snapshot,
    write_frame,
)
from service.steps.context import StepContext
from service.steps.held_camera import new_images
from service.store.database.tables import jobs, leases
from service.store.disk_space import USUAL_AGE_S, remove_leftovers
from service.store.durable_effects import moment_of
from service.store.records import NewJob
from service.web.media import live_view
from service.web.site import Site
from tests.support.clocks.world import Duration, Seen, World, above, allows, below
from tests.support.record.store import enqueue, put_image, start_run
from tests.support.rig.bench_rig import BenchRig, answer
from tests.support.rig.card import photograph, put
from tests.support.runs.bench_run import say
from tests.support.runs.computing_run import OneScanner, begin_computing_run

_LEASE_S, _COAT_S = 30.0, 2700.0
_RENEWED_S = 10.0  # a third of a lease
_CENTRES_MM = np.array([[60, 0, 20], [-55, 30, 35], [-50, -45, 15], [30, 55, 50], [25, -60, 30]], dtype=float)
_PROTOCOL = """\
id: scanned
version: "1"
title: A scan
spheres: {radius_mm: 6, registration: 5, control: 0}
camera: {aperture_f: 22, exposure_s: 1/50, iso: 100}
steps:
  - id: waiting
    kind: checklist
    title: Scan the specimen
    checklist: [scanned]
    gates: [{measure: checklist_items_open, max: 0}]
  - id: scan
    kind: scan_import
    title: Import the scan
    params: {spheres: 5, wait_s: 20}
    gates: [{measure: faces, min: 1}]
    recovery: {retries: 0}
"""


def _coat(world: World, true_s: float) -> Seen:
    applied = moment_of(world.clock)
    world.wait(true_s)
    age = elapsed(applied, moment_of(world.clock))
    passes = age.seconds is not None and age.seconds <= _COAT_S
    return Seen(passes, "the gate passes" if passes else age.why or "the gate does not pass", age.seconds)


# --- runs, jobs and files -------------------------------------------------------------------------------------------


def _run_lease(world: World, true_s: float, *, host: str, alive: bool) -> Seen:
    """Another runner wants the run of one that lives and renews by a right clock, or that has died."""
    run = start_run(world.store)
    world.store.lease(run, "the first", _LEASE_S)

    def renewed(at_utc_s: float) -> None:
        with world.store.database.writing() as connection:
            connection.execute(update(leases).values(host=host, until_utc_s=at_utc_s + _LEASE_S))

    with world.store.database.writing() as connection:
        if host:
            connection.execute(update(leases).values(host=host))
    world.wait(true_s)
    if alive and host:
        renewed(world.true_utc_s - _RENEWED_S)
        world.clock.on_sleep = lambda _seconds: renewed(world.true_utc_s)
    takes = allows(lambda: world.store.lease(run, "the second", _LEASE_S))
    if not host and world.fault.boot_monotonic_s is not None:
        return Seen(not takes, "the first died with the host; the second runner has the run")
    return Seen(takes, "the second runner has the run" if takes else "the second runner is refused")


def _job_lease(world: World, true_s: float, *, alive: bool) -> Seen:
    """Another worker wants the job of one on another host, which lives and renews by a right clock, or has died."""
    run = start_run(world.store)
    enqueue(world.store, run, NewJob("register", "capture", 1, "key"), actor="runner")
    assert world.store.claim_job("the first", _LEASE_S) is not None
    with world.store.database.writing() as connection:
        connection.execute(update(jobs).values(host="another"))
    world.wait(true_s)
    if alive:
        with world.store.database.writing() as connection:
            connection.execute(update(jobs).values(until_utc_s=world.true_utc_s - _RENEWED_S + _LEASE_S))
    takes = world.store.claim_job("the second", _LEASE_S) is not None
    return Seen(takes, "the second worker computes it" if takes else "the second worker leaves it alone")


def _young_file(world: World, true_s: float) -> Seen:
    start_run(world.store)
    put_image(world.store, "v1")
    world.wait(true_s)
    gone = bool(remove_leftovers(world.store, actor="Ada"))
    return Seen(gone, "the file is removed" if gone else "the file stays")


def _file_of_a_runner(world: World, true_s: float) -> Seen:
    """A runner on this host that lives through it; a restart of the host ends it."""
    run = start_run(world.store)
    world.store.record(run, [SessionStarted(resumed=False, software={}, host="here", pid=1)], actor="runner")
    lease = world.store.lease(run, "a runner", 1e9)
    put_image(world.store, "v1")
    world.wait(true_s)
    boot_s = boot_time() + world.fault.set_s + world.fault.true_s
    with patch("service.store.disk_space.psutil", SimpleNamespace(boot_time=lambda: boot_s)):
        gone = bool(remove_leftovers(world.store, actor="Ada", min_age_s=0))
    assert lease.run_id == run
    if world.fault.boot_monotonic_s is not None:
        return Seen(False, "its runner died with the host; the file is removed" if gone else "the file stays")
    return Seen(gone, "the file is removed" if gone else "the file stays for its record")


def _photograph(world: World, true_s: float, *, new: bool) -> Seen:
    """A photograph of a camera whose clock is right, taken so long before the step began, or after that."""
    folder = world.folder / "card"
    folder.mkdir()
    ended = moment_of(world.clock).at_utc  # of the step before
    taken_utc_s = world.true_utc_s
    world.wait(true_s)
    started = moment_of(world.clock).at_utc
    taken = datetime.fromtimestamp(world.true_utc_s + 1.0 if new else taken_utc_s - 1.0, UTC)
    steps = {
        "capture": SimpleNamespace(started_utc=started, ended_utc=""),
        "before": SimpleNamespace(ended_utc=ended),
    }
    evidence = SimpleNamespace(state=lambda: SimpleNamespace(steps=steps), holds=lambda _sha256: False)
    context = cast(StepContext, SimpleNamespace(step=SimpleNamespace(id="capture"), evidence=evidence))
    camera = PhotoWatch(PhotoWatchConfig(folder=folder, stable_s=0), world.clock.monotonic_s, world.clock.sleep)
    if not new:
        put(folder, "DSC00001.JPG", photograph(1, taken))
    target = world.folder / "images"
    target.mkdir()
    camera.open()
    camera.released_images(target, 0.0)
    if new:
        put(folder, "DSC00001.JPG", photograph(1, taken))
    found: list[Any] = []
    told = not allows(lambda: found.extend(new_images(context, camera, target)))
    did = "the photograph is a view" if found else "it is left out" + (" and named" if told else "")
    return Seen(bool(found), did)


def _export(world: World, true_s: float, *, new: bool) -> Seen:
    """An export of a scanner beside the host, by whose clock it is dated: of this step or of before."""
    rig = OneScanner()
    rig.folder = world.folder / "scans"
    rig.folder.mkdir()
    path = rig.folder / "scan.ply"

    def export() -> None:
        balls = [trimesh.creation.icosphere(2, 6.0).apply_translation(centre) for centre in _CENTRES_MM]
        trimesh.util.concatenate(balls).export(path)
        os.utime(path, (world.clock.utc_s(), world.clock.utc_s()))

    def confirm(question: AskOperator, _state: RunState) -> OperatorAction:
        world.wake(true_s / 2)
        world.strike(restart=False)
        world.wake(true_s / 2)
        if new:
            export()
        return answer(question, "confirm")

    if not new:
        export()
        world.wake(10.0)
    bench = begin_computing_run(world.store, _PROTOCOL, world.folder, rig)
    bench.script("scan", "confirm", confirm)
    bench.script("scan", "recovery", say("abort", reason="no scan"))
    taken = bench.run().status == "completed"
    named = any("left out" in told for told in bench.operator.told)
    return Seen(taken, "the export is taken" if taken else "it is left out" + (" and named" if named else ""))


# --- what screens show ----------------------------------------------------------------------------------------------


def _reporter(world: World, run: str) -> Reporter:
    return Reporter(world.folder / "data", run, OpenDevices, BenchRig().camera_named, clock=world.clock)


def _dead_runner(world: World, true_s: float) -> Seen:
    _reporter(world, "run").attend("working", "capture", 1)
    world.wait(true_s)
    told = read_snapshot(world.folder / "data", "run", world.clock.utc_s())
    return Seen(told.doing != "unknown", f"the page says: {told.doing}", told.age_s(world.clock.utc_s()))


def _hung_runner(world: World, true_s: float) -> Seen:
    """The main loop hangs in a call while the heartbeat goes on; a restart of the host ends it."""
    run, data = start_run(world.store), world.folder / "data"
    reporter = _reporter(world, run)
    reporter.attend("working", "capture", 1)
    world.wait(true_s)
    if world.fault.boot_monotonic_s is None:
        reporter.beat()
    told = read_snapshot(data, run, world.clock.utc_s())
    words = read_health(world.store, data, [run]).runners
    return Seen(not words, words or "the runner counts as healthy", told.unattended_s(world.clock.utc_s()))


def _frame(world: World, true_s: float) -> Seen:
    data, run = world.folder / "data", start_run(world.store)
    write_frame(data, run, b"jpeg")
    os.utime(frame_path(data, run), (world.clock.utc_s(), world.clock.utc_s()))
    world.wait(true_s)
    site = cast(Site, SimpleNamespace(data=data, store=world.store, run=lambda _run: None))
    shown = live_view(site, run).status_code == 200
    return Seen(shown, "the frame is shown as live" if shown else "no frame is shown")


def _wanted(world: World, true_s: float) -> Seen:
    data = world.folder / "data"
    ask_for_frames(data, "run")
    os.utime(data / "monitor" / "run.wanted", (world.clock.utc_s(), world.clock.utc_s()))
    world.wait(true_s)
    wanted = frames_wanted(data, "run", world.clock.utc_s()) is not None
    return Seen(wanted, "the camera takes frames" if wanted else "the camera takes no frames")


def _worker(world: World, true_s: float) -> Seen:
    SignOfLife(world.folder / "data", world.clock).give(0)
    world.wait(true_s)
    lives = bool(living_workers(world.folder / "data", world.clock))
    return Seen(lives, "the worker counts as living" if lives else "no worker is said to run")


def _never(_true_s: float) -> bool:
    return False


def _always(_true_s: float) -> bool:
    return True


RUN_DURATIONS = (
    Duration("age of the coat", _COAT_S, below(_COAT_S), _coat, "the coat counts as too old, or as of unknown age"),
    Duration(
        "run's lease, its runner lives on this host",
        _LEASE_S,
        _never,
        lambda world, true_s: _run_lease(world, true_s, host="", alive=True),
        "it is refused",
    ),
    Duration(
        "run's lease, its runner lives on another host",
        _LEASE_S,
        _never,
        lambda world, true_s: _run_lease(world, true_s, host="another", alive=True),
        "it is refused",
    ),
    Duration(
        "run's lease, its runner died on another host",
        _LEASE_S,
        above(_LEASE_S),
        lambda world, true_s: _run_lease(world, true_s, host="another", alive=False),
        "it waits longer",
        "watched for 30 s first, and nobody renewed it",
    ),
    Duration(
        "job's lease, its worker lives on another host",
        _LEASE_S,
        _never,
        lambda world, true_s: _job_lease(world, true_s, alive=True),
        "",
        "computed twice; what the first returns is refused",
    ),
    Duration(
        "job's lease, its worker died on another host",
        _LEASE_S,
        above(_LEASE_S),
        lambda world, true_s: _job_lease(world, true_s, alive=False),
        "it waits longer",
        "computed again sooner",
    ),
    Duration("age of an unrecorded file", USUAL_AGE_S, above(USUAL_AGE_S), _young_file, "it is kept longer"),
    Duration("a living runner's file", 60.0, _never, _file_of_a_runner),
    Duration(
        "a photograph of before the step",
        600.0,
        _never,
        lambda world, true_s: _photograph(world, true_s, new=False),
    ),
    Duration(
        "a photograph of the step",
        600.0,
        _always,
        lambda world, true_s: _photograph(world, true_s, new=True),
        "it is left out and named",
    ),
    Duration("an export of before the step", 600.0, _never, lambda world, true_s: _export(world, true_s, new=False)),
    Duration(
        "an export of the step",
        600.0,
        _always,
        lambda world, true_s: _export(world, true_s, new=True),
        "it is left out and named",
    ),
    Duration("last word of a runner", STALE_S, below(STALE_S), _dead_runner, "the page says unknown"),
    Duration(
        "time in which a runner's main loop hangs",
        60.0,
        below(60.0),
        _hung_runner,
        "it counts as silent",
        "time asleep does not count: no program reports then",
    ),
    Duration("age of a frame of the live view", 5.0, below(5.0), _frame, "no frame until the next"),
    Duration("time since somebody looked at the live view", 3.0, below(3.0), _wanted, "none until the next look"),
    Duration("a worker's sign of life", 15.0, below(15.0), _worker, "not counted until its next sign"),
)
