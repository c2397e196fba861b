"""`manual_capture` with a video source: the screen releases, and the stream's own files become evidence."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.video import VideoCamera, VideoConfig
from service.core.records.run_events import CaptureAsked, ViewHeld
from simulators.hand.technician import Grip
from tests.support.rig.bench_rig import answer
from tests.support.runs.bench_run import Bench, begin_run, bench_store
from tests.support.runs.held_run import MIDDLE_M, STEP, held_run
from tests.support.vendor.mjpeg_writer import jpeg


@pytest.fixture
def begin(tmp_path: Path) -> Iterator[Callable[[str], Bench]]:
    with bench_store(tmp_path / "data") as opened:
        yield lambda text: begin_run(opened, text, tmp_path)


def test_the_screen_releases_a_video_source(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench, person = held_run(begin, monkeypatch, tmp_path, {}, STEP)
    person.idle = True
    person.views = [(Grip(MIDDLE_M + np.array([0.0, 0.0, 0.66])).T_world_camera(), "")] * 2
    files = [jpeg(number) for number in range(3)]
    (tmp_path / "a.mjpeg").write_bytes(b"".join(files))
    port = str(tmp_path / "a.mjpeg")
    source = VideoCamera(VideoConfig(port=port, aperture_f=22.0, exposure_s=1 / 50, serial="M 12"))
    source.open()
    serve, shown = bench.operator.on_show, [0]

    def press(what: str) -> None:
        person.rig.card = source
        if what == "waiting for the next image":
            shown[0] += 1
            asked = {2: "release", 6: "release", 12: "finish"}.get(shown[0])
            if asked is not None:
                event = CaptureAsked.model_validate({"step": "capture", "attempt": 1, "what": asked})
                bench.store.record(bench.run_id, [event], actor="Grace")
        serve(what)

    bench.operator.on_show = press
    bench.script("capture", "recovery", lambda question, _s: answer(question, "abort", reason="as planned"))
    bench.run()
    source.close()
    views = bench.payloads(ViewHeld)
    assert [view.released_by for view in views] == ["screen", "screen"]
    assert [view.camera["body_serial"] for view in views] == ["M 12", "M 12"]
    stored = {ref.sha256 for view in views for ref in view.artefacts}
    assert {hashlib.sha256(file).hexdigest() for file in files[:2]} <= stored
