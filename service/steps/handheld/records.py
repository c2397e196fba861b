"""What a protocol says of a manual capture, and what the step yields."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from service.core.protocol.step_params import NAMES_CALIBRATION, NAMES_SPHERES, NeededDevice, RepeatedStep, StepParams
from service.core.records.events import Record
from service.steps.capture.live_numbers import CoverageRule
from service.steps.measures import Count, PredictedMeasures, Share


class Ring(Record):
    """Camera places on a hemisphere at one tilt from the vertical, evenly spread over an azimuth range.

    Azimuth 0 is the person's side at the first image, positive to the right. A range of 360° is a whole ring.
    """

    tilt_deg: Annotated[float, Field(ge=0, le=60)]  # from the vertical
    azimuth_from_deg: float = -180.0  # start of the range
    azimuth_to_deg: float = 180.0  # end of the range
    count: Annotated[int, Field(ge=1, le=60)]  # places on the ring
    distance_m: Annotated[float, Field(ge=0.2, le=2)]  # from the middle of the scene
    aim_spread_m: Annotated[float, Field(ge=0, le=0.2)] = (
        0.0  # of the aim point around the middle, for images of the board
    )

    def azimuths_deg(self) -> list[float]:
        """The azimuths of its places."""
        span = self.azimuth_to_deg - self.azimuth_from_deg
        whole = span >= 360.0
        if self.count == 1:
            return [self.azimuth_from_deg + span / 2]
        return [
            float(a) for a in np.linspace(self.azimuth_from_deg, self.azimuth_to_deg, self.count, endpoint=not whole)
        ]


class Params(StepParams):
    """What the images are for, and where they should be taken from."""

    by_hand: ClassVar = True
    repeated: ClassVar = RepeatedStep("Take the images that are missing or would help; the others are kept")

    purpose: Literal["dataset", "control", "calibration"]  # what the images are for
    hemisphere: Annotated[tuple[Ring, ...], Field(min_length=1)]  # where images are to be taken from
    prefix: str = "h_"  # of the views' names
    min_images: Annotated[int, Field(ge=3)] = 12  # usable images that are needed at least
    max_images: Annotated[int, Field(ge=3)] = 200  # including unusable ones
    # Step with the intrinsics; not for images of the board.
    calibration: Annotated[str | None, NAMES_CALIBRATION] = None
    # Steps that locate the spheres, the best first: ct_import, layout_check.
    spheres_of: Annotated[tuple[str, ...], NAMES_SPHERES] = ()
    sensor_width_mm: float = 35.7  # for images of the board, together with the focal length in the file
    coverage: CoverageRule = CoverageRule()  # when a view counts for a point of the specimen's surface
    pose_sigma_mm: Annotated[float, Field(gt=0)] = 0.05  # expected position error of structure from motion
    pose_sigma_mrad: Annotated[float, Field(gt=0)] = 0.1  # expected rotation error of structure from motion
    scan_sigma_mm: Annotated[float, Field(ge=0)] = 0.03  # expected error of the scan's own points, for predictions
    wait_s: Annotated[float, Field(gt=0)] = 600.0  # longest wait for the next image before the step stops

    @property
    def needed_devices(self) -> tuple[NeededDevice, ...]:
        """A camera."""
        return (NeededDevice("camera"),)

    @property
    def photographs_specimen(self) -> bool:
        """Whether the images are not of the calibration board."""
        return self.purpose != "calibration"


class Measures(PredictedMeasures):
    """Of the images so far."""

    images_taken: Annotated[Count, "photographs taken"] = None
    images_used: Annotated[Count, "photographs that can be used"] = None
    images_not_used: Annotated[Count, "photographs that cannot be used"] = None
    coverage: Annotated[Share, "share of the image area in which corners of the board were seen"] = None
    hemisphere_coverage: Annotated[Share, "share of the planned places with a usable image"] = None
    optics_departures: Annotated[Count, "images whose zoom, focus or lens differs from the calibrated one"] = None


class Result(Record):
    """Which images are used."""

    purpose: str
    used: tuple[str, ...]
    not_used: dict[str, str]  # image → why
