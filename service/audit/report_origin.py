"""Where the data comes from: devices and clocks, software, pictures, and the scene that they show."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from service.audit.recorded import RecordedRun
from service.audit.report_blocks import Block, Cell, Column, Heading, Paragraph, Pictures, Scene, Section, Table
from service.audit.report_pictures import LARGE_PX, THUMBNAIL_PX, picture
from service.audit.report_words import clock
from service.compute.budget.closure import Alignment
from service.core.errors import IntegrityError
from service.core.model import DeviceOpened, JobFinished, SessionStarted, View, ViewpointCaptured
from service.core.terms import term
from service.dataset.summary import RunSummary

_COMPUTES = ("orthocapture", "numpy", "scipy", "opencv-python-headless", "pycolmap", "trimesh", "scikit-image")


def devices_section(run: RecordedRun) -> Section:
    """Every device that answered, its versions and clocks; light and temperature over the captures."""
    columns = (
        Column("device", 0.8),
        Column("model", 1.7),
        Column("serial number", 1.4),
        Column("firmware", 1.1),
        Column("driver", 2.0),
        Column("clock against the host (s)", 1.2, "number"),
        Column("opened (UTC)", 0.9),
    )
    rows: list[tuple[Cell | str, ...]] = []
    for event in run.events:
        if isinstance(event.payload, DeviceOpened):
            report: Mapping[str, Any] = event.payload.report
            identity: Mapping[str, Any] = report.get("identity") or {}
            offset = report.get("clock_offset_s")
            rows.append(
                (
                    event.payload.device,
                    str(identity.get("model", "")),
                    str(identity.get("serial", "")) or "–",
                    str(identity.get("firmware", "")) or "–",
                    f"{identity.get('driver', '')}: {identity.get('driver_version', '')}",
                    "–" if offset is None else f"{offset:.6f}",
                    clock(event.at_utc),
                )
            )
    blocks: list[Block] = [Table(columns, tuple(rows), small=True)]
    captures = [view for view in run.summary().captures() if isinstance(view, ViewpointCaptured)]
    if captures:
        offsets = np.array([capture.clock_offset_s for capture in captures])
        sigma_m = max(capture.pose_sigma_m for capture in captures)
        text = (
            f"Over {len(captures)} captures the robot's clock stayed within {1e3 * float(np.ptp(offsets)):.1f} ms of "
            f"its distance from the host's monotonic clock; the flange stood still within {1e6 * sigma_m:.2f} µm "
            "(1σ) during every exposure."
        )
        blocks.append(Paragraph(text + _environment(captures)))
    return Section("Devices and clocks", tuple(blocks))


def _environment(captures: list[ViewpointCaptured]) -> str:
    parts: list[str] = []
    for key, name, unit, digits in (("light_lux", "light", "lx", 0), ("temperature_c", "temperature", "°C", 1)):
        values = [capture.environment[key] for capture in captures if key in capture.environment]
        if values:
            parts.append(f"{name} {min(values):.{digits}f} to {max(values):.{digits}f} {unit}")
    return f" Meanwhile: {', '.join(parts)}." if parts else ""


def pictures_section(run: RecordedRun, *, with_scene: bool) -> Section:
    """Overlays of the evaluation, the scene in 3D, then a contact sheet of every capture that counts."""
    blocks: list[Block] = []
    overlays = run.summary().artefacts("overlay")
    if overlays:
        blocks += [
            Heading("Detected and predicted outlines"),
            Paragraph(
                "Green: registration spheres. Blue: control spheres, which took no part in the registration. Yellow, "
                "dashed: predicted by the registration."
            ),
            Pictures(tuple(picture(run, ref.sha256, ref.original_name, LARGE_PX) for ref in overlays), 2),
        ]
    scene = _scene(run.summary()) if with_scene else None
    if scene is not None:
        blocks += [Heading("Cameras and mesh in one frame"), scene]
    for step in run.protocol.steps:
        seqs = sorted(run.state.steps[step.id].captured.values())
        captures = [run.events[seq - 1].payload for seq in seqs]
        sheet = tuple(
            picture(run, capture.artefacts[0].sha256, _caption(capture), THUMBNAIL_PX)
            for capture in captures
            if isinstance(capture, View)
        )
        if sheet:
            blocks += [Heading(f"Contact sheet: {step.title}"), Pictures(sheet, 5)]
    return Section("Pictures", tuple(blocks) or (Paragraph("No photograph was taken."),))


def _caption(capture: View) -> str:
    failed = [name for name, passed in capture.verdicts.items() if not passed]
    return capture.viewpoint + (f" ✗ {', '.join(failed)}" if failed else "")


def _scene(summary: RunSummary) -> Scene | None:
    """Cameras, spheres and mesh in one frame; None where there is no registration."""
    # plotly and the decimation are only for this: the PDF need not wait for them.
    from service.dataset import scene_view  # noqa: PLC0415

    best, registrations = summary.best(), summary.registrations()
    spheres = summary.result("scan_import").get("spheres_m")
    if best is None or best not in registrations or spheres is None or not summary.artefacts("scan_mesh"):
        return None
    try:
        summary.store.artefact_path(summary.artefacts("scan_mesh")[-1].sha256, verify=True)
    except IntegrityError:
        return None  # the first page says which file it is
    registered = registrations[best]
    points_m, triangles = scene_view.decimated(*summary.scan_mesh())
    placed = Alignment(np.array(registered["T_world_scan"]), np.array(registered["covariance"])[:6, :6])
    error_mm = 1e3 * np.sqrt(np.trace(placed.covariance_at_m2(points_m), axis1=1, axis2=2))
    cameras = {name: np.array(T) for name, T in registered["T_scan_camera"].items()}
    scene = scene_view.Scene(
        cameras=cameras,
        stations={c.viewpoint: c.station for c in summary.captures() if c.viewpoint in cameras},
        spheres=[scene_view.SceneSphere(str(i), "registration", centre) for i, centre in enumerate(spheres)],
        radius_m=summary.protocol.spheres.radius_mm / 1000,
        mesh=scene_view.SceneMesh(points_m, triangles, error_mm),
    )
    text = f"{len(cameras)} cameras, {len(spheres)} spheres and the scan's mesh, coloured by the predicted error."
    return Scene(scene_view.scene_html(scene), text)


def software_section(run: RecordedRun) -> Section:
    """What computed, for how long, and every version installed."""
    sessions = [event.payload for event in run.events if isinstance(event.payload, SessionStarted)]
    software = sessions[-1].software if sessions else run.root.software
    first = ", ".join(f"{name} {software[name]}" for name in _COMPUTES if name in software)
    differing = [s for s in sessions if s.software != run.root.software]
    blocks: list[Block] = [Paragraph(f"Computed with {first}.")]
    if differing:
        blocks.append(
            Paragraph(f"{len(differing)} of {len(sessions)} sessions ran with other versions.", "attention")
        )
    jobs: dict[str, tuple[int, float]] = {}
    for event in run.events:
        if isinstance(event.payload, JobFinished):
            count, seconds = jobs.get(event.payload.job_kind, (0, 0.0))
            jobs[event.payload.job_kind] = count + 1, seconds + event.payload.duration_s
    if jobs:
        columns = (Column("computed", 2.0), Column("times", 1.0, "number"), Column("seconds together", 1.0, "number"))
        rows = tuple((term(kind), str(n), f"{seconds:.1f}") for kind, (n, seconds) in jobs.items())
        blocks.append(Table(columns, rows))
    names = sorted(software, key=str.lower)
    texts = [f"{name} {software[name]}" for name in names]
    texts += [""] * (-len(texts) % 3)
    third = len(texts) // 3
    rows = tuple(zip(texts[:third], texts[third : 2 * third], texts[2 * third :], strict=True))
    blocks += [
        Heading("Every installed distribution"),
        Table((Column(""), Column(""), Column("")), rows, small=True),
    ]
    return Section("Software", tuple(blocks))
