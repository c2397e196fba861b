"""Job kind `calibrate`: board images → intrinsics, hand-eye, or both."""

from __future__ import annotations

from typing import Literal

from service.computations.calibrate.records import BoardSeen, HandEye, Intrinsics, KnownBoard
from service.computations.kind import Demand, JobKind, JobRecord
from service.computations.records import BoardSize, Camera, Hash, Matrix, ParameterCovariance, PosedPhotograph


class Arguments(BoardSize):
    """Board images and what to solve from them.

    Attributes:
        solve: the calibrations to solve.
        images: the images of the board.
        camera: the known intrinsics; None if they are solved.
        corners: the file of the job `board_view` of each image; None if the image has not been searched.
        known: an estimate of camera, mount and board, with which images of a part of the board can be used.
        flatness_mm: the largest bow of the board; None: not given.
        seen: the board as the calibration of `camera` saw it; None if the camera is solved here.
        size_tolerance: the largest relative error of the board's size; None: not given.
    """

    solve: tuple[Literal["intrinsics", "hand_eye"], ...]
    images: tuple[PosedPhotograph, ...]
    camera: Camera | None = None
    corners: tuple[Hash | None, ...] | None = None
    known: KnownBoard | None = None
    size_tolerance: float | None = None
    flatness_mm: float | None = None
    seen: BoardSeen | None = None


class CalibrationDetails(JobRecord):
    """Details on the images and, if they were solved, the intrinsics.

    Attributes:
        views_without_board: images that were not used.
        partial_views: number of corners in each image of a part of the board; like `reasons` only with `known`.
        reasons: the reasons why images were not used.
        intrinsics: the intrinsics, if they were solved.
    """

    views_without_board: tuple[str, ...] = ()
    partial_views: dict[str, int] | None = None
    reasons: dict[str, str] | None = None
    intrinsics: Intrinsics | None = None


class Answer(JobRecord):
    """The camera and, if solved, the hand-eye transform."""

    camera: Camera
    details: CalibrationDetails = CalibrationDetails()
    T_flange_camera: Matrix | None = None
    T_base_board: Matrix | None = None
    hand_eye: HandEye | None = None

    @property
    def intrinsics_covariance(self) -> ParameterCovariance | None:
        """The covariance of the camera's parameters, with their names; None if it was not computed."""
        return None if self.details.intrinsics is None else self.details.intrinsics.covariance


KIND = JobKind(
    name="calibrate",
    arguments=Arguments,
    answer=Answer,
    compute="service.computations.calibrate.compute:calibrate",
    words="camera calibration",
    version=5,  # its prior of an arm's lengths, joint by joint, keeps their scale from vanishing with few images
    order=12,
    demand=lambda arguments: Demand(
        memory_mb=800 + 5 * len(arguments.images), limit_s=3600 + 60 * len(arguments.images)
    ),
)
