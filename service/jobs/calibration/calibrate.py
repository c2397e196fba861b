"""Job kind `calibrate`: board images → intrinsics, hand-eye, or both."""

from __future__ import annotations

from typing import Any, Literal

from service.jobs.kind import JobKind, JobRecord
from service.jobs.records import ArmCorrection, BoardSize, Camera, Hash, Matrix, ParameterCovariance, Photograph


class Arguments(BoardSize):
    """Board images and what is solved from them.

    Attributes:
        solve: what is asked for.
        images: of the board.
        camera: intrinsics that are known; None where they are solved.
        corners: of each image, the file that a job `board_view` kept; None where the image is still to be searched.
        known: what is known of camera, mount and board, so that a part of the board counts.
    """

    solve: tuple[Literal["intrinsics", "hand_eye"], ...]
    images: tuple[Photograph, ...]
    camera: Camera | None = None
    corners: tuple[Hash | None, ...] | None = None
    known: dict[str, Any] | None = None


class Spread(JobRecord):
    """How well T_flange_camera is known: (6, 6) translation in metres, then rotation in radians."""

    covariance: Matrix


class Residuals(JobRecord):
    """Of each board image by name, as predicted by the others."""

    held_out_mm: dict[str, float]
    held_out_deg: dict[str, float]


class ArmAnswer(ArmCorrection):
    """The hand-eye answer with the arm's errors taken off."""

    sigma: Spread
    residuals: Residuals


class HandEye(JobRecord):
    """Where the camera sits on the flange, and how it was found (compute/calibration/hand_eye_record.py)."""

    T_flange_camera: Matrix
    T_base_board: Matrix | None = None
    sigma: Spread
    residuals: Residuals
    arm_correction: ArmAnswer | None = None

    @property
    def best(self) -> HandEye | ArmAnswer:
        """What the registration uses: with the arm's correction, where there is one."""
        return self.arm_correction or self


class Intrinsics(JobRecord):
    """What is known of the calibrated camera (compute/calibration/intrinsics_record.py)."""

    covariance: ParameterCovariance | None = None
    warnings: tuple[str, ...] = ()


class CalibrationDetails(JobRecord):
    """Of the images and of the intrinsics, where they were solved."""

    views_without_board: tuple[str, ...] = ()
    intrinsics: Intrinsics | None = None


class Answer(JobRecord):
    """The camera and, where solved, the hand-eye transform."""

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
