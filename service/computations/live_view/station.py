"""The registration of one station's images so far, and the error that it predicts."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from service.computations.job import JobContext
from service.computations.live_view import LiveArguments
from service.computations.records import Hash
from service.computations.scene import CaptureScene
from service.compute.live import LiveView, ProvisionalRegistration, register_station
from service.compute.markers.records import outline_from_record, outline_record
from service.compute.planning.coverage import (
    ViewInformation,
    mounting_covariance,
    point_sigmas_m,
    pose_covariance,
    pose_scatter,
    view_information,
)
from service.compute.registration.hypotheses import paired
from service.compute.scene import ScanSpheres
from service.core.geometry import Array, Transform, apply, inverse

_L = TypeVar("_L", bound=LiveArguments)


@dataclass(frozen=True, slots=True)
class LiveRecord:
    """The file of a job `live_view`: an image's outlines and pose, and the points of the specimen that it shows."""

    viewpoint: str
    station: str
    view: LiveView
    T_base_scan: Transform | None  # as the images up to this one determined it
    seen: NDArray[np.bool_]

    def plain(self, sha256: str) -> dict[str, object]:
        """Return the record as it is written, with the hash of the photograph."""
        return {
            "viewpoint": self.viewpoint,
            "station": self.station,
            "sha256": sha256,
            "T_base_camera": self.view.T_base_camera.tolist(),
            "T_base_scan": None if self.T_base_scan is None else self.T_base_scan.tolist(),
            "outlines": [outline_record(o) for o in self.view.outlines],
            "seen": base64.b64encode(np.packbits(self.seen).tobytes()).decode(),
        }


def read_records(context: JobContext[_L], hashes: Sequence[Hash], scene: CaptureScene) -> list[LiveRecord]:
    """Return the records of earlier images, from their files."""
    out: list[LiveRecord] = []
    for sha256 in hashes:
        data = context.input_json(sha256)
        outlines = tuple(outline_from_record(o, scene.camera) for o in data["outlines"])
        bits = np.unpackbits(np.frombuffer(base64.b64decode(data["seen"]), np.uint8))
        T = None if data["T_base_scan"] is None else np.array(data["T_base_scan"])
        view = LiveView(data["viewpoint"], np.array(data["T_base_camera"]), outlines)
        visible = bits[: scene.n_points].astype(bool)
        if len(bits) < scene.n_points:  # the surface was not ready yet
            visible = scene.seen_from(None if T is None else inverse(T) @ view.T_base_camera)
        out.append(LiveRecord(data["viewpoint"], data["station"], view, T, visible))
    return out


def last_known(records: Sequence[LiveRecord]) -> Transform | None:
    """Return the newest T_base_scan of a station's images; None before one is determined."""
    return next((r.T_base_scan for r in reversed(records) if r.T_base_scan is not None), None)


@dataclass(frozen=True, slots=True)
class LiveStation:
    """One station's registration so far, and the information of each of its images.

    Attributes:
        solved: the registration.
        informations: the information of each image about the scan's pose.
        P: (6, 6) covariance of one camera pose of the arm.
        mounting: (6, 6) covariance of the scan's pose due to the hand-eye transform.
        centre_m: (3,) centre of the spheres, base frame.
        targets_m: (T, 3) points at which errors are predicted, relative to the centre, base axes.
    """

    solved: ProvisionalRegistration
    informations: tuple[ViewInformation, ...]
    P: Array
    mounting: Array
    centre_m: Array
    targets_m: Array

    def error_m(self) -> float:
        """Predict the error (1σ, 3D) at the worst target."""
        return self._worst_m(pose_covariance([v.information for v in self.informations], self.P) + self.mounting)

    def outline_limited_m(self) -> float:
        """Predict the error (1σ, 3D) at the worst target if the camera poses were exact."""
        return self._worst_m(pose_covariance([v.information for v in self.informations], np.zeros((6, 6))))

    def _worst_m(self, covariance: Array) -> float:
        return float(point_sigmas_m(covariance, self.targets_m).max())


def solve_station(
    views: Sequence[LiveView], known: Transform | None, arguments: LiveArguments, scene: CaptureScene
) -> LiveStation:
    """Register a station's images and predict the error. Raises ComputeError while they do not determine it."""
    spheres, radius_m = scene.spheres_m, scene.radius_m
    sigma_m, sigma_rad = arguments.arm_sigma_m, arguments.arm_sigma_rad
    solved = register_station(views, spheres, radius_m, scene.camera, known)
    T = solved.T_base_scan
    centre = apply(T, spheres.mean(axis=0))
    informations = tuple(
        view_information(
            v.T_base_camera, T, v.outlines,
            paired(v.outlines, inverse(v.T_base_camera) @ T, spheres, radius_m, scene.camera),
            ScanSpheres(spheres, radius_m), centre, 3 * sigma_m,
        )
        for v in views
    )  # fmt: skip
    scatter = pose_scatter(informations, sigma_m, sigma_rad)
    # Raises if the views do not determine the pose; the next call would return a wrong result instead.
    pose_covariance([v.information for v in informations], scatter)
    mounting = mounting_covariance(
        [(i.information, v.T_base_camera) for i, v in zip(informations, views, strict=True)],
        np.array(arguments.T_flange_camera),
        np.array(arguments.hand_eye_covariance),
        centre,
    )
    return LiveStation(solved, informations, scatter, mounting, centre, apply(T, scene.targets_m()) - centre)
