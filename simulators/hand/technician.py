"""A simulated technician who holds the camera and follows the words on the screen, about as well as a person does."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from simulators.geometry import Array, from_euler

Kind = Literal["steady", "usual", "clumsy"]
#: A mishap happens every so many presses of the button; 0: never.
MISHAP_EVERY: Mapping[Kind, int] = {"steady": 0, "usual": 4, "clumsy": 2}
#: The mishaps, in the order in which they happen.
MISHAPS = ("blurred", "half_way", "finger", "settings", "repeated")
_TREMOR_M, _TREMOR_RAD = 0.012, np.radians(1.2)  # accuracy with which a person brings a camera to a pose
_REACTION_S = 0.15
_FORWARD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # looks along y, top up
_OVERHEAD = re.compile(r"(\d+) cm above")
_MOVE = re.compile(r"(\d+) cm (to the right|to the left|forward|back|higher|lower)")
_TURN = re.compile(r"(turn|tilt|lean) (\d+)° (to the left|to the right|up|down)")
_DIRECTIONS = {
    "to the right": (1, 0, 0),
    "to the left": (-1, 0, 0),
    "forward": (0, 1, 0),
    "back": (0, -1, 0),
    "higher": (0, 0, 1),
    "lower": (0, 0, -1),
}


@dataclass(frozen=True, slots=True)
class Grip:
    """Pose of the held camera: position (3,) in the world, turn about the vertical, lean to the right, tilt down."""

    position_m: Array
    turn_rad: float = 0.0
    lean_rad: float = 0.0
    tilt_rad: float = np.pi / 2

    def T_world_camera(self) -> Array:
        """The pose T_world_camera (4, 4)."""
        # Tilt first, then lean, then turn: the order of rotations about fixed axes.
        held = from_euler(np.array([-self.tilt_rad, self.lean_rad, self.turn_rad]), self.position_m)
        held[:3, :3] = held[:3, :3] @ _FORWARD
        return held


def follow(words: str, grip: Grip, above_m: Array, share: float = 1.0) -> Grip:
    """Return the grip after `share` of the requested motion.

    `above_m` (3,) is the centre of the photographed object.
    """
    overhead = _OVERHEAD.search(words)
    if overhead is not None:
        height = np.array([0.0, 0.0, int(overhead.group(1)) / 100])
        return Grip(grip.position_m + share * (above_m + height - grip.position_m))
    moved = np.zeros(3)
    for centimetres, direction in _MOVE.findall(words):
        moved += int(centimetres) / 100 * np.array(_DIRECTIONS[direction])
    c, s = np.cos(grip.turn_rad), np.sin(grip.turn_rad)
    moved = np.array([c * moved[0] - s * moved[1], s * moved[0] + c * moved[1], moved[2]])
    angles = {"turn": 0.0, "tilt": 0.0, "lean": 0.0}
    for verb, degrees, direction in _TURN.findall(words):
        positive = direction in {"turn": ("to the left",), "tilt": ("down",), "lean": ("to the right",)}[verb]
        angles[verb] += np.radians(int(degrees)) * (1 if positive else -1)
    return Grip(
        grip.position_m + share * moved,
        grip.turn_rad + share * angles["turn"],
        grip.lean_rad + share * angles["lean"],
        grip.tilt_rad + share * angles["tilt"],
    )


@dataclass(frozen=True, slots=True)
class Press:
    """Holds what happens during one press of the button."""

    shake: tuple[float, float] = (0.0, 0.0)  # image motion during the exposure, as fractions of its width
    finger: bool = False
    iso: int = 0  # the value to which the dial was turned by accident; 0: not turned


@dataclass
class Hand:
    """Acts on the world when it reads where to go next, and ignores all other words on the screen."""

    kind: Kind
    seed: int
    hold: Callable[[Array], None]  # called with the new T_world_camera
    press: Callable[[Press], None]
    above_m: Array
    grip: Grip = field(init=False)
    presses: int = 0
    mishaps: list[str] = field(default_factory=list[str])
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        self.grip = Grip(self.above_m + np.array([0.0, -0.1, 0.7]))

    def read(self, words: str) -> None:
        """React to words that say where to go next, or to take the photograph now; returns at once."""
        if words.startswith("next: "):
            threading.Thread(target=self.do, args=(words,), daemon=True).start()
        elif words.startswith("take the photograph now"):
            threading.Thread(target=self.press, args=(Press(),), daemon=True).start()

    def do(self, words: str) -> None:
        """Move as the words say and press the button."""
        with self._lock:
            self.presses += 1
            rng = np.random.default_rng([self.seed, 0x4A4D, self.presses])
            mishap = self._mishap()
            # The tremor is added to the requested pose, so the hand does not drift.
            share = 0.0 if mishap == "repeated" else 0.5 if mishap == "half_way" else 1.0
            wanted = follow(words, self.grip, self.above_m, share)
            shaken = rng.normal(0.0, 1.0, 6)
            self.grip = Grip(
                wanted.position_m + _TREMOR_M / np.sqrt(3) * shaken[:3] * max(share, 0.1),
                wanted.turn_rad + _TREMOR_RAD / np.sqrt(3) * shaken[3] * max(share, 0.1),
                wanted.lean_rad + _TREMOR_RAD / np.sqrt(3) * shaken[4] * max(share, 0.1),
                wanted.tilt_rad + _TREMOR_RAD / np.sqrt(3) * shaken[5] * max(share, 0.1),
            )
            self.hold(self.grip.T_world_camera())
            time.sleep(_REACTION_S)
            angle = rng.uniform(0, 2 * np.pi)
            shake = 0.012 if mishap == "blurred" else 0.0
            self.press(
                Press(
                    (shake * float(np.cos(angle)), shake * float(np.sin(angle))),
                    finger=mishap == "finger",
                    iso=200 if mishap == "settings" else 0,
                )
            )

    def _mishap(self) -> str:
        every = MISHAP_EVERY[self.kind]
        if not every or self.presses % every:
            return ""
        mishap = MISHAPS[len(self.mishaps) % len(MISHAPS)]
        self.mishaps.append(mishap)
        return mishap

    def report(self) -> dict[str, Any]:
        """Return the mishaps so far, for the truth file."""
        return {"presses": self.presses, "mishaps": list(self.mishaps)}
