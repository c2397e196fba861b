"""What the steps of each kind measure: names, units, and the limits that a protocol may sensibly set on them.

A gate on a number that no step of its kind measures fails when the step is done, hours into a run; a limit in another
unit passes everything. `orthocapture protocol check` holds a protocol's gates against this table.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from service.core.protocol.models import Gate, LoadedProtocol, Step
from service.core.text.yaml_tree import FieldPath, Plain, Problem, field_name, parse_yaml
from service.rig import RigSection
from service.steps.sources import Wanted


@dataclass(frozen=True, slots=True)
class Measure:
    """A number of a step: its unit, and between what a limit on it makes sense."""

    unit: str
    least: float = 0.0
    most: float = float("inf")


_COUNT, _SHARE = Measure("", 0, 1e6), Measure("", 0, 1)
_MM, _FINE_MM = Measure("mm", 1e-4, 1000), Measure("mm", 1e-4, 50)
_PX, _DEG = Measure("px", 1e-3, 50), Measure("°", 0, 360)

_LAYOUT = {
    "layout_margin_mm": _FINE_MM, "layout_margin_of_five_mm": _FINE_MM, "layout_margin_sigma_mm": _FINE_MM,
    "layout_depth_mm": _MM, "layout_gap_deg": _DEG, "layout_problems": _COUNT,
}  # fmt: skip
_SPHERES = {
    "spheres_found": _COUNT, "radius_residual_max_mm": Measure("mm", 1e-3, 5),
    "sphere_rms_max_mm": Measure("mm", 1e-3, 5), "sphere_sigma_max_mm": Measure("mm", 1e-4, 5),
    "sphere_change_max_mm": Measure("mm", 1e-3, 20), "sphere_change_rms_mm": Measure("mm", 1e-3, 20), **_LAYOUT,
}  # fmt: skip
_CAPTURE = {
    "viewpoints_planned": _COUNT, "viewpoints_captured": _COUNT, "viewpoints_given_up": _COUNT,
    "settings_departures": _COUNT, "moved_during_exposure": _COUNT, "optics_departures": _COUNT,
}  # fmt: skip
_PREDICTED = {"predicted_target_error_mm": Measure("mm", 1e-3, 20), "specimen_coverage": _SHARE}
_CALIBRATION = {
    **_CAPTURE,
    "views": _COUNT, "views_without_board": _COUNT, "views_partial": _COUNT, "views_excluded": _COUNT,
    "boards_unseen": _COUNT, "rms_px": _PX, "five_fold_rms_px": _PX, "leave_one_out_rms_px": _PX,
    "corner_sigma_px": _PX, "coverage": _SHARE, "tilt_deg": Measure("°", 0, 90),
    "uncertainty_px": _PX, "uncertainty_mm": Measure("mm", 1e-4, 10),
    "uncertainty_centre_mm": Measure("mm", 1e-4, 10),
    "hand_eye_sigma_mm": Measure("mm", 1e-4, 20), "hand_eye_sigma_deg": Measure("°", 1e-5, 10),
    "hand_eye_held_out_mm": Measure("mm", 1e-3, 50), "hand_eye_held_out_deg": Measure("°", 1e-4, 10),
    "hand_eye_uncorrected_held_out_mm": Measure("mm", 1e-3, 50), "hand_eye_arm_corrected": _SHARE,
    "hand_eye_excluded": _COUNT, "hand_eye_methods_spread_mm": _MM, "hand_eye_condition": Measure("", 1, 1e6),
    "rotation_spread_deg": Measure("°", 0, 180), "robot_noise_mm": Measure("mm", 1e-4, 50),
    "robot_noise_deg": Measure("°", 1e-5, 10),
}  # fmt: skip
_SCAN = {
    f"scan_{name}": _COUNT
    for name in (
        "vertices", "faces", "holes", "boundary_edges", "non_manifold_edges", "components", "degenerate_faces",
        "unreferenced_vertices", "normals_computed",
    )
}  # fmt: skip
_REGISTERED = {
    "rms_px": _PX, "chi2_reduced": Measure("", 0, 1e4), "markers": _COUNT, "images": _COUNT, "missing": _COUNT,
    "excluded_outlines": _COUNT, "predicted_error_mm": Measure("mm", 1e-3, 20), "reprojection_px": _PX,
    "leave_one_out_mm": Measure("mm", 1e-3, 20),
}  # fmt: skip
_EVALUATED = {"mean_radial_error_mm": Measure("mm", 1e-3, 20), "mean_reprojection_error_px": _PX}

_OF_KIND: Mapping[str, Mapping[str, Measure]] = {
    "checklist": {"checklist_items_open": _COUNT, "checklist_items_ticked": _COUNT},
    "timed_application": {"applications": _COUNT},
    "calibration": _CALIBRATION,
    "viewpoint_capture": {**_CAPTURE, **_PREDICTED, "images_spoilt": _COUNT},
    "manual_capture": {
        **_PREDICTED, "images_taken": _COUNT, "images_used": _COUNT, "images_not_used": _COUNT, "coverage": _SHARE,
        "hemisphere_coverage": _SHARE, "settings_departures": _COUNT, "optics_departures": _COUNT,
        "spheres_sigma_mm": Measure("mm", 1e-3, 20), "images_spoilt": _COUNT,
    },
    "image_import": {
        "images_imported": _COUNT, "raw_files": _COUNT, "settings_departures": _COUNT, "settings_not_stated": _COUNT,
        "optics_departures": _COUNT,
    },
    "ct_import": {
        **_SPHERES, "slices": _COUNT, "slice_spacing_mm": Measure("mm", 0.01, 10),
        "voxel_mm": Measure("mm", 0.01, 10),
        "vertices": _COUNT, "faces": _COUNT,
    },
    "scan_import": {**_SPHERES, **_SCAN, "faces": _COUNT, "since_application_min": Measure("min", 0.1, 1e4)},
    "layout_check": {**_LAYOUT, "spheres_seen": _COUNT, "photographs_used": _COUNT},
    "evaluation": {
        "best_mean_radial_error_mm": Measure("mm", 1e-3, 20), "best_predicted_error_mm": Measure("mm", 1e-3, 20),
        "control_normalised_chi2": Measure("", 0, 1e4), "control_spheres": _COUNT,
    },
    "registration": {"outlines": _COUNT, "outlines_an_image": _COUNT, "images_searched_whole": _COUNT},
}  # fmt: skip

# Sections of the file: field → between what it is plausible, in the field's unit.
_SECTIONS: Mapping[tuple[str, str], tuple[float, float, str]] = {
    ("spheres", "radius_mm"): (1.0, 100.0, "mm"),
    ("board", "square_mm"): (0.5, 1000.0, "mm"),
    ("camera", "aperture_f"): (0.7, 64.0, ""),
    ("camera", "iso"): (25.0, 409600.0, ""),
}
_ALIAS = {"deg": "°", "1": "", "degrees": "°"}


def measures_of(step: Step, protocol_steps: Mapping[str, Step]) -> Mapping[str, Measure] | None:
    """All that a step of this kind and with these parameters measures; None for a kind that nobody described."""
    known = _OF_KIND.get(step.kind)
    if known is None or step.kind not in ("registration", "evaluation"):
        return known
    params = step.params.model_dump()
    source = step if step.kind == "registration" else protocol_steps.get(str(params.get("registration")))
    if source is None:
        return None
    names = Wanted.of(source.params).registrations
    suffixes = _REGISTERED if step.kind == "registration" else _EVALUATED
    return {**known, **{f"{name}_{suffix}": m for name in names for suffix, m in suffixes.items()}}


def implausible(loaded: LoadedProtocol, rig: RigSection | None = None) -> tuple[Problem, ...]:
    """What cannot be meant of measures, units, limits and, with the rig, stations; in the order of the lines."""
    tree = parse_yaml(loaded.source, name="the protocol")
    found: list[tuple[FieldPath, str]] = []
    data = tree.data if isinstance(tree.data, dict) else {}
    for (section, field), (least, most, unit) in _SECTIONS.items():
        part = data.get(section)
        value = part.get(field) if isinstance(part, dict) else None
        if isinstance(value, int | float) and not least <= value <= most:
            found.append(
                ((section, field), f"{value:g} {unit} is not credible: {least:g} to {most:g} {unit}".strip())
            )
    steps = {step.id: step for step in loaded.protocol.steps}
    for index, step in enumerate(loaded.protocol.steps):
        known = measures_of(step, steps)
        for number, gate in enumerate(step.gates) if known is not None else ():
            assert known is not None
            found += [(("steps", index, "gates", number, *at), words) for at, words in _gate(gate, step, known)]
    if rig is not None:
        found += list(_stations(data, rig))
    problems = [Problem(tree.line(at), field_name(at), words) for at, words in found]
    return tuple(sorted(problems, key=lambda p: (p.line, p.field)))


def _gate(gate: Gate, step: Step, known: Mapping[str, Measure]) -> Iterator[tuple[FieldPath, str]]:
    measure = known.get(gate.measure)
    if measure is None:
        near = difflib.get_close_matches(gate.measure, known, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else f"; it measures {', '.join(sorted(known))}"
        yield ("measure",), f"a step of kind {step.kind} measures no {gate.measure!r}{hint}"
        return
    unit = _ALIAS.get(gate.unit, gate.unit)
    if measure.unit and unit != measure.unit:
        yield ("unit",), f"{gate.measure} is in {measure.unit}, not in {gate.unit or 'nothing'}"
    for name, limit in (("min", gate.min), ("max", gate.max)):
        if limit is not None and limit != 0 and not measure.least <= limit <= measure.most:
            between = f"{measure.least:g} to {measure.most:g} {measure.unit}".strip()
            yield (name,), f"a limit of {limit:g} on {gate.measure} is not credible: {between}"


def _stations(data: Mapping[str, Plain], rig: RigSection) -> Iterator[tuple[FieldPath, str]]:
    """Stations that the protocol names and the rig file does not have."""

    def walk(value: Plain, at: FieldPath) -> Iterator[tuple[FieldPath, str]]:
        if isinstance(value, dict):
            for key, inner in value.items():
                if key == "station" and isinstance(inner, str) and inner not in rig.stations:
                    there = ", ".join(rig.stations) or "none"
                    near = difflib.get_close_matches(inner, rig.stations, n=1)
                    hint = f"; did you mean {near[0]!r}?" if near else f"; it has {there}"
                    yield (*at, key), f"the rig has no station {inner!r}{hint}"
                else:
                    yield from walk(inner, (*at, key))
        elif isinstance(value, list):
            for number, inner in enumerate(value):
                yield from walk(inner, (*at, number))

    yield from walk(data.get("steps"), ("steps",))
