"""The state of the simulated laboratory (arms, spheres, lights, camera) and its control socket."""

from __future__ import annotations

import json
import socketserver
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from simulators.geometry import Array, apply, inverse, look_at
from simulators.hand.technician import Press
from simulators.scene.further_cameras import FurtherCamera
from simulators.scene.world import RADIUS_M, STATIONS, Scene

# Where the technician holds the camera: nearly above the scene, so that no sphere hides another; and, for a further
# photograph, beyond one edge of that image, high enough for every sphere to be visible.
_HELD_EYES_M = {
    "above": (0.06, -0.17, 0.78),
    "left": (-0.36, -0.06, 0.74),
    "right": (0.36, -0.07, 0.76),
    "near": (0.05, -0.40, 0.72),
    "far": (-0.04, 0.33, 0.76),
}
_SCENE_M = np.array([0.0, 0.0, 0.05])
HELD_CAMERAS = {
    side: look_at(np.array(eye), _SCENE_M, np.array([0.0, 1.0, 0.0])) for side, eye in _HELD_EYES_M.items()
}
_POINTED_AT = 1.5  # in radii around a sphere's centre in the image: pointing within it means this sphere
_HEIGHTS_M = (0.028, 0.150)  # heights of a sphere's centre on the available posts
_TABLE_M = (0.215, 0.150)  # half the extent of the board, on which the posts stand
_ROOM_M = 2.3 * RADIUS_M  # minimum distance between two centres

_LONGEST_WAIT_S = 1.0
_LONGEST_REQUEST = 1 << 20  # bytes; a longer request is truncated and then is not valid JSON

Act = Callable[[Mapping[str, Any]], dict[str, Any]]


