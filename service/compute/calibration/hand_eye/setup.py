"""Checks whether robot poses and board images fit together, and names the usual mistake if they do not.

If the camera is on the flange and the board lies still, T_base_flange · X · T_camera_board is constant. A file with
T_flange_base instead, or a camera beside the robot that looks at a board on the flange, gives poses that fit only
when inverted; a file in millimetres fits only when scaled by 1/1000. A solver would still give an answer: a camera
metres away, with centimetres of noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from service.compute.calibration.hand_eye.closed_form import deviation, robust_start
from service.core.errors import ComputeError
from service.core.geometry import Array, inverse
from service.core.units import metres

Setup = Literal["eye-in-hand", "eye-to-hand"]

# If half of the views place the board farther than this from its place, these are not a robot's poses.
_MOST_MM, _MOST_DEG = 25.0, 3.0
_CLEARLY = 3.0  # the true reading's errors are this many times smaller, in position and rotation


@dataclass(frozen=True, slots=True)
class SetupFit:
    """Agreement of the views under one reading of the poses: medians over the views."""

    mm: float
    deg: float

    @property
    def fits(self) -> bool:
        """Whether the errors are small enough for a robot."""
        return self.mm <= _MOST_MM and self.deg <= _MOST_DEG

    def beats(self, other: SetupFit) -> bool:
        """Whether it fits, and so much better that the other reading must be a mistake."""
        return self.fits and _CLEARLY * self.mm < other.mm and _CLEARLY * self.deg < other.deg

    def __str__(self) -> str:
        return f"{self.mm:.3g} mm and {self.deg:.2g}°"


def inverted(poses: Array) -> Array:
    """(N, 4, 4) inverses of poses (N, 4, 4)."""
    return np.array([inverse(T) for T in poses])


def check_setup(hands: Array, boards: Array, point_m: Array, setup: Setup) -> None:
    """Raise ComputeError unless robot and image poses fit; its message names another reading of them that fits.

    Args:
        hands: (N, 4, 4) T_base_flange, or T_flange_base for a camera beside the robot.
        boards: (N, 4, 4) T_camera_board.
        point_m: (3,) point of the board at which distances are measured.
        setup: the assumed reading of the poses.
    """
    as_read = _fit(hands, boards, point_m)
    in_metres = hands.copy()
    in_metres[:, :3, 3] = metres(hands[:, :3, 3])
    other: Setup = "eye-to-hand" if setup == "eye-in-hand" else "eye-in-hand"
    where = (
        "beside the robot, the board on its flange" if other == "eye-to-hand" else "on the flange, the board still"
    )
    inverse_words = f"inverted: either the file holds T_flange_base, or the camera stands {where}"
    inverse_way = f"Invert the poses in the file, or give --setup {other}"
    readings = (
        (inverted(hands), inverse_words, inverse_way),
        (in_metres, "in millimetres", "Write positions in metres"),
        (inverted(in_metres), f"in millimetres and {inverse_words}", f"Write positions in metres. {inverse_way}"),
    )
    for poses, words, remedy in readings:
        found = _fit(poses, boards, point_m)
        # Poses in millimetres fit in rotation as they are: only their positions give it away.
        better = found.fits and not as_read.fits if poses is in_metres else found.beats(as_read)
        if better:
            raise ComputeError(
                f"the robot's poses do not fit the images as they are ({as_read} off in the median), but fit {words} "
                f"({found})",
                remedy=remedy,
            )
    if not as_read.fits:
        raise ComputeError(
            f"the robot's poses do not fit the images: half of them place the board more than {as_read} from "
            "its place, even with the poses inverted or in millimetres",
            remedy="Check that each image has its own pose (order, names), that the pose is the flange's, the "
            "order qx,qy,qz,qw, the board's square, camera.json, and that the board lay still",
        )


def _fit(hands: Array, boards: Array, point_m: Array) -> SetupFit:
    try:
        X, B = robust_start(hands, boards, np.random.default_rng(0))
    except ComputeError:
        return SetupFit(float("inf"), float("inf"))
    mm, deg = deviation(hands @ X @ boards, B, point_m)
    return SetupFit(float(np.median(mm)), float(np.median(deg)))
