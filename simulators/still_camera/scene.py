"""Sources of the simulated camera's pictures: the rig's world, picture files, or a built-in still life."""

from __future__ import annotations

import importlib
import json
import logging
import socket
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from simulators.hand.effects import hand_in_picture
from simulators.rendering.sensor import Light, bordered
from simulators.serve import SimulatorError
from simulators.still_camera.exif import ExposureSettings

Rgb = NDArray[np.uint8]  # (H, W, 3)
_REFERENCE = (22.0, 1.0 / 15.0, 100.0)  # f-number, seconds and ISO at which a grey card is rendered mid-grey


_PREVIEW_PATIENCE_S = 1.0  # libgphoto2 gives up after 2.5 s without an answer
_LOG = logging.getLogger(__name__)


class NotReadyError(SimulatorError):
    """The renderer is busy or still being built."""


@dataclass(frozen=True, slots=True)
class Moment:
    """Holds what was in front of the lens when the shutter opened; develop() may take longer."""

    counter: int
    T_world_camera: list[list[float]] | None
    view: Mapping[str, Any]


class ImageSource(Protocol):
    """Supplies pictures: freeze() is fast and called at the exposure, develop() renders."""

    def freeze(self, counter: int) -> Moment:
        """Record what the camera sees now."""
        ...

    def develop(self, moment: Moment, settings: ExposureSettings) -> Rgb:
        """Render the picture of that moment as (H, W, 3) RGB."""
        ...

    def light(self, moment: Moment, settings: ExposureSettings) -> Light:
        """The light on the sensor at that moment, for a raw file.

        Linear RGB (H, W, 3) of the picture and its border.
        """
        ...

    def preview(self) -> Rgb:
        """Return a small live-view frame as (H, W, 3) RGB."""
        ...


def exposure_gain(settings: ExposureSettings) -> float:
    """Light on the sensor relative to the reference exposure: (22 / f)² · t / (1/15 s) · ISO / 100."""
    aperture_f, exposure_s, iso = _REFERENCE
    return (aperture_f / settings.aperture_f) ** 2 * settings.exposure_s / exposure_s * settings.iso / iso


def expose(picture: Rgb, gain: float) -> Rgb:
    """Return the picture with `gain` times the light, through a gamma of 2.2."""
    if abs(gain - 1.0) < 0.02:
        return picture
    linear = (np.arange(256) / 255.0) ** 2.2 * gain
    table = np.round(np.clip(linear, 0.0, 1.0) ** (1 / 2.2) * 255.0).astype(np.uint8)
    return cast(Rgb, cv2.LUT(picture, table))


