"""Job kinds of the calibration: `board_view` looks for the board in one image, `calibrate` computes from all."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from service.computations.kind import Demand, JobKind, JobRecord
from service.computations.records import (
    ArmCorrection,
    BoardSize,
    Camera,
    Hash,
    ImageFile,
    Matrix,
    ParameterCovariance,
    PosedPhotograph,
)


class Coverage(JobRecord):
    """Board corners over the image: their number in each cell, row by row, and the share of cells that hold one."""

    share: float
    corners: tuple[tuple[int, ...], ...]


class ResidualField(JobRecord):
    """Mean residual (dx, dy), px, of the corners in each cell of the image, row by row, and their number."""

    corners: tuple[tuple[int, ...], ...]
    mean_px: tuple[tuple[tuple[float, float], ...], ...]


class CrossValidation(JobRecord):
    """Residuals, px, of corners in images that the fit has not seen; by image in the order of Intrinsics.images."""

    folds: int
    five_fold_rms_px: float
    five_fold_view_px: tuple[float, ...] = ()
    leave_one_out_rms_px: float | None = None
    leave_one_out_view_px: tuple[float | None, ...] = ()


class ProjectionUncertainty(JobRecord):
    """Standard deviation of a projected point, in px, and in mm at the board's distance.

    Attributes:
        distance_m: the board's distance.
        centre_px, centre_mm: the value at the image's centre.
        worst_px, worst_mm: the largest value.
        rms_px, rms_mm: the root mean square over the image.
        x_px, y_px: the columns and rows of the grid.
        sigma_px, sigma_mm: the values on the grid, row by row.
    """

    distance_m: float
    centre_px: float
    worst_px: float
    rms_px: float | None = None
    centre_mm: float
    worst_mm: float
    rms_mm: float | None = None
    x_px: tuple[float, ...] = ()
    y_px: tuple[float, ...] = ()
    sigma_px: Matrix
    sigma_mm: Matrix


class ExcludedImage(JobRecord):
    """A board image that was not used, and why."""

    image: str
    reason: str


class KnownBoard(JobRecord):
    """An estimate of camera, mount and board, with its tolerances.

    Attributes:
        camera: the camera, nominal, or estimated from the images like the two poses.
        T_flange_camera: the camera's pose on the flange, (4, 4).
        T_base_board: the board's pose in the base frame, (4, 4).
        spread: (12, 12); possible increments of the two poses.
        focal: relative tolerance of the focal length.
        centre: tolerance of the principal point, over the image's width.
        measured: number of images used.
    """

    camera: Camera
    T_flange_camera: Matrix
    T_base_board: Matrix
    spread: Matrix
    focal: float
    centre: float
    measured: int


class BoardSeen(JobRecord):
    """The calibration board: inner corners, the edge of a square, and how it is bent.

    Attributes:
        pattern: the pattern printed on it.
        columns, rows: the numbers of columns and rows of inner corners.
        square_mm: the edge of a square.
        flatness_mm: the largest bow that was given.
        bow_mm: the distance of its middle behind its sides, and behind its ends; None if it was taken as flat.
        bow_sigma_mm: standard deviations of the two.
    """

    pattern: str
    columns: int
    rows: int
    square_mm: float
    flatness_mm: float | None = None
    bow_mm: tuple[float, float] | None = None
    bow_sigma_mm: tuple[float, float] | None = None

    @property
    def bow_words(self) -> str:
        """The bow for people; empty for a board that was taken as flat."""
        if self.bow_mm is None or self.bow_sigma_mm is None:
            return ""
        x, y = (f"{bow:+.3f} ± {sigma:.3f} mm" for bow, sigma in zip(self.bow_mm, self.bow_sigma_mm, strict=True))
        return f"{x} across its columns, {y} across its rows (+: the middle lies away from the camera)"


class Tilt(JobRecord):
    """The largest angle of the board to the image plane, and between two of its normals."""

    largest_deg: float
    spread_deg: float


class Intrinsics(JobRecord):
    """The facts about the calibrated camera besides its parameters.

    Attributes:
        model: the distortion's model.
        board: the board that was seen.
        n_views: the number of images used.
        images: names of the images used.
        rms_px: the rms residual of all corners.
        per_view_rms_px: the rms residual of each image's corners, in the order of `images`.
        excluded: images that were not used.
        sigma: standard deviation of each free parameter of the camera, in the parameter's own unit.
        sigma_independent: the same if the errors of corners were independent.
        sigma_by_image: the same from the scatter between images; None if there are too few.
        sigma_corner_px: standard deviation of a corner.
        inflation: the factor of the covariance, because errors within an image are alike.
        covariance: the covariance of the free parameters.
    """

    model: str = ""
    board: BoardSeen | None = None
    n_views: int = 0
    images: tuple[str, ...] = ()
    rms_px: float | None = None
    per_view_rms_px: tuple[float, ...] = ()
    excluded: tuple[ExcludedImage, ...] = ()
    sigma: dict[str, float] = Field(default_factory=dict)
    sigma_independent: dict[str, float] = Field(default_factory=dict)
    sigma_by_image: dict[str, float | None] = Field(default_factory=dict)
    sigma_corner_px: float | None = None
    inflation: float | None = None
    covariance: ParameterCovariance | None = None
    coverage: Coverage | None = None
    residuals: ResidualField | None = None
    tilt: Tilt | None = None
    cross_validation: CrossValidation | None = None
    uncertainty: ProjectionUncertainty | None = None
    warnings: tuple[str, ...] = ()


class Spread(JobRecord):
    """The uncertainty of T_flange_camera.

    Attributes:
        covariance: (6, 6), translation in m, then rotation in rad.
        mm: standard deviation of the position, 3D.
        deg: standard deviation of the rotation, about all axes.
        camera_mm, camera_deg: the part that is due to the uncertainty of the camera's calibration.
        formal_covariance: (6, 6) that the fit's noise model predicts; None unless the method is weighted.
    """

    covariance: Matrix
    mm: float | None = None
    deg: float | None = None
    camera_mm: float | None = None
    camera_deg: float | None = None
    formal_covariance: Matrix | None = None


class Residuals(JobRecord):
    """Differences between the board pose from each image, by name, and the one from the other images.

    Attributes:
        mm: the difference of position, in the fit.
        deg: the difference of rotation, in the fit.
        held_out_mm: the difference of position, predicted by the other images alone.
        held_out_deg: the difference of rotation, predicted by the other images alone.
    """

    mm: dict[str, float] = Field(default_factory=dict)
    deg: dict[str, float] = Field(default_factory=dict)
    held_out_mm: dict[str, float]
    held_out_deg: dict[str, float]


class RobotNoise(JobRecord):
    """Repeatability of the arm's poses, 1σ; None where there were too few images to estimate it."""

    mm: float | None = None
    deg: float | None = None


