"""Cross-validation of a calibration over images, and warnings about its weaknesses."""

from __future__ import annotations

from dataclasses import dataclass
from math import floor

import numpy as np
from numpy.typing import NDArray

from service.compute.calibration.intrinsics.adjustment import adjust, fit_pose, rms
from service.compute.calibration.intrinsics.estimate import (
    IntrinsicsResult,
    calibrate_intrinsics,
    leave_one_out,
    surface_of,
)
from service.compute.calibration.intrinsics.uncertainty import ProjectionUncertainty
from service.core.errors import ComputeError
from service.core.geometry import Array
from service.core.units import mm

MIN_VIEWS_TO_VALIDATE = 4
_FOLDS = 5
# Limits for warnings (the reasons are in the messages).
_VIEWS = 60
_RMS_PX = 0.5
_COVERAGE = 0.9
_TILT_DEG = 30.0
_HELD_OUT_FACTOR = 1.3
_INFLATION = 4.0
_SIMPLE = ("pinhole", "radial2", "opencv4", "opencv5")  # models that a wide lens does not follow
_WIDE = 0.5  # times as large residuals with the rational model tell a wide lens


@dataclass(frozen=True, slots=True)
class CrossValidation:
    """Errors of views that were not used in the calibration; only the view's own pose is fitted to it.

    Attributes:
        folds: number of parts into which the views were split.
        five_fold_rms_px: over all views, each held out once.
        five_fold_view_px: (N,).
        leave_one_out_rms_px: each view judged by a calibration without it (one Newton step).
        leave_one_out_view_px: (N,); NaN if the other views do not determine the camera.
    """

    folds: int
    five_fold_rms_px: float
    five_fold_view_px: Array
    leave_one_out_rms_px: float
    leave_one_out_view_px: Array


def cross_validate(result: IntrinsicsResult, *, seed: int = 0) -> CrossValidation:
    """Five-fold and leave-one-out over the views of a calibration.

    Raises:
        ComputeError: fewer than four views.
    """
    n = len(result.corners)
    if n < MIN_VIEWS_TO_VALIDATE:
        raise ComputeError(f"{n} views cannot be cross-validated", remedy="Take more board images")
    surface = surface_of(result.board)
    size = (result.camera.width, result.camera.height)
    folds = min(_FOLDS, n)
    fold = np.random.default_rng(seed).permutation(n) % folds
    solution = result.adjustment
    held_out = np.zeros(n)
    for k in range(folds):
        train = np.flatnonzero(fold != k)
        without = adjust(
            [result.corners[i] for i in train],
            surface,
            size,
            solution.camera,
            solution.poses[train],
            parameters=len(result.parameters),
            bow_m=solution.bow_m,
            iterations=6,
        )
        points = surface.bent(without.bow_m)
        for i in np.flatnonzero(fold == k):
            held_out[i] = fit_pose(result.corners[i], points, without.camera, solution.poses[i])[1]
    one_out = np.array(
        [
            rms(view.residual + view.reduced @ change)
            for view, change in zip(solution.views, leave_one_out(solution), strict=True)
        ]
    )
    counts = np.array([len(view.indices) for view in result.corners])
    return CrossValidation(folds, _pooled(held_out, counts), held_out, _pooled(one_out, counts), one_out)


def _pooled(per_view_px: Array, counts: Array) -> float:
    return float(np.sqrt(np.sum(per_view_px**2 * counts) / np.sum(counts)))


def residual_field(result: IntrinsicsResult, columns: int = 24, rows: int = 16) -> tuple[Array, NDArray[np.int64]]:
    """Mean residual (rows, columns, 2), px, and number (rows, columns) of the corners in each cell of the image.

    Noise averages out; what remains is the error of the lens model.
    """
    corners = np.concatenate([view.corners for view in result.corners])
    residual = np.concatenate([view.residual.reshape(-1, 2) for view in result.adjustment.views])
    cells = np.array([columns, rows])
    size = np.array([result.camera.width, result.camera.height])
    cell = np.clip((corners + 0.5) / size * cells, 0, cells - 1).astype(int)
    flat = cell[:, 1] * columns + cell[:, 0]
    count = np.bincount(flat, minlength=columns * rows)
    total = np.stack([np.bincount(flat, residual[:, k], columns * rows) for k in (0, 1)], axis=1)
    mean = total / np.maximum(count, 1)[:, None]
    return mean.reshape(rows, columns, 2), count.reshape(rows, columns).astype(np.int64)


