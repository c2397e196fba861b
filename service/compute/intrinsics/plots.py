"""Plots a calibration as PNG: corner coverage, residuals, projection uncertainty."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.intrinsics.estimate import IntrinsicsResult
from service.compute.intrinsics.uncertainty import ProjectionUncertainty, residual_field
from service.core.errors import ComputeError
from service.core.geometry import Array

_WIDTH = 1080
_MARGIN = 56
_ENOUGH = 5  # corners in a cell for an arrow
_BLACK, _GREY, _BLUE, _RED = (20, 20, 20), (190, 190, 190), (180, 90, 20), (40, 40, 210)

Canvas = NDArray[np.uint8]


def calibration_plots(result: IntrinsicsResult, uncertainty: ProjectionUncertainty) -> dict[str, bytes]:
    """Return PNG files by name: coverage, residuals, uncertainty.

    Raises:
        ComputeError: an image cannot be encoded.
    """
    return {
        "coverage.png": _png(_coverage(result)),
        "residuals.png": _png(_residuals(result)),
        "uncertainty.png": _png(_uncertainty(result, uncertainty)),
    }


def _coverage(result: IntrinsicsResult) -> Canvas:
    """Return the number of corners in each cell, and the corners themselves."""
    counts = result.coverage_map.astype(np.float64)
    canvas, scale = _frame(result, f"{result.coverage:.0%} of the cells hold a corner; {len(result.views)} views")
    _heat(canvas, 1 - 0.45 * counts / max(counts.max(), 1), cv2.COLORMAP_BONE, cv2.INTER_NEAREST)
    for view in result.corners:
        for point in view.corners:
            cv2.circle(canvas, _at(point, scale), 1, _BLUE, -1, cv2.LINE_AA)
    height, width = counts.shape
    for (row, column), count in np.ndenumerate(counts):
        centre = (np.array([column, row]) + 0.5) / [width, height] * [result.camera.width, result.camera.height]
        x, y = _at(centre, scale)
        _text(canvas, f"{count:.0f}", (x - 12, y + 5), _RED if count == 0 else _BLACK, 0.45)
    return canvas


def _residuals(result: IntrinsicsResult) -> Canvas:
    """Draw the mean residual in each of 24 × 16 cells, which shows what the lens model misses, and views' errors."""
    field, counts = residual_field(result)
    mean, enough = field.reshape(-1, 2), np.flatnonzero(counts >= _ENOUGH)
    cells = np.array(counts.shape[::-1])
    size = np.array([result.camera.width, result.camera.height])
    largest = float(np.linalg.norm(mean[enough], axis=1).max(initial=1e-6))
    length = 0.8 * float((size / cells).min())
    canvas, scale = _frame(
        result, f"{result.rms_px:.3f} px rms; arrows: mean residual of a cell, longest {largest:.3f} px"
    )
    for k in enough:
        middle = (np.array([k % cells[0], k // cells[0]]) + 0.5) / cells * size
        tip = middle + mean[k] / largest * length
        cv2.arrowedLine(canvas, _at(middle, scale), _at(tip, scale), _BLUE, 1, cv2.LINE_AA, tipLength=0.3)
    bars = np.full((170, _WIDTH, 3), 255, dtype=np.uint8)
    _text(bars, "rms of each view, px", (_MARGIN, 20), _BLACK, 0.5)
    errors = result.per_view_rms_px
    step = (_WIDTH - 2 * _MARGIN) / len(errors)
    for k, error in enumerate(errors):
        left = round(_MARGIN + k * step)
        top = round(150 - 115 * error / errors.max())
        cv2.rectangle(bars, (left, top), (max(left + 1, round(left + 0.7 * step)), 150), _BLUE, -1)
    _text(bars, f"{errors.max():.3f}", (4, 42), _BLACK, 0.45)
    return np.vstack([canvas, bars])


def _uncertainty(result: IntrinsicsResult, uncertainty: ProjectionUncertainty) -> Canvas:
    """Return the standard deviation of a projected point, with its values on the grid."""
    field = uncertainty.sigma_px
    canvas, scale = _frame(
        result,
        f"sigma of projection at {uncertainty.distance_m:.2f} m: {uncertainty.centre_px:.3f} px in the centre, "
        f"{uncertainty.worst_px:.3f} px ({uncertainty.worst_mm:.4f} mm) at worst",
    )
    low, high = np.log(field.min()), np.log(field.max())
    _heat(canvas, (np.log(field) - low) / max(high - low, 1e-9), cv2.COLORMAP_VIRIDIS, cv2.INTER_CUBIC)
    for row in range(1, field.shape[0], 3):
        for column in range(1, field.shape[1], 3):
            x, y = _at(uncertainty.pixels[row, column], scale)
            _text(canvas, f"{field[row, column]:.3f}", (x - 20, y + 5), (255, 255, 255), 0.45)
    return canvas


def _frame(result: IntrinsicsResult, title: str) -> tuple[Canvas, float]:
    """Return a white canvas with the image's outline, and the canvas pixels per image pixel."""
    scale = (_WIDTH - 2 * _MARGIN) / result.camera.width
    height = round(result.camera.height * scale)
    canvas = np.full((height + 2 * _MARGIN, _WIDTH, 3), 255, dtype=np.uint8)
    cv2.rectangle(canvas, (_MARGIN - 1, _MARGIN - 1), (_WIDTH - _MARGIN, height + _MARGIN), _GREY, 1)
    _text(canvas, title, (_MARGIN, 34), _BLACK, 0.52)
    _text(
        canvas, f"{result.camera.width} x {result.camera.height} px", (_MARGIN, height + _MARGIN + 28), _BLACK, 0.45
    )
    return canvas, scale


def _heat(canvas: Canvas, share: Array, colours: int, interpolation: int) -> None:
    inside = canvas[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN]
    values = np.clip(share * 255, 0, 255).astype(np.uint8)
    size = (inside.shape[1], inside.shape[0])
    inside[:] = cv2.applyColorMap(
        np.asarray(cv2.resize(values, size, interpolation=interpolation), np.uint8), colours
    )


def _at(pixel: Array, scale: float) -> tuple[int, int]:
    return round(_MARGIN + (pixel[0] + 0.5) * scale), round(_MARGIN + (pixel[1] + 0.5) * scale)


def _text(canvas: Canvas, text: str, at: tuple[int, int], colour: tuple[int, int, int], size: float) -> None:
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)


def _png(canvas: Canvas) -> bytes:
    done, data = cv2.imencode(".png", canvas)
    if not done:
        raise ComputeError("a plot cannot be written as PNG")
    return data.tobytes()