class BoardSizeByRobot(JobRecord):
    """The board's true size over the given one, as the robot's lengths show it.

    Attributes:
        ratio: the ratio by robot and images alone.
        sigma: standard deviation of `ratio`.
        tolerance: the relative tolerance given for the board.
        used: the ratio used in the answer.
        words: a sentence on these for people.
    """

    ratio: float
    sigma: float
    tolerance: float
    used: float
    words: str = ""


class HandEyeMethod(JobRecord):
    """A hand-eye transform by one method, and its distance from the one in use."""

    T_flange_camera: Matrix
    distance_mm: float
    distance_deg: float


class MethodSpread(JobRecord):
    """The largest distance between the method in use and another."""

    mm: float
    deg: float


class ArmRotations(JobRecord):
    """The arm's rotations, which must differ enough to determine the transform.

    Attributes:
        rotation_spread_deg: largest rotation between two images.
        second_axis_deg: root mean square rotation about the second best axis.
        condition: condition number of the translation's linear system.
    """

    rotation_spread_deg: float
    second_axis_deg: float
    condition: float


class ArmAnswer(ArmCorrection):
    """The hand-eye answer with the arm's errors corrected; `terms`: of the arm's model, such as geometry+gears."""

    T_base_board: Matrix | None = None
    sigma: Spread
    residuals: Residuals
    robot_noise: RobotNoise = RobotNoise()
    terms: str = ""
    board_size: BoardSizeByRobot | None = None


