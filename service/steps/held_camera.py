"""Images of a hand-held camera: released over a cable or on the camera, or found as files without a cable."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Literal

from drivers.errors import (
    DeviceError,
    DeviceTimeoutError,
    DriverKilledError,
    ReleasedElsewhereError,
    StaleImageError,
    UnreadableFileError,
)
from drivers.interfaces import Camera, CapturedImage
from service.core.records.run_events import ViewHeld, ViewpointFailed
from service.core.run.state import WAITING_FOR_HAND
from service.steps.context import StepContext
from service.steps.exposure import camera_record, environment_now, put_image, settings_agree, wanted_settings
from service.steps.views import WORTH_ANOTHER_TRY, apply_settings, photograph
from service.store.records import NewArtefact

_PATIENCE_S = 0.3  # how long to wait for an image in one call
_CLOCKS_S = 300.0  # tolerated delay of the camera's clock; images from before the step are ignored

By = Literal["camera", "screen", "pedal"]


@dataclass
class HeldCamera:
    """The camera in one execution of a step, and the ways to release it."""

    context: StepContext
    prefix: str
    image_kind: str
    finished: bool = False  # somebody has asked to end the capture with the images so far
    _asked: int = field(init=False)
    _pedal: int | None = field(init=False)

    def __post_init__(self) -> None:
        self._asked, self._pedal = len(self.context.evidence.asked()), self._presses()
        camera = self.context.devices.camera()
        self._set(camera)
        for problem in camera.report().problems:
            self.context.tell(problem)

    def new_views(self) -> list[ViewHeld]:
        """Wait a moment for images, and record them. For an unreadable image, only the failure is recorded."""
        context = self.context
        context.evidence.require_space()
        camera = context.devices.camera()
        with tempfile.TemporaryDirectory(prefix="orthocapture-") as folder:
            by, images = self._images(camera, Path(folder))
            views = [self._record(image, by) for image in images]
        if any(not view.verdicts["settings"] for view in views):
            self._set(camera)  # somebody turned a dial: correct it for the next image
        return views

    def _images(self, camera: Camera, folder: Path) -> tuple[By, tuple[CapturedImage, ...]]:
        wanted = wanted_settings(self.context)
        for by in self._requests():
            try:
                return by, (photograph(self.context, camera, wanted, folder),)
            except ReleasedElsewhereError as error:
                self.context.tell(str(error))
        try:
            return "camera", new_images(self.context, camera, folder)
        except (StaleImageError, UnreadableFileError) as error:
            self._failed(error)
        except WORTH_ANOTHER_TRY as error:
            self._failed(error)
            self.context.devices.reopen(camera)
            if isinstance(error, DriverKilledError):
                raise
            self._set(camera)
        return "camera", ()

    def _requests(self) -> list[By]:
        """Return at most one request for a release, from a page or the pedal."""
        asked = self.context.evidence.asked()
        for what in asked[self._asked :]:
            self._asked += 1
            if what == "finish":
                self.finished = True
            else:
                return ["screen"]
        presses = self._presses()
        pressed, self._pedal = presses is not None and self._pedal is not None and presses > self._pedal, presses
        return ["pedal"] if pressed else []

    def _presses(self) -> int | None:
        lightbox = self.context.devices.lightbox()
        if lightbox is None:
            return None
        try:
            return lightbox.pedal().presses
        except DeviceError:
            return None  # the camera can still be released in other ways

    def _set(self, camera: Camera) -> None:
        apply_settings(self.context, camera, wanted_settings(self.context))

    def _record(self, image: CapturedImage, by: By) -> ViewHeld:
        """Record an image: first its files, then its rows and its event in one transaction."""
        context = self.context
        number = len(context.evidence.captures(context.step.id)) + 1
        name = f"{self.prefix}{number:03d}"
        refs = put_image(context, image, self.image_kind)
        view = ViewHeld(
            step=context.step.id,
            attempt=context.attempt,
            viewpoint=name,
            station="",
            artefacts=refs,
            camera=camera_record(image),
            environment=environment_now(context),
            verdicts={"settings": settings_agree(image.exif, wanted_settings(context))},
            released_by="elsewhere" if image.found_at else by,
            found_at=image.found_at,
            arrival_monotonic_s=image.arrival_monotonic_s,
        )
        rows = tuple(
            NewArtefact(
                ref=ref,
                device="camera",
                step=context.step.id,
                attempt=context.attempt,
                viewpoint=name,
                who=context.operator,
                monotonic_s=image.trigger_monotonic_s,
            )
            for ref in refs
        )
        context.evidence.record(view, artefacts=rows)
        return view

    def _failed(self, error: DeviceError) -> None:
        name = f"{self.prefix}{len(self.context.evidence.captures(self.context.step.id)) + 1:03d}"
        failed = ViewpointFailed(
            step=self.context.step.id,
            attempt=self.context.attempt,
            viewpoint=name,
            error=type(error).__name__,
            message=str(error),
        )
        self.context.evidence.record(failed)
        self.context.tell(f"{name}: {error}")

    def waiting(self, done: int, total: int) -> None:
        """Report that the step waits for an image, so that pages show the live view."""
        self.context.progress(WAITING_FOR_HAND, done, total)


def new_images(context: StepContext, camera: Camera, folder: Path) -> tuple[CapturedImage, ...]:
    """Wait a moment for images that were released on the camera during this step and are not recorded yet."""
    steps = context.evidence.state().steps
    started, ended = steps[context.step.id].started_utc, max(step.ended_utc for step in steps.values())
    # After the host's clock was set back, the start would be too early; the end of the step before is not.
    since_s = datetime.fromisoformat(max(started, ended)).timestamp() - (_CLOCKS_S if started >= ended else 0.0)
    images = camera.released_images(folder, _PATIENCE_S, since_s)
    # After a restart, a watched folder delivers all photographs again. From a camera, a repeated file is an error.
    return tuple(image for image in images if not (image.found_at and context.evidence.holds(image.jpeg.sha256)))


def awaited_images(context: StepContext, camera: Camera, folder: Path, wait_s: float) -> tuple[CapturedImage, ...]:
    """Wait for at least one image of a camera without a cable. Raises DeviceTimeoutError after `wait_s`."""
    context.tell("take the photograph now, with the camera's own button; it is read as soon as its file is there")
    for problem in camera.report().problems:
        context.tell(problem)
    deadline_s = context.monotonic_s() + wait_s
    while not (images := new_images(context, camera, folder)):
        context.checkpoint()
        context.progress("waiting for the photograph's file", 0, 1)
        if context.monotonic_s() > deadline_s:
            raise DeviceTimeoutError(
                f"no photograph came within {wait_s:.0f} s",
                where=f"step {context.step.id}",
                remedy="Put the card in, or check that the camera sends its files; then confirm to wait again",
            )
    return images
