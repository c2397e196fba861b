"""The modes of a simulated controller: the way to running with its times, back drive, and what stops the arm."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.errors import DeviceRefusedError, LeaveNeededError, SafetyStopError
from drivers.interfaces import SafetyState
from drivers.ur.safety import safety_state
from simulators.faults import FaultPlan
from simulators.ur_controller.controller import Controller
from simulators.ur_controller.dashboard import Dashboard
from simulators.ur_controller.kinematics import MODELS
from simulators.ur_controller.modes import BRAKES_S, POWERING_S, SAFETY_BITS, WITHOUT_POWER, Runtime, SafetyMode
from simulators.ur_controller.pendant import Pendant
from simulators.ur_controller.program import Interpreter
from tests.support.arms.ur_driver import SPEED_UP, dashboard, let_move, move, opened, travel, turned, wait_for
from tests.support.arms.ur_simulator import address, pendant, simulated_ur

HOME = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])


class Cell:
    """A controller with its pendant and one dashboard client, on time that the test lets pass."""

    def __init__(self) -> None:
        self.controller = Controller(
            MODELS["UR10e"], (5, 12), joints=HOME, serial="20235001", faults=FaultPlan(), device="robot"
        )
        self.interpreter = Interpreter(self.controller)
        self.ask = Dashboard(self.controller, self.interpreter).answer
        self.person = Pendant(self.controller, self.interpreter).carry_out

    def shown(self, seconds: float = 0.0) -> list[tuple[int, int, int]]:
        """robot_mode, safety_mode and safety_status_bits, each time they change within these seconds."""
        seen: list[tuple[int, int, int]] = []
        for _ in range(round(seconds / 0.01) + 1):
            values = self.controller.values()
            now = tuple(int(values[n][0]) for n in ("robot_mode", "safety_mode", "safety_status_bits"))
            if not seen or seen[-1] != now:
                seen.append((now[0], now[1], now[2]))
            self.controller.advance(0.01)
            self.interpreter.step()
        return seen

    def modes(self, seconds: float) -> list[int]:
        return [mode for mode, _, _ in self.shown(seconds)]


def test_the_way_from_switched_off_to_running_takes_its_time() -> None:
    cell = Cell()
    assert cell.ask("power off") == "Powering off"
    assert cell.modes(1.0) == [3]
    assert cell.ask("power on") == "Powering on"
    assert cell.modes(POWERING_S - 0.1) == [4]
    assert cell.modes(5.0) == [4, 5]
    assert cell.ask("power on") == "Powering on", "Universal_Robots_Client_Library#397"
    assert cell.modes(5.0) == [5], "the mode stays"
    assert cell.ask("brake release") == "Brake releasing"
    assert cell.modes(BRAKES_S - 0.1) == [5]
    assert cell.modes(1.0) == [5, 7]
    cell.ask("power off")
    cell.ask("brake release")
    assert cell.modes(POWERING_S + BRAKES_S + 0.1) == [4, 5, 7], "both in one order"
    cell.ask("power off")
    cell.ask("brake release")
    cell.ask("power off")
    assert cell.modes(10.0) == [3], "what was begun is cancelled"


def test_back_drive_needs_closed_brakes() -> None:
    cell = Cell()
    assert cell.person("backdrive 0.1 0 0 0 0 0 0.5").startswith("no:")
    cell.ask("power off")
    cell.ask("power on")
    cell.modes(POWERING_S + 0.1)
    assert cell.person("backdrive 0.1 0 0 0 0 0 0.5") == "ok"
    assert cell.modes(1.0) == [6, 5]
    np.testing.assert_allclose(cell.controller.actual_q - HOME, [0.1, 0, 0, 0, 0, 0], atol=1e-9)


@pytest.mark.parametrize("mode", SafetyMode)
def test_every_safety_mode_is_shown_and_understood(mode: SafetyMode) -> None:
    cell = Cell()
    cell.ask("load a.urp")
    cell.ask("play")
    assert cell.person(f"safety {mode.name.lower()}") == "ok"
    assert cell.shown() == [(3 if mode in WITHOUT_POWER else 7, int(mode), SAFETY_BITS[mode])]
    free = mode in (SafetyMode.NORMAL, SafetyMode.REDUCED)
    assert cell.controller.may_move is free
    assert safety_state(SAFETY_BITS[mode]).may_move is free, "the driver holds the arm in the same modes"
    assert cell.ask("safetymode") == f"Safetymode: {mode.name}"
    held = mode.name in ("SAFEGUARD_STOP", "SYSTEM_THREE_POSITION_ENABLING_STOP")
    assert cell.controller.runtime is (Runtime.PLAYING if free else Runtime.PAUSED if held else Runtime.STOPPED)
    if mode in WITHOUT_POWER:
        cell.ask("power on")
        assert cell.modes(5.0) == [3]


def test_a_released_emergency_stop_shows_normal_and_no_power() -> None:
    """Universal_Robots_ROS_Driver#141."""
    cell = Cell()
    cell.controller.emergency_stop()
    assert cell.shown(1.0) == [(3, 7, 1 << 6 | 1 << 7 | 1 << 10)]
    assert cell.shown(2.0)[-1] == (3, 1, 1)
    assert not cell.controller.may_move


def test_the_driver_says_which_mode_and_stop_hold_the_arm() -> None:
    host = address(75)
    with simulated_ur(host, "--speed-up", SPEED_UP), opened(host) as arm:
        travel(arm, turned(arm, 0.1))
        pendant(host, "safety system_three_position_enabling_stop")
        wait_for(lambda: arm.state().sample.safety is SafetyState.SAFEGUARD_STOP)
        with pytest.raises(SafetyStopError, match="safeguard stop"):
            move(arm, turned(arm, 0.1))
        pendant(host, "safety normal")
        wait_for(lambda: arm.state().sample.safety is SafetyState.NORMAL)
        held = (SafetyStopError, LeaveNeededError)  # whichever was seen first: the stop, or the end of the program
        with pytest.raises(held, match="nobody has confirmed since"):
            move(arm, turned(arm, 0.1))
        let_move(arm)
        travel(arm, turned(arm, 0.1))
        dashboard(host, "power off", "power on")
        wait_for(lambda: arm.state().robot_mode in ("POWER_ON", "IDLE"))
        with pytest.raises(DeviceRefusedError, match=r"mode (POWER_ON|IDLE)"):
            move(arm, turned(arm, 0.1))