class HandEye(JobRecord):
    """The hand-eye calibration.

    Attributes:
        T_flange_camera: the transform for the poses that the arm reports, without correction.
        T_base_board: the board's pose.
        sigma: the standard deviations of T_flange_camera.
        residuals: the residuals by image.
        robot_noise: the noise of the arm's poses.
        setup: the camera's place: eye-in-hand for one on the flange, eye-to-hand for one beside the robot.
        method: the method that gave T_flange_camera.
        methods: the transform by every method that gave an answer.
        spread: the differences between the methods.
        corner_sigma_px: standard deviation of a board corner.
        motion: the arm's motion between the images.
        excluded: the reason, by image that no fit used.
        turned: images in which the board was seen turned by 180°.
        arm_held_out_rms_mm: the error of held-out images, by terms of the arm's model; "none": poses as reported.
        arm_correction: the answer with the arm's errors corrected; None if that does not improve held-out images.
        board_size: the board's size by the robot.
        findings: sentences on what robot and images contradict each other in.
    """

    T_flange_camera: Matrix
    T_base_board: Matrix | None = None
    sigma: Spread
    residuals: Residuals
    robot_noise: RobotNoise = RobotNoise()
    setup: str = ""
    method: str = ""
    methods: dict[str, HandEyeMethod] = Field(default_factory=dict[str, HandEyeMethod])
    spread: MethodSpread | None = None
    corner_sigma_px: float | None = None
    motion: ArmRotations | None = None
    excluded: dict[str, str] = Field(default_factory=dict[str, str])
    turned: tuple[str, ...] = ()
    arm_held_out_rms_mm: dict[str, float] = Field(default_factory=dict[str, float])
    arm_correction: ArmAnswer | None = None
    board_size: BoardSizeByRobot | None = None
    findings: tuple[str, ...] = ()

    @property
    def best(self) -> HandEye | ArmAnswer:
        """The answer that the registration uses: with the arm's correction, where there is one."""
        return self.arm_correction or self


class BoardViewArguments(BoardSize):
    """The image and the board."""

    image: ImageFile


class BoardViewAnswer(JobRecord):
    """The board as an image shows it; its corners are in the job's file. `size` is width and height in pixels."""

    viewpoint: str
    size: tuple[int, int]
    seen: bool
    reason: str
    black: bool = False


class Corners(JobRecord):
    """The file of an answer: the image's size, and the board's corners that it shows, by index and in pixels."""

    size: tuple[int, int]
    indices: tuple[int, ...]
    corners: tuple[tuple[float, float], ...]


BOARD_VIEW = JobKind(
    name="board_view",
    arguments=BoardViewArguments,
    answer=BoardViewAnswer,
    compute="service.computations.calibration.compute:board_view",
    words="board images",
    order=10,
    replayed=False,
    demand=lambda _: Demand(memory_mb=1200, limit_s=900),
)


class CalibrateArguments(BoardSize):
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


class CalibrateAnswer(JobRecord):
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


CALIBRATE = JobKind(
    name="calibrate",
    arguments=CalibrateArguments,
    answer=CalibrateAnswer,
    compute="service.computations.calibration.compute:calibrate",
    words="camera calibration",
    version=5,  # its prior of an arm's lengths, joint by joint, keeps their scale from vanishing with few images
    order=12,
    demand=lambda arguments: Demand(
        memory_mb=800 + 5 * len(arguments.images), limit_s=3600 + 60 * len(arguments.images)
    ),
)

KINDS = (BOARD_VIEW, CALIBRATE)
