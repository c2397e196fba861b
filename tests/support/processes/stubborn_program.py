"""A program that moves an arm back and forth and always tries to continue: a process for tests to kill.

Its arguments are a driver, its configuration as JSON, the values of the first joint between which it moves, its
speed and acceleration. Each line that it reads is the name of a person who permits motion, or the word `hang`, after
which its main loop hangs. It reports its observations as lines of JSON.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from typing import Any

from drivers.errors import DeviceError, DeviceUnavailableError
from drivers.host.hosted_device import HostedDevice, hosted
from drivers.host.serving import load_spec
from drivers.interfaces import RobotArm


def say(**words: object) -> None:
    sys.stdout.write(json.dumps(words) + "\n")
    sys.stdout.flush()


def main() -> None:
    spec, given, *numbers = sys.argv[1:]
    config = load_spec(spec).config.model_validate_json(given)
    *goals_rad, speed_rad_s, acceleration_rad_s2 = map(float, numbers)
    arm = hosted(RobotArm, spec, config, call_timeout_s=60, name="robot")
    while not _open(arm):
        time.sleep(0.1)
    persons: list[tuple[str, float]] = []
    hangs = threading.Event()
    threading.Thread(target=_listen, args=(persons, hangs), daemon=True).start()
    device: HostedDevice = vars(arm)["hosted_device"]
    say(driver=device.pid)
    said: Any = None
    while True:
        try:
            if persons:
                name, asked_s = persons.pop()
                said = None
                _let_move(arm, name, asked_s)
            target = arm.state().sample.joints_rad.copy()
            target[0] = goals_rad[0]
            arm.move_joints(target, speed_rad_s=speed_rad_s, acceleration_rad_s2=acceleration_rad_s2)
            said = None
            say(moves_to=target[0])
            while arm.is_moving():
                time.sleep(0.02)
                while hangs.is_set():  # only a screen's thread goes on watching the arm
                    arm.samples(time.monotonic() - 0.3, time.monotonic())
                    time.sleep(0.1)
            say(arrived=target[0])
            goals_rad.reverse()
        except DeviceError as error:
            if type(error).__name__ != said:
                said = type(error).__name__
                say(error=said, message=str(error), driver=device.pid)
            time.sleep(0.1)
            if isinstance(error, DeviceUnavailableError):
                _open(arm)


def _let_move(arm: RobotArm, name: str, asked_s: float) -> None:
    try:
        arm.let_move(name, asked_s)
    except DeviceError as error:
        say(let_by=None, message=str(error))
        raise
    say(let_by=name)


def _open(arm: RobotArm) -> bool:
    try:
        arm.open()
    except DeviceError as error:
        say(opening=str(error))
        return False
    return True


def _listen(persons: list[tuple[str, float]], hangs: threading.Event) -> None:
    for line in sys.stdin:
        if line.strip() == "hang":
            hangs.set()
        else:
            persons.append((line.strip(), time.monotonic()))


if __name__ == "__main__":
    main()
