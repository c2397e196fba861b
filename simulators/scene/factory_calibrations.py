"""Thirteen factory calibrations of arms of Universal Robots: how they were built, against the published dimensions.

Each controller holds the calibration of its own arm. Some of their owners have published theirs as `ur_calibration`
writes it (`my_robot_calibration.yaml`). The numbers below are those files less the published dimensions, in the form

    T_(i-1)_i = Rz(θ_i) Tz(d_i) Tx(a_i) Ry(β_i) Rx(α_i),

which reproduces the files' chains to 5 µm (two CB3 arms: 30 and 70 µm, by the zeros of joints, which are left out).
β turns an axis that is parallel to the one before in the direction that α cannot; Hayati and Mirmirani, 1985.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simulators.geometry import Array
from simulators.units import metres, radians_of_mrad

# d6 of the five big arms of the e-Series is shorter than published, by more than it scatters; no other length is.
BIG_D6_MM, BIG_D6_SIGMA_MM = -0.944, 0.094
# Each departure is one of a, d, α, θ, β, and of a joint.
_A, _D, _ALPHA, _BETA = 0, 1, 2, 4
_COLUMNS = (
    (_D, 0), (_A, 0), (_ALPHA, 0), (_A, 1), (_ALPHA, 1), (_BETA, 1), (_A, 2), (_ALPHA, 2), (_BETA, 2), (_D, 3),
    (_A, 3), (_ALPHA, 3), (_D, 4), (_A, 4), (_ALPHA, 4), (_D, 5),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class FactoryCalibration:
    """One arm: its model, where its file was found, and its departures in mm and mrad, in the order of the table."""

    model: str
    source: str
    departures: tuple[float, ...]

    @property
    def dh_deltas(self) -> Array:
        """(6, 5) added to a, d (metres), α, θ, β (radians) of each joint."""
        return _as_deltas(np.array(self.departures))


# d1, a1, α1; a2, α2, β2; a3, α3, β3, d4; a4, α4, d5; a5, α5, d6
CALIBRATIONS = (
    FactoryCalibration("UR10e", "Jaron-G/ur10e_gripper", (
        -0.1712, -0.0002, -0.6615, 0.5214, -0.2459, 0.4408, 0.4161, -13.3134, 0.0809, 0.1140,
        0.0603, -1.5359, -0.1111, -0.0625, -0.5310, -1.0342,
    )),
    FactoryCalibration("UR10e", "YongyuLiu03/ur10e_controller", (
        0.3950, -0.0167, -0.7877, 0.1805, -0.8657, 1.8188, 0.4035, -1.2457, -0.9161, 0.3734,
        -0.0240, -0.6209, -0.0618, 0.0841, 0.1259, -0.8560,
    )),
    FactoryCalibration("UR10e", "pushkarkadam/robot_cell_control", (
        -0.1434, 0.0330, -0.7864, 0.5293, 1.4013, -0.3151, 0.2744, 5.1623, -0.7501, -0.1093,
        0.0466, -1.4455, -0.1686, 0.0842, -0.0981, -0.8844,
    )),
    FactoryCalibration("UR10e", "yerayNS-CDEI/ur_arm_control_cpp", (
        -0.1145, 0.1060, -0.9054, 0.3773, -0.0223, 0.9712, 0.1478, 3.4922, -0.9615, 0.0446,
        0.0092, 0.2806, 0.0171, -0.0234, 0.8411, -1.0539,
    )),
    FactoryCalibration("UR16e", "panin-anan/pcl_processing_ros2", (
        0.2673, 0.1026, 0.7499, -0.0720, 1.1135, 0.5102, -0.0386, -3.0500, -0.3054, 0.7520,
        0.0638, -0.0003, 0.0231, 0.0708, 0.8722, -0.8935,
    )),
    FactoryCalibration("UR5e", "mhor992/Active-Collision-Avoidance", (
        0.1714, 0.1074, -1.8960, -0.2792, -1.3771, 2.6003, -0.2080, 4.7152, -1.2986, 0.3974,
        -0.0045, -1.7736, 0.0474, 0.0104, 0.9242, 0.0887,
    )),
    FactoryCalibration("UR5e", "pablotrelis/haptic_ur5e", (
        0.0565, 0.0363, 0.2672, -0.1084, -0.0685, -1.2737, -0.1314, 6.8622, 0.1338, 0.0258,
        -0.0026, -0.7256, 0.1533, 0.0344, 0.6546, -0.0009,
    )),
    FactoryCalibration("UR5e", "the text of a course, calib_14698139022496758595", (
        0.2122, 0.1820, 0.5185, -0.1703, 1.4443, -0.4261, -0.2888, 3.0279, -1.1857, -0.1930,
        -0.0071, 0.0032, -0.0964, 0.0137, 0.9561, -0.0151,
    )),
    FactoryCalibration("UR3e", "andersbloch09/ERCROB6", (
        0.1323, -0.2244, -0.0884, -0.0435, 0.2390, 0.5018, -0.2061, -6.1097, 0.4209, -0.3741,
        0.1159, -0.3134, 0.0041, -0.1453, -0.5459, 0.0615,
    )),
    FactoryCalibration("UR3e", "cambel/ur3-tools", (
        -0.0595, -0.1126, 0.2351, -0.1295, -2.5676, 0.7890, -0.0833, -6.7739, 0.1274, -0.1796,
        -0.0002, 1.0221, -0.0847, -0.1439, -1.8818, -0.0157,
    )),
    FactoryCalibration("UR3", "florent-lamiraux/agimus-demos-ur3-pointing", (
        0.0437, -0.0477, 0.1504, -0.5171, -1.7327, 2.3744, 0.1843, -2.9008, -3.9895, -0.7790,
        -0.0120, 0.0784, -0.0401, -0.0134, -0.3554, 0.5010,
    )),
    FactoryCalibration("UR5", "senturkkomer/tag_tracking", (
        -0.0242, 0.2388, -1.6778, -0.3729, 2.5222, 2.7642, 0.0142, -1.8727, 0.5666, 1.7095,
        0.0016, -0.5563, 0.0822, 0.0418, 0.4611, 0.1006,
    )),
    FactoryCalibration("UR5", "a script with its calibration, calib_15200003067234149431", (
        0.0421, 0.0828, -0.5170, -0.1460, 0.2773, 0.7418, 0.1014, -6.3941, -1.4972, 0.9014,
        0.0365, -1.8913, 0.0714, 0.1540, 1.5327, 0.1214,
    )),
)  # fmt: skip


def draw_departures(rng: np.random.Generator) -> Array:
    """(6, 5) departures of a big arm of the e-Series, drawn from the thirteen: how they spread and go together.

    A sum of all of them with normal weights has the same second moments; d6 is drawn from the big arms alone.
    """
    table = np.array([one.departures for one in CALIBRATIONS])
    drawn = rng.standard_normal(len(table)) @ table / np.sqrt(len(table))
    drawn[-1] = BIG_D6_MM + BIG_D6_SIGMA_MM * rng.standard_normal()
    return _as_deltas(drawn)


def _as_deltas(departures: Array) -> Array:
    deltas = np.zeros((6, 5))
    for (kind, joint), value in zip(_COLUMNS, departures, strict=True):
        deltas[joint, kind] = metres(float(value)) if kind in (_A, _D) else radians_of_mrad(float(value))
    return deltas
