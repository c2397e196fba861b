"""What a person does at the pendant or with their hands on the arm: one order a line, carried out as Polyscope would.

A real arm has no such port. What each act shows on the other ports:

- `push`: the arm gives way while its program runs on, as in a program's own free drive: actual_q and target_q move,
  actual_qd is not zero, and target_qd stays 0, since nothing is commanded. A motion under way ends as far off. (Where
  the controller holds the position, a hand that is strong enough causes a protective stop instead.)
- `freedrive`: Polyscope ends the program first (runtime_state 1); robot_mode stays 7 and safety_mode 1.
- `backdrive`: before the brakes are released, the arm is turned against them: robot_mode 6, then 5 again.
- `safety`: safety_mode, safety_status_bits; a stop of its kind holds or ends the program, or cuts the power.
- `tcp`, `payload`: tcp_offset, actual_TCP_pose, payload and payload_cog change from one cycle to the next.
- `slider`: target_speed_fraction and speed_scaling.
- `program`: the running program ends, and the foreign one begins after the time that opening it takes.
"""

from __future__ import annotations

import numpy as np

from simulators.ur_controller.controller import Controller
from simulators.ur_controller.modes import SafetyMode
from simulators.ur_controller.program import Interpreter

ORDERS = (
    "push Q1 Q2 Q3 Q4 Q5 Q6 SECONDS, freedrive Q1 Q2 Q3 Q4 Q5 Q6 SECONDS, backdrive Q1 Q2 Q3 Q4 Q5 Q6 SECONDS, "
    "tcp X Y Z RX RY RZ, payload KG X Y Z, slider PERCENT, safety MODE, stop, program NAME.urp"
)


class Pendant:
    """Carries out orders on one controller."""

    def __init__(self, controller: Controller, interpreter: Interpreter) -> None:
        self._controller = controller
        self._interpreter = interpreter

    def carry_out(self, line: str) -> str:
        """Carry out one order; returns `ok`, or why not."""
        word, *rest = line.split()[:8] or [""]
        if word == "program" and len(rest) == 1 and rest[0].endswith(".urp"):
            self._interpreter.run_foreign(rest[0])
            return "ok"
        if word == "safety" and len(rest) == 1 and rest[0].upper() in SafetyMode.__members__:
            self._controller.turn_safety(SafetyMode[rest[0].upper()])
            return "ok"
        if word == "stop" and not rest:
            self._interpreter.stop()
            return "ok"
        try:
            numbers = [float(text) for text in rest]
        except ValueError:
            numbers = []
        done = bool(np.all(np.isfinite(numbers))) and self._turn(word, numbers)
        return "ok" if done else f"no: {ORDERS}"

    def _turn(self, word: str, numbers: list[float]) -> bool:
        """Do what is stated in numbers; False if there is no such order, or if the controller refuses it."""
        controller = self._controller
        match word, len(numbers):
            case "push" | "freedrive", 7:
                if word == "freedrive":
                    self._interpreter.stop()
                controller.push(np.array(numbers[:6]), numbers[6])
            case "backdrive", 7:
                return controller.backdrive(np.array(numbers[:6]), numbers[6])
            case "tcp", 6:
                controller.set_tcp(np.array(numbers))
            case "payload", 4:
                return controller.set_payload(numbers[0], numbers[1:])
            case "slider", 1:
                controller.set_speed(numbers[0] / 100)
            case _:
                return False
        return True
