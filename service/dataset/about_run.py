"""Reads what the record of a run says about its data set, for its card and for dataset.json."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from service.core.gates import BOUNDS_HOLD, accepted_gates, describe, standing
from service.core.recorded_devices import bodies, recorded_report
from service.core.records.data_set import FIRST_VERSION, DataSetStatement
from service.core.records.import_list import imported_sentence
from service.core.records.run_events import DeviceOpened
from service.core.units import mm
from service.dataset.records import About, UsedDevice
from service.dataset.registrations import late_results, shared_adjustment_note
from service.dataset.summary import RunSummary, recorded_fusion

_UNNAMED = "a person who is not named here"


def about_run(
    summary: RunSummary,
    own: str,
    not_in_yet: Sequence[str] = (),
    *,
    stated: DataSetStatement | None = None,
    version: str = FIRST_VERSION,
    personal: bool = True,
) -> About:
    """Return what a run's data set says about itself.

    Args:
        summary: the run.
        own: the name of its registration.
        not_in_yet: texts on results that have not arrived yet.
        stated: the statement that replaces the protocol's.
        version: the data set's version.
        personal: False leaves people and serial numbers out.
    """
    root, entered = summary.root, summary.root.about
    return About(
        stated=(stated or DataSetStatement()).or_else(summary.protocol.data_set),
        version=version,
        run=summary.run_id,
        protocol=f"{root.protocol_id} {root.protocol_version}, SHA-256 {root.protocol_sha256}",
        protocol_title=summary.protocol.title,
        source=summary.protocol.source,
        specimen="" if entered is None else entered.specimen,
        purpose="" if entered is None else entered.purpose,
        site="" if entered is None else entered.site,
        origin=origin_sentence(summary, personal=personal),
        published_utc=summary.events[-1].at_utc,
        head_sha256=summary.events[-1].sha256,
        software=root.software.get("orthocapture", "unknown"),
        people=tuple(sorted(filter(None, {*summary.state.people, root.operator}))) if personal else (),
        devices=_devices(summary, personal=personal),
        settings=_settings(summary),
        accuracy=next((row for row in summary.table() if row.poses == own), None),
        budget=summary.budgets().get(own),
        fusion=_fusion(summary, personal=personal),
        gates=tuple(gates_in_words(summary).items()),
        accepted=tuple(gate.text for gate in accepted_gates(summary.protocol, summary.state)),
        deviations=tuple(d.text for d in summary.state.deviations),
        later=tuple(late.text for late in late_results(summary.protocol, summary.state)),
        not_in_yet=tuple(not_in_yet),
    )


def gates_in_words(summary: RunSummary) -> dict[str, tuple[str, ...]]:
    """Return each judged step's gates as text, with their verdicts."""
    steps = {step.id: summary.state.steps[step.id] for step in summary.protocol.steps}
    return {
        name: tuple(
            f"{describe(v)}: {standing(v, accepted=state.accepted is not None).replace('_', ' ')}"
            for v in state.verdicts
        )
        for name, state in steps.items()
        if state.verdicts
    }


def origin_sentence(summary: RunSummary, *, personal: bool = True) -> str:
    """Return how the photographs came into the run."""
    if summary.root.origin != "imported":
        return "The photographs were captured in this run"
    by = summary.root.operator if personal else _UNNAMED
    return imported_sentence(summary.events[0].at_utc, by)


