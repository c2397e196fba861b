"""Whether robot poses and board images fit together at all, and if not, which mistake explains them.

Where the camera hangs on the flange and the board lies still, T_base_flange · X · T_camera_board is one pose. A file
that holds T_flange_base instead, or a camera that stands beside the robot and looks at a board on the flange, gives
poses that fit only when they are inverted; a file in millimetres, only a thousand times smaller. A solver answers all
the same: with a camera metres away and a noise of centimetres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from service.compute.calibration.hand_eye.closed_form import deviation, robust_start
from service.core.errors import ComputeError
from service.core.geometry import Array, inverse

Setup = Literal["eye-in-hand", "eye-to-hand"]

# Half of the views place the board by more than this beside its place: no robot's poses, whatever the robot.
_MOST_MM, _MOST_DEG = 25.0, 3.0
_CLEARLY = 3.0  # times smaller, position and rotation: then the other reading is the true one


@dataclass(frozen=True, slots=True)
class SetupFit:
    """How views agree under one reading of the poses: medians over the views."""

    mm: float
    deg: float

    @property
    def fits(self) -> bool:
        """Whether a robot could be as bad."""
        return self.mm <= _MOST_MM and self.deg <= _MOST_DEG

    def beats(self, other: SetupFit) -> bool:
        """Whether it fits, and so much better that the other reading is a mistake."""
        return self.fits and _CLEARLY * self.mm < other.mm and _CLEARLY * self.deg < other.deg

    def __str__(self) -> str:
        return f"{self.mm:.3g} mm and {self.deg:.2g}°"


def inverted(poses: Array) -> Array:
    """(N, 4, 4) the inverses of poses (N, 4, 4)."""
    return np.array([inverse(T) for T in poses])


def check_setup(hands: Array, boards: Array, point_m: Array, setup: Setup) -> None:
    """Raise ComputeError unless the robot's and the images' poses fit as they are read; name the reading that does.

    Args:
        hands: (N, 4, 4) T_base_flange, or T_flange_base for a camera beside the robot.
        boards: (N, 4, 4) T_camera_board.
        point_m: (3,) of the board, at which distances are measured.
        setup: how the poses are read.
    """
    as_read = _fit(hands, boards, point_m)
    metres = hands.copy()
    metres[:, :3, 3] *= 1e-3
    other: Setup = "eye-to-hand" if setup == "eye-in-hand" else "eye-in-hand"
    where = (
        "beside the robot, the board on its flange" if other == "eye-to-hand" else "on the flange, the board still"
    )
    inverse_words = f"inverted: either the file holds T_flange_base, or the camera stands {where}"
    inverse_way = f"Invert the poses in the file, or give --setup {other}"
    readings = (
        (inverted(hands), inverse_words, inverse_way),
        (metres, "in millimetres", "Write positions in metres"),
        (inverted(metres), f"in millimetres and {inverse_words}", f"Write positions in metres. {inverse_way}"),
    )
    for poses, words, remedy in readings:
        found = _fit(poses, boards, point_m)
        # A millimetre file fits in rotation as it is: only its positions tell.
        better = found.fits and not as_read.fits if poses is metres else found.beats(as_read)
        if better:
            raise ComputeError(
                f"the robot's poses do not fit the images as they are ({as_read} off in the median), but fit {words} "
                f"({found})",
                remedy=remedy,
            )
    if not as_read.fits:
        raise ComputeError(
            f"the robot's poses do not fit the images: half of them place the board by more than {as_read} beside "
            "its place, also with the poses inverted or in millimetres",
            remedy="check that each image has its own pose (order, names), that the pose is the flange's, the "
            "order qx,qy,qz,qw, the board's square, camera.json, and that the board lay still",
        )


def _fit(hands: Array, boards: Array, point_m: Array) -> SetupFit:
    try:
        X, B = robust_start(hands, boards, np.random.default_rng(0))
    except ComputeError:
        return SetupFit(float("inf"), float("inf"))
    mm, deg = deviation(hands @ X @ boards, B, point_m)
    return SetupFit(float(np.median(mm)), float(np.median(deg)))