class StillLife:
    """A procedural picture: disks like fruit in a bowl on a grained table, with the file counter in one corner."""

    def __init__(self, image_width: int) -> None:
        self._size = (image_width, round(image_width * 2 / 3))
        self._plain: Rgb | None = None

    def _picture(self, width: int, height: int) -> Rgb:
        rng = np.random.default_rng(7)
        x = np.linspace(-1.5, 1.5, width, dtype=np.float32)[None, :]
        y = np.linspace(-1.0, 1.0, height, dtype=np.float32)[:, None]
        grain = cv2.resize(rng.random((64, 8), dtype=np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
        light = 0.25 + 0.45 * np.exp(-((x + 0.4) ** 2 + (y + 0.3) ** 2) / 1.5)
        wood = np.asarray(light * (0.75 + 0.35 * grain), dtype=np.float32)
        picture = np.stack([wood * 0.8, wood * 0.62, wood * 0.42], axis=2)
        for _ in range(9):
            cx, cy, radius = rng.uniform(-1.1, 1.1), rng.uniform(-0.7, 0.7), rng.uniform(0.12, 0.3)
            distance2 = ((x - cx) ** 2 + (y - cy) ** 2) / radius**2
            inside = distance2 < 1.0
            facing = np.sqrt(np.clip(1.0 - distance2, 0.0, 1.0)) * 0.7 + 0.2
            colour = rng.uniform(0.25, 0.9, 3)
            for channel in range(3):
                picture[..., channel] = np.where(inside, facing * colour[channel], picture[..., channel])
        noisy = picture + rng.normal(0.0, 0.008, (height, width, 1)).astype(np.float32)
        return (np.clip(noisy, 0.0, 1.0) ** (1 / 2.2) * 255.0).astype(np.uint8)

    def _full_size(self) -> Rgb:
        # Drawn at a moderate size: rendering sixty megapixels would take longer than the client waits.
        width, height = self._size
        painted_width = min(width, 1536)
        painted = self._picture(painted_width, round(painted_width * 2 / 3))
        if painted_width == width:
            return painted
        return cast(Rgb, cv2.resize(painted, (width, height), interpolation=cv2.INTER_CUBIC))

    def freeze(self, counter: int) -> Moment:
        """Record the counter; nothing else changes in a still life."""
        return Moment(counter, None, {})

    def develop(self, moment: Moment, settings: ExposureSettings) -> Rgb:
        """Return the picture with the settings' brightness and the counter's digits."""
        if self._plain is None:
            self._plain = self._full_size()
        picture = expose(self._plain, exposure_gain(settings)).copy()
        height = picture.shape[0]
        corner = (height // 20, height - height // 20)
        thickness = max(1, height // 150)
        cv2.putText(picture, f"{moment.counter:05d}", corner, 0, height / 300, (255, 255, 255), thickness)
        return picture

    def light(self, moment: Moment, settings: ExposureSettings) -> Light:
        """Return the light of that picture; its edge pixels are repeated in the border."""
        return bordered(self.develop(moment, settings))

    def preview(self) -> Rgb:
        """Return a frame of 640 × 424."""
        return self._picture(640, 424)


class PictureFiles:
    """Pictures from files in turn, scaled to the image width if one is given."""

    def __init__(self, files: list[Path], image_width: int | None) -> None:
        self._files = files
        self._width = image_width
        for file in files:
            if not file.is_file():
                raise SimulatorError(f"the picture {file} does not exist")

    def _load(self, counter: int) -> Rgb:
        file = self._files[(counter - 1) % len(self._files)]
        picture = cv2.imread(str(file), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
        if picture is None:
            raise SimulatorError(f"the picture {file} cannot be read")
        if self._width is not None and picture.shape[1] != self._width:
            height = round(picture.shape[0] * self._width / picture.shape[1])
            picture = cv2.resize(picture, (self._width, height), interpolation=cv2.INTER_AREA)
        return cast(Rgb, picture)

    def freeze(self, counter: int) -> Moment:
        """Record the counter, which selects the file."""
        return Moment(counter, None, {})

    def develop(self, moment: Moment, settings: ExposureSettings) -> Rgb:
        """Return the picture file of that moment, as bright as the settings make it."""
        return expose(self._load(moment.counter), exposure_gain(settings))

    def light(self, moment: Moment, settings: ExposureSettings) -> Light:
        """Return the light of that picture; its edge pixels are repeated in the border."""
        return bordered(self.develop(moment, settings))

    def preview(self) -> Rgb:
        """Return the first file at a small size."""
        picture = self._load(1)
        return cast(Rgb, cv2.resize(picture, (640, round(640 * picture.shape[0] / picture.shape[1]))))


class _Renderer(Protocol):
    def render(self, view: Mapping[str, Any], camera_settings: Mapping[str, float], seed: int) -> Rgb: ...

    def light(self, view: Mapping[str, Any], camera_settings: Mapping[str, float]) -> Light: ...

    def preview(self, view: Mapping[str, Any]) -> Rgb: ...


class WorldSource:
    """Pictures of the rig's world, rendered for the camera pose at the moment of exposure."""

    def __init__(self, address: str, image_width: int, timeout_s: float = 10.0, camera: str = "") -> None:
        """Take the world's address and the name of the camera there; "": the first."""
        host, _, port = address.rpartition(":")
        if not host or not port.isdigit():
            raise SimulatorError(f"--world takes HOST:PORT, not {address}")
        self._address = (host, int(port))
        self._width = image_width
        self._timeout_s = timeout_s
        self._camera = camera
        self._built: _Renderer | None = None
        self._rendering = threading.Lock()  # live view and exposures use different threads

    @property
    def _renderer(self) -> _Renderer:
        if self._built is None:
            # Imported on demand: ray casting is slow to import, and picture files do not need it.
            render = importlib.import_module("simulators.rendering.render")
            self._built = cast(_Renderer, render.Renderer(self._width))
        return self._built

    def _view(self) -> dict[str, Any]:
        answer = self._ask({"op": "view", **({"camera": self._camera} if self._camera else {})})
        if "T_world_camera" not in answer:
            raise SimulatorError(f"the world refused a view: {answer.get('error', answer)}")
        return answer

    def _ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        try:
            with socket.create_connection(self._address, self._timeout_s) as link, link.makefile("rwb") as stream:
                stream.write(json.dumps(request).encode() + b"\n")
                stream.flush()
                line = stream.readline()
        except OSError as error:
            raise SimulatorError(
                f"the world at {self._address[0]}:{self._address[1]} does not answer: {error}"
            ) from error
        try:
            answer: object = json.loads(line)
        except ValueError as error:
            raise SimulatorError(f"the world answered {line[:80]!r}") from error
        if not isinstance(answer, dict):
            raise SimulatorError(f"the world answered {line[:80]!r}")
        return cast("dict[str, Any]", answer)

    def freeze(self, counter: int) -> Moment:
        """Ask the world what is in front of the lens now."""
        view = self._view()
        return Moment(counter, view["T_world_camera"], view)

    def develop(self, moment: Moment, settings: ExposureSettings) -> Rgb:
        """Render the recorded view."""
        with self._rendering:
            picture = self._renderer.render(moment.view, _lens(settings), moment.counter)
        return hand_in_picture(picture, moment.view)

    def light(self, moment: Moment, settings: ExposureSettings) -> Light:
        """Render the light of the recorded view."""
        with self._rendering:
            light = self._renderer.light(moment.view, _lens(settings))
        return hand_in_picture(light, moment.view)

    def preview(self) -> Rgb:
        """Render a small frame of the current view."""
        view = self._view()
        if not self._rendering.acquire(timeout=_PREVIEW_PATIENCE_S):
            raise NotReadyError("the renderer is busy")
        try:
            return self._renderer.preview(view)
        finally:
            self._rendering.release()

    def await_press(self, after: int) -> tuple[int, int]:
        """Wait until the body's button was pressed more than `after` times, or for a second.

        Returns the number of presses, and the ISO to which the dial was turned before the last one (0: not turned).
        """
        answer = self._ask({"op": "shutter", "after": after})
        if "shutter_presses" not in answer:
            raise SimulatorError(f"the world has no button: {answer.get('error', '')}")
        return int(answer["shutter_presses"]), int(answer["iso"])

    def warm_up(self, stop: threading.Event, interval_s: float = 0.5) -> None:
        """Build the renderer's scene as soon as the world answers, and again after a sphere was moved.

        This spares the clients the wait.
        """
        built: object = None
        while not stop.is_set():
            try:
                view = self._view()
            except SimulatorError as error:
                _LOG.debug("warming up: %s", error)
            else:
                moved = view["scene"].get("moved", [])
                if moved != built:
                    with self._rendering:
                        self._renderer.preview(view)
                    built = moved
            stop.wait(interval_s)


def _lens(settings: ExposureSettings) -> dict[str, float]:
    return {"aperture_f": settings.aperture_f, "exposure_s": settings.exposure_s, "iso": float(settings.iso)}