def _fusion(summary: RunSummary, *, personal: bool) -> tuple[tuple[str, str], ...]:
    """Return how CT and scan agree, and what of the mesh comes from where."""
    fusion = recorded_fusion(summary)
    if fusion is None:
        return ()
    m, loop = fusion.measures, fusion.measures.get("loop_closure_mm")
    drawn = [
        f"{'CT' if region.source == 'ct' else 'scan'} by "
        + (region.by if personal or region.by.startswith("protocol ") else _UNNAMED)
        for region in fusion.answer.regions
    ]
    return (
        (
            "Chamfer distance of CT and scan",
            f"{m['chamfer_ct_scan_mm']:.3f} mm (CT to scan {m['ct_to_scan_mm']:.3f} mm, scan to CT "
            f"{m['scan_to_ct_mm']:.3f} mm; medians {m['ct_to_scan_median_mm']:.3f} mm and "
            f"{m['scan_to_ct_median_mm']:.3f} mm), sampled every {mm(fusion.spacing_m):g} mm; equal surfaces would "
            f"give {m['chamfer_floor_mm']:.3f} mm",
        ),
        (
            "Distances of the spheres over the transport",
            f"changed by up to {m['sphere_distance_change_max_mm']:.3f} mm",
        ),
        ("Loop from scan to CT by spheres and back by cameras", "no images" if loop is None else f"{loop:.3f} mm"),
        (
            "Vertices",
            f"{100 * m['ct_share']:.1f} % of the CT, {100 * m['scan_share']:.1f} % of the scan, "
            f"{100 * m['blend_share']:.1f} % blended; median stated sigma {m['sigma_median_mm']:.3f} mm",
        ),
        ("Wound", f"proposed, then corrected: {'; '.join(drawn)}" if drawn else "as proposed"),
    )


def _devices(summary: RunSummary, *, personal: bool) -> tuple[UsedDevice, ...]:
    """Return every device as it first identified itself in the run."""
    known = bodies(summary.events)
    found: dict[str, UsedDevice] = {}
    for event in summary.events:
        if isinstance(event.payload, DeviceOpened):
            identity = recorded_report(event.payload.report).identity
            serial = known.shown(identity) if personal else ""
            device = UsedDevice(event.payload.device, identity.model, serial, identity.firmware)
            found.setdefault(event.payload.device, device)
    return tuple(found.values())


def _settings(summary: RunSummary) -> tuple[tuple[str, str], ...]:
    """Return the camera settings of the protocol, the lens as the photographs state it, and the spheres."""
    camera, spheres = summary.protocol.camera, summary.protocol.spheres
    optics = [view.optics for view in summary.captures()]
    lenses = dict.fromkeys(one.lens for one in optics if one.lens)
    lengths = dict.fromkeys(f"{one.focal_length_mm:g} mm" for one in optics if one.focal_length_mm)
    found = [("lens", ", ".join(lenses)), ("focal length", ", ".join(lengths))]
    if camera is not None:
        found += [
            ("aperture", f"f/{camera.aperture_f:g}"),
            ("exposure", f"{camera.exposure_s:.4g} s"),
            ("sensitivity", f"ISO {camera.iso}"),
            ("focus", camera.focus_mode),
            ("files", camera.image_quality),
        ]
    found.append(
        (
            "spheres",
            f"{spheres.registration} for registration and {spheres.control} for control, "
            f"radius {spheres.radius_mm:g} mm",
        )
    )
    return tuple((name, value) for name, value in found if value)


def described_run(
    summary: RunSummary, own: str, not_in_yet: Sequence[str], *, personal: bool = True
) -> dict[str, Any]:
    """Return what `dataset.json` says of the run as plain data; `own` is the name of its registration."""
    later = summary.better_later()
    return {
        "run": summary.run_id,
        "simulated": summary.root.simulated,
        "origin": summary.root.origin,
        "origin_in_words": origin_sentence(summary, personal=personal),
        "protocol": f"{summary.root.protocol_id} {summary.root.protocol_version}",
        "protocol_sha256": summary.root.protocol_sha256,
        "frame": "scan",
        "unit": "m",
        "pose_source": own,
        "evaluation": [row.plain() for row in summary.table()],
        "gates": gates_in_words(summary),
        "gates_explained": BOUNDS_HOLD,
        "accepted_gates": [gate.text for gate in accepted_gates(summary.protocol, summary.state)],
        "evaluation_note": shared_adjustment_note(summary.protocol, summary.state),
        "arrived_later": [late.text for late in late_results(summary.protocol, summary.state)],
        "arrived_later_and_better": None if later is None else later.poses,
        "not_in_yet": list(not_in_yet),
        "deviations": [d.text for d in summary.state.deviations],
        "head_of_chain_sha256": summary.events[-1].sha256,
    }