@dataclass
class World:
    """The changing state of the laboratory; thread-safe."""

    scene: Scene
    image_width: int
    arms: tuple[str, ...]  # one arm that is moved between the stations, or one at each
    start_joints_rad: Array
    spray: bool = False
    control_spheres: bool = True
    board_placements: int = 0
    board_placed: bool = False
    lens_cleanings: int = 0
    pedal_presses: int = 0
    pedal_pressed_s: float = 0.0  # time.monotonic() of the last press
    further: Mapping[str, FurtherCamera] = field(default_factory=dict[str, FurtherCamera])  # by name
    camera_held: bool = False  # in the technician's hands, instead of on the arm
    T_world_held: Array = field(default_factory=HELD_CAMERAS["above"].copy)  # where it is held
    shutter_presses: int = 0  # number of presses of the camera's own button
    press: Press = field(default_factory=Press)  # the last one
    station: str = STATIONS[0]
    _joints: dict[str, Array] = field(default_factory=dict[str, Array])
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _pressed: threading.Condition = field(init=False)

    def __post_init__(self) -> None:
        self._pressed = threading.Condition(self._lock)

    def arm_moved(self, arm: str, q: Array) -> None:
        """Update the joints (6,), in radians, of an arm's controller."""
        with self._lock:
            self._joints[arm] = q

    def joints_rad(self, arm: str) -> Array:
        """Return the joints (6,) last reported by a controller, initially the start joints."""
        with self._lock:
            return self._joints.get(arm, self.start_joints_rad)

    @property
    def camera_arm(self) -> str:
        """The arm that carries the camera: if there are two, the one at the current station."""
        return self.arms[STATIONS.index(self.station) % len(self.arms)]

    def view(self, name: str = "") -> dict[str, Any]:
        """Return what a camera sees now and what the light box measures, as JSON data; "": the first camera.

        Raises LookupError if there is no further camera of this name.
        """
        with self._lock:
            board = self.scene.board_placement(self.board_placements) if self.board_placed else None
            camera = self.T_world_held
            if not self.camera_held:
                q = self._joints.get(self.camera_arm, self.start_joints_rad)
                camera = self.scene.true_camera(q, self.station)
            lens = self.scene.camera_intrinsics(self.image_width)
            if name:
                if name not in self.further:
                    raise LookupError(f"there is no camera {name!r}")
                one = self.further[name]
                camera, lens = one.pose(camera), one.lens.scaled(self.image_width)
            return {
                "T_world_camera": camera.tolist(),
                "intrinsics": lens.to_json(),
                "scene": {
                    "seed": self.scene.seed,
                    "moved": self.scene.moved,
                    "spray": self.spray,
                    "control_spheres": self.control_spheres,
                    "board": None if board is None else board.tolist(),
                },
                "station": self.station,
                "light_lux": self.scene.light_lux,
                "temperature_c": self.scene.temperature_c,
                "pedal_presses": self.pedal_presses,
                "pedal_ago_s": time.monotonic() - self.pedal_pressed_s,
                "lens_cleanings": self.lens_cleanings,
                "hand": {"shake": self.press.shake, "finger": self.press.finger},
            }

    def hold(self, T_world_camera: Array) -> None:
        """Hold the camera at this pose."""
        with self._lock:
            self.T_world_held = T_world_camera

    def press_shutter(self, press: Press) -> None:
        """Press the camera's own button."""
        with self._pressed:
            self.press = press
            self.shutter_presses += 1
            self._pressed.notify_all()

    def await_shutter(self, after: int) -> dict[str, Any]:
        """Wait until the button was pressed more than `after` times, or for a moment.

        Returns the count and the last press.
        """
        with self._pressed:
            self._pressed.wait_for(lambda: self.shutter_presses > after, timeout=_LONGEST_WAIT_S)
            return {"shutter_presses": self.shutter_presses, "iso": self.press.iso}

    def act(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Carry out an action of the technician's hands that only changes the scene."""
        action = request.get("action")
        with self._lock:
            match action:
                case "place_board" | "remove_board":
                    self.board_placed = action == "place_board"
                    self.board_placements += self.board_placed
                case "move_robot":
                    if request.get("station") not in STATIONS:
                        return {"ok": False, "error": f"no station {request.get('station')!r}; {', '.join(STATIONS)}"}
                    self.station = str(request["station"])
                case "place_control_spheres" | "remove_control_spheres":
                    self.control_spheres = action == "place_control_spheres"
                case "spray":
                    self.spray = True
                case "hold_camera":
                    return self._hold_camera(str(request.get("side", "above")))
                case "mount_camera":
                    return self._mount_camera()
                case "move_sphere":
                    return self._move_sphere(request)
                case "press_shutter":
                    self.press = Press()
                    self.shutter_presses += 1
                    self._pressed.notify_all()
                case "clean_lens":
                    self.lens_cleanings += 1
                case "press_pedal":
                    self.pedal_presses += 1
                    self.pedal_pressed_s = time.monotonic()
                case _:
                    return {"ok": False, "error": f"hands cannot do {action!r}"}
        return {"ok": True}

    def _hold_camera(self, side: str) -> dict[str, Any]:
        if side not in HELD_CAMERAS:
            return {"ok": False, "error": f"no side {side!r}; {', '.join(HELD_CAMERAS)}"}
        self.camera_held, self.T_world_held = True, HELD_CAMERAS[side]
        return {"ok": True}

    def _mount_camera(self) -> dict[str, Any]:
        if not self.arms:
            return {"ok": False, "error": "there is no arm to mount the camera on"}
        self.camera_held = False
        return {"ok": True}

    def _move_sphere(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Follow an arrow drawn in the held camera's image: move the sphere at its start along the table.

        `from` and `to` (2,) are fractions of the image's width and height; `higher_m` is the change of the sphere's
        height.
        """
        if not self.camera_held:
            return {"ok": False, "error": "there is no picture to point at: the camera is on the arm"}
        lens = self.scene.camera_intrinsics(self.image_width)
        size = np.array([lens.width, lens.height])
        start, end = (size * np.array(request[name], dtype=np.float64) for name in ("from", "to"))
        T_world_camera = self.T_world_held
        centres = apply(inverse(T_world_camera), self.scene.registration_m)
        away_px = np.linalg.norm(lens.project(centres) - start, axis=1)
        index = int(np.argmin(away_px))
        if away_px[index] > _POINTED_AT * lens.fx * RADIUS_M / centres[index, 2]:
            return {"ok": False, "error": "there is no registration sphere where the arrow begins"}
        place = self.scene.registration_m[index].copy()
        origin, direction = T_world_camera[:3, 3], T_world_camera[:3, :3] @ lens.rays(end)
        place[:2] = (origin + direction * (place[2] - origin[2]) / direction[2])[:2]
        place[2] += float(request.get("higher_m", 0.0))
        place = np.clip(place, [-_TABLE_M[0], -_TABLE_M[1], _HEIGHTS_M[0]], [*_TABLE_M, _HEIGHTS_M[1]])
        others = np.concatenate([np.delete(self.scene.registration_m, index, axis=0), self.scene.control_m])
        if np.linalg.norm(others - place, axis=1).min() < _ROOM_M:
            return {"ok": False, "error": "another sphere is in the way"}
        self.scene = self.scene.with_sphere_at(index, place)
        return {"ok": True}


class WorldServer(socketserver.ThreadingTCPServer):
    """JSON lines on a loopback port: `robot`, `camera` (no answer), `view`, `act`, `shutter` (answers at a press)."""

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, world: World, act: Act) -> None:
        self.world, self.act = world, act
        super().__init__(("127.0.0.1", 0), _Client)

    @property
    def address(self) -> str:
        """The address as HOST:PORT."""
        host, port = self.server_address[:2]
        return f"{host!s}:{port}"


class _Client(socketserver.StreamRequestHandler):
    def handle(self) -> None:
        server = self.server
        assert isinstance(server, WorldServer)
        try:
            while line := self.rfile.readline(_LONGEST_REQUEST):
                answer = _answer(server, line)
                if answer is not None:
                    self.wfile.write(json.dumps(answer).encode() + b"\n")
        except (ConnectionError, TimeoutError):
            return  # the client disconnected; the world does not depend on it


def _answer(server: WorldServer, line: bytes) -> dict[str, Any] | None:
    try:
        request: object = json.loads(line)
        if not isinstance(request, dict):
            return {"ok": False, "error": "bad request: not a JSON object"}
        request = cast("dict[str, Any]", request)
        if request.get("op") == "robot":
            server.world.arm_moved(str(request["arm"]), np.array(request["q"], dtype=np.float64))
            return None
        if request.get("op") == "camera":  # a device other than an arm carries it
            server.world.hold(_rigid(request["T_world_camera"]))
            return None
        return _operation(server, request)
    except (ValueError, LookupError, TypeError, ArithmeticError, RecursionError) as error:
        return {"ok": False, "error": f"bad request: {error}"}


def _rigid(rows: object) -> Array:
    """A pose (4, 4). Raises ValueError if it is not one."""
    T = np.array(rows, dtype=np.float64)
    if T.shape != (4, 4) or not np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6):
        raise ValueError("T_world_camera is not a rigid 4×4 transform")
    return T


def _operation(server: WorldServer, request: dict[str, Any]) -> dict[str, Any]:
    match request.get("op"):
        case "view":
            return server.world.view(str(request.get("camera", "")))
        case "act":
            return server.act(request)
        case "shutter":
            return server.world.await_shutter(int(request["after"]))
        case other:
            return {"ok": False, "error": f"no operation {other!r}"}
