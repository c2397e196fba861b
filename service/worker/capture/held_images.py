"""Hand-held images: what the worker has found in each, and how it is written and read back."""

from __future__ import annotations

import base64
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from service.compute.hand_held import ImageReading
from service.core.geometry import Array, Transform
from service.jobs.capture.hand_view import HeldArguments
from service.worker.capture.scene import CaptureScene
from service.worker.job import JobContext

_H = TypeVar("_H", bound=HeldArguments)


@dataclass(frozen=True, slots=True)
class HandheldImage:
    """An image that a person took, and what it contributes.

    Attributes:
        viewpoint: its name.
        used: whether it counts.
        T_scene_camera: None where the image does not show where the camera was.
        T_scene_level: frame with z up and y towards the top of the first image whose pose is known.
        information: (6, 6) about the scan's pose.
        seen: (P,) points of the surface that it shows.
        cells: board corners in each cell of the frame; empty for images of the specimen.
        reading: outlines and spheres, where the spheres have not been measured.
        spheres_m: (S, 3) as the images up to this one show them.
    """

    viewpoint: str
    used: bool
    T_scene_camera: Transform | None
    T_scene_level: Transform | None
    information: Array = field(repr=False)
    seen: NDArray[np.bool_] = field(repr=False)
    cells: NDArray[np.int64] = field(repr=False)
    reading: ImageReading | None = field(repr=False)
    spheres_m: Array | None = field(repr=False)

    def plain(self, *, rough: bool) -> dict[str, object]:
        """The view as it is written into its file; with `rough`, the spheres too."""
        record: dict[str, object] = {
            "viewpoint": self.viewpoint,
            "used": self.used,
            "T_scene_camera": None if self.T_scene_camera is None else self.T_scene_camera.tolist(),
            "T_scene_level": None if self.T_scene_level is None else self.T_scene_level.tolist(),
            "information": self.information.tolist(),
            "seen": base64.b64encode(np.packbits(self.seen).tobytes()).decode(),
            "cells": self.cells.tolist(),
        }
        if rough:
            record["reading"] = None if self.reading is None else self.reading.record()
            record["spheres_m"] = None if self.spheres_m is None else self.spheres_m.tolist()
        return record


def read_views(context: JobContext[_H], scene: CaptureScene) -> list[HandheldImage]:
    """The views of the earlier images, from their files."""
    return [_read(context, sha256, scene) for sha256 in context.arguments.earlier]


def _read(context: JobContext[_H], sha256: str, scene: CaptureScene) -> HandheldImage:
    data = context.input_json(sha256)
    bits = np.unpackbits(np.frombuffer(base64.b64decode(data["seen"]), np.uint8))
    T, level = (None if data[key] is None else np.array(data[key]) for key in ("T_scene_camera", "T_scene_level"))
    reading = data.get("reading")
    visible = bits[: scene.n_points].astype(bool)
    if len(bits) < scene.n_points:  # the surface was not ready yet
        visible = scene.seen_from(T)
    return HandheldImage(
        viewpoint=data["viewpoint"],
        used=bool(data["used"]),
        T_scene_camera=T,
        T_scene_level=level,
        information=np.array(data["information"]),
        seen=visible,
        cells=np.array(data["cells"], dtype=np.int64),
        reading=None if reading is None or T is None else ImageReading.read(data["viewpoint"], T, reading),
        spheres_m=None if data.get("spheres_m") is None else np.array(data["spheres_m"]),
    )
