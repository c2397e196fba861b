"""Measures outlines again in developed raw files, which have 14 bits, linear light and no JPEG compression."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from service.compute.camera_model import CameraModel
from service.compute.images.develop import coded, read_developed
from service.compute.markers.outlines.edges import Pixels
from service.compute.markers.outlines.refine import AveragedCone, measure_outlines
from service.compute.markers.records import DEFAULTS, DetectionOptions, SphereOutline
from service.core.errors import DataError


def remeasure_file(
    path: Path, camera: CameraModel, outlines: Sequence[SphereOutline], options: DetectionOptions = DEFAULTS
) -> tuple[SphereOutline | None, ...]:
    """`remeasure` in a TIFF that `develop` made.

    Raises:
        DataError: the file is none, or it is not of the camera's size.
    """
    linear = read_developed(path)
    if linear.shape[:2] != (camera.height, camera.width):
        raise DataError(
            f"the developed picture has {linear.shape[1]}×{linear.shape[0]} pixels, "
            f"the camera model is for {camera.width}×{camera.height}",
            where=str(path),
            remedy="Develop the raw file together with its JPEG, which gives it the JPEG's size",
        )
    return remeasure(coded(linear), camera, outlines, options)


def remeasure(
    coded_bgr: Pixels, camera: CameraModel, outlines: Sequence[SphereOutline], options: DetectionOptions = DEFAULTS
) -> tuple[SphereOutline | None, ...]:
    """The outlines that the JPEG showed, measured in another picture of the same exposure.

    Args:
        coded_bgr: (H, W, 3), sRGB coded: the noise is then about the same in shadows and lights, as the fit assumes.
        camera: intrinsics.
        outlines: found in the JPEG.
        options: of the detector.

    Returns:
        One for each outline; None where this picture shows none there.
    """
    starts = [AveragedCone(outline.cone) for outline in outlines]
    scores = [outline.score for outline in outlines]
    return tuple(measure_outlines(coded_bgr, camera, starts, options, scores=scores))
