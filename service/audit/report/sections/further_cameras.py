"""The further cameras of a run: calibration, pose with sigma, clock, and what was left out."""

from __future__ import annotations

from service.audit.record.run import RecordedRun
from service.audit.report.blocks import Block, Column, DescriptionList, Heading, Paragraph, Section, Table, TableCell
from service.core.text.words import counted
from service.dataset.further_cameras import KnownFurtherCamera, known_further_cameras

_INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


def further_cameras_section(run: RecordedRun) -> Section | None:
    """A table of all, then the numbers of each; None for a run with one camera."""
    cameras = known_further_cameras(run.protocol, run.state, run.summary().captures())
    if not cameras:
        return None
    text = (
        "They exposed after the first camera at the viewpoints of the data set. Each is calibrated by itself, and "
        "located by the spheres in its images."
    )
    blocks: list[Block] = [Paragraph(text), _table(cameras)]
    for camera in cameras:
        blocks += [Heading(camera.name), _facts(camera)]
        if camera.located is not None and camera.located.T_outer_camera is not None:
            rows = tuple(tuple(f"{value:.6f}" for value in row) for row in camera.located.T_outer_camera)
            name = "T_scan_camera" if camera.mounted == "fixed" else "T_first_camera"
            empty = (Column("", 1.0, "number"),) * 3
            blocks.append(Table((Column(f"{name}, m", 1.0, "number"), *empty), rows, small=True))
    return Section("Further cameras", tuple(blocks))


def _table(cameras: tuple[KnownFurtherCamera, ...]) -> Table:
    columns = (
        Column("camera", 0.9),
        Column("place", 1.4),
        Column("images", 0.7, "number"),
        Column("in the frame of", 1.2),
        Column("σ position, mm", 0.9, "number"),
        Column("σ rotation, mrad", 1.0, "number"),
        Column("its clock is ahead by", 1.6, "number"),
    )
    return Table(columns, tuple(_row(camera) for camera in cameras))


def _row(camera: KnownFurtherCamera) -> tuple[TableCell | str, ...]:
    place = "in the room" if camera.mounted == "fixed" else "beside the first camera"
    clock = "not known" if camera.clock is None else f"{camera.clock.offset_s:+.3f} ± {camera.clock.sigma_s:.3f} s"
    if camera.sigma_mm is None or camera.sigma_mrad is None:
        why = "not registered" if camera.located is None else f"NOT LOCATED: {camera.located.why}"
        tone = "attention" if camera.located is None else "stop"
        return camera.name, place, str(len(camera.images)), TableCell(why, tone), "–", "–", clock
    sigmas = f"{camera.sigma_mm:.3f}", f"{camera.sigma_mrad:.3f}"
    return camera.name, place, str(len(camera.images)), camera.outer, *sigmas, clock


def _facts(camera: KnownFurtherCamera) -> DescriptionList:
    optics, located = camera.optics, camera.located
    body = ", ".join(filter(None, (optics.model, optics.lens, f"body {optics.body_serial}")))
    rows: list[tuple[str, TableCell | str]] = [
        ("Camera and lens", body),
        ("Calibration (SHA-256 of its file)", camera.calibration.sha256),
    ]
    if located is not None:
        parameters = ", ".join(f"{name} {float(getattr(located.camera, name)):.6g}" for name in _INTRINSICS)
        rows.append(("Intrinsics", f"{located.camera.width} × {located.camera.height} px; {parameters}"))
        rows.append(("Outlines measured in", "raw files" if located.measured_on == "raw" else "JPEGs"))
        if located.consistency_mm is not None and located.consistency_mrad is not None:
            agree = f"{located.consistency_mm:.3f} mm and {located.consistency_mrad:.3f} mrad rms"
            rows.append(("Its images agree within", agree))
        if located.excluded:
            left_out = "; ".join(f"{view}: {why}" for view, why in located.excluded.items())
            rows.append(("Images left out", TableCell(left_out, "attention")))
    if camera.clock is not None:
        unlike = "; two models, whose delays differ" if camera.clock.unlike else ""
        rows.append(("Clocks compared by", counted(camera.clock.photographs, "pair") + " of photographs" + unlike))
    return DescriptionList(tuple(rows))
