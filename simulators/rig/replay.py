"""A simulated rig that serves a recording: which simulator serves which device, and which devices none serves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from simulators.recordings import RecordedDevice, recorded_devices
from simulators.scene.world import ARMS
from simulators.serve import SimulatorError
from simulators.ur_controller.replay import recorded

_BODIES = {"Sony": "camera", "Nikon": "nikon", "Canon": "canon"}  # makers of bodies, and their simulators
_MOST_ARMS = 2


@dataclass(frozen=True, slots=True)
class Replay:
    """Holds what a recording makes of a rig."""

    arm: str  # model of its arms; "" if it holds none
    arms: int
    camera: str  # simulator of the first camera; "" if it holds none that is served
    words: dict[str, tuple[str, ...]]  # what the command lines of the rig's simulators have beside
    not_served: tuple[str, ...]


NOTHING = Replay("", 0, "", {}, ())


def replay_of(file: Path) -> Replay:
    """Read which devices of a recording are served. Raises SimulatorError for arms that no rig has."""
    devices = recorded_devices(file)
    arms = [device for device in devices if device.driver == "ur" and device.exchanges]
    models = {recorded(device).model.name for device in arms}
    if len(models) > 1 or len(arms) > _MOST_ARMS or not models <= set(ARMS):
        raise SimulatorError(
            f"a rig has one arm or two equal ones of {', '.join(ARMS)}, the recording {sorted(models)}"
        )
    camera = next((device for device in devices if _body(device)), None)
    names = ("robot",) if len(arms) == 1 else ("robot_1", "robot_2")
    replayed = dict(zip(names, arms, strict=False)) | ({"camera": camera} if camera else {})
    served = [device.name for device in replayed.values()]
    return Replay(
        next(iter(models), ""),
        len(arms),
        _body(camera) if camera else "",
        {name: ("--replay", str(file), "--replayed", device.name) for name, device in replayed.items()},
        tuple(f"{one.name} ({one.driver}): simulated as in any rig" for one in devices if one.name not in served),
    )


def _body(device: RecordedDevice) -> str:
    """The simulator of a recorded still camera; "" if there is none for it."""
    if device.driver != "gphoto" or "listing" not in device.answers:
        return ""
    return next((name for maker, name in _BODIES.items() if device.listing["maker"].startswith(maker)), "")
