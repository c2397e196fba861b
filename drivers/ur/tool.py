"""Follows the tool on the flange, centre point and payload, in every sample: somebody may change it at the pendant.

The controller reports the pose of the tool's centre point, from which the flange's follows only if the tool is known.
RTDE has the centre point (tcp_offset), but ur_rtde's client has no getter for it, and a query takes a command of the
control script. So it is read by command once, and then followed: what pose and joints of a sample say of the tool
together changes slowly with the posture, by the arm's factory calibration, and at once with the tool.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Generator

import numpy as np

from drivers.arm.latch import Latch
from drivers.errors import DeviceFaultError, DeviceTimeoutError
from drivers.interfaces import Array, Payload, Transform
from drivers.ur.link import vendor
from drivers.ur.script import wait
from service.core.arms import ArmModel, fits, flange_pose, pose_gap
from service.core.geometry import inverse
from service.core.units import deg, mm

READ_BACK_S = 1.0
# From one sample to the next, the tool seems to change by so much at most, and by so much for each radian that the
# joints turn meanwhile: by the factory calibration, or by all of the motion for an arm whose kinematics are unknown.
JUMP_M, JUMP_RAD = 0.0005, 0.001
CALIBRATION_M_RAD, CALIBRATION_RAD_RAD = 0.02, 0.03
UNKNOWN_ARM_M_RAD, UNKNOWN_ARM_RAD_RAD = 2.5, 1.1
SAME_KG = SAME_COG_M = 0.001
SET_ELSEWHERE = "Check on the pendant whether another program sets it, end that program, then try again"


class ToolWatch:
    """The tool that the controller holds, as last stated and as seen since; latches the arm when it changes."""

    def __init__(self, latch: Latch) -> None:
        self._latch = latch
        self._lock = threading.Lock()  # samples come in a thread of their own
        self._arm: ArmModel | None = None
        self._T_flange_tcp = self._T_tcp_flange = np.eye(4)
        self._stated = self._changing = False
        self._before: tuple[Array, Transform] | None = None  # joints of the last sample, and the tool seen in it
        self._payload: Payload | None = None

    @property
    def T_flange_tcp(self) -> Transform:
        """The centre point (4, 4) in the flange frame."""
        return self._T_flange_tcp

    @property
    def payload(self) -> Payload | None:
        """The payload in the newest sample; None before the first one."""
        return self._payload

    def start(self, arm: ArmModel | None) -> None:
        """Begin with a new connection to this arm, None if its kinematics are unknown; no tool is known yet."""
        with self._lock:
            self._arm, self._before, self._payload = arm, None, None
            self._stated = self._changing = False

    def state(self, T_flange_tcp: Transform) -> None:
        """Take the centre point (4, 4) as the controller states it; another one than before latches the arm."""
        with self._lock:
            away = pose_gap(self._T_flange_tcp, T_flange_tcp)
            if self._stated and not self._changing and (away[0] > JUMP_M or away[1] > JUMP_RAD):
                self._latch.change(f"the tool centre point was changed by {_words(away)}")
            self._use(T_flange_tcp)
            self._stated = True

    @contextlib.contextmanager
    def changing(self, payload: Payload) -> Generator[None]:
        """Let this driver change the tool: nothing is judged meanwhile, and nothing is taken as known if it fails.

        Leave it once the stream shows what was set. The next sample is compared with that, so that no change by
        somebody else falls between the two.
        """
        with self._lock:
            self._changing = True
        try:
            yield
        except BaseException:
            with self._lock:
                self._stated = self._changing = False
                self._before, self._payload = None, None
            raise
        with self._lock:
            self._changing, self._payload = False, payload

    def flange(self, joints_rad: Array, T_base_tcp: Transform, payload: Payload) -> Transform:
        """T_base_flange (4, 4) of a sample; latches the arm if the tool is not that of the sample before."""
        with self._lock:
            by_joints = None if self._arm is None else flange_pose(self._arm, joints_rad)
            self._follow(joints_rad, T_base_tcp, by_joints)
            T_base_flange = T_base_tcp @ self._T_tcp_flange
            self._weigh(payload)
            if by_joints is not None and self._judging and not fits(away := pose_gap(by_joints, T_base_flange)):
                self._latch.change(f"the flange is reported {_words(away)} from where its joints put it")
            return T_base_flange

    @property
    def _judging(self) -> bool:
        return self._stated and not self._changing

    def _follow(self, joints_rad: Array, T_base_tcp: Transform, by_joints: Transform | None) -> None:
        """Compare the tool seen in a sample with that of the sample before; `by_joints`: T_base_flange, if known."""
        before = self._before
        seen = T_base_tcp if by_joints is None else inverse(by_joints) @ T_base_tcp
        self._before = (joints_rad, seen)
        if before is None or not self._judging:
            return
        turned_rad = float(np.sum(np.abs(joints_rad - before[0])))
        away = pose_gap(before[1], seen)
        if not jumped(away, turned_rad, known=by_joints is not None):
            return
        self._latch.change(f"the tool centre point was changed by {_words(away)}")
        self._use(self._T_flange_tcp @ inverse(before[1]) @ seen)  # so that poses stay the flange's

    def _weigh(self, payload: Payload) -> None:
        before, self._payload = self._payload, payload
        if before is None or not self._judging:
            return
        shift_m = np.linalg.norm(np.subtract(payload.centre_of_gravity_m, before.centre_of_gravity_m))
        if abs(payload.mass_kg - before.mass_kg) > SAME_KG or shift_m > SAME_COG_M:
            self._latch.change(
                f"the payload was changed from {before.mass_kg:g} kg to {payload.mass_kg:g} kg, and its centre of "
                f"gravity by {mm(float(shift_m)):.0f} mm"
            )

    def _use(self, T_flange_tcp: Transform) -> None:
        self._T_flange_tcp, self._T_tcp_flange = T_flange_tcp, inverse(T_flange_tcp)


def jumped(away: tuple[float, float], turned_rad: float, *, known: bool) -> bool:
    """Return whether the tool of two samples in a row differs by more than the motion between them explains.

    Args:
        away: how far the one is from the other, m and rad.
        turned_rad: how far all joints together turned from the one to the other.
        known: whether the arm's kinematics are known.
    """
    of_m, of_rad = (CALIBRATION_M_RAD, CALIBRATION_RAD_RAD) if known else (UNKNOWN_ARM_M_RAD, UNKNOWN_ARM_RAD_RAD)
    return away[0] > JUMP_M + of_m * turned_rad or away[1] > JUMP_RAD + of_rad * turned_rad


def read_back(agrees: Callable[[], bool], what: str, where: str) -> None:
    """Wait until the stream shows what was set. Raises DeviceFaultError if it does not within READ_BACK_S."""
    with vendor(where, f"reading back the {what}"):
        try:
            wait(agrees, READ_BACK_S, what, where)
        except DeviceTimeoutError:
            raise DeviceFaultError(
                f"the {what} reads back differently from what was set", where=where, remedy=SET_ELSEWHERE
            ) from None


def _words(away: tuple[float, float]) -> str:
    return f"{mm(away[0]):.1f} mm and {deg(away[1]):.1f}°"
