"""The simulated rig: one world behind a socket, its children, its files, and how all of it ends."""

from __future__ import annotations

import json
import os
import signal
import socket
import threading
from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import yaml
from pydicom import dcmread

from simulators.geometry import apply, inverse, rigid_fit
from simulators.rig_world import World, WorldServer
from simulators.world import SCENE_CENTRE_M, Scene
from tests.support.rig import simulated_rig

Q = np.array([1.4, -1.6, 1.9, -1.9, -1.57, 0.0])


class Wire:
    """One client of the world's socket."""

    def __init__(self, address: str) -> None:
        host, _, port = address.rpartition(":")
        self._socket = socket.create_connection((host, int(port)), timeout=60)
        self._stream = self._socket.makefile("rwb")

    def send(self, line: bytes) -> None:
        self._stream.write(line + b"\n")
        self._stream.flush()

    def ask(self, **request: Any) -> dict[str, Any]:
        self.send(json.dumps(request).encode())
        return self.answer()

    def answer(self) -> dict[str, Any]:
        return json.loads(self._stream.readline())

    def close(self) -> None:
        self._stream.close()
        self._socket.close()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.generate(7)


@pytest.fixture
def wire(scene: Scene) -> Generator[Wire]:
    world = World(scene, 600, ("robot",), Q)
    server = WorldServer(world, world.act)
    threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
    client = Wire(server.address)
    yield client
    client.close()
    server.shutdown()
    server.server_close()


def test_the_view_follows_the_arm_and_the_station(wire: Wire, scene: Scene) -> None:
    q = Q + 0.05
    wire.send(json.dumps({"op": "robot", "arm": "robot", "q": q.tolist(), "t": 0.0}).encode())
    view = wire.ask(op="view")  # same connection: the joints came first
    assert np.allclose(view["T_world_camera"], scene.true_camera(q, "station_1"))
    assert view["intrinsics"] == scene.camera_intrinsics(600).to_json()
    assert wire.ask(op="act", action="move_robot", station="station_2") == {"ok": True}
    assert np.allclose(wire.ask(op="view")["T_world_camera"], scene.true_camera(q, "station_2"))


def test_hands_change_the_scene_and_refuse_what_they_cannot(wire: Wire) -> None:
    assert wire.ask(op="view")["scene"] == {"seed": 7, "spray": False, "control_spheres": True, "board": None}
    for action in ("place_board", "spray", "remove_control_spheres", "press_pedal"):
        assert wire.ask(op="act", action=action) == {"ok": True}
    view = wire.ask(op="view")
    assert (view["scene"]["spray"], view["scene"]["control_spheres"], view["pedal_presses"]) == (True, False, 1)
    first = np.array(view["scene"]["board"])
    assert np.allclose(first[:3, :3] @ first[:3, :3].T, np.eye(3))
    wire.ask(op="act", action="remove_board")
    assert wire.ask(op="view")["scene"]["board"] is None
    wire.ask(op="act", action="place_board")
    assert not np.allclose(wire.ask(op="view")["scene"]["board"], first)
    for request in ({"op": "act", "action": "dance"}, {"op": "act", "action": "move_robot", "station": "x"}):
        answer = wire.ask(**request)
        assert not answer["ok"]
        assert answer["error"]


def test_the_truth_is_not_on_the_wire_and_nonsense_is_answered(wire: Wire) -> None:
    assert not wire.ask(op="truth")["ok"]
    wire.send(b"not json")
    assert not wire.answer()["ok"]
    assert not wire.ask(op="robot")["ok"]
    assert "T_world_camera" in wire.ask(op="view")


def test_scenes_are_the_same_for_a_seed_and_differ_between_seeds(scene: Scene) -> None:
    again, other = Scene.generate(7), Scene.generate(8)
    assert np.array_equal(again.specimen.grid_m, scene.specimen.grid_m)
    assert np.array_equal(again.true_camera(Q, "station_2"), scene.true_camera(Q, "station_2"))
    assert not np.allclose(other.registration_m, scene.registration_m, atol=1e-4)
    assert not np.allclose(other.T_flange_camera, scene.T_flange_camera, atol=1e-5)


def test_the_arm_errs_by_what_no_shift_of_its_base_explains(scene: Scene) -> None:
    joints = Q + np.random.default_rng(0).uniform(-0.3, 0.3, (40, 6))
    T_base_world = inverse(scene.T_world_base["station_1"])
    true = np.array([(T_base_world @ scene.true_flange(q, "station_1"))[:3, 3] for q in joints])
    nominal = np.array([scene.nominal_flange(q)[:3, 3] for q in joints])
    left = np.linalg.norm(true - apply(rigid_fit(true, nominal), nominal), axis=1)
    # An order of magnitude above the repeatability of 0.02 mm, and not a broken arm.
    assert 0.2e-3 < np.sqrt(np.mean(left**2)) < 1.5e-3


def test_the_rig_serves_delivers_and_ends_with_all_its_children(tmp_path: Path, scene: Scene) -> None:
    options = ("--scene", "7", "--image-width", "600", "--ct-voxel-mm", "3.0")
    with simulated_rig(tmp_path, *options) as ready:
        rig = yaml.safe_load(Path(ready["rig"]).read_text())
        for name, station in rig["stations"].items():
            measured = apply(scene.T_world_base[name], np.array(station["scene_centre_m"]))
            assert np.linalg.norm(measured - SCENE_CENTRE_M) < 0.015
        drawing = np.array(rig["T_flange_camera_nominal"])
        off = inverse(drawing) @ scene.T_flange_camera
        assert 0.1e-3 < np.linalg.norm(off[:3, 3]) < 3e-3
        assert (tmp_path / "lightbox").is_symlink()
        wire = Wire(ready["world"])
        assert wire.ask(op="act", action="ct_scan")["ok"]
        wire.close()
        slices = sorted((tmp_path / "ct").rglob("*.dcm"))
        assert dcmread(slices[0]).Modality == "CT"
        truth = json.loads(Path(ready["truth"]).read_text())
        assert np.allclose(np.linalg.det(np.array(truth["ct"][0]["T_world_ct"])[:3, :3]), 1.0)
        assert np.allclose(truth["registration_m"], scene.registration_m)
        processes = psutil.Process(_rig_process(tmp_path)).children(recursive=True)
        assert len(processes) >= 3
    _, alive = psutil.wait_procs(processes, timeout=10)
    assert not alive


def test_the_children_do_not_outlive_a_killed_rig(tmp_path: Path) -> None:
    with simulated_rig(tmp_path, "--scene", "7", "--image-width", "600"):
        pid = _rig_process(tmp_path)
        children = psutil.Process(pid).children(recursive=True)
        assert len(children) >= 3
        os.kill(pid, signal.SIGKILL)
        _, alive = psutil.wait_procs(children, timeout=15)
        assert not alive


def _rig_process(folder: Path) -> int:
    """The process of ours that simulates the rig of this folder."""
    for process in psutil.Process().children(recursive=True):
        words = process.cmdline()
        if "rig" in words and str(folder) in words:
            return process.pid
    raise AssertionError(f"no rig serves {folder}")
