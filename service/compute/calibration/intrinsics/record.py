"""A calibration as plain data, for camera.json and the run's evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from service.compute.calibration.intrinsics.estimate import COVERAGE_GRID, IntrinsicsResult
from service.compute.calibration.intrinsics.uncertainty import ProjectionUncertainty
from service.compute.calibration.intrinsics.validation import CrossValidation, residual_field
from service.core.geometry import Array
from service.core.units import mm


def intrinsics_record(
    result: IntrinsicsResult,
    validation: CrossValidation | None,
    uncertainty: ProjectionUncertainty,
    warnings: Sequence[str],
    names: Sequence[str],
    excluded: Mapping[str, str],
) -> dict[str, Any]:
    """Everything but the camera itself; unknown numbers are null.

    Args:
        names: of the images used, in the order of `result.views`.
        excluded: reason by image name, including images without the board.
    """
    board = result.board
    residuals, counts = residual_field(result, *COVERAGE_GRID)
    return {
        "model": result.model,
        "board": {
            "pattern": board.pattern,
            "columns": board.columns,
            "rows": board.rows,
            "square_mm": mm(board.square_m),
        },
        "n_views": len(result.views),
        "images": list(names),
        "rms_px": result.rms_px,
        "per_view_rms_px": result.per_view_rms_px.tolist(),
        "excluded": [{"image": image, "reason": reason} for image, reason in excluded.items()],
        "sigma": dict(result.sigma),
        "sigma_independent": dict(result.sigma_independent),
        "sigma_by_image": {name: _number(value) for name, value in result.sigma_by_image.items()},
        "sigma_corner_px": result.sigma_corner_px,
        "inflation": result.inflation,
        "covariance": {"parameters": list(result.parameters), "matrix": result.covariance.tolist()},
        "coverage": {"share": result.coverage, "corners": result.coverage_map.tolist()},
        "residuals": {"corners": counts.tolist(), "mean_px": np.round(residuals, 5).tolist()},
        "tilt": {"largest_deg": float(result.tilt_deg.max()), "spread_deg": result.tilt_spread_deg},
        "cross_validation": None if validation is None else _cross_validation(validation),
        "uncertainty": _uncertainty(uncertainty),
        "warnings": list(warnings),
    }


def _cross_validation(validation: CrossValidation) -> dict[str, Any]:
    return {
        "folds": validation.folds,
        "five_fold_rms_px": validation.five_fold_rms_px,
        "five_fold_view_px": validation.five_fold_view_px.tolist(),
        "leave_one_out_rms_px": _number(validation.leave_one_out_rms_px),
        "leave_one_out_view_px": [_number(value) for value in validation.leave_one_out_view_px],
    }


def _uncertainty(uncertainty: ProjectionUncertainty) -> dict[str, Any]:
    return {
        "distance_m": uncertainty.distance_m,
        "centre_px": uncertainty.centre_px,
        "worst_px": uncertainty.worst_px,
        "rms_px": uncertainty.rms_px,
        "centre_mm": uncertainty.centre_mm,
        "worst_mm": uncertainty.worst_mm,
        "rms_mm": uncertainty.rms_mm,
        "x_px": uncertainty.pixels[0, :, 0].tolist(),
        "y_px": uncertainty.pixels[:, 0, 1].tolist(),
        "sigma_px": _rounded(uncertainty.sigma_px),
        "sigma_mm": _rounded(uncertainty.sigma_mm),
    }


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _rounded(values: Array) -> list[list[float]]:
    return [[float(f"{value:.4g}") for value in row] for row in values]
