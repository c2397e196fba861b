"""What a run knows of its further cameras: images, calibration, pose, clock; their images as views of a data set."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from service.computations.further_cameras import FurtherCameraAnswer
from service.computations.records import Matrix
from service.compute.camera_model import CameraModel
from service.compute.images.views import Splits
from service.compute.registration.result import product_jacobians
from service.core.geometry import Array, Transform
from service.core.protocol import Protocol
from service.core.recorded_devices import ClockOffset, clock_offset
from service.core.records.base import ArtefactRef
from service.core.records.run_events import FurtherExposure, RecordedOptics, RecordedView, ViewpointCaptured
from service.core.run.state import RunState
from service.core.units import mm, mrad
from service.dataset.registrations import further_cameras
from service.dataset.summary import RunSummary


@dataclass(frozen=True, slots=True)
class KnownFurtherCamera:
    """A further camera of a run.

    Attributes:
        name: the camera's name in rig.yaml.
        mounted: fixed in the room, or rigid beside the first camera.
        optics: body, lens and settings as its first photograph states them.
        calibration: file with its intrinsics.
        images: its photograph of each valid view, by viewpoint.
        located: its pose, as the registration step found it; None before that.
        clock: the offset of its clock from the first camera's; None if the photographs do not show it.
    """

    name: str
    mounted: Literal["fixed", "rigid"]
    optics: RecordedOptics
    calibration: ArtefactRef
    images: dict[str, ArtefactRef]
    located: FurtherCameraAnswer | None
    clock: ClockOffset | None

    @property
    def outer(self) -> str:
        """A text on the frame in which its pose is given."""
        return "the scan" if self.mounted == "fixed" else "the first camera"

    @property
    def sigma_mm(self) -> float | None:
        """Standard deviation of its position, over all three axes."""
        return None if self._sigmas is None else mm(self._sigmas[0])

    @property
    def sigma_mrad(self) -> float | None:
        """Standard deviation of its rotation, over all three axes."""
        return None if self._sigmas is None else mrad(self._sigmas[1])

    @property
    def _sigmas(self) -> tuple[float, float] | None:
        if self.located is None or self.located.covariance is None:
            return None
        return pose_sigmas(self.located)


def pose_sigmas(located: FurtherCameraAnswer) -> tuple[float, float]:
    """Return the standard deviations of a located camera's position (m) and rotation (rad): roots of the traces."""
    variances = np.diag(np.array(located.covariance))
    return float(np.sqrt(variances[:3].sum())), float(np.sqrt(variances[3:].sum()))


def further_pose(located: FurtherCameraAnswer, T_scan_first: Matrix | None) -> Transform | None:
    """Return T_scan_camera (4, 4) of a further camera while the first one was at this pose; None if not known."""
    if located.T_outer_camera is None or (located.mounted == "rigid" and T_scan_first is None):
        return None
    T_outer_camera = np.array(located.T_outer_camera)
    return T_outer_camera if located.mounted == "fixed" else np.array(T_scan_first) @ T_outer_camera


def further_poses(
    protocol: Protocol, state: RunState, views: Iterable[RecordedView], T_scan_first: Mapping[str, Matrix]
) -> dict[str, dict[str, Transform]]:
    """Return T_scan_camera of every further camera by its name: by viewpoint if it is rigid, once if it is fixed."""
    found: dict[str, dict[str, Transform]] = {}
    for camera in known_further_cameras(protocol, state, views):
        for viewpoint in camera.images:
            pose = None if camera.located is None else further_pose(camera.located, T_scan_first.get(viewpoint))
            if pose is not None:
                shown = camera.name if camera.mounted == "fixed" else f"{viewpoint}, {camera.name}"
                found.setdefault(camera.name, {})[shown] = pose
    return found


