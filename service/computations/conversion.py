"""Cameras, calibrations, spheres and layouts as the records of jobs, some of which are also files; and read back."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from service.computations import calibration as calibration_records
from service.computations import records as shared
from service.computations.records import (
    Camera,
    ImagesCamera,
    JudgedLayout,
    Matrix,
    MeasuredSphere,
    ParameterCovariance,
    SphereConfusion,
    matrix,
)
from service.compute.arm_kinematics import ArmCorrection, CorrectedMounting
from service.compute.calibration.board import Board
from service.compute.calibration.hand_eye import CorrectedHandEye, HandEyeAnswer, HandEyeResult
from service.compute.calibration.hand_eye_setup import Setup, distance
from service.compute.calibration.hand_eye_uncertainty import BoardSizeFound
from service.compute.calibration.intrinsics import COVERAGE_GRID, IntrinsicsResult
from service.compute.calibration.intrinsics_quality import CrossValidation, ProjectionUncertainty, residual_field
from service.compute.camera_model import CameraCovariance, CameraModel
from service.compute.images.resample import camera_at
from service.compute.layout.ambiguity import BoundedLength, LayoutReport, layout_bounds
from service.compute.surfaces.mesh_spheres import MeshSphere
from service.core.errors import DataError
from service.core.geometry import Array, Transform
from service.core.records.run_events import Uncertainty
from service.core.units import deg, metres, mm


def camera_of(record: Camera) -> CameraModel:
    """Return the camera model of a record."""
    return CameraModel.from_record(record.plain())


def camera_record(camera: CameraModel) -> Camera:
    """Return the record of a camera model."""
    return Camera.model_validate(camera.record())


def lens_covariance(record: Matrix | ParameterCovariance | None) -> Array | None:
    """Return the intrinsics' covariance (8, 8) of a record; None if unknown, or that of another lens model."""
    if record is None:
        return None
    if not isinstance(record, ParameterCovariance):
        return np.array(record)
    return CameraCovariance(record.parameters, np.array(record.matrix)).of_lens()


def camera_used(arguments: ImagesCamera) -> CameraModel:
    """Return the camera at the size of the images that a job uses."""
    camera = camera_of(arguments.camera)
    return camera if arguments.reduced_to is None else camera_at(camera, *arguments.reduced_to)


def camera_reduced(arguments: ImagesCamera) -> CameraModel | None:
    """Return the camera at the size of the photographs if the job uses reduced copies of them; else None."""
    if arguments.reduced_to is not None:
        return camera_of(arguments.camera)
    return None if arguments.full_camera is None else camera_of(arguments.full_camera)


_CORRECTION, _CALIBRATE_AGAIN = "arm_correction of the hand-eye calibration", "Calibrate hand and eye again"


def intrinsics_record(
    result: IntrinsicsResult,
    validation: CrossValidation | None,
    uncertainty: ProjectionUncertainty,
    warnings: Sequence[str],
    names: Sequence[str],
    excluded: Mapping[str, str],
) -> calibration_records.Intrinsics:
    """Return everything but the camera itself; unknown numbers are None.

    Args:
        result: the calibration.
        validation: the cross-validation; None if there are too few images.
        uncertainty: the uncertainty of a projected point.
        warnings: sentences of warning about the images.
        names: the names of the images used, in the order of `result.views`.
        excluded: the reason by image name, including images without the board.
    """
    return calibration_records.Intrinsics(
        model=result.model,
        board=_board(result),
        n_views=len(result.views),
        images=tuple(names),
        rms_px=result.rms_px,
        per_view_rms_px=_row(result.per_view_rms_px),
        excluded=tuple(
            calibration_records.ExcludedImage(image=image, reason=reason) for image, reason in excluded.items()
        ),
        sigma=dict(result.sigma),
        sigma_independent=dict(result.sigma_independent),
        sigma_by_image={name: _number(value) for name, value in result.sigma_by_image.items()},
        sigma_corner_px=result.sigma_corner_px,
        inflation=result.inflation,
        covariance=ParameterCovariance(parameters=tuple(result.parameters), matrix=matrix(result.covariance)),
        coverage=calibration_records.Coverage(share=result.coverage, corners=_counts(result.coverage_map)),
        residuals=_residuals(result),
        tilt=calibration_records.Tilt(largest_deg=float(result.tilt_deg.max()), spread_deg=result.tilt_spread_deg),
        cross_validation=None if validation is None else _cross_validation(validation),
        uncertainty=_uncertainty(uncertainty),
        warnings=tuple(warnings),
    )


