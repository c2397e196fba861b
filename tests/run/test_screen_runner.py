"""A runner without a terminal: started by the web, controlled by events and the pedal, reporting in its snapshot."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from service.core.protocol import Protocol, load_protocol
from service.core.records.run_events import ItemTicked, OperatorAction
from service.core.run.decide import record_to_sign
from service.core.run.fold import fold
from service.core.run.state import RunState
from service.monitor.snapshot import Snapshot, ask_for_frames, frame_path, read_snapshot
from service.rig import load_rig
from service.run_start import start_run
from service.steps import params_models
from service.store.store import Store
from service.store.verification.verify import verify
from service.web.site import Launcher
from tests.support.processes.runners import no_runner_left
from tests.support.processes.waiting import until
from tests.support.protocols.short_protocol import short_protocol
from tests.support.rig.rig import press_pedal, simulated_rig

pytestmark = [pytest.mark.timeout(300)]


class Watched:
    """A run as seen by another process."""

    def __init__(self, store: Store, data: Path, run_id: str, protocol: Protocol) -> None:
        self.store, self.data, self.run_id, self.protocol = store, data, run_id, protocol

    def state(self) -> RunState:
        return fold(self.protocol, self.store.events(self.run_id))

    def tick_all(self) -> None:
        now = self.state().step
        for item in self.protocol.step(now.step).checklist:
            tick = ItemTicked(step=now.step, attempt=now.attempt, item=item, ticked=True)
            self.store.record(self.run_id, [tick], actor="ada")

    def act(self, **fields: object) -> None:
        action = OperatorAction.model_validate({"via": "web", **fields})
        self.store.record(self.run_id, [action], actor="ada")

    def confirm(self) -> None:
        now = self.state().step
        self.act(action="confirm", step=now.step, checklist=now.ticked)

    @property
    def told(self) -> Snapshot:
        """What the runner told last."""
        return read_snapshot(self.data, self.run_id, self.store.clock.utc_s())

    def at(self, step: str, phase: str) -> bool:
        state = self.state()
        return (state.current, state.phase) == (step, phase)


def press_until(condition: Callable[[], bool], watched: Watched, world: str, what: str) -> None:
    """Press the pedal, and again only if nothing came of it: one that a busy machine reads late does not count."""

    def pressed() -> bool:
        before_utc_s = watched.told.at_utc_s
        press_pedal(world)
        until(lambda: condition() or watched.told.at_utc_s > before_utc_s + 10.0, what)
        return condition()

    until(lambda: condition() or pressed(), what)


def pressed_twice(watched: Watched, world: str) -> bool:
    """Press the pedal twice, a second apart, while the run waits for it; never says that this was enough."""

    def waits() -> bool:
        return watched.at("viewpoint_capture_1", "ready")

    if waits():
        before_utc_s = watched.told.at_utc_s
        press_pedal(world)
        # A busy machine may read this press together with the one before, or late, and the pedal is not armed then.
        until(
            lambda: watched.told.pedal_armed or watched.told.at_utc_s > before_utc_s + 3.0 or not waits(),
            "the press is heeded",
        )
        if not watched.told.pedal_armed:
            return False
        armed_utc_s = watched.told.at_utc_s
        until(lambda: watched.told.at_utc_s > armed_utc_s + 1.0 or not waits(), "a second later")
        press_pedal(world)
        until(lambda: not watched.told.pedal_armed or not waits(), "the second press is heeded")
    return False


@pytest.mark.slow
def test_a_run_driven_from_screens_and_pedal_survives_its_starter(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with (
        simulated_rig(
            tmp_path, "--scene", "3", "--image-width", "320", "--speed-up", "3", host="127.0.0.41"
        ) as ready,
        no_runner_left(data),
        Store.open(data) as store,
    ):
        loaded = load_protocol(short_protocol(tmp_path / "protocols"), params_models())
        run_id = start_run(store, loaded, load_rig(Path(ready["rig"])), operator="ada", auto_confirm=False)
        watched = Watched(store, data, run_id, loaded.protocol)
        launcher = Launcher(data, store)
        launcher.start(run_id)
        until(lambda: watched.told.doing == "asking", "the runner asks")
        # A web process that starts meanwhile finds the runner by its lease.
        assert Launcher(data, store).driven(run_id)

        # The pedal acts as the screen's button: with open items it is refused, which is recorded.
        press_until(lambda: bool(watched.state().deviations), watched, ready["world"], "the refusal is recorded")
        assert "not ticked" in watched.state().deviations[0].text
        watched.tick_all()
        confirmed = "the pedal confirmed"
        press_until(lambda: watched.at("viewpoint_capture_1", "ready"), watched, ready["world"], confirmed)

        ask_for_frames(data, run_id)
        until(lambda: frame_path(data, run_id).exists() or bool(ask_for_frames(data, run_id)), "a live view frame")
        assert frame_path(data, run_id).read_bytes()[:2] == b"\xff\xd8"

        # One press arms, and nothing moves.
        press_pedal(ready["world"])
        until(lambda: watched.told.pedal_armed, "the screens show that the pedal is armed")
        armed_utc_s = watched.told.at_utc_s
        until(lambda: watched.told.at_utc_s > armed_utc_s + 1.0, "a second later")
        assert watched.at("viewpoint_capture_1", "ready")
        press_pedal(ready["world"])
        # Where this machine was too busy to read the second press in time, the pedal is pressed twice again.
        until(
            lambda: bool(watched.state().step.captured) or not watched.told.pedal_armed, "the second press is heeded"
        )
        until(
            lambda: bool(watched.state().step.captured) or pressed_twice(watched, ready["world"]), "the first image"
        )
        assert watched.told.robot in ("moving", "standing")

        watched.act(action="pause")
        until(lambda: watched.told.doing == "paused", "paused, and said so")
        assert watched.told.robot == "standing"
        taken = set(watched.state().step.captured)
        runner = watched.told.pid
        os.kill(runner, signal.SIGKILL)
        until(lambda: not launcher.driven(run_id), "the death is noticed")
        until(lambda: watched.told.doing == "unknown", "the screens say unknown, never wrong")

        launcher.start(run_id)
        until(lambda: watched.told.doing == "paused", "it goes on where it was")
        watched.act(action="resume")
        until(lambda: watched.at("photographs", "ready"), "the capture is complete", 120)
        assert taken < set(watched.state().steps["viewpoint_capture_1"].captured)
        watched.act(action="skip", step="photographs", reason="no second camera today")
        until(lambda: watched.at("control_sphere_removal", "ready"), "skipped")
        target = record_to_sign(loaded.protocol, watched.state())
        watched.act(action="sign", step="control_sphere_removal", meaning="released", signed_sha256=target)
        watched.tick_all()
        watched.confirm()
        until(lambda: watched.state().status == "completed", "the end")
        until(lambda: watched.told.doing == "ended", "the runner has ended")
        until(lambda: not launcher.driven(run_id), "the lease is let go")
    report = verify(data, run_id)
    assert report.ok, report.first_fault