def known_further_cameras(
    protocol: Protocol, state: RunState, views: Iterable[RecordedView]
) -> tuple[KnownFurtherCamera, ...]:
    """Return the further cameras that exposed at these valid views, in the order of the rig file."""
    captures = [view for view in views if isinstance(view, ViewpointCaptured)]
    located = further_cameras(protocol, state)
    exposures: dict[str, list[tuple[str, FurtherExposure]]] = {}
    for capture in captures:
        for exposure in capture.further:
            exposures.setdefault(exposure.device, []).append((capture.viewpoint, exposure))
    return tuple(
        KnownFurtherCamera(
            name=name,
            mounted=mine[-1][1].mounted,
            optics=mine[0][1].optics,
            calibration=mine[-1][1].calibration,
            images={viewpoint: exposure.artefacts[0] for viewpoint, exposure in mine},
            located=located.get(name),
            clock=clock_offset(captures, name),
        )
        for name, mine in exposures.items()
    )


@dataclass(frozen=True, slots=True)
class FurtherView:
    """An image of a further camera.

    Attributes:
        name: the view's name: that of the viewpoint, and the camera's.
        viewpoint: the viewpoint at which it was taken.
        device: the camera.
        path, sha256: file and hash of the photograph.
        camera: its intrinsics.
        T_scan_camera: (4, 4) the camera's pose in the frame of the scan, m.
        from_first: (6, 6) how the pose follows an error of the first camera's pose at the viewpoint; 0 if fixed.
        from_mount: (6, 6) how it follows an error of the camera's pose in its outer frame.
        taken: time that the photograph states.
    """

    name: str
    viewpoint: str
    device: str
    path: Path
    sha256: str
    camera: CameraModel
    T_scan_camera: Transform = field(repr=False)
    from_first: Array = field(repr=False)
    from_mount: Array = field(repr=False)
    taken: str


@dataclass(frozen=True, slots=True)
class FurtherViews:
    """The images of all further cameras that were located.

    Attributes:
        views: the views in order of their names.
        mounts: (6, 6) covariance of each camera in its outer frame.
        statement: the entry of `dataset.json` for each further camera, also for those that were not located.
    """

    views: tuple[FurtherView, ...]
    mounts: Mapping[str, Array] = field(repr=False)
    statement: list[dict[str, Any]] = field(repr=False)

    def covariances(self, first: Mapping[str, Array]) -> dict[str, Array]:
        """Return the covariance (6, 6) of each view's pose, given those of the first camera's."""
        return {
            view.name: view.from_first @ first[view.viewpoint] @ view.from_first.T
            + view.from_mount @ self.mounts[view.device] @ view.from_mount.T
            for view in self.views
        }

    def with_them(self, first: Splits) -> Splits:
        """Return the splits with the images of the further cameras.

        An image of a rigid camera is where its viewpoint is. Those of a fixed one all show the same, so they are all
        for training. None is among the sparse views.
        """
        test = {v.name for v in self.views if v.from_first.any() and v.viewpoint in first.test}
        names = {view.name for view in self.views}
        return Splits(
            dense=tuple(sorted({*first.dense, *names})),
            sparse=first.sparse,
            train=tuple(sorted({*first.train, *(names - test)})),
            test=tuple(sorted({*first.test, *test})),
        )

    def joint(self, first: Array, viewpoints: Sequence[str]) -> Array:
        """Return the joint covariance (6 V, 6 V) of the errors of all poses, in order of the views' names.

        Args:
            first: (6 N, 6 N) of the first camera's poses.
            viewpoints: N, in the order of its rows.
        """
        names = [*viewpoints, *(view.name for view in self.views)]
        devices = sorted(self.mounts)
        n, source = len(viewpoints), np.zeros((len(first) + 6 * len(devices),) * 2)
        source[: len(first), : len(first)] = first
        J = np.zeros((6 * len(names), len(source)))
        J[: 6 * n, : 6 * n] = np.eye(6 * n)
        for k, device in enumerate(devices):
            inside = slice(6 * (n + k), 6 * (n + k) + 6)
            source[inside, inside] = self.mounts[device]
        for k, view in enumerate(self.views):
            rows = slice(6 * (n + k), 6 * (n + k) + 6)
            at, mount = list(viewpoints).index(view.viewpoint), n + devices.index(view.device)
            J[rows, 6 * at : 6 * at + 6] = view.from_first
            J[rows, 6 * mount : 6 * mount + 6] = view.from_mount
        order = sorted(range(len(names)), key=names.__getitem__)
        picked = (6 * np.array(order)[:, None] + np.arange(6)).ravel()
        joint = J @ source @ J.T
        return joint[np.ix_(picked, picked)]


