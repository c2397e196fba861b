"""The further cameras of a rig at a viewpoint: which of them expose, and the record of their images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from drivers.interfaces import Camera, CameraSettings, CapturedImage
from service.core.records.events import ArtefactRef, FurtherExposure, ViewpointCaptured
from service.steps.capture.image_files import put_image
from service.steps.capture.plan.viewpoints import Viewpoint
from service.steps.context import FurtherCamera, StepContext

IMAGE_KIND = "further_image"  # artefact kind of their photographs
CALIBRATION_KIND = "camera_calibration"

Expose = Callable[[Camera, Path], CapturedImage]  # releases the shutter; the files arrive in the folder


@dataclass(frozen=True, slots=True)
class FurtherImage:
    """An image that has arrived from a further camera, and the settings that it should have been taken with."""

    taken_by: FurtherCamera
    image: CapturedImage
    wanted: CameraSettings

    @property
    def rigid(self) -> bool:
        """Whether the camera moves with the arm."""
        return self.taken_by.section.mounted == "rigid"


def settings_of(camera: FurtherCamera, wanted: CameraSettings) -> CameraSettings:
    """The settings of a further camera: those of the protocol, except what its section in rig.yaml states."""
    section = camera.section
    return replace(
        wanted,
        aperture_f=section.aperture_f or wanted.aperture_f,
        exposure_s=section.exposure_s or wanted.exposure_s,
        iso=section.iso or wanted.iso,
        image_quality=section.image_quality or wanted.image_quality,
    )


def exposing_at(context: StepContext, viewpoint: Viewpoint, cameras: Sequence[FurtherCamera]) -> list[FurtherCamera]:
    """The cameras that expose at a viewpoint: all but those that expose once at a station and have done so."""
    seen = {
        exposure.device
        for capture in context.evidence.captures(context.step.id)
        if isinstance(capture, ViewpointCaptured)
        and capture.station == viewpoint.station
        and capture.viewpoint != viewpoint.name  # whose images are taken again
        for exposure in capture.further
    }
    return [camera for camera in cameras if camera.section.every == "viewpoint" or camera.name not in seen]


def expose_further(
    cameras: Sequence[FurtherCamera], wanted: CameraSettings, folder: Path, expose: Expose
) -> tuple[FurtherImage, ...]:
    """One image of each camera, one after the other. Raises DeviceError of the first that fails."""
    images: list[FurtherImage] = []
    for camera in cameras:
        inside = folder / camera.name  # of its own, because cameras may give files the same names
        inside.mkdir()
        images.append(FurtherImage(camera, expose(camera.camera, inside), settings_of(camera, wanted)))
    return tuple(images)


def keep_further(context: StepContext, further: FurtherImage) -> tuple[tuple[ArtefactRef, ...], ArtefactRef]:
    """Put the files of a further camera's image into the store, and its calibration; returns both."""
    taken_by = further.taken_by
    images = put_image(context, further.image, IMAGE_KIND)
    calibration = context.evidence.put_file(
        taken_by.calibration,
        kind=CALIBRATION_KIND,
        media_type="application/json",
        original_name=taken_by.calibration.name,
    )
    return images, calibration


def files_of(context: StepContext, exposure: FurtherExposure) -> tuple[ArtefactRef, ...]:
    """The files of an exposure to be recorded with it; the calibration only the first time."""
    new = not context.evidence.holds(exposure.calibration.sha256)
    return (*exposure.artefacts, *((exposure.calibration,) if new else ()))
