"""Measures: the numbers that steps yield for gates, each declared once with unit, credible limits and meaning."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Generic, Self, TypeVar, get_args

from pydantic import Field, ValidationError
from pydantic.fields import FieldInfo

from service.core.errors import DataError
from service.core.records.base import Record


@dataclass(frozen=True, slots=True)
class Measure:
    """The declaration of a number of a step: its unit, and between what a limit on it is credible."""

    unit: str
    least: float = 0.0
    most: float = float("inf")
    meaning: str = ""  # one sentence, for the page of the step kinds; its name: service/core/measure_names.py


class MeasureRecord(Record):
    """Base of the `Measures` of every step kind: each field is a measure that a gate can judge.

    A field is declared as `rms_px: Annotated[Px, "rms reprojection error"] = None`, with one of the types below or
    with `Annotated[float | None, Measure(…)]`. None means that it was not measured this time; it is not recorded.
    """

    @classmethod
    def declared(cls) -> dict[str, Measure]:
        """Return the declaration of each measure, by name, in the order of the fields."""
        found = {name: _declaration(field) for name, field in cls.model_fields.items()}
        return {name: measure for name, measure in found.items() if measure is not None}

    @classmethod
    def read(cls, values: Mapping[str, float]) -> Self:
        """Return the record of numbers that have the names of measures, such as those of a job.

        Raises:
            DataError: a name is not declared.
        """
        return _validated(cls, dict(values))

    def plain(self) -> dict[str, float]:
        """Return the numbers that were measured, by name, as events and gates have them."""
        values = {name: getattr(self, name) for name in type(self).declared()}
        return {name: float(value) for name, value in values.items() if value is not None}


M = TypeVar("M", bound=MeasureRecord)


class RegistrationMeasures(MeasureRecord, Generic[M]):
    """Base of the `Measures` of a kind that yields the same numbers for each of several registrations.

    In events and gates, the name of the registration stands before the name of the number: `colmap_rms_px`.
    """

    registrations: Mapping[str, M] = Field(default_factory=dict)  # the registrations' measures, by name

    @classmethod
    def of_one(cls) -> type[MeasureRecord]:
        """Return the record of one registration."""
        return get_args(cls.model_fields["registrations"].annotation)[1]

    @classmethod
    def declared_for(cls, registrations: Iterable[str]) -> dict[str, Measure]:
        """Return all declarations, with those of the registrations of these names."""
        one = cls.of_one().declared()
        return cls.declared() | {f"{name}_{number}": one[number] for name in registrations for number in one}

    @classmethod
    def read_all(cls, values: Mapping[str, float], registrations: Iterable[str]) -> Self:
        """Return the record of numbers as they are recorded. Raises DataError where a name is not declared."""
        own = {name: value for name, value in values.items() if name in cls.declared()}
        rest = {name: value for name, value in values.items() if name not in own}
        numbers = cls.of_one().declared()
        each: dict[str, dict[str, float]] = {}
        for name in registrations:
            mine = {number: rest.pop(f"{name}_{number}") for number in numbers if f"{name}_{number}" in rest}
            if mine:
                each[name] = mine
        return _validated(cls, {**own, **rest, "registrations": each})

    def plain(self) -> dict[str, float]:
        """Return the numbers that were measured, by name, with those of every registration."""
        each = {
            f"{name}_{number}": value
            for name, record in self.registrations.items()
            for number, value in record.plain().items()
        }
        return {**MeasureRecord.plain(self), **each}


R = TypeVar("R", bound=MeasureRecord)


def _validated(record: type[R], values: Mapping[str, Any]) -> R:
    try:
        return record.model_validate(values)
    except ValidationError as error:
        names = ", ".join(str(part) for found in error.errors() for part in found["loc"])
        raise DataError(
            f"the step has measured something that its kind does not declare: {names}",
            where=record.__module__,
            remedy="Declare it in the Measures of the step kind",
        ) from error


def _declaration(field: FieldInfo) -> Measure | None:
    measure = next((part for part in field.metadata if isinstance(part, Measure)), None)
    meaning = next((part for part in field.metadata if isinstance(part, str)), "")
    if measure is None or not meaning:
        return measure
    return replace(measure, meaning=meaning)


# --- types of measures, with limits within which a gate is credible ------------------------------------------------

Count = Annotated[float | None, Measure("", 0, 1e6)]
Share = Annotated[float | None, Measure("", 0, 1)]
Ratio = Annotated[float | None, Measure("", 0, 1e4)]
Mm = Annotated[float | None, Measure("mm", 1e-4, 1000)]
FineMm = Annotated[float | None, Measure("mm", 1e-4, 50)]
ErrorMm = Annotated[float | None, Measure("mm", 1e-3, 20)]
Px = Annotated[float | None, Measure("px", 1e-3, 50)]
Deg = Annotated[float | None, Measure("°", 0, 360)]


# --- measures that several kinds share -----------------------------------------------------------------------------


class LayoutMeasures(MeasureRecord):
    """The measures of the layout of the spheres: whether one set of spheres could be mistaken for another."""

    layout_margin_mm: Annotated[
        FineMm, "misfit of the best wrong assignment of four spheres: how far they are from being mistaken"
    ] = None
    layout_margin_of_five_mm: Annotated[FineMm, "misfit of the best wrong assignment of five spheres"] = None
    layout_margin_sigma_mm: Annotated[FineMm, "standard deviation of the margin against confusing four spheres"] = (
        None
    )
    layout_depth_mm: Annotated[Mm, "depth of the layout across its best plane"] = None
    layout_gap_deg: Annotated[Deg, "largest angle around the centre of the scene without a sphere"] = None
    layout_problems: Annotated[Count, "findings about the layout that fall short of what is required"] = None


class SphereMeasures(LayoutMeasures):
    """The measures of the spheres in a mesh, and of how they moved since an earlier one."""

    spheres_found: Annotated[Count, "spheres found in the mesh"] = None
    radius_residual_max_mm: Annotated[
        float | None, Measure("mm", 1e-3, 5), "largest difference between a fitted radius and the nominal one"
    ] = None
    sphere_radius_mm: Annotated[
        float | None,
        Measure("mm", 1e-3, 5),
        "radius of the spheres by the mesh, in the mean: another than theirs means a wrong scale or a coat",
    ] = None
    sphere_rms_max_mm: Annotated[
        float | None, Measure("mm", 1e-3, 5), "largest rms distance of the mesh's vertices from their sphere"
    ] = None
    sphere_sigma_max_mm: Annotated[
        float | None,
        Measure("mm", 1e-4, 5),
        "largest standard deviation of a sphere's centre (root of the trace of its covariance)",
    ] = None
    sphere_change_max_mm: Annotated[
        ErrorMm, "largest distance between a sphere here and in the earlier mesh, after a rigid fit"
    ] = None
    sphere_change_rms_mm: Annotated[ErrorMm, "rms distance between the spheres here and in the earlier mesh"] = None
    spheres_compared: Annotated[Count, "spheres found both here and in the earlier mesh"] = None
    spheres_moved: Annotated[Count, "spheres that moved by more than their uncertainty explains"] = None
    loop_closure_chi2: Annotated[
        Ratio,
        "chi-squared per degree of freedom of the spheres that did not move: near 1 if the covariances are right",
    ] = None
    sphere_scale_percent: Annotated[
        float | None,
        Measure("%", -15, 15),
        "by how much distances between spheres are larger here than in the earlier mesh: one of two scanners may err",
    ] = None
    sphere_scale_sigma_percent: Annotated[
        float | None,
        Measure("%", 1e-4, 5),
        "standard deviation of the difference in scale between here and the earlier mesh",
    ] = None


class CaptureMeasures(MeasureRecord):
    """The measures of a capture by the robot."""

    viewpoints_planned: Annotated[Count, "viewpoints that the step was to take"] = None
    viewpoints_captured: Annotated[Count, "viewpoints with a valid image"] = None
    viewpoints_given_up: Annotated[Count, "viewpoints that could not be taken"] = None
    settings_departures: Annotated[Count, "images with other settings than the protocol's"] = None
    moved_during_exposure: Annotated[Count, "images during which the arm did not stand still"] = None
    optics_departures: Annotated[Count, "images whose zoom, focus or lens differs from the calibrated one"] = None


class PredictedMeasures(MeasureRecord):
    """The registration's accuracy and coverage, predicted by a capture before it is computed."""

    predicted_target_error_mm: Annotated[
        ErrorMm, "predicted error of the registration at the worst point of the specimen"
    ] = None
    specimen_coverage: Annotated[Share, "share of the specimen's surface that enough images see well"] = None