def hand_eye_record(
    result: HandEyeResult, images: Sequence[str], setup: Setup = "eye-in-hand"
) -> calibration_records.HandEye:
    """Return the whole result of a hand-eye calibration; `images` are the names of its views."""
    chosen = result.T_flange_camera
    methods: dict[str, calibration_records.HandEyeMethod] = {}
    for name, T in result.methods.items():
        away_mm, away_deg = distance(T, chosen)
        methods[name] = calibration_records.HandEyeMethod(
            T_flange_camera=matrix(T), distance_mm=away_mm, distance_deg=away_deg
        )
    corrected = result.corrected
    return calibration_records.HandEye(
        T_flange_camera=matrix(chosen),
        T_base_board=matrix(result.T_base_board),
        sigma=_spread(result),
        residuals=_residuals_of(result, images),
        robot_noise=calibration_records.RobotNoise(mm=result.robot_noise_mm, deg=result.robot_noise_deg),
        setup=setup,
        method=result.method,
        methods=methods,
        spread=calibration_records.MethodSpread(mm=result.spread_mm, deg=result.spread_deg),
        corner_sigma_px=result.corner_sigma_px,
        motion=calibration_records.ArmRotations(
            rotation_spread_deg=result.rotation_spread_deg,
            second_axis_deg=result.second_axis_deg,
            condition=result.condition,
        ),
        excluded={images[i]: reason for i, reason in result.excluded.items()},
        turned=tuple(name for name, turned in zip(images, result.turned, strict=True) if turned),
        arm_held_out_rms_mm={str(terms): error_mm for terms, error_mm in result.arm_held_out_mm.items()},
        arm_correction=None if corrected is None else _arm_answer(corrected, images),
        board_size=_size(result.size),
        findings=result.findings,
    )


def arm_correction_record(correction: ArmCorrection, T_flange_camera: Transform) -> shared.ArmCorrection:
    """Return a correction, and the camera's pose on the flange (4, 4) for corrected poses."""
    return shared.ArmCorrection(
        T_flange_camera=matrix(T_flange_camera),
        arm=correction.arm,
        model="dh_deltas + gear harmonics" if correction.gear_cos_rad.any() else "dh_deltas",
        dh_deltas=matrix(correction.dh_deltas),
        gear_cos_rad=matrix(correction.gear_cos_rad),
        gear_sin_rad=matrix(correction.gear_sin_rad),
        observed=_row(correction.observed),
    )


def corrected_mounting(record: shared.ArmCorrection) -> CorrectedMounting:
    """Return the correction of a record as arrays.

    Raises:
        DataError: a matrix has another shape.
    """
    try:
        T_flange_camera = np.array(record.T_flange_camera, dtype=np.float64)
        correction = ArmCorrection(
            record.arm,
            _five_columns(np.array(record.dh_deltas, dtype=np.float64)),
            np.array(record.gear_cos_rad, dtype=np.float64),
            np.array(record.gear_sin_rad, dtype=np.float64),
            np.array(record.observed, dtype=np.float64),
        )
    except ValueError as error:  # rows of different lengths
        raise DataError(f"not an arm correction: {error}", where=_CORRECTION, remedy=_CALIBRATE_AGAIN) from error
    if T_flange_camera.shape != (4, 4):
        raise DataError("T_flange_camera is not 4 × 4", where=_CORRECTION, remedy=_CALIBRATE_AGAIN)
    return CorrectedMounting(correction, T_flange_camera)


def _five_columns(dh_deltas: Array) -> Array:
    """Return deltas with those of β, which calibrations of before version 4 did not have."""
    if dh_deltas.ndim != 2 or dh_deltas.shape[1] != 4:
        return dh_deltas
    return np.concatenate([dh_deltas, np.zeros((len(dh_deltas), 1))], axis=1)


def _arm_answer(corrected: CorrectedHandEye, images: Sequence[str]) -> calibration_records.ArmAnswer:
    return calibration_records.ArmAnswer(
        **arm_correction_record(corrected.correction, corrected.T_flange_camera).set_fields(),
        T_base_board=matrix(corrected.T_base_board),
        sigma=_spread(corrected),
        residuals=_residuals_of(corrected, images),
        robot_noise=calibration_records.RobotNoise(mm=corrected.robot_noise_mm, deg=corrected.robot_noise_deg),
        terms=corrected.terms,
        board_size=_size(corrected.size),
    )


def _size(size: BoardSizeFound) -> calibration_records.BoardSizeByRobot:
    return calibration_records.BoardSizeByRobot(
        ratio=size.ratio, sigma=size.sigma, tolerance=size.tolerance, used=size.used, words=size.words
    )


def _spread(answer: HandEyeAnswer) -> calibration_records.Spread:
    formal, camera = answer.formal_covariance, answer.camera_share
    return calibration_records.Spread(
        covariance=matrix(answer.covariance),
        mm=answer.sigma_mm,
        deg=answer.sigma_deg,
        camera_mm=mm(float(np.sqrt(np.trace(camera[:3, :3])))),
        camera_deg=deg(np.sqrt(np.trace(camera[3:, 3:]))),
        formal_covariance=None if formal is None else matrix(formal),
    )


def _residuals_of(answer: HandEyeAnswer, images: Sequence[str]) -> calibration_records.Residuals:
    def by_image(values: Array) -> dict[str, float]:
        return dict(zip(images, _row(values), strict=True))

    return calibration_records.Residuals(
        mm=by_image(answer.residual_mm),
        deg=by_image(answer.residual_deg),
        held_out_mm=by_image(answer.held_out_mm),
        held_out_deg=by_image(answer.held_out_deg),
    )


