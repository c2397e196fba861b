"""The simulated technician's handling of a photograph: hold the camera elsewhere, move the indicated sphere."""

from __future__ import annotations

import json
import socket
import threading
from typing import Any

import numpy as np
import pytest

from simulators.faults import Fault
from simulators.geometry import Array, apply, inverse
from simulators.rendering.picture_faults import Lens
from simulators.rig.world_server import HELD_CAMERAS, World, WorldServer
from simulators.scene.world import Scene, parse_moved


@pytest.fixture
def world() -> World:
    return World(Scene.generate(21), 1920, ("robot",), np.zeros(6))


def _pointing_at(world: World, side: str, point_m: Array) -> list[float]:
    lens = world.scene.camera_intrinsics(1920)
    pixel = lens.project(apply(inverse(HELD_CAMERAS[side]), point_m))
    return (pixel / [lens.width, lens.height]).tolist()


def test_a_sphere_goes_where_the_arrow_in_the_photograph_points(world: World) -> None:
    assert world.act({"action": "hold_camera", "side": "left"})["ok"]
    before = world.scene.registration_m
    target = before[6] + np.array([0.0, 0.015, 0.0])
    arrow = {"from": _pointing_at(world, "left", before[6]), "to": _pointing_at(world, "left", target)}
    assert world.act({"action": "move_sphere", **arrow, "higher_m": 0.02})["ok"]
    after = world.scene.registration_m
    np.testing.assert_allclose(after[6], target + np.array([0.0, 0.0, 0.02]), atol=1e-6)
    np.testing.assert_array_equal(np.delete(after, 6, axis=0), np.delete(before, 6, axis=0))
    moved = world.view()["scene"]["moved"]
    again = Scene.generate(21, parse_moved(str([list(entry) for entry in moved])))
    np.testing.assert_array_equal(again.registration_m, after)
    np.testing.assert_allclose(again.foot_m[6, :2] - Scene.generate(21).foot_m[6, :2], [0.0, 0.015], atol=1e-6)


def test_what_he_cannot_do_he_says(world: World) -> None:
    arrow = {"from": [0.5, 0.5], "to": [0.6, 0.5]}
    assert "on the arm" in world.act({"action": "move_sphere", **arrow})["error"]
    assert "no side" in world.act({"action": "hold_camera", "side": "below"})["error"]
    assert world.act({"action": "hold_camera"})["ok"]
    assert "no registration sphere" in world.act({"action": "move_sphere", **arrow})["error"]
    neighbours = world.scene.registration_m[[6, 7]]
    here, there = (_pointing_at(world, "above", point) for point in neighbours)
    height = float(neighbours[1, 2] - neighbours[0, 2])
    answer = world.act({"action": "move_sphere", "from": here, "to": there, "higher_m": height})
    assert "in the way" in answer["error"]


def test_a_smeared_lens_blurs_every_picture_until_it_is_cleaned(world: World) -> None:
    lens, sharp = Lens(), np.random.default_rng(0).integers(0, 255, (60, 90, 3)).astype(np.uint8)
    np.testing.assert_array_equal(lens.picture(sharp, None, world.view()), sharp)
    smear = Fault(device="camera", on="image", kind="smear", value=0.03)
    smeared = [lens.picture(sharp, fault, world.view()) for fault in (smear, None, None)]
    assert all(picture.std() < 0.5 * sharp.std() for picture in smeared)
    assert world.act({"action": "clean_lens"})["ok"]
    np.testing.assert_array_equal(lens.picture(sharp, None, world.view()), sharp)


@pytest.mark.parametrize(("kind", "changed"), [("blur", 1.0), ("black", 1.0), ("covered", 0.5)])
def test_other_faults_spoil_one_picture(world: World, kind: str, changed: float) -> None:
    lens, sharp = Lens(), np.random.default_rng(0).integers(1, 255, (60, 90, 3)).astype(np.uint8)
    spoilt = lens.picture(sharp, Fault(device="camera", on="image", kind=kind, value=0.5), world.view())
    assert np.mean((spoilt != sharp).any(axis=2)) == pytest.approx(changed, abs=0.1)
    np.testing.assert_array_equal(lens.picture(sharp, None, world.view()), sharp)


def test_a_device_that_carries_the_camera_says_where_it_is(world: World) -> None:
    server = WorldServer(world, world.act)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        world.act({"action": "hold_camera"})
        answer = _asked(
            server.address, {"op": "camera", "T_world_camera": HELD_CAMERAS["left"].tolist()}, {"op": "view"}
        )
        np.testing.assert_allclose(answer["T_world_camera"], HELD_CAMERAS["left"])
        twice = (2 * HELD_CAMERAS["left"]).tolist()
        assert "not a rigid" in _asked(server.address, {"op": "camera", "T_world_camera": twice})["error"]
    finally:
        server.shutdown()
        server.server_close()


def _asked(address: str, *requests: dict[str, Any]) -> dict[str, Any]:
    """Send the requests and return the first answer."""
    host, _, port = address.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=10) as link, link.makefile("rw") as lines:
        lines.writelines(json.dumps(request) + "\n" for request in requests)
        lines.flush()
        return json.loads(lines.readline())
