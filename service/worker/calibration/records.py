"""A camera calibration as the record of a job, which is also written into camera.json."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from service.compute.calibration.board.board import Board
from service.compute.calibration.intrinsics.estimate import COVERAGE_GRID, IntrinsicsResult
from service.compute.calibration.intrinsics.uncertainty import ProjectionUncertainty
from service.compute.calibration.intrinsics.validation import CrossValidation, residual_field
from service.core.geometry import Array
from service.core.units import mm
from service.jobs.calibration import records
from service.jobs.records import Matrix, ParameterCovariance, matrix


def intrinsics_record(
    result: IntrinsicsResult,
    validation: CrossValidation | None,
    uncertainty: ProjectionUncertainty,
    warnings: Sequence[str],
    names: Sequence[str],
    excluded: Mapping[str, str],
) -> records.Intrinsics:
    """Everything but the camera itself; unknown numbers are None.

    Args:
        result: the calibration.
        validation: None if there are too few images.
        uncertainty: of a projected point.
        warnings: about the images.
        names: of the images used, in the order of `result.views`.
        excluded: reason by image name, including images without the board.
    """
    return records.Intrinsics(
        model=result.model,
        board=_board(result.board),
        n_views=len(result.views),
        images=tuple(names),
        rms_px=result.rms_px,
        per_view_rms_px=_row(result.per_view_rms_px),
        excluded=tuple(records.ExcludedImage(image=image, reason=reason) for image, reason in excluded.items()),
        sigma=dict(result.sigma),
        sigma_independent=dict(result.sigma_independent),
        sigma_by_image={name: _number(value) for name, value in result.sigma_by_image.items()},
        sigma_corner_px=result.sigma_corner_px,
        inflation=result.inflation,
        covariance=ParameterCovariance(parameters=tuple(result.parameters), matrix=matrix(result.covariance)),
        coverage=records.Coverage(share=result.coverage, corners=_counts(result.coverage_map)),
        residuals=_residuals(result),
        tilt=records.Tilt(largest_deg=float(result.tilt_deg.max()), spread_deg=result.tilt_spread_deg),
        cross_validation=None if validation is None else _cross_validation(validation),
        uncertainty=_uncertainty(uncertainty),
        warnings=tuple(warnings),
    )


def _board(board: Board) -> records.BoardSeen:
    return records.BoardSeen(
        pattern=board.pattern, columns=board.columns, rows=board.rows, square_mm=mm(board.square_m)
    )


def _residuals(result: IntrinsicsResult) -> records.ResidualField:
    mean_px, counts = residual_field(result, *COVERAGE_GRID)
    cells = tuple(tuple((float(dx), float(dy)) for dx, dy in row) for row in np.round(mean_px, 5))
    return records.ResidualField(corners=_counts(counts), mean_px=cells)


def _cross_validation(validation: CrossValidation) -> records.CrossValidation:
    return records.CrossValidation(
        folds=validation.folds,
        five_fold_rms_px=validation.five_fold_rms_px,
        five_fold_view_px=_row(validation.five_fold_view_px),
        leave_one_out_rms_px=_number(validation.leave_one_out_rms_px),
        leave_one_out_view_px=tuple(_number(value) for value in validation.leave_one_out_view_px),
    )


def _uncertainty(uncertainty: ProjectionUncertainty) -> records.ProjectionUncertainty:
    return records.ProjectionUncertainty(
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
    """To four digits."""
    return tuple(tuple(float(f"{value:.4g}") for value in row) for row in values)
