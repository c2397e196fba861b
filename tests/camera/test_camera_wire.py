"""The simulated camera as seen by python-gphoto2, over a socket."""

from __future__ import annotations

import dataclasses
import json
import socketserver
import threading
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simulators.geometry import look_at
from simulators.scene.world import Scene
from tests.support.processes.lateness import Lateness
from tests.support.rig.camera_simulator import RunningCamera, camera_simulator
from tests.support.vendor.camera_vendor_session import vendor_session


@pytest.fixture(scope="module")
def camera(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningCamera]:
    with camera_simulator() as running:
        yield running


def test_identity_battery_and_space(camera: RunningCamera) -> None:
    answers = vendor_session(
        camera.gphoto_port,
        ["value", "cameramodel"],
        ["value", "deviceversion"],
        ["value", "batterylevel"],
        ["storage"],
    )
    assert answers == ["ILCE-7RM5", "3.00", "87%", []], "in PC Remote mode it lists no storage"


@pytest.mark.parametrize(
    ("widget", "value"),
    [
        ("f-number", "f/22"),
        ("shutterspeed", "1/15"),
        ("shutterspeed", "32/10"),
        ("iso", "100"),
        ("focusmode", "Manual"),
        ("imagequality", "RAW+JPEG"),
        ("imagequality", "JPEG"),
        ("jpegquality", "X.Fine"),
        ("d222", "17"),
        ("d222", "1"),
    ],
)
def test_settings_are_set_and_survive_a_session(camera: RunningCamera, widget: str, value: str) -> None:
    choices, _ = vendor_session(camera.gphoto_port, ["choices", widget], ["set", widget, value])
    assert value in choices
    assert vendor_session(camera.gphoto_port, ["value", widget]) == [value]


def test_the_focal_position_is_read_and_moved_by_hand_in_manual_focus_only(camera: RunningCamera) -> None:
    """Read-only, 0 to 100; `manualfocus` moves it by steps on the client's own scale."""
    before, refused, *_ = vendor_session(
        camera.gphoto_port,
        ["value", "focalposition"],
        ["set", "focalposition", 20.0],
        ["set", "focusmode", "Automatic"],
    )
    assert before == 50.0
    assert refused["error"] < 0
    denied, _, up = vendor_session(
        camera.gphoto_port,
        ["set", "manualfocus", 3.0],
        ["set", "focusmode", "Manual"],
        ["set", "manualfocus", 3.0],
    )
    (near,) = vendor_session(camera.gphoto_port, ["value", "focalposition"])  # a client caches a value
    assert denied["error"] < 0
    assert isinstance(up, float)
    assert near == 53.0


@pytest.mark.parametrize("mode", ["Manual", "DMF"])
def test_the_focus_is_moved_by_three_steps_either_way(camera: RunningCamera, mode: str) -> None:
    def position() -> float:
        (found,) = vendor_session(camera.gphoto_port, ["value", "focalposition"])  # a client caches a value
        return found

    vendor_session(camera.gphoto_port, ["set", "focusmode", mode])
    before = position()
    (up,) = vendor_session(camera.gphoto_port, ["set", "manualfocus", 3.0])
    assert isinstance(up, float)
    assert position() == before + 3
    (down,) = vendor_session(camera.gphoto_port, ["set", "manualfocus", -3.0])
    assert isinstance(down, float)
    assert position() == before


def test_the_exposure_compensation_has_thirds_of_a_stop_from_5_to_minus_5(camera: RunningCamera) -> None:
    choices, set_s = vendor_session(
        camera.gphoto_port, ["choices", "exposurecompensation"], ["set", "exposurecompensation", "-1.3"]
    )
    assert len(choices) == 31
    assert choices[:4] == ["5", "4.7", "4.3", "4"]
    assert choices[-1] == "-5"
    assert isinstance(set_s, float)
    assert vendor_session(camera.gphoto_port, ["value", "exposurecompensation"]) == ["-1.3"]
    vendor_session(camera.gphoto_port, ["set", "exposurecompensation", "0"])


def test_an_empty_value_is_refused_and_the_link_goes_on(camera: RunningCamera) -> None:
    """libgphoto2 sends an empty data phase for `capturetarget` set by name."""
    words = (["set", "capturetarget", "card+sdram"], ["value", "cameramodel"], ["set", "iso", "200"])
    refused, model, seconds = vendor_session(camera.gphoto_port, *words)
    assert refused["error"] < 0
    assert model == "ILCE-7RM5"
    assert isinstance(seconds, float)