def _board(result: IntrinsicsResult) -> calibration_records.BoardSeen:
    board = result.board
    seen = calibration_records.BoardSeen(
        pattern=board.pattern, columns=board.columns, rows=board.rows, square_mm=mm(board.square_m)
    )
    sigma = np.sqrt(np.diag(result.joint_covariance)[len(result.parameters) :])
    if len(sigma) == 0:
        return seen
    (x, y), (sigma_x, sigma_y) = board.bow_m, sigma
    return calibration_records.BoardSeen(
        **seen.set_fields(),
        flatness_mm=mm(board.flatness_m),
        bow_mm=(mm(x), mm(y)),
        bow_sigma_mm=(mm(float(sigma_x)), mm(float(sigma_y))),
    )


def seen_board(board: Board, seen: calibration_records.BoardSeen | None) -> Board:
    """Return the board as a calibration of the camera has found it to be bent, if it saw this board."""
    if seen is None or seen.bow_mm is None:
        return board
    if (seen.pattern, seen.columns, seen.rows) != (board.pattern, board.columns, board.rows):
        return board
    x, y = seen.bow_mm
    return replace(board, bow_m=(metres(x), metres(y)))


def _residuals(result: IntrinsicsResult) -> calibration_records.ResidualField:
    mean_px, counts = residual_field(result, *COVERAGE_GRID)
    cells = tuple(tuple((float(dx), float(dy)) for dx, dy in row) for row in np.round(mean_px, 5))
    return calibration_records.ResidualField(corners=_counts(counts), mean_px=cells)


def _cross_validation(validation: CrossValidation) -> calibration_records.CrossValidation:
    return calibration_records.CrossValidation(
        folds=validation.folds,
        five_fold_rms_px=validation.five_fold_rms_px,
        five_fold_view_px=_row(validation.five_fold_view_px),
        leave_one_out_rms_px=_number(validation.leave_one_out_rms_px),
        leave_one_out_view_px=tuple(_number(value) for value in validation.leave_one_out_view_px),
    )


def _uncertainty(uncertainty: ProjectionUncertainty) -> calibration_records.ProjectionUncertainty:
    return calibration_records.ProjectionUncertainty(
        distance_m=uncertainty.distance_m,
        centre_px=uncertainty.centre_px,
        worst_px=uncertainty.worst_px,
        rms_px=uncertainty.rms_px,
        centre_mm=uncertainty.centre_mm,
        worst_mm=uncertainty.worst_mm,
        rms_mm=uncertainty.rms_mm,
        x_px=_row(uncertainty.pixels[0, :, 0]),
        y_px=_row(uncertainty.pixels[:, 0, 1]),
        sigma_px=_rounded(uncertainty.sigma_px),
        sigma_mm=_rounded(uncertainty.sigma_mm),
    )


def _row(values: Array) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _counts(rows: Iterable[Iterable[int]]) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(int(count) for count in row) for row in rows)


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _rounded(values: Array) -> Matrix:
    """Round to four significant digits."""
    return tuple(tuple(float(f"{value:.4g}") for value in row) for row in values)


def measured_sphere(sphere: MeshSphere) -> MeasuredSphere:
    """Return the record of a sphere found in a mesh."""
    x, y, z = sphere.centre_m.tolist()
    return MeasuredSphere(
        centre_m=(x, y, z),
        covariance_m2=matrix(sphere.covariance),
        sigma_mm=mm(float(np.sqrt(np.trace(sphere.covariance)))),
        rms_mm=mm(sphere.rms_m),
        radius_residual_mm=mm(sphere.radius_residual_m),
        radius_sigma_mm=mm(sphere.radius_sigma_m),
        coverage=sphere.coverage,
        n_points=sphere.n,
    )


def judged_layout(report: LayoutReport) -> JudgedLayout:
    """Return the record of a layout's report."""
    return JudgedLayout(
        passed=report.passed,
        problems=report.problems,
        margin_mm=mm(report.margin_m),
        margin_sigma_mm=mm(report.margin.sigma_m),
        bounds={name: _uncertainty_of_length(bounded) for name, (bounded, _) in layout_bounds(report).items()},
        margin_by_count_mm={str(k): mm(v) for k, v in report.margin_by_count_m.items() if np.isfinite(v)},
        worst=tuple(
            SphereConfusion(spheres=c.spheres, taken_for=c.taken_for, misfit_mm=mm(c.misfit_m)) for c in report.worst
        ),
        depth_mm=mm(report.depth.value_m),
        extent_mm=mm(report.extent_m),
        largest_gap_deg=deg(report.largest_gap_rad),
    )


def _uncertainty_of_length(length: BoundedLength) -> Uncertainty:
    return Uncertainty(sigma=mm(length.sigma_m), lower=mm(length.lower_m), upper=mm(length.upper_m))
