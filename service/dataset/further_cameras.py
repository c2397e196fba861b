"""What a run knows of each of its further cameras: images, calibration, pose with sigma, offset of its clock."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from service.computations.further_camera import Answer
from service.computations.records import Matrix
from service.core.geometry import Transform
from service.core.protocol import Protocol
from service.core.recorded_devices import ClockOffset, clock_offset
from service.core.records.base import ArtefactRef
from service.core.records.run_events import FurtherExposure, RecordedOptics, RecordedView, ViewpointCaptured
from service.core.run.state import RunState
from service.core.units import mm, mrad
from service.dataset.registrations import further_cameras


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
    located: Answer | None
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


def pose_sigmas(located: Answer) -> tuple[float, float]:
    """Return the standard deviations of a located camera's position (m) and rotation (rad): roots of the traces."""
    variances = np.diag(np.array(located.covariance))
    return float(np.sqrt(variances[:3].sum())), float(np.sqrt(variances[3:].sum()))


def further_pose(located: Answer, T_scan_first: Matrix | None) -> Transform | None:
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
