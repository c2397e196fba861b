"""The frame of every page of a run: its name, its navigation, the robot banner."""

from __future__ import annotations

from dataclasses import dataclass

from service.core.errors import OrthocaptureError
from service.core.records.events import RunStarted
from service.core.records.import_list import imported_sentence
from service.core.run.expected import tries_words
from service.core.text.words import time_here
from service.monitor.snapshot import Standing, read_snapshot
from service.people.control import Control
from service.run_record import RunRecord
from service.steps.coats import Coat, coats
from service.store.durable_effects import moment_of
from service.web.page.robot_banner import NOT_THE_STOP, Banner, robot_banner
from service.web.page.run_standing import run_standing
from service.web.site import Site


@dataclass(frozen=True, slots=True)
class Attention:
    """What a screen reports by sound and notification, if alerts are switched on there."""

    key: Standing = "works"
    words: str = ""


@dataclass(frozen=True, slots=True)
class Tab:
    """A page of a run."""

    href: str
    text: str
    below: bool = False  # also the current one on pages below it


@dataclass(frozen=True, slots=True)
class RunFrame:
    """What base.html.j2 needs to know about a run."""

    run_id: str
    name: str
    protocol_id: str
    protocol_version: str
    protocol_sha256: str
    simulated: bool
    imported: str  # the sentence that says so; "" for a run that captures its photographs itself
    live: bool  # not ended, so there may be new events
    pausable: bool
    asked: tuple[str, str]  # the screen that has control, and the name of who asks for it; "" for nobody
    attention: Attention
    banner: Banner
    tabs: tuple[Tab, ...]
    coats: tuple[Coat, ...] = ()  # that disappear before a scan which is still to come


def run_frame(site: Site, run_id: str) -> RunFrame:
    """The frame of a run's pages. Raises UnknownRunError."""
    log = site.run(run_id)
    root = log.events[0].payload
    assert isinstance(root, RunStarted)  # checked when the run was read
    here = f"/runs/{run_id}"
    now_utc_s = site.store.clock.utc_s()
    holder = Control(site.store).holder(run_id)
    driven, snapshot = site.launcher.driven(run_id), read_snapshot(site.data, run_id, now_utc_s)
    stands = run_standing(log.protocol, log.state, driven=driven, robot=snapshot.robot)
    return RunFrame(
        run_id=run_id,
        name=run_id,
        protocol_id=root.protocol_id,
        protocol_version=root.protocol_version,
        protocol_sha256=root.protocol_sha256,
        simulated=root.simulated,
        imported=imported_sentence(log.events[0].at_utc, root.operator) if root.origin == "imported" else "",
        live=not log.state.terminal,
        pausable=log.state.status == "active" and driven,
        asked=(holder.screen, holder.asked_by_name),
        attention=Attention(stands.key, stands.alert),
        banner=robot_banner(
            log.state, snapshot, now_utc_s, driven=driven, tries=tries_words(log.protocol, log.state, time_here)
        ),
        tabs=(
            Tab(here, "Step"),
            Tab(f"{here}/capture", "Capture"),
            Tab(f"{here}/scene", "3D view"),
            Tab(f"{here}/calibration", "Calibration"),
            Tab(f"{here}/dataset", "Data set"),
            Tab(f"/audit/runs/{run_id}", "Audit", below=True),
        ),
        coats=coats_of(site, log),
    )


def coats_of(site: Site, log: RunRecord) -> tuple[Coat, ...]:
    """The coats of a run whose clocks run now."""
    return coats(log.protocol, log.state, moment_of(site.store.clock))


def driven_frames(site: Site, *, but: str = "") -> list[RunFrame]:
    """The frames of all runs that a living process drives now, for the banners of pages that are not theirs.

    Never raises: a run whose state cannot be read is shown as unknown.

    Args:
        site: the site.
        but: a run to leave out, because the page has its banner already; "" for none.
    """
    try:
        driven = [run_id for run_id in site.launcher.driven_runs() if run_id != but]
    except OrthocaptureError:
        return [_unreadable("")]
    return [_frame_or_unknown(site, run_id) for run_id in driven]


def _frame_or_unknown(site: Site, run_id: str) -> RunFrame:
    try:
        return run_frame(site, run_id)
    except OrthocaptureError:
        return _unreadable(run_id)


def _unreadable(run_id: str) -> RunFrame:
    text = f"The record cannot be read now. Look at the robot. {NOT_THE_STOP}"
    banner = Banner("unknown", "unknown", "unknown", "Robot: unknown.", text)
    return RunFrame(
        run_id, run_id, "", "", "", simulated=False, imported="", live=False, pausable=False, asked=("", ""),
        attention=Attention(), banner=banner, tabs=(),
    )  # fmt: skip
