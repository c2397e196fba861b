"""Checks what must be equal in all slices of a series, and that their values are Hounsfield units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import cast

from pydicom.dataset import Dataset
from pydicom.multival import MultiValue

# All instances of a series have one modality, one frame of reference, one piece of equipment, one patient and one
# study (DICOM PS3.3, A.1.2, and the modules of the series). Dates and free texts are not compared: they do not change
# what the voxels are, and programs do write them slice by slice. The values depend on kernel and tube voltage too.
UNSPECIFIED = "rescale type US, of no stated unit"
_PATIENT = "patient"


@dataclass(frozen=True, slots=True)
class _Attribute:
    what: str  # in words
    keywords: tuple[str, ...]
    sequence: str = ""  # of functional groups, where a multi-frame file states it


_EQUAL = (
    _Attribute("frame of reference", ("FrameOfReferenceUID",)),
    _Attribute("study", ("StudyInstanceUID",)),
    _Attribute(_PATIENT, ("PatientID", "PatientName", "PatientBirthDate")),
    _Attribute("modality", ("Modality",)),
    _Attribute("series number", ("SeriesNumber",)),
    _Attribute("patient position", ("PatientPosition",)),
    _Attribute("laterality", ("Laterality",)),
    _Attribute("body part", ("BodyPartExamined",)),
    _Attribute("equipment", ("Manufacturer", "ManufacturerModelName", "DeviceSerialNumber")),
    _Attribute("reconstruction kernel", ("ConvolutionKernel",), "CTReconstructionSequence"),
    _Attribute("tube voltage in kV", ("KVP",), "CTXRayDetailsSequence"),
)
_RESCALE_TYPE = _Attribute("", ("RescaleType",), "PixelValueTransformationSequence")
_MOST_VALUES, _MOST_NAMED = 3, 5
_HOUNSFIELD = frozenset({"HU", "HOUNSFIELD", "HOUNSFIELD UNIT", "HOUNSFIELD UNITS"})
# Image types of multi-energy CT whose pixels are no attenuation (PS3.3, C.8.15.2.1.1.1 and C.8.2.1.1.1), in words.
_NO_ATTENUATION = {
    "EFF_ATOMIC_NUM": "effective atomic numbers",
    "ELECTRON_DENSITY": "electron densities",
    "MAT_SPECIFIC": "the share of one material in it",
    "MAT_FRACTIONAL": "the fraction of one material",
    "MAT_VALUE_BASED": "the amount of materials of some values",
}
# Rescale types (PS3.3, C.11.1.1.2), in words.
_UNITS = {
    "Z_EFF": "effective atomic numbers",
    "ED": "electron densities",
    "EDW": "electron densities relative to water",
    "MGML": "mg/ml, as of an iodine map",
    "OD": "optical densities",
    "HU_MOD": "modified Hounsfield units",
    "PCT": "percentages",
}


def common_of(dataset: Dataset, groups: Sequence[Dataset]) -> Mapping[str, str]:
    """Return what a slice states of each thing that must be equal in its series; "" where it states nothing."""
    return {one.what: _text_of(one, dataset, groups) for one in _EQUAL}


def value_unit(dataset: Dataset, groups: Sequence[Dataset], image_type: Sequence[str]) -> str:
    """Return what the rescaled values are, in words; "" for Hounsfield units, which a CT image without a type has.

    UNSPECIFIED for a file that says so, as GDCM makes it of one without a type.
    """
    kind = _text_of(_RESCALE_TYPE, dataset, groups).upper()
    if kind == "US":
        return UNSPECIFIED
    if kind and kind not in _HOUNSFIELD:
        words = _UNITS.get(kind)
        return f"rescale type {kind}" + (f", {words}" if words else "")
    material = next((word for word in image_type if word in _NO_ATTENUATION), None)
    return "" if material is None else f"image type {material}, {_NO_ATTENUATION[material]}"


def differences(slices: Sequence[tuple[str, Mapping[str, str]]]) -> list[str]:
    """Return what must be equal in a series and is not, one text each, with the slices of each value.

    `slices`: the name of each slice, and what it states. A patient's data are compared, but not told.
    """
    problems: list[str] = []
    for what in dict.fromkeys(what for _, stated in slices for what in stated):
        by_value: dict[str, list[str]] = {}
        for name, stated in slices:
            by_value.setdefault(stated.get(what, ""), []).append(name)
        if len(by_value) > 1:
            told = sorted(by_value.items(), key=lambda item: -len(item[1]))
            parts = [
                f"{_value(what, value, number)} in {_slices(names)}" for number, (value, names) in enumerate(told)
            ]
            problems.append(
                f"mixed {what}, which must be the same in a whole series: {'; '.join(parts[:_MOST_VALUES])}"
            )
    return problems


def _value(what: str, value: str, number: int) -> str:
    if not value:
        return "none"
    return f"{what} {number + 1}" if what == _PATIENT else value


def _slices(names: Sequence[str]) -> str:
    more = ", …" if len(names) > _MOST_NAMED else ""
    return f"{len(names)} slice{'s' * (len(names) > 1)} ({', '.join(names[:_MOST_NAMED])}{more})"


def _text_of(attribute: _Attribute, dataset: Dataset, groups: Sequence[Dataset]) -> str:
    places: list[Dataset] = []
    for group in groups:
        inside = group.get(attribute.sequence) if attribute.sequence else None
        places += [item for item in cast("list[object]", inside or ()) if isinstance(item, Dataset)]
        places.append(group)
    places.append(dataset)
    return " ".join(filter(None, (_first(places, keyword) for keyword in attribute.keywords)))


def _first(places: Sequence[Dataset], keyword: str) -> str:
    for place in places:
        value = cast("object", place.get(keyword))
        if value is not None and (text := _text(value)):
            return text
    return ""


def _text(value: object) -> str:
    """A value as text, without the blanks and empty parts of names, which programs write or not."""
    parts = cast("list[object]", value) if isinstance(value, MultiValue | list) else [value]
    texts = (" ".join(str(part).replace("\0", " ").split()).rstrip("^ ") for part in parts)
    return "\\".join(f"{float(text):g}" if isinstance(value, float) else text for text in texts)
