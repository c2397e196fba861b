"""The content of hand_eye.json: the calibration, the images that were not used, and further poses to take."""

from __future__ import annotations

import json
from typing import Any, cast

from service.jobs.calibration.records import HandEye
from service.jobs.kind import JobRecord
from service.jobs.records import Matrix

_BESIDE = {"T_flange_camera": "T_base_camera", "T_base_board": "T_flange_board"}


class SuggestedBoardPose(JobRecord):
    """A further pose of the arm for an image of the board, and the fit's standard deviation with it."""

    T_base_flange: Matrix
    T_base_camera: Matrix
    predicted_sigma_mm: float
    predicted_sigma_deg: float


class HandEyeFile(HandEye):
    """A hand_eye.json.

    Attributes:
        left_out: reason, by file of the folder that was not searched.
        images_without_board: reason, by image in which the board was not found.
        suggested_poses: further poses, the most useful first.
        suggestions_reachable: whether it was checked that the arm reaches them.
    """

    left_out: dict[str, str]
    images_without_board: dict[str, str]
    suggested_poses: tuple[SuggestedBoardPose, ...]
    suggestions_reachable: bool

    @property
    def not_used(self) -> dict[str, str]:
        """Reason, by file that the calibration does not use."""
        return {**self.left_out, **self.excluded, **self.images_without_board}

    def text(self) -> str:
        """The file's text. For a camera beside the robot it has T_base_camera and T_flange_board.

        So nothing that expects T_flange_camera can read such a file by mistake.
        """
        return json.dumps(self.printed(), indent=1, allow_nan=False) + "\n"

    def printed(self) -> Any:
        """The content of the file as plain data, as `--json` prints it."""
        record = self.plain()
        return record if self.setup == "eye-in-hand" else _renamed(record)


def _renamed(value: Any) -> Any:
    if isinstance(value, dict):
        named = cast("dict[str, Any]", value)
        return {_BESIDE.get(key, key): _renamed(part) for key, part in named.items()}
    return value
