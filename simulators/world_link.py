"""A simulated controller's link to the world, which draws what its camera sees."""

from __future__ import annotations

import json
import logging
import socket

_LOG = logging.getLogger(__name__)

WORLD_MOVING_S, WORLD_STILL_S = 0.016, 0.1


class WorldLink:
    """Reports a device's state to the world; reconnects by itself and never blocks."""

    def __init__(self, address: tuple[str, int], arm: str) -> None:
        self._address, self._arm = address, arm
        self._socket: socket.socket | None = None
        self._next_s = 0.0
        self._place: object = None  # joints or pose, as last sent

    def push(self, joints_rad: list[float], time_s: float, now_s: float) -> None:
        """Send the joints at a controller's time if they changed, and otherwise now and then."""
        self._push(joints_rad, {"op": "robot", "arm": self._arm, "q": joints_rad, "t": time_s}, now_s)

    def push_camera(self, T_world_camera: list[list[float]], now_s: float) -> None:
        """Send where the device carries the camera, (4, 4), if it moved, and otherwise now and then."""
        self._push(T_world_camera, {"op": "camera", "T_world_camera": T_world_camera}, now_s)

    def _push(self, place: object, message: dict[str, object], now_s: float) -> None:
        moving = place != self._place
        if now_s < self._next_s - (WORLD_STILL_S - WORLD_MOVING_S if moving else 0.0):
            return
        self._next_s = now_s + WORLD_STILL_S
        self._place = place
        try:
            if self._socket is None:
                self._socket = socket.create_connection(self._address, timeout=0.2)
                self._socket.setblocking(False)
            self._socket.sendall(json.dumps(message).encode() + b"\n")
        except OSError as error:
            _LOG.warning("world %s:%d: %s", *self._address, error)
            self.close()
            self._next_s = now_s + 1.0

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
