"""Results of a hand-eye calibration: transforms, their covariances and measures of their quality."""

from __future__ import annotations

from dataclasses import dataclass

from service.compute.arm.correction import ArmCorrection
from service.compute.calibration.hand_eye.board_size import BoardSizeFound
from service.compute.calibration.hand_eye.fit import ArmTerms, Method
from service.core.geometry import Array, Transform


@dataclass(frozen=True, slots=True)
class HandEyeAnswer:
    """T_flange_camera, T_base_board and measures of their quality; arrays are over the N views.

    Attributes:
        T_flange_camera: the calibration.
        T_base_board: the board's pose.
        sigma_mm: bootstrap standard deviation of the translation (root of the summed variances), over images.
        sigma_deg: bootstrap standard deviation of the rotation.
        covariance: (6, 6) of T_flange_camera from the bootstrap, (d in metres, w in radians) in the flange's axes,
            including `camera_share`.
        camera_share: (6, 6) part of it due to the camera calibration's uncertainty, which more images do not reduce.
        formal_covariance: (6, 6) predicted by the fit's own noise model; None unless the method is weighted.
        robot_noise_mm: standard deviation per axis of the robot's remaining position error; None unless the method is
            weighted.
        robot_noise_deg: the same for its rotation.
        residual_mm: (N,) distance between the board as placed by each view and T_base_board, at the board's middle.
        residual_deg: (N,) the same for its orientation.
        held_out_mm: (N,) as residual_mm, but each view is judged by a calibration without its fold.
        held_out_deg: (N,) the same for its orientation.
    """

    T_flange_camera: Transform
    T_base_board: Transform
    sigma_mm: float
    sigma_deg: float
    covariance: Array
    camera_share: Array
    formal_covariance: Array | None
    robot_noise_mm: float | None
    robot_noise_deg: float | None
    residual_mm: Array
    residual_deg: Array
    held_out_mm: Array
    held_out_deg: Array


@dataclass(frozen=True, slots=True)
class CorrectedHandEye(HandEyeAnswer):
    """The answer for poses corrected by `correction` (`corrected_T_base_flange`).

    Attributes:
        correction: the arm's systematic error.
        terms: which of its parameters were estimated.
        size: of the board, by the lengths of the corrected arm.
    """

    correction: ArmCorrection
    terms: ArmTerms
    size: BoardSizeFound


@dataclass(frozen=True, slots=True)
class HandEyeResult(HandEyeAnswer):
    """The answer for the robot's poses as reported, and the diagnostics of the calibration.

    Attributes:
        method: method that gave T_flange_camera.
        methods: T_flange_camera by every method that gave an answer.
        spread_mm: largest distance between the chosen method's translation and another's (including Tsai's and
            Andreff's, which are the weakest: a large spread warns of weak data).
        spread_deg: the same for the rotation.
        corner_sigma_px: standard deviation of the corners; None if only board poses were given.
        rotation_spread_deg: largest rotation between two views.
        second_axis_deg: root mean square rotation about the second best axis.
        condition: condition number of the translation's linear system; infinite for a single rotation axis.
        turned: (N,) whether the view's board pose was rotated by half a turn.
        excluded: reason by index of each view that no fit used.
        corrected: the answer with the arm's systematic error estimated; None if no joints were given or if it does
            not lower the held-out error.
        arm_held_out_mm: root mean square of held_out_mm for each arm model that was tried ("none": the poses as
            reported).
        size: of the board, by the robot's lengths.
        findings: what the measurements contradict, in words; empty if nothing.
    """

    method: Method
    methods: dict[Method, Transform]
    spread_mm: float
    spread_deg: float
    corner_sigma_px: float | None
    rotation_spread_deg: float
    second_axis_deg: float
    condition: float
    turned: tuple[bool, ...]
    excluded: dict[int, str]
    corrected: CorrectedHandEye | None
    arm_held_out_mm: dict[ArmTerms, float]
    size: BoardSizeFound
    findings: tuple[str, ...]
