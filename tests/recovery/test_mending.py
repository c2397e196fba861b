"""A step's advice when it falls short: the simulated technician follows it, confirms, and finally gives up."""

from __future__ import annotations

import io
import json
import socketserver
import threading
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from service.cli.operators import AutomaticOperator, Display, SimulatedHands
from service.cli.terminal_output import Terminal
from service.core.errors import OrthocaptureError
from service.core.protocol import parse_protocol
from service.core.records.run_events import OperatorAction, StepNote
from service.core.run.state import RunState
from service.monitor.reporter import OpenDevices, Reporter
from service.rig import load_rig
from service.run_start import recorded_run, start_run
from service.runner.loop import Runner
from service.steps import params_models
from service.steps.context import StepContext
from service.steps.kinds import viewpoint_capture
from tests.support.rig.bench_rig import other_settings
from tests.support.runs.bench_run import PROTOCOL, Bench, bench_store

ADVICE = {
    "advice": "Turn the ISO wheel back",
    "hands": [{"action": "turn_wheel", "iso": 100}, {"action": "step_back"}],
}


class _World(socketserver.ThreadingTCPServer):
    """The world to which the hands connect: records what it is asked to do, and does it."""

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self) -> None:
        self.asked: list[dict[str, Any]] = []
        super().__init__(("127.0.0.1", 0), _Client)


class _Client(socketserver.StreamRequestHandler):
    def handle(self) -> None:
        assert isinstance(self.server, _World)
        for line in self.rfile:
            request = json.loads(line)
            self.server.asked.append(request)
            answer = {"ok": request["action"] != "juggle", "error": "hands cannot do 'juggle'"}
            self.wfile.write(json.dumps(answer).encode() + b"\n")


@contextmanager
def _serving() -> Generator[_World]:
    with _World() as world:
        threading.Thread(target=world.serve_forever, daemon=True).start()
        yield world
        world.shutdown()


@pytest.fixture
def world() -> Iterator[_World]:
    with _serving() as world:
        yield world


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with bench_store(tmp_path / "data") as store:
        (tmp_path / "rig.yaml").write_text("name: bench\nsimulated: true\ndevices: {}\n")
        loaded = parse_protocol(PROTOCOL.encode(), params_models(), name="bench.yaml")
        run_id = start_run(store, loaded, load_rig(tmp_path / "rig.yaml"), operator="Ada", auto_confirm=True)
        yield Bench(store, run_id, tmp_path / "data")


def automatic_run(bench: Bench, world: _World) -> RunState:
    """The run with --auto-confirm, with the simulated world as the technician's hands."""
    protocol, _ = recorded_run(bench.store, bench.run_id)
    reporter = Reporter(bench.data, bench.run_id, OpenDevices, bench.rig.camera_named)
    host, port = world.server_address[:2]
    operator = AutomaticOperator(
        "Ada", protocol, Display(Terminal(file=io.StringIO()), reporter), SimulatedHands(f"{host!s}:{port}")
    )
    return Runner(bench.store, bench.run_id, protocol, bench.rig, operator).run()


def advise(monkeypatch: pytest.MonkeyPatch, data: dict[str, Any] | None) -> None:
    """Replace the capture's own advice (to retake images) when it falls short; None: no advice."""

    def note(context: StepContext, _measures: Mapping[str, float], _images: int) -> None:
        if data is not None:
            context.note("wheel", **data)

    monkeypatch.setattr(viewpoint_capture, "advise_retakes", note)


def mends(bench: Bench) -> list[OperatorAction]:
    actions = [a for a in bench.payloads(OperatorAction) if a.step == "capture" and a.action == "confirm"]
    return actions[1:]  # the first one began the capture


def test_the_simulated_technician_does_what_a_step_advises_and_confirms(
    bench: Bench, world: _World, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.rig.shutter.exif = lambda applied: applied if world.asked else other_settings(applied)
    advise(monkeypatch, ADVICE)
    assert automatic_run(bench, world).status == "completed"
    assert world.asked == [
        {"op": "act", "action": "turn_wheel", "iso": 100},
        {"op": "act", "action": "step_back"},
    ]
    (mend,) = mends(bench)
    assert mend.automatic
    assert mend.via == "auto"
    bench.must_verify()


def test_he_gives_up_after_a_few_mends_that_did_not_help(
    bench: Bench, world: _World, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.rig.shutter.exif = other_settings
    advise(monkeypatch, ADVICE)
    with pytest.raises(OrthocaptureError, match="Images with wrong camera settings 4"):
        automatic_run(bench, world)
    assert len(mends(bench)) == 4
    assert bench.state().phase == "recovering", "the run is whole and can be resumed"


def test_without_advice_from_this_attempt_he_leaves_it_to_a_person(
    bench: Bench, world: _World, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.rig.shutter.exif = other_settings
    advise(monkeypatch, None)
    bench.store.record(bench.run_id, [StepNote(step="fixation", attempt=1, note="wheel", data=ADVICE)], actor="")
    with pytest.raises(OrthocaptureError, match="Images with wrong camera settings 4"):
        automatic_run(bench, world)
    assert not mends(bench)
    assert not world.asked


def test_hands_that_cannot_do_it_say_so(bench: Bench, world: _World, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.rig.shutter.exif = other_settings
    advise(monkeypatch, {"advice": "Juggle", "hands": [{"action": "juggle"}]})
    with pytest.raises(OrthocaptureError, match="could not juggle"):
        automatic_run(bench, world)


@pytest.mark.slow
def test_the_newest_advice_counts_with_its_words_and_its_hands(bench: Bench, world: _World) -> None:
    bench.rig.shutter.exif = other_settings

    def earlier(_exposure: int) -> None:
        attempt = bench.state().steps["capture"].attempt
        note = StepNote(step="capture", attempt=attempt, note="wheel", data=ADVICE)
        bench.store.record(bench.run_id, [note], actor="")

    bench.rig.shutter.on_capture = earlier
    with pytest.raises(OrthocaptureError, match="First set the camera as the protocol has it"):
        automatic_run(bench, world)
    assert len(mends(bench)) == 4
    assert not world.asked, "hands of advice that no screen shows any more"