def _wide_lens(result: IntrinsicsResult) -> list[str]:
    """The warning that a lens is too wide for its model, if the rational one fits the same views far better."""
    size = (result.camera.width, result.camera.height)
    try:
        wide = calibrate_intrinsics(result.corners, result.board, size, model="rational")
    except ComputeError:  # these views do not determine so many terms
        return []
    if wide.rms_px > _WIDE * result.rms_px or len(wide.views) < len(result.views) - 1:
        return []
    return [
        f"a wide lens: the model {result.model} fits to {result.rms_px:.2f} px, rational to {wide.rms_px:.2f} px "
        f"(fx {wide.camera.fx:.1f} ± {wide.sigma['fx']:.1f}): calibrate with --model rational"
    ]


def _undetermined(result: IntrinsicsResult, uncertainty: ProjectionUncertainty) -> list[str]:
    """Warnings that the images do not determine terms of the distortion."""
    if result.model == "rational":
        # Terms of a quotient may cancel each other: what they mean together is in the projection's uncertainty.
        if uncertainty.worst_px <= _RMS_PX:
            return []
        return [
            "the quotient of k1 … k6 is not determined in all of the image: show the board in its corners, or use "
            "fewer terms"
        ]
    return [
        f"{name} is not determined ({getattr(result.camera, name):.3g} ± {sigma:.2g}): use fewer terms"
        for name, sigma in result.sigma.items()
        if name in ("k2", "k3") and sigma > abs(getattr(result.camera, name))
    ]


def calibration_warnings(
    result: IntrinsicsResult, validation: CrossValidation | None, uncertainty: ProjectionUncertainty
) -> tuple[str, ...]:
    """Reasons to trust this calibration less, in words; empty if there are none."""
    found: list[str] = []
    n = len(result.views)
    if n < _VIEWS:
        found.append(f"{n} views; {_VIEWS} or more average the errors that corners of one image share")
    if result.rms_px > _RMS_PX:
        found.append(f"{result.rms_px:.2f} px rms, more than {_RMS_PX} px: blur, motion, bent board, wrong model")
    if result.coverage < _COVERAGE:
        share = f"{floor(1000 * result.coverage) / 10:g} %"  # rounded down, so that it never reaches its limit
        found.append(f"corners in {share} of the image, less than {_COVERAGE:.0%}: show the board there")
    if result.tilt_deg.max() < _TILT_DEG:
        found.append(f"largest tilt {result.tilt_deg.max():.0f}°, less than {_TILT_DEG:.0f}°: focal length is weak")
    if result.inflation > _INFLATION:
        found.append(
            f"images disagree {np.sqrt(result.inflation):.1f} times as much as their corners' noise explains "
            "(light, a bent board or a wrong model); the sigmas are enlarged by this"
        )
    if result.model in _SIMPLE and (result.rms_px > _RMS_PX or result.inflation > _INFLATION):
        found += _wide_lens(result)
    found += _undetermined(result, uncertainty)
    bow_m = max(result.board.bow_m, key=abs)
    if abs(bow_m) > result.board.flatness_m:
        found.append(
            f"the board is bent by {mm(abs(bow_m)):.2f} mm, more than its stated flatness of "
            f"{mm(result.board.flatness_m):g} mm: the camera is corrected for an even bow, not for waves"
        )
    if result.board.pattern == "circles":
        found.append("the middle of a tilted circle's image is not its centre: a checkerboard is more accurate")
    if validation is None:
        found.append("too few views for cross-validation")
    elif validation.five_fold_rms_px > _HELD_OUT_FACTOR * result.rms_px:
        found.append(
            f"held-out views err by {validation.five_fold_rms_px:.2f} px, views in the fit by {result.rms_px:.2f} px"
        )
    if uncertainty.worst_px > _RMS_PX:
        found.append(
            f"projection is uncertain by {uncertainty.worst_px:.2f} px ({uncertainty.worst_mm:.3f} mm at "
            f"{uncertainty.distance_m:.2f} m) where it is worst in the image"
        )
    return tuple(found)
