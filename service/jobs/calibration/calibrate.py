"""Job kind `calibrate`: board images → intrinsics, hand-eye, or both."""

from __future__ import annotations

from typing import Any, Literal

from service.jobs.kind import JobKind, JobRecord
from service.jobs.records import ArmCorrection, BoardSize, Camera, Hash, Matrix, ParameterCovariance, Photograph


class Arguments(BoardSize):
    """Board images and what to solve from them.

    Attributes:
        solve: which calibrations.
        images: of the board.
        camera: known intrinsics; None if they are solved.
        corners: for each image, the file of its job `board_view`; None if the image has not been searched.
        known: estimate of camera, mount and board, with which images of a part of the board can be used.
    """

    solve: tuple[Literal["intrinsics", "hand_eye"], ...]
    images: tuple[Photograph, ...]
    camera: Camera | None = None
    corners: tuple[Hash | None, ...] | None = None
    known: dict[str, Any] | None = None


class Spread(JobRecord):
    """Uncertainty of T_flange_camera: (6, 6) covariance of translation (m), then rotation (rad)."""

    covariance: Matrix


class Residuals(JobRecord):
    """Errors of each held-out board image, by name."""

    held_out_mm: dict[str, float]
    held_out_deg: dict[str, float]


class ArmAnswer(ArmCorrection):
    """The hand-eye calibration with the arm's errors corrected."""

    sigma: Spread
    residuals: Residuals


class HandEye(JobRecord):
    """Where the camera is on the flange (service/compute/calibration/hand_eye/record.py)."""

    T_flange_camera: Matrix
    T_base_board: Matrix | None = None
    sigma: Spread
    residuals: Residuals
    arm_correction: ArmAnswer | None = None

    @property
    def best(self) -> HandEye | ArmAnswer:
        """The calibration that the registration uses: with the arm's correction, if there is one."""
        return self.arm_correction or self


class Intrinsics(JobRecord):
    """Uncertainty and warnings of the intrinsics (service/compute/calibration/intrinsics/record.py)."""

    covariance: ParameterCovariance | None = None
    warnings: tuple[str, ...] = ()


class CalibrationDetails(JobRecord):
    """Details on the images and, if they were solved, the intrinsics."""

    views_without_board: tuple[str, ...] = ()
    intrinsics: Intrinsics | None = None


class Answer(JobRecord):
    """The camera and, if solved, the hand-eye transform."""

    camera: Camera
    details: CalibrationDetails = CalibrationDetails()
    T_flange_camera: Matrix | None = None
    T_base_board: Matrix | None = None
    hand_eye: HandEye | None = None


KIND = JobKind(
    name="calibrate",
    arguments=Arguments,
    answer=Answer,
    compute="service.worker.calibration.calibrate:calibrate",
    words="camera calibration",
    order=12,
)
