"""Checks whether the slices of a series form a uniform volume, and arranges them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from pydicom.uid import UID

from drivers.dicom_folder.codecs import lacking_decoder
from drivers.dicom_folder.consistency import UNSPECIFIED, differences
from drivers.dicom_folder.headers import SliceHeader
from drivers.interfaces import Array, Transform
from service.core.units import metres

_LARGEST_PIXELS = 8192 * 8192  # per image; a CT slice has at most a sixteenth of it
_ORIENTATION_TOLERANCE = 1e-3
# Positions are decimal strings of a few digits; a missing slice doubles the step.
_SPACING_TOLERANCE = 0.02
_POSITION_TOLERANCE_MM = 0.01
_MAX_NAMED = 5


def problems_of(
    headers: Sequence[SliceHeader], first_number: int, *, unspecified_is_hounsfield: bool = False
) -> tuple[str, ...]:
    """Why these slices do not form a uniform CT volume, one text per problem; empty if they do.

    Args:
        headers: the slices' headers.
        first_number: the number of the first slice of a whole series.
        unspecified_is_hounsfield: values whose unit the files state as unspecified are Hounsfield units.
    """
    if all(header.rows == 0 or header.columns == 0 for header in headers):
        return (f"it holds no images (modality {headers[0].modality})",)
    problems: list[str] = []
    for text, bad in (
        ("localiser images", [h for h in headers if "LOCALIZER" in h.image_type]),
        ("files that hold no image, perhaps cut short", [h for h in headers if h.rows * h.columns == 0]),
        ("files that are cut short", [h for h in headers if h.cut_short]),
        (
            "multi-frame images that do not describe each frame (not enhanced CT)",
            [h for h in headers if h.frames > 1],
        ),
        (
            f"images of more than {_LARGEST_PIXELS:,} pixels",
            [h for h in headers if h.rows * h.columns > _LARGEST_PIXELS],
        ),
        ("colour images", [h for h in headers if h.samples > 1]),
        ("images that are not CT", [h for h in headers if h.modality != "CT"]),
        *(
            (_other_unit(unit), same)
            for unit in sorted(
                {h.value_unit for h in headers} - {"", UNSPECIFIED if unspecified_is_hounsfield else ""}
            )
            if (same := [h for h in headers if h.value_unit == unit])
        ),
        ("no rescale slope and intercept, so no Hounsfield units, in", [h for h in headers if h.rescale is None]),
        ("no position, orientation or pixel spacing in", [h for h in headers if not _has_place(h)]),
    ):
        if bad:
            problems.append(f"{text}: {_named(bad)}")
    problems += [
        f"images compressed as {UID(syntax).name}, for which no decoder is installed ({remedy}): "
        + _named([h for h in headers if h.transfer_syntax == syntax])
        for syntax in sorted({h.transfer_syntax for h in headers})
        if (remedy := lacking_decoder(syntax)) is not None
    ]
    problems += _count_problems(headers, first_number)
    images = [header for header in headers if header.rows * header.columns > 0]
    bodies = [header for header in images if "LOCALIZER" not in header.image_type]
    problems += differences([(header.file_name, _common_values(header)) for header in bodies])
    placed = [header for header in images if _has_place(header) and "LOCALIZER" not in header.image_type]
    if placed:
        problems += _shape_problems(placed) or _position_problems(placed)
    return tuple(problems)


def _other_unit(unit: str) -> str:
    if unit == UNSPECIFIED:
        remedy = "if they are Hounsfield units, set unspecified_is_hounsfield: true for this device in rig.yaml"
    else:
        remedy = "use a series of the attenuation"
    return f"values that are not said to be Hounsfield units ({unit}; {remedy}) in"


def _common_values(header: SliceHeader) -> dict[str, str]:
    # Further image types are a manufacturer's own words.
    kinds = {"image type": "\\".join(header.image_type[:3]), "unit of the values": header.value_unit or "HU"}
    return {**header.common, **kinds}


def _count_problems(headers: Sequence[SliceHeader], first_number: int) -> list[str]:
    """Return whether slices are missing, by what the files state; for most series only that the first ones are."""
    problems: list[str] = []
    stated = max((header.stated_instances or 0 for header in headers), default=0)
    found = len({header.instance_uid for header in headers})
    if found < stated:
        problems.append(f"incomplete: {found} of the {stated} files that the series states")
    numbers = [header.number for header in headers if header.number is not None]
    first, last = min(numbers, default=first_number), max(numbers, default=first_number)
    if first > first_number and len(headers) > 1 and sorted(numbers) == list(range(first, first + len(headers))):
        problems.append(
            f"incomplete: its slices are numbered {first} to {last}, not from {first_number}; if there never were "
            f"others, set first_number: {first} for this device in rig.yaml"
        )
    parts = {header.part for header in headers if header.part is not None}
    for uid in sorted({part.concatenation_uid for part in parts}):
        own = [part for part in parts if part.concatenation_uid == uid]
        here = {part.number for part in own}
        total = max(max(part.number, part.total or 0) for part in own)
        if len(here) < total:
            problems.append(
                f"incomplete: {len(here)} of the {total} files of which it consists (concatenation {uid})"
            )
    return problems


def acquired_images(headers: Sequence[SliceHeader]) -> int | None:
    """How many images the series' acquisitions have, as the files state; None unless all of them do.

    An acquisition may be reconstructed into several series, so a series with fewer is not incomplete for that.
    """
    stated: dict[int, int] = {}
    for header in headers:
        if header.acquisition is None:
            return None
        number, images = header.acquisition
        stated[number] = max(images, stated.get(number, 0))
    return sum(stated.values())


def _has_place(header: SliceHeader) -> bool:
    return None not in (header.position_mm, header.orientation, header.pixel_spacing_mm)


def _named(headers: Sequence[SliceHeader]) -> str:
    names = ", ".join(header.name for header in headers[:_MAX_NAMED])
    return names + (f" and {len(headers) - _MAX_NAMED} more" if len(headers) > _MAX_NAMED else "")


def _shape_problems(headers: Sequence[SliceHeader]) -> list[str]:
    problems: list[str] = []
    for what, keys in (
        ("image size", [(h.rows, h.columns) for h in headers]),
        ("pixel spacing", [tuple(round(x, 4) for x in h.pixel_spacing_mm or ()) for h in headers]),
        ("orientation", [tuple(round(x / 2e-3) for x in h.orientation or ()) for h in headers]),
    ):
        usual = Counter(keys).most_common(1)[0][0]
        slack = 1 if what == "orientation" else 0  # rounded to 0.002, so adjacent values count as equal
        other = [
            header
            for header, key in zip(headers, keys, strict=True)
            if max(abs(a - b) for a, b in zip(key, usual, strict=True)) > slack
        ]
        if other:
            problems.append(f"mixed {what}: {_named(other)}")
    if any(min(header.pixel_spacing_mm or (0.0,)) <= 0 for header in headers):
        problems.append("pixel spacing that is not positive")
    for header in headers:
        row, column = np.array(header.orientation).reshape(2, 3)
        lengths = np.linalg.norm([row, column], axis=1)
        if np.max(np.abs(lengths - 1)) > _ORIENTATION_TOLERANCE or abs(row @ column) > _ORIENTATION_TOLERANCE:
            problems.append(f"row and column directions that are not perpendicular unit vectors: {header.name}")
            break
    return problems


def _position_problems(headers: Sequence[SliceHeader]) -> list[str]:
    if len(headers) < 2:
        return ["only one slice: there is no spacing"]
    ordered, along = _along_normal(headers)
    steps = np.diff(along)
    distinct = steps[steps > _POSITION_TOLERANCE_MM]
    if len(distinct) == 0:
        return [f"all slices at the same position: {_named(ordered)}"]
    # The median step, not the mean, which gaps would change. With only two steps the smaller one is the spacing.
    spacing = float(np.median(distinct)) if len(distinct) > 2 else float(distinct.min())
    problems: list[str] = []
    for step, before, after, at in zip(steps, ordered[:-1], ordered[1:], along[:-1], strict=True):
        span = f"between {before.name} at {at:.3f} mm and {after.name} at {at + step:.3f} mm"
        if step <= _POSITION_TOLERANCE_MM:
            problems.append(f"duplicate slice: {before.name} and {after.name}, both at {at:.3f} mm")
        elif step > 1.5 * spacing:
            problems.append(f"gap: {round(step / spacing) - 1} slices of {spacing:.3f} mm missing {span}")
        elif abs(step - spacing) > max(_SPACING_TOLERANCE * spacing, _POSITION_TOLERANCE_MM):
            problems.append(f"uneven spacing: {step:.3f} mm instead of {spacing:.3f} mm {span}")
    if problems:
        return problems
    position = np.array([header.position_mm for header in ordered])
    straight = position[0] + np.linspace(0.0, 1.0, len(ordered))[:, None] * (position[-1] - position[0])
    off = np.linalg.norm(position - straight, axis=1)
    if off.max() > max(_SPACING_TOLERANCE * spacing, _POSITION_TOLERANCE_MM) * 2:
        worst = ordered[int(off.argmax())]
        return [f"slices do not lie on a line: {worst.name} is off by {off.max():.3f} mm"]
    return []


def _along_normal(headers: Sequence[SliceHeader]) -> tuple[list[SliceHeader], Array]:
    """The slices sorted along the slice normal (cross product of row and column), and their positions on it in mm."""
    row, column = np.array(headers[0].orientation).reshape(2, 3)
    along = np.array([header.position_mm for header in headers]) @ np.cross(row, column)
    order = np.argsort(along, kind="stable")
    return [headers[index] for index in order], along[order]


def arrange(headers: Sequence[SliceHeader]) -> tuple[list[SliceHeader], Transform, tuple[float, float, float]]:
    """Return the slices in order of k, T_ct_voxel (4, 4) and the spacing (i, j, k) in metres.

    The series must have no problems. The step along k is taken from the slice positions, so T_ct_voxel includes the
    shear of a tilted gantry.
    """
    ordered, _ = _along_normal(headers)
    orientation = ordered[0].orientation or ()
    row_spacing, column_spacing = ordered[0].pixel_spacing_mm or (0.0, 0.0)
    first, last = (np.array(header.position_mm, dtype=np.float64) for header in (ordered[0], ordered[-1]))
    T = np.eye(4)
    T[:3, 0] = np.array(orientation[:3]) * column_spacing
    T[:3, 1] = np.array(orientation[3:]) * row_spacing
    T[:3, 2] = (last - first) / (len(ordered) - 1)
    T[:3, 3] = first
    T[:3] = metres(T[:3])
    i, j, k = np.linalg.norm(T[:3, :3], axis=0)
    return ordered, T, (float(i), float(j), float(k))