def test_a_value_that_is_not_offered_is_refused_and_nothing_changes(camera: RunningCamera) -> None:
    answers = vendor_session(camera.gphoto_port, ["set", "iso", "100"], ["set", "iso", "123"])
    assert answers[1] == {"error": -2}
    assert vendor_session(camera.gphoto_port, ["value", "iso"]) == ["100"]  # this client has cached nothing


@pytest.mark.realtime
def test_settings_take_no_delayed_acknowledgements(camera: RunningCamera) -> None:
    with Lateness() as lateness:
        steps = [["set", "iso", value] for value in ("100", "200") * 6]
        times_s = vendor_session(camera.gphoto_port, *steps)
    # Without TCP_QUICKACK each takes 44 ms; on a busy machine up to three quarters of them may be delayed.
    assert sorted(times_s)[len(times_s) // 4] < 0.02 + 4 * lateness.usual_s


def test_capture_raw_and_jpeg_share_a_stem_and_the_log_has_the_bytes_that_were_sent(tmp_path: Path) -> None:
    log = tmp_path / "exposures.jsonl"
    with camera_simulator((), "--exposures-log", str(log)) as camera:
        _, single, _, _, _, events = vendor_session(
            camera.gphoto_port,
            ["set", "imagequality", "JPEG"],
            ["capture"],
            ["events", 0.3],
            ["set", "imagequality", "RAW+JPEG"],
            ["trigger"],
            ["events", 60.0, 2],
        )
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert single["name"] == "capt_DSC00001.JPG"
    assert (single["head"][:4], single["tail"]) == ("ffd8", "ffd9")
    files = {data["name"]: data for kind, data in events if kind == "file"}
    assert set(files) == {"capt_DSC00002.JPG", "capt_DSC00002.ARW"}
    assert files["capt_DSC00002.ARW"]["head"] == "49492a00"
    assert [line["counter"] for line in lines] == [1, 2]
    assert [line["sha256"] for line in lines] == [single["sha256"], files["capt_DSC00002.JPG"]["sha256"]]
    assert lines[0]["size"] == single["size"]


@pytest.mark.parametrize(("announce", "complete"), [("event", False), ("property", True)])
def test_end_of_capture_by_event_or_by_property(announce: str, complete: bool) -> None:
    with camera_simulator((), "--announce", announce) as camera:
        awaited = "complete" if complete else "c201"
        steps = (["set", "focusmode", "Manual"], ["trigger"], ["events", 60.0, 1, awaited])
        events = vendor_session(camera.gphoto_port, *steps)[2]
    files = [data["name"] for kind, data in events if kind == "file"]
    assert files == ["capt_DSC00001.JPG"]
    if complete:
        assert ["complete", None] in events
    else:
        assert any(kind == "unknown" and "c201" in str(data) for kind, data in events)


def test_live_view(camera: RunningCamera) -> None:
    (frame,) = vendor_session(camera.gphoto_port, ["preview"])
    assert (frame["head"], frame["tail"]) == ("ffd8", "ffd9")
    assert frame["size"] > 5000


def test_autofocus_and_exposure_time_are_waited_for(camera: RunningCamera) -> None:
    answers = vendor_session(
        camera.gphoto_port,
        ["set", "imagequality", "JPEG"],
        ["set", "focusmode", "Automatic"],
        ["set", "shutterspeed", "1"],
        ["capture"],
    )
    assert answers[3]["name"].endswith(".JPG")


def test_busy_shutter_then_success() -> None:
    with camera_simulator([{"on": "shutter", "kind": "busy"}]) as camera:
        first, second = vendor_session(camera.gphoto_port, ["capture"], ["capture"])
    assert first == {"error": -110}
    assert second["name"] == "capt_DSC00001.JPG"


def test_the_lists_are_those_of_recorded_bodies(camera: RunningCamera) -> None:
    """Before, drives were codes of protocol 2.00, and there was no Bulb, no automatic and no extended ISO."""
    drives, shutters, isos, balances = vendor_session(
        camera.gphoto_port, *(["choices", name] for name in ("capturemode", "shutterspeed", "iso", "whitebalance"))
    )
    assert drives[0] == "Single Shot"
    for words in (drives, shutters, balances):
        assert not [word for word in words if "Unknown" in word]
    assert shutters[-1] == "Bulb"
    assert isos[:2] == ["Auto ISO", "50 Multi Frame Noise Reduction"]
    assert "16000" in isos


def test_full_store_shows_in_the_photographs_that_fit() -> None:
    with camera_simulator([{"on": "shutter", "kind": "disk_full"}]) as camera:
        before, capture, _, after = vendor_session(
            camera.gphoto_port, ["value", "d249"], ["capture"], ["events", 0.1], ["value", "d249"]
        )
    assert float(before) > 0
    assert capture == {"error": -1}
    assert float(after) == 0


def test_refused_setting() -> None:
    with camera_simulator([{"on": "set", "kind": "reject", "nth": 2, "times": 2}]) as camera:
        refused, again = vendor_session(camera.gphoto_port, ["set", "iso", "100"], ["value", "iso"])
    assert refused == {"error": -2}
    assert again == "400"


@pytest.mark.parametrize(("kind", "codes"), [("drop", {-1, -7}), ("reset", {-1, -7}), ("stall", {-10})])
def test_link_lost_in_mid_download_and_a_new_session_works(kind: str, codes: set[int]) -> None:
    with camera_simulator([{"on": "get_object", "kind": kind}]) as camera:
        (lost,) = vendor_session(camera.gphoto_port, ["capture"])[:1]
        _, capture = vendor_session(camera.gphoto_port, ["events", 0.3], ["capture"])
    assert lost["error"] in codes
    assert capture["name"] == "capt_DSC00002.JPG"


def test_truncated_file_is_short_of_its_end_marker() -> None:
    with camera_simulator([{"on": "image", "kind": "truncate"}]) as camera:
        (capture,) = vendor_session(camera.gphoto_port, ["capture"])
    assert capture["head"][:4] == "ffd8"
    assert capture["tail"] != "ffd9"


def test_stale_image_is_the_previous_file_again() -> None:
    with camera_simulator([{"on": "image", "kind": "stale", "nth": 2}]) as camera:
        first, _, second = vendor_session(camera.gphoto_port, ["capture"], ["events", 0.3], ["capture"])
    assert first["sha256"] == second["sha256"]


def test_init_can_be_refused() -> None:
    with camera_simulator([{"on": "init", "kind": "reject"}]) as camera:
        assert vendor_session(camera.gphoto_port, ["preview"]) == [{"error": -1}]
        assert vendor_session(camera.gphoto_port, ["value", "cameramodel"]) == ["ILCE-7RM5"]


@contextmanager
def world_socket(answer: dict[str, Any]) -> Generator[str]:
    """Answer every line with the same JSON object; yields its HOST:PORT."""

    class Handler(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            for line in self.rfile:
                assert json.loads(line) == {"op": "view"}
                self.wfile.write(json.dumps(answer).encode() + b"\n")

    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        try:
            yield f"127.0.0.1:{server.server_address[1]}"
        finally:
            server.shutdown()
            thread.join()


@pytest.mark.slow
def test_pictures_of_the_world_and_their_true_pose(tmp_path: Path) -> None:
    log = tmp_path / "truth.jsonl"
    pose = look_at(np.array([0.0, -0.3, 0.6]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    view = {
        "T_world_camera": pose.tolist(),
        "intrinsics": dataclasses.asdict(Scene.generate(7).camera_intrinsics(240)),
        "scene": {"seed": 7, "spray": False, "control_spheres": True, "board": None},
        "light_lux": 1000.0,
    }
    options = ("--image-width", "240", "--exposures-log", str(log))
    with world_socket(view) as address, camera_simulator((), "--world", address, *options) as camera:
        capture, frame = vendor_session(camera.gphoto_port, ["capture"], ["preview"])
    line = json.loads(log.read_text())
    assert (frame["head"], frame["tail"]) == ("ffd8", "ffd9")
    assert line["sha256"] == capture["sha256"]
    assert line["T_world_camera"] == pose.tolist()


def test_silent_world_gives_no_picture_and_the_camera_lives_on() -> None:
    with camera_simulator((), "--world", "127.0.0.1:9") as camera:
        _, events, model = vendor_session(camera.gphoto_port, ["trigger"], ["events", 0.8], ["value", "cameramodel"])
    assert not [event for event in events if event[0] == "file"]
    assert model == "ILCE-7RM5"
