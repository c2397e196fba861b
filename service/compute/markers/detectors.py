"""The detectors selectable by name; a new one is a function and a line here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.markers.colours import colour_of
from service.compute.markers.detect import detect_spheres
from service.compute.markers.paper_chain import detect_by_masks
from service.compute.markers.records import DEFAULTS, DetectionOptions, SphereOutline


class Detector(Protocol):
    """Finds the outlines of all spheres in an image (H, W, 3) of the camera's size."""

    def __call__(
        self, image_bgr: NDArray[np.uint8], camera: CameraModel, options: DetectionOptions = ...
    ) -> tuple[SphereOutline, ...]:
        """The outlines, the most certain first."""
        ...


def options_for(colour: str | None, largest: float | None = None) -> DetectionOptions:
    """Default options with the spheres' colour, by name or as #rrggbb; None: it is learnt from each image.

    Args:
        colour: of the spheres.
        largest: largest radius searched for, over the image's width; None: the default.

    Raises:
        ConfigurationError: the colour is unknown.
    """
    options = DEFAULTS if largest is None else replace(DEFAULTS, max_radius=largest)
    if colour is None:
        return options
    colour_bgr, tolerance = colour_of(colour)
    return replace(options, colour_bgr=colour_bgr, colour_tolerance=tolerance)


DETECTORS: Mapping[str, Detector] = {"classical": detect_spheres, "paper": detect_by_masks}