def further_views(summary: RunSummary, T_scan_first: Mapping[str, Transform]) -> FurtherViews:
    """Return the images of the further cameras at the registered viewpoints of the data set.

    Args:
        summary: the run.
        T_scan_first: (4, 4) pose of the first camera at each of these viewpoints.
    """
    located = further_cameras(summary.protocol, summary.state)
    captures = [c for c in summary.captures() if isinstance(c, ViewpointCaptured)]
    there = [c for c in captures if c.viewpoint in T_scan_first]
    views = [
        _view(summary, capture, k, located[exposure.device], T_scan_first[capture.viewpoint])
        for capture in there
        for k, exposure in enumerate(capture.further)
        if exposure.device in located and located[exposure.device].T_outer_camera is not None
    ]
    return FurtherViews(
        tuple(sorted(views, key=lambda view: view.name)),
        {name: np.array(one.covariance) for name, one in located.items() if one.covariance is not None},
        [_stated(captures, one) for one in located.values()],
    )


def _view(
    summary: RunSummary,
    capture: ViewpointCaptured,
    number: int,
    located: FurtherCameraAnswer,
    T_scan_first: Transform,
) -> FurtherView:
    exposure = capture.further[number]
    photograph, T_outer_camera = exposure.artefacts[0], np.array(located.T_outer_camera)
    rigid = located.mounted == "rigid"
    T_scan_outer = T_scan_first if rigid else np.eye(4)
    by_outer, by_mount = product_jacobians(T_scan_outer, T_outer_camera)
    return FurtherView(
        name=f"{capture.viewpoint}_{exposure.device}",
        viewpoint=capture.viewpoint,
        device=exposure.device,
        path=summary.store.artefact_path(photograph.sha256),
        sha256=photograph.sha256,
        camera=CameraModel.from_record(located.camera.plain()),
        T_scan_camera=T_scan_outer @ T_outer_camera,
        from_first=by_outer if rigid else np.zeros((6, 6)),
        from_mount=by_mount,
        taken=exposure.optics.exif_time,
    )


def _stated(captures: Sequence[ViewpointCaptured], located: FurtherCameraAnswer) -> dict[str, Any]:
    """Return the entry of `dataset.json` for one further camera."""
    clock = clock_offset(captures, located.device)
    said: dict[str, Any] = {
        "camera": located.device,
        "mounted": located.mounted,
        "intrinsics": located.camera.plain(),
        "clock_offset_s": None if clock is None else clock.offset_s,
        "clock_offset_sigma_s": None if clock is None else clock.sigma_s,
        "clock_offset_of": "its clock minus that of the first camera",
        "measured_on": located.measured_on,
        "images_left_out": located.excluded,
    }
    if located.T_outer_camera is None or located.covariance is None:
        return {**said, "not_located": located.why}
    sigma_m, sigma_rad = pose_sigmas(located)
    return {
        **said,
        "T_scan_camera" if located.mounted == "fixed" else "T_first_camera": located.T_outer_camera,
        "covariance": located.covariance,
        "sigma_mm": mm(sigma_m),
        "sigma_mrad": mrad(sigma_rad),
        "consistency_mm": located.consistency_mm,
        "consistency_mrad": located.consistency_mrad,
        "images": len(located.views),
    }
