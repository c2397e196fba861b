"""What is drawn over an image: outlines of its spheres, identified by the spheres and poses that are known so far."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, TypeAdapter

from service.computations.further_cameras import FURTHER_VIEW
from service.computations.live import LIVE_VIEW
from service.computations.records import Matrix, SpheresFound
from service.computations.registration import Registration
from service.computations.scans import LOCATE_SPHERES
from service.compute.camera_model import CameraModel
from service.compute.markers.records import SphereOutline, outline_from_record
from service.compute.poses.pose_files import read_camera_json
from service.compute.registration.hypotheses import CONTROL_GATE, paired
from service.core.geometry import Transform, inverse
from service.core.jobs import jobs_of
from service.core.step_params import Gives
from service.core.units import metres
from service.dataset.further_cameras import further_pose
from service.dataset.registrations import best_registration, further_cameras, registrations
from service.dataset.summary import control_centres, control_scan, registered_scan
from service.followed_run import RunRecord
from service.web.images import Capture, DrawnOutline, further_of

SphereKind = Literal["registration", "control", "sphere"]


@dataclass(frozen=True, slots=True)
class Sphere:
    """A sphere with the label that pages and pictures show."""

    label: str  # "3"; "C1" for a control sphere
    kind: SphereKind  # "sphere": not known yet whether it is a registration or a control sphere
    centre_m: tuple[float, float, float]
    rms_mm: float | None = None  # rms distance of the surface points from the fitted sphere
    radius_residual_mm: float | None = None


@dataclass(frozen=True, slots=True)
class DisplayedRegistration:
    """The registration that pages show: see service.dataset.registrations.best_registration."""

    name: str
    record: Registration
    step: str


def last_step(log: RunRecord, gives: Gives) -> str:
    """Return the last step that gives this and has a result; "" if there is none."""
    steps = (step.id for step in reversed(log.protocol.steps) if step.gives == gives)
    return next((step for step in steps if log.state.steps[step].result), "")


def displayed_registration(log: RunRecord) -> DisplayedRegistration | None:
    """Return the registration to show; None before there is one."""
    name = best_registration(log.protocol, log.state)
    if name is None:
        return None
    record = registrations(log.protocol, log.state)[name]
    return DisplayedRegistration(name, record, last_step(log, "registrations"))


def scan_spheres(log: RunRecord) -> tuple[Sphere, ...]:
    """Return spheres of the registered scan, and the control spheres, in its frame."""
    scan = _found_in(log, registered_scan(log.protocol, log.state))
    if not scan.spheres_m:
        return ()
    before = control_scan(log.protocol)
    control = _found_in(log, before) if before else SpheresFound(spheres_m=())
    extra = control_centres(scan.spheres_m, control.spheres_m)
    return (*_numbered(scan, "registration"), *(Sphere(f"C{i}", "control", c) for i, c in enumerate(extra)))


def ct_spheres(log: RunRecord) -> tuple[Sphere, ...]:
    """Return all spheres of the CT, in its frame; the CT does not show which of them are removed later."""
    return _numbered(_found_in(log, last_step(log, "ct_surface")), "sphere")


def _found_in(log: RunRecord, step: str) -> SpheresFound:
    """Return the spheres that an import of a scan or a CT found; none without such a step, or before its result."""
    result = log.state.steps[step].result if step in log.state.steps else {}
    return LOCATE_SPHERES.read_answer(result) if result else SpheresFound(spheres_m=())


def _numbered(found: SpheresFound, kind: SphereKind) -> tuple[Sphere, ...]:
    measured = found.details.spheres or (None,) * len(found.spheres_m)
    return tuple(
        Sphere(str(i), kind, centre)
        if sphere is None
        else Sphere(str(i), kind, centre, sphere.rms_mm, sphere.radius_residual_mm)
        for i, (centre, sphere) in enumerate(zip(found.spheres_m, measured, strict=False))
    )


OutlineRecord = dict[str, object]  # as service.compute.markers.records writes it
_OUTLINES_BY_VIEWPOINT = TypeAdapter(dict[str, tuple[OutlineRecord, ...]])


class LivePose(BaseModel):
    """The place where an image was taken, as the job `live_view` found it; T_base_scan is None until it is known."""

    model_config = ConfigDict(frozen=True)

    station: str
    T_base_camera: Matrix
    T_base_scan: Matrix | None


class LiveOutlines(LivePose):
    """Add the outlines of the spheres that the job found in the image."""

    outlines: tuple[OutlineRecord, ...]


@lru_cache(maxsize=512)
def read_live_pose(path: Path) -> LivePose:
    """Return the pose in a file of a job `live_view`; cached, because an artefact never changes under its name."""
    return LivePose.model_validate_json(path.read_bytes())


@lru_cache(maxsize=8)
def read_live_outlines(path: Path) -> LiveOutlines:
    """Return a file of a job `live_view`, with its outlines."""
    return LiveOutlines.model_validate_json(path.read_bytes())


@lru_cache(maxsize=8)
def read_outlines(path: Path) -> Mapping[str, tuple[OutlineRecord, ...]]:
    """Return a file of a job `detect_spheres`: the outlines in each image, by viewpoint."""
    return _OUTLINES_BY_VIEWPOINT.validate_json(path.read_bytes())


@dataclass(frozen=True, slots=True)
class OutlineSource:
    """The source of an image's outlines.

    Attributes:
        source: version of the outlines, which changes with what would be drawn.
        artefact: file with the outlines.
        T_camera_scan: the pose of the frame of `spheres`; None while it is not known.
        live: the artefact is a file of the job `live_view`, which holds one image; others hold all, by viewpoint.
    """

    source: str
    artefact: str
    spheres: tuple[Sphere, ...]
    camera: CameraModel  # camera of the images in which the outlines were found
    photograph: CameraModel  # camera of the photographs as captured, which may be larger
    T_camera_scan: Transform | None
    live: bool


def outlines_of(log: RunRecord, capture: Capture, device: str = "") -> OutlineSource | None:
    """Return the registration's outlines of a valid image, else what the live numbers found, else None.

    `device`: a further camera, whose image it is; "" for the first one.
    """
    if device:
        return _of_further(log, capture, device)
    registered = displayed_registration(log)
    if registered is not None and capture.replaced is None:
        T = registered.record.T_scan_camera.get(capture.payload.viewpoint)
        artefact = registered.record.outlines
        if T is not None and capture.payload.artefacts[0].kind in ("image", "control_image"):
            return OutlineSource(
                f"{artefact[:16]}-{registered.name}",
                artefact,
                scan_spheres(log),
                CameraModel.from_record(registered.record.camera.plain()),
                CameraModel.from_record((registered.record.full_camera or registered.record.camera).plain()),
                inverse(np.array(T, dtype=np.float64)),
                live=False,
            )
    job = capture.live
    if job is None or job.status != "finished" or not job.artefacts:
        return None
    arguments = LIVE_VIEW.read_arguments(job.arguments, jobs_of(log.state))
    camera = CameraModel.from_record(arguments.camera.plain())
    sha256 = job.artefacts[0].sha256
    return OutlineSource(f"live-{sha256[:16]}", sha256, ct_spheres(log), camera, camera, None, True)


def _of_further(log: RunRecord, capture: Capture, device: str) -> OutlineSource | None:
    """Return the outlines in the image of a further camera, as the registration measured them, or as it arrived."""
    mine = next((one for one in further_of(log, capture) if one.exposure.device == device), None)
    located = further_cameras(log.protocol, log.state).get(device)
    registered, viewpoint = displayed_registration(log), capture.payload.viewpoint
    if capture.replaced is None and located is not None and located.outlines and registered is not None:
        camera = CameraModel.from_record(located.camera.plain())
        T_scan_camera = further_pose(located, registered.record.T_scan_camera.get(viewpoint))
        placed = None if T_scan_camera is None else inverse(T_scan_camera)
        source = f"{located.outlines[:16]}-{registered.name}"
        return OutlineSource(source, located.outlines, scan_spheres(log), camera, camera, placed, live=False)
    if mine is None or mine.live is None or mine.live.status != "finished":
        return None
    sha256 = mine.live.artefacts[0].sha256
    answer = FURTHER_VIEW.read_answer(mine.live.result)
    camera = read_camera_json(log.store.artefact_path(mine.exposure.calibration.sha256))
    placed = None if answer.T_ct_camera is None else inverse(np.array(answer.T_ct_camera))
    return OutlineSource(f"live-{sha256[:16]}", sha256, ct_spheres(log), camera, camera, placed, live=False)


def marks_of(log: RunRecord, capture: Capture, device: str = "") -> tuple[DrawnOutline, ...]:
    """Return outlines with numbers: registration spheres 0, 1, 2 …, control spheres C0, C1 …, and what is neither."""
    found = outlines_of(log, capture, device)
    if found is None:
        return ()
    path = log.store.artefact_path(found.artefact)
    if found.live:
        live = read_live_outlines(path)
        records, placed = live.outlines, _provisional(live)
    else:
        records, placed = read_outlines(path).get(capture.payload.viewpoint, ()), found.T_camera_scan
    outlines = [outline_from_record(record, found.camera) for record in records]
    named = _named(outlines, found, placed, metres(log.protocol.spheres.radius_mm))
    return tuple(
        DrawnOutline(
            named[i].kind if i in named else "unassigned",
            named[i].label if i in named else "?",
            outline.captured_px(found.photograph),
        )
        for i, outline in enumerate(outlines)
    )


def _provisional(live: LiveOutlines) -> Transform | None:
    if live.T_base_scan is None:
        return None
    return inverse(np.array(live.T_base_camera)) @ np.array(live.T_base_scan)


def _named(
    outlines: Sequence[SphereOutline], found: OutlineSource, T_camera_scan: Transform | None, radius_m: float
) -> Mapping[int, Sphere]:
    if T_camera_scan is None or not outlines or not found.spheres:
        return {}
    centres = np.array([sphere.centre_m for sphere in found.spheres])
    pairs = paired(outlines, T_camera_scan, centres, radius_m, found.camera, CONTROL_GATE)
    return {outline: found.spheres[m] for outline, m in pairs.items()}
